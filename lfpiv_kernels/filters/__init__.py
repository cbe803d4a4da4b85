"""Separable filters of volumes: Gaussian blurs, coefficients of splines (Warp)."""
