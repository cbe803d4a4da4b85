"""Kernels of lfpiv, arrays in and arrays out: Taichi traces and counts rays, Warp weights, projects and correlates."""

import os

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # Taichi prints a banner on import otherwise
