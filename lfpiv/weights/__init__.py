"""Weights of voxels in pixels (Eq. 10): the operator from volumes to images and its adjoint."""
