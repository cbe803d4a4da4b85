"""C++ sources of the Warp kernels, package data beside this file, and the function that reads them."""

from pathlib import Path

_FOLDER = Path(__file__).parent


def read_native(name: str) -> str:
    """Return the text of a source file of this folder, after an empty line."""
    return "\n" + (_FOLDER / name).read_text(encoding="utf-8")
