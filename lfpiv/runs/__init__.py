"""One run of an experiment: its steps in order, pair by pair, in one process or in several."""
