"""Whether two volumes show the same particles, although neighbouring vectors do not confirm each other.

The windows of the same particles correlate better than by chance. Chance is measured with the second volume mirrored
along each set of axes, which keeps its particles and moves them to other places.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from lfpiv.velocity.multi_pass import UndeformedPair
from lfpiv.velocity.settings import Triple
from lfpiv.velocity.windows import Windows
from lfpiv_kernels.correlation.correlate import correlate_windows
from lfpiv_kernels.transfer import to_host

CLEAR = 5.0
"""Least excess of the mean coefficient over its mean by chance [standard deviations of chance]."""
OVERLAP = 0.5
"""Part of a window that its neighbour shares."""


def in_common(pair: UndeformedPair, window: Triple, search: Triple) -> bool:
    """Return whether windows of two volumes clearly correlate better than by chance.

    Parameters
    ----------
    pair : UndeformedPair
        The volumes without background.
    window, search : tuple of int
        Edges of a window, and largest lag, order (z, y, x) [voxel].
    """
    volumes, _ = pair.given(window)
    first, second = (to_host(volume) for volume in volumes)
    step = Windows.overlapping(first.shape, window, OVERLAP).step

    def mean_peak(other: np.ndarray) -> float:
        found = correlate_windows(first, np.ascontiguousarray(other), window=window, step=step, search=search)
        return float(np.nan_to_num(found.correlation).mean())

    seen, *chance = (mean_peak(second[mirror]) for mirror in product((slice(None), slice(None, None, -1)), repeat=3))
    return seen - float(np.mean(chance)) > CLEAR * float(np.std(chance, ddof=1)) > 0
