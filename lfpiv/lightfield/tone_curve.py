"""Find a gamma curve, or another tone curve, by the counts that an image never holds, or that share a value.

A sensor's counts are proportional to light, and all counts between the darkest pixels and the particles occur. A curve
that brightens dark pixels moves neighbouring counts apart, the more the darker they are, and leaves the values between
them empty. With ``I' ~ I**(1 / gamma)`` the distance of neighbours goes with ``I'**(1 - gamma)``. Where a curve leads
to fewer bits, values are not empty, but take unlike numbers of counts (`lfpiv.lightfield.merged_counts`).
"""

from __future__ import annotations

import numpy as np

from lfpiv.lightfield.merged_counts import merged_exponent

CURVED = 1.3
"""Exponent of a gamma curve above which an image is not proportional to light."""

_LEAST_PIXELS = 20  # least number of pixels of a value: rarer values may lack neighbours by chance
_LEAST_STEPS = 6  # least number of distances between values
_APART = 1.5  # least distance of neighbours that the curve moved apart, in the smallest distance of all values
_MOST = 65535  # largest count that is looked at
_SURE = 5.0  # least distance of the exponent from 1 [standard errors]


def tone_exponent(image: np.ndarray) -> float:
    """Fit the exponent gamma of the curve between light and counts, ``I' ~ I**(1 / gamma)``.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Image as recorded [counts].

    Returns
    -------
    float
        1 where no curve shows, or where counts are no whole numbers from 0 to 65535.
    """
    whole = image.astype(np.int64)
    if whole.min() < 0 or whole.max() > _MOST or not np.array_equal(whole, image):
        return 1.0
    pixels = np.bincount(whole.ravel())
    exponent = _exponent_by_gaps(pixels)
    if exponent > 1:
        return exponent
    unit = int(np.gcd.reduce(np.flatnonzero(pixels)))
    return merged_exponent(pixels[:: max(unit, 1)])


def _exponent_by_gaps(pixels: np.ndarray) -> float:
    """Return the exponent by the values that never occur, from the number of pixels of each value."""
    values = np.flatnonzero(pixels)
    steps, count = np.diff(values), pixels[values]
    if not steps.size:
        return 1.0
    frequent = np.minimum(count[1:], count[:-1]) >= _LEAST_PIXELS
    first = int(np.argmax(frequent))  # some dead pixels may be darker
    apart = frequent & (steps >= _APART * steps.min())
    number = int(np.argmin(np.append(apart[first:], False)))
    levels = (values[1:] + values[:-1])[first : first + number] / 2
    if number < _LEAST_STEPS or levels[0] <= 0:
        return 1.0
    (slope, _), spread = np.polyfit(np.log(levels), np.log(steps[first : first + number]), 1, cov=True)
    exponent = 1 - float(slope)
    sure = exponent - 1 > _SURE * float(np.sqrt(spread[0, 0]))
    return exponent if sure else 1.0
