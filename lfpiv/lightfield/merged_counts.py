"""Find a tone curve by how many of a sensor's counts share a stored value.

A table from 12 to 8 bits merges neighbouring counts. Through a straight line each stored value takes equally many of
them, or two numbers in turn, at a constant period. Through a curve the period changes with the level: value ``k``
takes the whole numbers between ``x(k)`` and ``x(k + 1)``, whose distance grows. Light is spread smoothly, so the
number of pixels of a value, over the smooth course of its neighbours, shows the number of counts.

In a window of some values ``x`` is a cubic: its slope is the number of counts per value, and its curvature
is zero where counts are proportional to light. Both are fitted by trial, once with curvature and once without.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike

MOST_VALUES = 256
"""Largest number of stored values: 8 bits. With more of them a curve leaves gaps, or moves slowly."""

_FIRST, _WIDTHS, _STRIDE = 24, (24, 30, 36), 6  # values of a window, as it grows; distance of windows
_MEAN_PIXELS, _LEAST_PIXELS = 400, 20  # mean and least number of pixels of a window's values
_UNEVEN = 3.0  # least variance of the pixels of a window [variance by chance]
_LIKE_FIRST, _LIKE, _LIKE_SHARE = 0.8, 0.8, 0.9  # least correlation, also in the largest one that chance allows
_BETTER = 0.25  # least lead over the best straight line
_EXPONENTS = (1.3, 4.0)  # of real curves
_CURVATURES = (0.02, 0.25)  # of tables of 10 to 12 bits [counts]
_DEGREES = (4, 5)  # of the smooth course, in a window of the first width, and a larger one
_STEP = np.array([0.12, 0.03, 0.003, 0.0008])  # first step of phase, slope, curvature, and its slope
_SHRINK = (1.0, 0.5, 0.25, 0.5, 0.25)  # of the steps


def merged_exponent(pixels: np.ndarray) -> float:
    """Fit the exponent gamma of a curve ``I' ~ I**(1 / gamma)`` by which counts were merged.

    Parameters
    ----------
    pixels : ndarray, shape (values,)
        Number of pixels of each stored value from 0 on.

    Returns
    -------
    float
        1 where no curve shows, or where there are more than `MOST_VALUES` values.
    """
    if len(pixels) > MOST_VALUES:
        return 1.0
    found = [
        exponent
        for start in range(0, len(pixels) - _WIDTHS[-1] + 1, _STRIDE)
        if (exponent := _exponent(pixels, start + (_WIDTHS[-1] - _FIRST) // 2)) is not None
    ]
    return float(np.median(found)) if found else 1.0


class _Window:
    """Pixels of the values of a window, over their smooth course [standard deviations by chance]."""

    def __init__(self, pixels: np.ndarray, middle: int, width: int):
        self.width = width
        here = np.maximum(pixels[middle - width // 2 : middle + width // 2].astype(float), 1)
        place = np.linspace(-1, 1, width)
        smooth = np.polynomial.chebyshev.chebvander(place, _DEGREES[width > _FIRST])
        logarithm, *_ = np.linalg.lstsq(smooth * here[:, None] ** 0.5, np.log(here) * here**0.5, rcond=None)
        course = np.exp(smooth @ logarithm)
        self.weight = course**0.5
        every_other = (-1.0) ** np.arange(width)  # halves that are rounded to even values
        self._away = np.linalg.qr(np.column_stack([smooth, every_other]) * self.weight[:, None])[0]
        self.rest = self._without_course((here / course - 1) * self.weight)
        self.unevenness = float(self.rest @ self.rest) / (width - self._away.shape[1])

    def _without_course(self, values: np.ndarray) -> np.ndarray:
        return values - (values @ self._away) @ self._away.T

    def fits(self, merged: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return correlation and factor of numbers of merged counts (n, width) with the pixels."""
        shape = self._without_course(merged * self.weight)
        square = (shape**2).sum(axis=1)
        told = square > 4e-4 * (self.weight**2).sum()
        factor = np.where(told, shape @ self.rest, 0) / np.where(told, square, 1)
        return factor * square**0.5 / max(float(np.linalg.norm(self.rest)), 1e-9), factor

    def refine(self, cubic: np.ndarray, free: int) -> tuple[np.ndarray, float, float]:
        """Vary the first `free` coefficients of a cubic; return it with its correlation and factor."""
        steps = _steps(free)
        for shrink in _SHRINK:
            tried = cubic[:, None] + shrink * steps
            tried[2] = np.maximum(tried[2], 0)
            like, factor = self.fits(_merged(tried, self.width))
            best = int(like.argmax())
            cubic = tried[:, best]
        return cubic, float(like[best]), float(factor[best])


