"""Find images whose pixels are not what the camera recorded.

Bytes are exchanged, a low byte is noise, numbers below zero became large ones, or rows are of two exposures in turn.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

ALIKE = 0.3
"""Bytes may be swapped where neighbouring pixels correlate by more than this once the bytes are exchanged."""
UNLIKE = 1.5
"""They are swapped where the exchange divides 1 - correlation by more than this."""
LARGEST_SHARE = 0.5
"""A byte that is the same in a larger share of the lit pixels is no low byte, because noise varies a low byte."""
ONE_HIGH_BYTE = 0.8
"""Share of the pixels with one high byte among which the low byte is judged."""
EVEN = 0.8
"""Least of the counts of low bytes, relative to the largest, of noise."""
END = 1 / 32
"""Part of the range at either end in which noise about zero lies where numbers below zero are stored without a sign."""
BELOW_ZERO = 0.01
"""Least share of the pixels at the upper end that are such numbers; hot pixels are fewer."""
LEAST_ZERO, MOST_BETWEEN = 0.25, 0.25
"""Least share of their neighbours at the lower end, and largest share between both ends, as at edges of light."""
INTERLACED = 1.1
"""Ratio above which rows are of two exposures; sound images give at most 1.01.

It compares what correlations of rows lack from 1: rows one or three apart, over rows two apart.
"""

_PIXELS = 300_000  # pixels that are compared, at most about
_BINS = 16  # bins of the low byte
_LEAST_PIXELS = 5000  # least number of pixels with one high byte
_TWO_BYTES = 1 << 16


def fault(image: np.ndarray) -> str | None:
    """Return what is wrong with the bytes of an image, with the remedy; None for nothing.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Grey values as read [counts].
    """
    rows = image[:: 1 + image.size // _PIXELS]
    low, high = float(rows.min()), float(rows.max())
    if low >= 0 and _wrapped(rows, 256 if high < 256 else _TWO_BYTES):
        return (
            "numbers below zero that became the largest ones, as when a background is subtracted from counts without a "
            "sign. Save the image as recorded, or subtract in numbers with a sign and save those"
        )
    middle = image[(len(image) - min(len(image), _PIXELS // image.shape[1])) // 2 :][: _PIXELS // image.shape[1]]
    middle = np.maximum(middle, 0)
    if (alternate := _alternate(middle.T)) and not _alternate(middle):  # microimages of 2 pixels: columns do as well
        return (
            "rows of two exposures in turn, as interlaced video has them (neighbouring rows correlate by "
            f"{alternate[0]:.2f}, every other row by {alternate[1]:.2f}). Record whole frames, without interlacing"
        )
    if not (low >= 0 and 256 <= high < _TWO_BYTES) or (rows != np.rint(rows)).any():
        return None
    pixels = rows.astype(np.uint16)
    (alike,), (exchanged,) = _likeness(pixels, (1,)), _likeness(pixels.byteswap(), (1,))
    if _varies(pixels[pixels > 0] >> 8) and exchanged > ALIKE and 1 - alike > UNLIKE * (1 - exchanged):
        return (
            f"pixels whose two bytes are exchanged (neighbours correlate by {alike:.2f}, by {exchanged:.2f} after an "
            "exchange). Save the image in the other byte order, or state byte_order in raw"
        )
    first = pixels >> 8
    chosen = pixels[first == np.bincount(first.ravel()).argmax()]
    counts = np.bincount((chosen & 255) * _BINS >> 8, minlength=_BINS)
    if chosen.size > max(_LEAST_PIXELS, ONE_HIGH_BYTE * pixels.size) and counts.min() > EVEN * counts.max():
        return "pixels whose low byte is noise: all its values are as frequent. Save the image again as recorded"
    return None


def _wrapped(rows: np.ndarray, full: int) -> bool:
    """Return whether noise about zero lies at both ends of a range of `full` values."""
    upper, lower = rows >= full * (1 - END), rows < full * END
    beside, count = upper[:, :-1], np.count_nonzero(upper[:, :-1])
    zero, same = (np.count_nonzero(beside & one[:, 1:]) for one in (lower, upper))
    return bool(
        count > BELOW_ZERO * rows.size and zero > LEAST_ZERO * count and zero + same > (1 - MOST_BETWEEN) * count
    )


def _alternate(pixels: np.ndarray) -> list[float] | None:
    """Return the correlation of pixels one and two apart along the rows if every other pixel is alike; else None."""
    beside, second, third = _likeness(pixels, (1, 2, 3))
    alternate = second > ALIKE and 1 - max(beside, third) > INTERLACED * (1 - second)
    return [beside, second] if alternate else None


def _varies(values: np.ndarray) -> bool:
    """Return whether no single value fills more than `LARGEST_SHARE` of the pixels."""
    return values.size > 0 and bool(np.bincount(values).max() <= LARGEST_SHARE * values.size)


def _likeness(pixels: np.ndarray, lags: Sequence[int]) -> list[float]:
    """Return the correlation of pixels along the rows, in logarithms, at each distance in `lags`.

    Single bright pixels, hot or points, would outweigh all others: an exchange, which wraps them, would seem right.
    """
    values = np.log1p(pixels.astype(np.float32))
    values -= values.mean()
    power = float((values**2).mean(dtype=float))
    if power == 0:
        return [0.0 for _ in lags]
    steps = [values[:, lag:] - values[:, :-lag] for lag in lags]
    return [1 - float((step**2).mean(dtype=float)) / (2 * power) if step.size else 0.0 for step in steps]
