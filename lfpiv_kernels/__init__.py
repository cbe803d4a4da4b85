"""Kernels of lfpiv: arrays in, arrays out. Taichi traces rays and builds weights, Warp projects and correlates."""
