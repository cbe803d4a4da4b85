"""Tables of the experiment file: every key with its range, its default and one sentence."""
