"""Limit what an image may take: sizes that a file declares, and sizes that its compressed form grows to.

Every reader asks `require_plausible` before memory is allocated, and `require_apart` for pieces at stated places.
"""

from __future__ import annotations

from collections.abc import Iterable

LARGEST_IMAGE = 5 * 10**8
"""Largest number of pixels of an image that is decoded: twice that of the largest sensors of one exposure [pixel]."""
LARGEST_EXPANSION = 2000
"""Largest size of pixels over that of their compressed form; deflate reaches 1032, LZW about 1400."""
SMALL_IMAGE = 1 << 26
"""Size of pixels that may be decoded from a compressed form of any size [byte]."""


def require_plausible(shape: tuple[int, ...], item_bytes: int, stored_bytes: int) -> None:
    """Refuse an image whose declared size its stored bytes cannot hold, before memory is allocated for it.

    Parameters
    ----------
    shape : tuple of int
        Declared shape [pixel].
    item_bytes : int
        Size of a pixel [byte].
    stored_bytes : int
        Size of its compressed form in the file [byte].

    Raises
    ------
    ValueError
        If it has more than `LARGEST_IMAGE` pixels, or expands by more than `LARGEST_EXPANSION`.
    """
    pixels = 1
    for size in shape:
        pixels *= int(size)
    if pixels <= 0 or pixels > LARGEST_IMAGE:
        declared = " x ".join(str(size) for size in shape)
        raise ValueError(f"it declares {declared} pixels of at most {LARGEST_IMAGE:,}")
    if pixels * item_bytes > SMALL_IMAGE + LARGEST_EXPANSION * stored_bytes:
        raise ValueError(f"{stored_bytes} stored bytes cannot hold the {pixels} pixels that the header declares")


def require_apart(places: Iterable[tuple[int, int]], file_bytes: int) -> None:
    """Refuse pieces of an image that share bytes of the file, or end beyond it.

    Parameters
    ----------
    places : iterable of (int, int)
        First byte and number of bytes of each piece.
    file_bytes : int
        Size of the file [byte].

    Raises
    ------
    ValueError
        If two pieces overlap, or there is none, or one ends beyond the file.
    """
    end = 0
    for start, length in sorted(places):
        if start < end:
            raise ValueError(f"two parts of the pixels share the bytes from {start} to {end}")
        end = start + length
    if end == 0 or end > file_bytes:
        raise ValueError(f"pixel data end at byte {end}, the file at byte {file_bytes}")
