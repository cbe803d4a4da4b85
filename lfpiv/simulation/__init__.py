"""Simulated experiments with known truth: particles, flows, cameras and their images."""
