"""Find saturated pixels of an image, by the value at which its pixels pile up.

Many cameras clip below the end of a range of bits: at the white level of their header, less a dark level, or behind a
look-up table. Clipped pixels share one value, and the values just below are rare. Hot pixels may lie above.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

SATURATED = 0.02
"""Part of the bright pixels that is saturated above which an image is saturated."""

_LEAST_SATURATED = 20  # least number of saturated pixels
_WIDTHS = (0.0, 0.005)  # width of a pile over its level: one value, or values spread by a camera's own corrections
_LEAST_SPREAD = 200  # least number of pixels of a spread pile, and of one of the last value
_LEAST_WIDTH = 3.0  # least width of such a pile [counts]: of few bits a single value is as wide
_BELOW = 0.1  # depth below the bright pixels in which a pile is compared, too: half of a white image may be as bright
_NEIGHBOURS = 3  # values, or intervals, below a pile that it is compared with
_PILE = 4.0  # pixels of a pile, relative to each of them
_ABOVE = 0.25  # pixels above a pile, such as hot ones, relative to the pile: at most
_LAST, _ABOVE_LAST = 1.2, 0.02  # the same two of the last value: of few bits, noise fills the values below a pile
_LEAST_AREAS = 5  # least number of separate areas in a pile: fewer may be a bright particle of even light
_ISOLATED = 0.2  # part of a pile's pixels with a bright neighbour: at least, or they are hot pixels
_SAMPLES = 100_000  # pixels that tell which ones are bright
_BRIGHT_PERCENTILE = 99.9  # percentile above whose half pixels are bright
_RANGES = {(1 << bits) - 1 << shift for bits in range(8, 17) for shift in (0, 16 - bits)}  # right- and left-justified


def saturation_level(image: np.ndarray, white_level: float | None, *, piles: bool = True) -> float:
    """Return the value from which on pixels are saturated [counts]; infinite if none is.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Image as recorded [counts].
    white_level : float, optional
        Value from which on pixels are saturated, where it is known [counts].
    piles : bool
        Look for a pile below the end of a range of bits. An evenly lit image without noise has one by nature.
    """
    top = float(image.max())
    levels = [pile for width in _WIDTHS if piles and np.isfinite(pile := _pile(image, width))][:1]
    if top.is_integer() and int(top) in _RANGES:
        levels.append(top)
    if white_level is not None and top >= white_level:
        levels.append(white_level)
    return min(levels, default=np.inf)


def saturated_share(image: np.ndarray, white_level: float | None = None, *, piles: bool = True) -> float:
    """Return the number of saturated pixels relative to those above half of their level.

    The result is 0 where few pixels are saturated, or isolated ones: hot pixels. Parameters as for `saturation_level`.
    """
    level = saturation_level(image, white_level, piles=piles)
    clipped = image >= level
    count = np.count_nonzero(clipped)
    if count < _LEAST_SATURATED or _share_in_light(image, clipped, level) < _ISOLATED:
        return 0.0
    return count / np.count_nonzero(image > level / 2)


def saturated_pixels(image: np.ndarray, white_level: float | None = None) -> np.ndarray:
    """Return the saturated pixels, bool. Parameters as for `saturation_level`."""
    return image >= saturation_level(image, white_level)


def _pile(image: np.ndarray, width: float) -> float:
    """Return the least value of the highest pile of pixels, at most `width` times its level wide; infinite for none."""
    flat = image.ravel()
    sample = flat[:: 1 + flat.size // _SAMPLES]
    median, high = np.percentile(sample, (50, _BRIGHT_PERCENTILE))
    least = (median + high) / 2
    bright = np.sort(flat[flat > (1 - _BELOW) * least])
    values, first, count = np.unique(bright, return_index=True, return_counts=True)
    above = len(bright) - first - count
    if width:
        edges = values[:, None] * (1 - width * np.arange(_NEIGHBOURS + 2))
        after = np.searchsorted(bright, edges, side="right")
        windows = after[:, :-1] - after[:, 1:]
        count, below = windows[:, 0], windows[:, 1:].max(axis=1, initial=0)
    else:
        padded = np.concatenate([np.zeros(_NEIGHBOURS, int), count])
        below = np.max([padded[shift : shift + len(count)] for shift in range(_NEIGHBOURS)], axis=0)
    enough = (count >= _LEAST_SPREAD) & (width * values >= _LEAST_WIDTH) if width else count >= _LEAST_SATURATED
    piled = enough & (count > _PILE * below) & (above <= _ABOVE * count)
    if not width:
        piled |= (count >= _LEAST_SPREAD) & (count > _LAST * below) & (above <= _ABOVE_LAST * count)
    piles = np.flatnonzero((values >= least) & piled)
    if not piles.size:
        return np.inf
    level = float(values[piles[np.argmax(count[piles])]]) * (1 - width)
    areas = ndimage.label(image >= level)[1]
    return level if areas >= _LEAST_AREAS else np.inf


def _share_in_light(image: np.ndarray, clipped: np.ndarray, level: float) -> float:
    """Return the part of the clipped pixels that have a neighbour brighter than half of their level."""
    rows, columns = np.nonzero(clipped)
    lit = np.zeros(len(rows), bool)
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        near = np.clip(rows + down, 0, image.shape[0] - 1), np.clip(columns + right, 0, image.shape[1] - 1)
        lit |= (image[near] > level / 2) & ((near[0] != rows) | (near[1] != columns))
    return float(lit.mean())
