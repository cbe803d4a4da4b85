"""Velocity vectors from pairs of volumes by 3D cross-correlation, and the fields computed from them."""
