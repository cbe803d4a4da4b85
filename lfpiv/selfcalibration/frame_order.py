"""Order of frames: what the frames of each camera alone say about which of them is first.

The volumes of a single camera show every particle, elongated along the line of sight. Those of its two frames correlate
at the displacement of the particles. Two cameras see the same displacement across both lines of sight. Where its signs
are opposite, one camera's frames are exchanged. This shows in dense seeding, too, where a volume explains images in any
order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from lfpiv.calibration.camera import CalibratedCamera
from lfpiv.geometry.grid import Grid
from lfpiv.selfcalibration.disparity import FIT_REACH, cut_into_windows, fit_peak, slant
from lfpiv.selfcalibration.masked_correlation import masked_correlation, mirrored_window

REACH_VOXEL = 8
"""Largest displacement of particles along each axis that is sought [voxel]."""
CLEAR = 1.2
"""Least ratio of a peak to the highest coefficient with the second volume reflected, which is due to chance."""
FEWEST_WINDOWS = 4
"""Least number of windows in which both cameras show the displacement."""
MOVING_VOXEL = 0.25
"""Least displacement across the lines of sight that tells the order of frames, a median [voxel]."""
DECIDED = 3.0
"""Least ratio of the medians of differences and sums of two cameras' displacements."""

Motion = Mapping[str, np.ndarray]
"""Camera -> displacement (x, y, z) at which its volumes correlate best, shape (window, 3) [voxel]. Along its line of
sight it says nothing. nan in windows without a clear peak."""


def own_motion(volumes: Mapping[str, Sequence[np.ndarray]], grid: Grid) -> Motion:
    """Measure the displacement between the two volumes of each camera, of `CameraVolumes.own`."""
    windows = cut_into_windows(grid)
    return {
        name: np.array([_displacement(first, second, window) for window in windows])
        for name, (first, second) in volumes.items()
    }


def exchanged(motions: Sequence[Motion], cameras: Mapping[str, CalibratedCamera], grid: Grid) -> tuple[str, ...]:
    """Return the camera whose particles move opposite to every other camera's; both of two cameras.

    Empty where the order is right, or is not told.
    """
    joined = {name: np.concatenate([one[name] for one in motions]) for name in cameras}
    opposite = [
        (one, other)
        for one, other in combinations(cameras, 2)
        if _opposite(joined[one], joined[other], slant([cameras[one], cameras[other]], grid))
    ]
    if not opposite or len(cameras) == 2:
        return tuple(cameras) if opposite else ()
    alone = [name for name in cameras if all(name in pair for pair in opposite)]
    return tuple(alone) if len(opposite) > 1 and len(alone) == 1 else ()


def _opposite(first: np.ndarray, second: np.ndarray, slanted: np.ndarray) -> bool:
    """Return whether displacements of two cameras across their lines of sight have opposite signs."""
    across = np.linalg.eigh(slanted)[1][:, 0]
    one, two = first @ across, second @ across
    both = np.isfinite(one) & np.isfinite(two)
    if np.count_nonzero(both) < FEWEST_WINDOWS:
        return False
    apart, together = (float(np.median(np.abs(one[both] + sign * two[both]))) for sign in (-1, 1))
    return apart > max(2 * MOVING_VOXEL, DECIDED * together)


def _displacement(first: np.ndarray, second: np.ndarray, window: tuple[slice, ...]) -> np.ndarray:
    """Return the displacement (x, y, z) at which a window of two volumes correlates best; nan without a clear peak."""
    reach = REACH_VOXEL + FIT_REACH
    coefficient = masked_correlation([first], [second], window, reach=reach)
    reflected = mirrored_window(window, first.shape, (0, 1, 2))  # a reflection about a point keeps lines of sight
    rival = masked_correlation([first], [np.flip(second)], reflected, reach=reach)
    place = np.unravel_index(int(coefficient.argmax()), coefficient.shape)
    inside = all(FIT_REACH <= i < n - FIT_REACH for i, n in zip(place, coefficient.shape, strict=True))
    if not inside or not coefficient[place] >= CLEAR * rival.max():
        return np.full(3, np.nan)
    fitted = fit_peak(coefficient[tuple(slice(i - FIT_REACH, i + FIT_REACH + 1) for i in place)])
    if fitted is None:
        return np.full(3, np.nan)
    found: np.ndarray = np.array(place)[::-1] - reach + fitted[0]
    return found
