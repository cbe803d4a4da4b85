"""`reconstruct`: a particle volume from the cameras' images by SMART, Eq. 5 of the paper (docs/conventions.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.reconstruction.settings import DEFAULTS, SmartSettings
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.weights.operator import Weights


def reconstruct(
    weights: Weights,
    images: Mapping[str, np.ndarray],
    iterations: int = DEFAULTS.iterations,
    *,
    floor: float | Mapping[str, float] | None = None,
    first: np.ndarray | None = None,
    mask: np.ndarray | xr.DataArray | None = None,
    progress: Callable[[float], None] | None = None,
    **smart: Any,
) -> xr.DataArray:
    """Reconstruct a particle volume from the cameras' images by SMART.

    With E the volume, w the weights, I the images, P = sum w E their projection and b the noise floor, one iteration is

    - "column" (default): ``E *= exp(mu sum_i w log((I + b) / (P + b)) / sum_i w)``;
    - "paper": Eq. 5, ``E *= exp(mu sum_i w log((I + b) / (P + b)) / N_i)``, w scaled to a largest weight of 1.

    For mu <= 1 the first lowers the misfit in every iteration. Momentum (`lfpiv.reconstruction.momentum`) reaches the
    same misfit in at most half the iterations; the misfit still falls in every one, and the limit is the same. The
    first guess is ``exp(sum_i w log(I + b) / sum_i w)``, less the floor's own share, scaled to the images' light.

    For many frames make one `lfpiv.reconstruction.solver.SmartSolver`. `lfpiv.measure_pair` adds what a run does
    besides: guard layers, finer voxels, light that stands still.

    Parameters
    ----------
    weights : Weights
        The operator. Threads that share it wait for each other. `progress` may not project with it.
    images : mapping of str to ndarray
        Camera name -> image, shape (rows, columns) [counts], background subtracted. Negative counts are taken as zero.
        Pixels that no voxel lights are left out. Differences of the cameras' brightness are measured and corrected
        (`lfpiv.reconstruction.image_preparation`).
    iterations : int
        Largest number of iterations, >= 0.
    floor : float or mapping of str to float, optional
        Noise floor b [counts], added to images and projections: without it one dark pixel would make a voxel dark.
        Default: the noise of an image's dark pixels, and at least 1e-4 of its brightest counts without hot pixels. A
        given floor is raised to at least 1e-6 of these.
    first : ndarray, shape (z, y, x), optional
        First guess, to continue an iteration or to start from your own; with a sieve, of c. Finite and >= 0. Voxels
        that are zero stay zero and cost no time.
    mask : ndarray or DataArray, shape (z, y, x), optional
        True, or a number of 0.5 to 1, where a voxel holds no fluid. These voxels stay dark and cost no time.
    progress : callable, optional
        Called with the finished fraction.
    **smart
        The other settings, by the names in `lfpiv.reconstruction.settings.SmartSettings`, which the table
        ``[smart]`` of an experiment file has, too. Their defaults are the table's.

    Returns
    -------
    xarray.DataArray, shape (z, y, x), float32
        Volume [counts per unit weight] with coordinates in mm. If fewer than two of several cameras see some voxels,
        the coordinate ``views`` is the number of cameras that see each voxel. With a mask the coordinate ``masked`` is
        true where there is no fluid; `correlate` reads it. Attributes: `residual`, ||I - P|| /
        ||I||, and `misfit`, the Kullback-Leibler divergence sum P' log(P'/I') - P' + I' with P' = P + b, I' = I + b,
        which SMART lowers [counts]: both before each iteration and after the last, over the pixels that voxels light,
        and of iterations over subsets but the first the sums of each subset's own before its step;
        `light`, by camera, the sum of an image over these pixels [counts]; `light_outside`, by camera, the part of an
        image's light in the other pixels: from particles beyond the volume, or reflections; `camera_gain`, by camera,
        its brightness relative to the brightest, in whose counts the volume is; `stop`, why the
        iteration ended; the settings.

    Raises
    ------
    ValueError
        If an argument is out of its range, or an image is missing, has the wrong shape or holds no finite light where
        the volume is seen.
    TypeError
        If a setting is unknown.
    RuntimeError
        If `progress` projects with the same weights, or reconstructs.
    """
    solver = SmartSolver(weights, SmartSettings(iterations=iterations, **smart))
    return solver.solve(images, floor=floor, mask=mask, first=first, progress=progress).to_dataarray()
