"""Particles: found and refined on the raw images, linked between frames, joined to tracks."""
