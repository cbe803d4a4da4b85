"""Cameras calibrated from images of a dot board: the mapping of rays to the microlens array."""
