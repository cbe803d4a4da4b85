"""Version of this package, and of the libraries that its numbers depend on.

The package imports this module first, so it imports nothing that takes time.
"""

from __future__ import annotations

__version__ = "0.1.0"


SOURCE = f"lfpiv {__version__}"
"""Program that a file comes from, for its attribute ``source``."""


def history(earlier: str = "") -> str:
    """Return the attribute ``history`` of a file that is written now: a line with time and program after earlier ones.

    The line has no arguments of the command: they name folders of the machine.
    """
    from datetime import datetime, timezone

    return "\n".join([*earlier.splitlines(), f"{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%SZ} {SOURCE}"])


def versions() -> dict[str, str]:
    """Return the versions of this package, of Python and of the libraries that its numbers depend on."""
    import importlib.metadata
    import platform

    names = ("numpy", "scipy", "taichi", "warp-lang", "xarray", "opencv-python-headless", "scikit-learn")
    found = {"lfpiv": __version__, "python": platform.python_version()}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
