"""Rays through the calibrated mapping, and rays counted per pixel (Taichi)."""
