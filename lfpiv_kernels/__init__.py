"""Kernels of lfpiv, arrays in and arrays out: Taichi traces and counts rays, Warp weights, projects and correlates."""

import os
import tempfile

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # Taichi prints a banner on import otherwise
os.environ.setdefault("TI_ENABLE_PYBUF", "0")  # for prints of kernels, which have none; Taichi logs that it uses it
if not {"HOME", "XDG_CACHE_HOME"} & set(os.environ):
    home = os.path.expanduser("~")  # Taichi aborts the process on import where neither variable is set
    os.environ["HOME"] = home if os.path.isabs(home) else tempfile.gettempdir()
