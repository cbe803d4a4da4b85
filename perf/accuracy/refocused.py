"""Refocused stacks: what users of a single plenoptic camera correlate.

A refocused image is the sum of a camera's sub-aperture images, each shifted so that points at one depth coincide [1]_.
Here the shift comes from the camera's mapping: voxel x gets the mean, over points u of the pupil, of the light that the
ray from x through u brings to the microlens array, interpolated between the lenses. Particles out of focus remain as
haze, of which the mean around each voxel is subtracted. The stacks of several cameras are combined by their product or
minimum, as in synthetic aperture imaging [2]_.

References
----------
.. [1] R. Ng et al., "Light field photography with a hand-held plenoptic camera", Stanford CTSR 2005-02.
.. [2] J. Belden et al., "Three-dimensional synthetic aperture particle image velocimetry", Meas. Sci. Technol.
       21 (2010) 125403, doi:10.1088/0957-0233/21/12/125403.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from scipy import ndimage

from lfpiv.calibration.camera import CalibratedCamera, Calibration
from lfpiv.geometry.grid import Grid

PUPIL_SHARE = 0.9
"""Radius of the used part of the pupil [pupil radius]; pixels at its edge see little of it."""
HAZE_VOXEL = 2.0
"""Standard deviation of the Gaussian that gives the haze around a voxel [voxel]. Of 0, 2 and 3 it measured best."""
LEAST_SEEN = 0.5
"""Least part of the rays of a voxel that the sensor must record."""
COMBINE = ("product", "minimum", "mean")


def refocus(camera: CalibratedCamera, light: np.ndarray, grid: Grid) -> np.ndarray:
    """Return the refocused stack of one camera on the voxels of a grid.

    Parameters
    ----------
    camera : CalibratedCamera
        The camera.
    light : ndarray, shape (rows, columns)
        Image above its dark level [count].
    grid : Grid
        Voxels.

    Returns
    -------
    ndarray, shape (z, y, x)
        Mean light of the rays of a voxel, relative to the white image's. 0 where the camera does not see it.
    """
    lenses = camera.decoder.lens_grid()
    total, count = np.zeros(grid.size), np.zeros(grid.size)
    for pupil, at in zip(_pupil_points(camera), _places(camera, grid), strict=True):
        values = camera.decoder.sample(light.astype(np.float32), lenses, pupil)
        seen = np.isfinite(values)
        total += ndimage.map_coordinates(np.where(seen, values, 0.0), at, order=1, prefilter=False)
        count += ndimage.map_coordinates(seen.astype(np.float32), at, order=1, prefilter=False)
    least = LEAST_SEEN * len(_pupil_points(camera))
    return np.divide(total, count, out=np.zeros(grid.size), where=count > least).reshape(grid.shape)


def refocused_volume(
    calibration: Calibration, light: Mapping[str, np.ndarray], grid: Grid, combine: str = "product"
) -> np.ndarray:
    """Return the refocused stacks of all cameras without haze, combined, shape (z, y, x), float32.

    `combine` is "product" (the geometric mean), "minimum" or "mean" of the stacks, each scaled to a mean of 1. Light
    below zero is taken as zero.
    """
    if combine not in COMBINE:
        raise ValueError(f"combine: expected one of {', '.join(COMBINE)}, got {combine!r}.")
    stacks = [refocus(camera, light[name], grid) for name, camera in calibration.cameras.items()]
    stacks = [np.maximum(stack - ndimage.gaussian_filter(stack, HAZE_VOXEL), 0) for stack in stacks]
    scaled = np.stack([stack / stack.mean() for stack in stacks])
    if combine == "product":
        return (scaled.prod(0) ** (1 / len(scaled))).astype(np.float32)
    return (scaled.min(0) if combine == "minimum" else scaled.mean(0)).astype(np.float32)


def _pupil_points(camera: CalibratedCamera) -> np.ndarray:
    """Return points on a square lattice over the pupil, as far apart as pixels, shape (k, 2) [mm]."""
    radius, step = PUPIL_SHARE * camera.optics.pupil_radius_mm, camera.optics.pupil_pixel_mm
    along = step * np.arange(-int(radius / step), int(radius / step) + 1)
    points = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)
    return points[np.hypot(*points.T) <= radius]


@lru_cache(maxsize=4)
def _places(camera: CalibratedCamera, grid: Grid) -> np.ndarray:
    """Return where the rays of the voxels through the pupil points meet the array, shape (k, 2, voxel) [lens].

    The numbers are indices into the arrays of `LightFieldDecoder.lens_grid`.
    """
    first = camera.decoder.lens_grid()[0, 0]
    inverse = np.linalg.inv(np.asarray(camera.lattice.basis_mm))
    points = grid.centres_mm()
    places = []
    for pupil in _pupil_points(camera):
        array = camera.map(points, np.broadcast_to(pupil, (len(points), 2)))
        places.append(((array - camera.lattice.origin_mm) @ inverse - first).T.astype(np.float32))
    return np.stack(places)
