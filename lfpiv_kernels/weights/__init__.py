"""Weights integrated over voxel, pixel and microlens (Warp)."""
