"""3D cross-correlation of windows, its peaks, and the deformation of volumes (Warp)."""
