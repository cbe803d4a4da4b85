"""Frozen geometry values in millimetres: optics of a camera, lattice of microlenses, grid of voxels."""
