"""Optics of a camera, grid of voxels, lattice of lenses: frozen values in millimetres, arrays ordered (z, y, x)."""
