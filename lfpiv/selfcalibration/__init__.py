"""Measure disparities between cameras with particles, and find the camera movements that explain them."""