def _exponent(pixels: np.ndarray, start: int) -> float | None:
    """Return the exponent of the curve in the window from `start` on; None where it is not told."""
    here = pixels[start : start + _FIRST]
    if here.mean() < _MEAN_PIXELS or here.min() < _LEAST_PIXELS:
        return None
    middle = start + _FIRST // 2
    window = _Window(pixels, middle, _FIRST)
    if window.unevenness < _UNEVEN:
        return None
    trials, merged = _trials()
    like, _ = window.fits(merged)
    if like.max() < _LIKE_FIRST:
        return None
    curved = trials[:, int(like.argmax())]
    for width in _WIDTHS:
        window = _Window(pixels, middle, width)
        curved, likeness, factor = window.refine(curved, 4)
    least = max(_LIKE, _LIKE_SHARE * max(0.0, 1 - 1 / max(window.unevenness, 1e-9)) ** 0.5)
    if window.unevenness < _UNEVEN or likeness < least or curved[2] < _CURVATURES[0]:
        return None
    if likeness - _straight(window, curved) < _BETTER:
        return None
    slope = max(round(1 / factor - curved[1]) + curved[1], 0.3)  # its whole part is in the factor alone
    exponent = 1 + curved[2] * (middle - 0.5) / slope
    return float(exponent) if _EXPONENTS[0] < exponent < _EXPONENTS[1] else None


def _straight(window: _Window, curved: np.ndarray) -> float:
    """Return the correlation of the best straight line."""
    trials = _grid(np.arange(32) / 32, np.arange(288) / 288, [0.0])
    like, _ = window.fits(_merged(trials, window.width))
    begins = (trials[:, int(like.argmax())], curved * (1, 1, 0, 0))
    return max(window.refine(begin, 2)[1] for begin in begins)


def _merged(cubics: np.ndarray, width: int) -> np.ndarray:
    """Return the counts that each value takes, less the slope; cubics of shape (4, n), the result (n, width)."""
    edge = np.arange(width + 1) - width / 2
    powers = np.stack([np.ones_like(edge), edge, edge**2 / 2, edge**3 / 6])
    reached = (cubics.T @ powers).astype(np.float32) % 1
    return reached[:, :-1] - reached[:, 1:]


@functools.cache
def _trials() -> tuple[np.ndarray, np.ndarray]:
    """Return cubics of every phase, slope and curvature, and their merged counts in the first window."""
    cubics = _grid(np.arange(8) / 8, np.arange(32) / 32, np.arange(0, _CURVATURES[1], 0.003))
    return cubics, _merged(cubics, _FIRST)


@functools.cache
def _steps(free: int) -> np.ndarray:
    """Return the first steps of a cubic, of which the first `free` coefficients vary, shape (4, n)."""
    units = np.linspace(-1, 1, 5)
    varied = np.meshgrid(*[units] * free, *[[0.0]] * (4 - free), indexing="ij")
    return _STEP[:, None] * np.stack(varied).reshape(4, -1)


def _grid(*axes: ArrayLike) -> np.ndarray:
    """Return all combinations of phase, slope and curvature as cubics, shape (4, n)."""
    three: np.ndarray = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(3, -1)
    return np.concatenate([three, np.zeros_like(three[:1])])
