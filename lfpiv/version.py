"""Version of this package, and of the libraries that its numbers depend on."""

from __future__ import annotations

import contextlib
import importlib.metadata
import platform

__version__ = "0.1.0"


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the libraries that its numbers depend on."""
    names = ("numpy", "scipy", "taichi", "warp-lang", "xarray", "opencv-python-headless", "scikit-learn")
    found = {"lfpiv": __version__, "python": platform.python_version()}
    for name in names:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found
