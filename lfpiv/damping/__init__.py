"""Damping of the measured flow by ghosts, from simulated pairs that look like the recorded pairs."""
