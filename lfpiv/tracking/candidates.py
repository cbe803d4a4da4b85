"""Candidates for particles: peaks of a volume that SMART reconstructs from images, or from what is left of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from scipy import ndimage

from lfpiv.geometry.grid import AXES
from lfpiv.metrics.particles import find_particles
from lfpiv.reconstruction.settings import PLAIN
from lfpiv.reconstruction.volume import reconstruct
from lfpiv.tracking.refinement import Cloud
from lfpiv.weights.operator import Weights

FIRST_ITERATIONS = 25
"""SMART iterations of the volume of the whole images."""
RESIDUAL_ITERATIONS = 8
"""SMART iterations of a volume of residual images."""
LEAST_PEAK = 0.02
"""Least brightness of a peak that is looked at, as a share of the typical one."""


def typical(values: np.ndarray) -> float:
    """Return the value that half of the sum of all values exceeds: many weak ghosts hardly change it."""
    ordered = np.sort(values)[::-1]
    if not len(ordered):
        return 0.0
    return float(ordered[np.searchsorted(np.cumsum(ordered), 0.5 * ordered.sum())])


def volume_peaks(weights: Weights, volume: xr.DataArray, least_light: float | None = None) -> Cloud:
    """Return the peaks of a volume as particles whose light is that of the voxels around.

    Parameters
    ----------
    weights : Weights
        The operator. Peaks that no camera sees are left out.
    volume : DataArray, shape (z, y, x)
        Reconstruction [counts per unit weight].
    least_light : float, optional
        Least light of a particle [counts]. Default: `LEAST_PEAK` of the typical one.
    """
    values = np.where(_views(weights, volume) > 0, volume.values.astype(float), 0.0)
    threshold = 0.0 if least_light is not None else LEAST_PEAK * typical(values[values > 0])
    peaks = find_particles(volume.copy(data=values), threshold)
    around = 27 * ndimage.uniform_filter(values, 3, mode="constant")
    offset = peaks.positions_mm[:, ::-1] - [float(volume[axis][0]) for axis in volume.dims]
    index = np.rint(offset / float(volume.attrs["voxel_mm"])).astype(int)
    index = np.clip(index, 0, np.array(values.shape) - 1)
    light = around[tuple(index.T)]
    chosen = light > (LEAST_PEAK * typical(light) if least_light is None else least_light)
    every = np.repeat(light[chosen, None], len(weights.cameras), axis=1)
    return Cloud(positions_mm=peaks.positions_mm[chosen], light=every)


def _views(weights: Weights, volume: xr.DataArray) -> np.ndarray:
    """Return how many cameras see each voxel of a volume on any grid within that of the weights, shape (z, y, x)."""
    nearest = [
        np.abs(weights.grid.axis_mm(number)[:, None] - volume[axis].values).argmin(0)
        for number, axis in enumerate(AXES)
    ]
    return weights.views[np.ix_(*nearest)]


def reconstructed(
    weights: Weights, images: Mapping[str, np.ndarray], noise: Mapping[str, float], iterations: int
) -> xr.DataArray | None:
    """Reconstruct a volume from images; None if they hold no light where the volume is seen."""
    try:
        return reconstruct(weights, images, iterations, floor=dict(noise), floor_share=0.02, **PLAIN)
    except ValueError:
        return None
