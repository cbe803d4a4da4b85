"""Time after which the light of the particles in a time series is independent of what it was.

Images that follow each other closely show the same particles at nearly the same places. Their light would count as
light that stands still. The overlap of two images, the light that both have in the same pixels, falls with the time
between them to the overlap of independent particles plus what really stands. The time to fall is that after which
images are independent. Where the overlap still falls at the longest time, the series does not show it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

FEWEST_LAGS = 6
"""Least number of times between images that show whether the overlap still falls."""
SETTLED = 0.05
"""Decrease of the overlap from the middle to the last third of the times, relative to its whole, that is none."""
SIGNIFICANT = 3.0
"""Least decrease from the middle to the last third that counts [standard error]."""
INDEPENDENT = 0.2
"""Overlap beyond the final one, relative to the overlap of an image with itself, below which images are independent."""


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Return the light that two images have in common, relative to the darker one, 0 to 1.

    Parameters
    ----------
    first, second : ndarray, shape (rows, columns)
        Images without dark level [counts].
    """
    one, other = np.maximum(first, 0), np.maximum(second, 0)
    darker = min(float(one.sum(dtype=float)), float(other.sum(dtype=float)))
    return float(np.minimum(one, other).sum(dtype=float)) / darker if darker > 0 else 0.0


def independent_after(lags: Sequence[int], overlaps: Sequence[float]) -> int | None:
    """Return the time after which images are independent.

    Parameters
    ----------
    lags : sequence of int
        Times between two images, rising from above 0.
    overlaps : sequence of float
        Overlap of two images at each of these times.

    Returns
    -------
    int or None
        The first of the times at which images are independent; None where the series is too short to tell.
    """
    if len(lags) < FEWEST_LAGS:
        return None
    values = np.asarray(overlaps, float)
    third = len(values) // 3
    middle, last = values[third : len(values) - third], values[len(values) - third :]
    final = float(last.mean())
    error = np.sqrt(sum(part.var(ddof=1) / len(part) for part in (middle, last)))
    if middle.mean() - final > max(SETTLED * (1 - final), SIGNIFICANT * error):
        return None
    below = np.flatnonzero(values - final <= INDEPENDENT * (1 - final))
    return int(lags[below[0]])
