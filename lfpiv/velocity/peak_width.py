"""Reach of correlation peaks: how many lags around a peak belong to it.

A correlation peak is as wide as the particles' autocorrelation. The peak ratio compares it with the highest coefficient
elsewhere, so it must leave out the whole peak. Two lags suit particles of about a voxel. Particles that are sampled
more finely have wider peaks: their flanks would count as rivals, and no peak would be clear.
"""

from __future__ import annotations

import math

from lfpiv.velocity.settings import REFINE_SEARCH, Triple
from lfpiv_kernels.correlation import sums
from lfpiv_kernels.correlation.correlate import PEAK_REACH
from lfpiv_kernels.correlation.light import fluctuation
from lfpiv_kernels.transfer import Values, block

OWN = 0.2
"""Autocorrelation of the volumes below which a lag no longer belongs to a peak."""
LARGEST_REACH = 8
"""Largest reach [voxel]. Particles as large as that take more than a window."""
BLOCK = 24
"""Edge of the blocks in which the autocorrelation of a larger volume is taken [voxel]."""
PLACES = ((0.25, 0.25, 0.25), (0.25, 0.75, 0.75), (0.75, 0.25, 0.75), (0.75, 0.75, 0.25))
"""Places of the blocks (z, y, x) along the way that a block can go."""


def peak_reach(first: Values, second: Values, window: Triple) -> int:
    """Return the number of lags around a correlation peak that belong to it.

    It is the smallest one, from `PEAK_REACH` on, beyond which the autocorrelation of the volumes is below `OWN` along
    some axis. The axis with the narrowest peak counts: lines of sight stretch particles along the others.

    Parameters
    ----------
    first, second : array, shape (z, y, x), float32
        Volumes as they are correlated.
    window : (int, int, int)
        Last window (z, y, x) [voxel]. The mean over it is subtracted: light that varies slowly is no particle.
    """
    for given in (_blocks(first), [first, second]):
        fluctuations = [fluctuation(volume, window) for volume in given]
        power = sums.power(fluctuations)
        if power > 0:
            break
    else:
        return PEAK_REACH
    shape = fluctuations[0].shape
    for reach in range(PEAK_REACH, LARGEST_REACH):
        axes = [axis for axis in range(3) if shape[axis] > 2 * (reach + 1)]
        if not axes or min(sums.lag_products(fluctuations, reach + 1, axes)) < OWN * power:
            return reach
    return LARGEST_REACH


def _blocks(volume: Values) -> list[Values]:
    """Return a volume, or blocks of a large volume: particles are as wide elsewhere, and in the other volume."""
    edges = [min(n, BLOCK) for n in volume.shape]
    if len(PLACES) * math.prod(edges) >= math.prod(volume.shape):
        return [volume]
    starts = [
        [round(at * (n - edge)) for at, n, edge in zip(place, volume.shape, edges, strict=True)] for place in PLACES
    ]
    parts = [tuple(slice(a, a + edge) for a, edge in zip(start, edges, strict=True)) for start in starts]
    return [block(volume, part) for part in parts]


def refine_search(reach: int) -> Triple:
    """Return the largest lag of a pass after the first [voxel]: as far beyond the peak as for the least reach."""
    lag = math.ceil(REFINE_SEARCH * reach / PEAK_REACH)
    return lag, lag, lag
