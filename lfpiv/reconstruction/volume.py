"""`reconstruct`: a particle volume from the cameras' images by SMART, Eq. 5 of the paper (docs/conventions.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import xarray as xr

from lfpiv.reconstruction.settings import DEFAULTS, SmartSettings
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.weights.operator import Weights


def reconstruct(
    weights: Weights,
    images: Mapping[str, np.ndarray],
    iterations: int = DEFAULTS.iterations,
    relaxation: float = DEFAULTS.relaxation,
    *,
    floor: float | Mapping[str, float] | None = None,
    floor_share: float = DEFAULTS.floor_share,
    intensity_cap: float | str = DEFAULTS.intensity_cap,
    normalisation: str = DEFAULTS.normalisation,
    accelerate: bool = DEFAULTS.accelerate,
    sieve_voxel: float | str = DEFAULTS.sieve_voxel,
    tolerance: float = DEFAULTS.tolerance,
    subsets: int | str = DEFAULTS.subsets,
    first: np.ndarray | None = None,
    mask: np.ndarray | xr.DataArray | None = None,
    progress: Callable[[float], None] | None = None,
) -> xr.DataArray:
    """Reconstruct a particle volume from the cameras' images by SMART.

    With E the volume, w the weights, I the images, P = sum w E their projection and b the noise floor, one iteration is

    - "column" (default): ``E *= exp(mu sum_i w log((I + b) / (P + b)) / sum_i w)``;
    - "paper": Eq. 5, ``E *= exp(mu sum_i w log((I + b) / (P + b)) / N_i)``, w scaled to a largest weight of 1.

    For mu <= 1 the first lowers the misfit in every iteration. Momentum (`lfpiv.reconstruction.momentum`) reaches the
    same misfit in at most half the iterations; the misfit still falls in every one, and the limit is the same. The
    first guess is ``exp(sum_i w log(I + b) / sum_i w)``, less the floor's own share, scaled to the images' light.

    The keywords are those of the table ``[smart]`` of an experiment file, one by one: hence more than eight. Their
    defaults are the table's (`lfpiv.settings.processing.Smart`). For many instants make one
    `lfpiv.reconstruction.solver.SmartSolver`. `lfpiv.measure_pair` adds what a run does besides: guard layers, finer
    voxels, light that stands still.

    Parameters
    ----------
    weights : Weights
        The operator. Threads that share it wait for each other. `progress` may not project with it.
    images : mapping of str to ndarray
        Camera name -> image, shape (rows, columns) [counts], background subtracted. Negative counts are taken as zero.
        Pixels that no voxel lights are left out. Differences of the cameras' brightness are measured and corrected
        (`lfpiv.reconstruction.recording`).
    iterations : int
        Largest number of iterations, >= 0.
    relaxation : float
        Relaxation parameter mu, > 0; 1 is safe, 3 diverges.
    floor : float or mapping of str to float, optional
        Noise floor b [counts], added to images and projections: without it one dark pixel would make a voxel dark.
        Default: the noise of an image's dark pixels, and at least 1e-4 of its brightest counts without hot pixels. A
        given floor is raised to at least 1e-6 of these.
    floor_share : float
        Least floor as a share of each image's brightness, sum I^2 / sum I, hot pixels left out. Particles smaller than
        a voxel light fewer pixels than the voxel; the floor keeps the dark pixels beside them from counting against it.
        0 takes `floor` as it is.
    intensity_cap : float or "auto"
        Upper limit of the counts as a multiple of the typical peak, the median over the lit microimages of each one's
        brightest pixel; 0 for none. It makes particles of unlike brightness more alike between cameras and frames
        (`lfpiv.reconstruction.intensity_cap`). "auto": none if the images show equally bright particles
        (`lfpiv.reconstruction.particle_size`); otherwise 1 for particles that ``sieve_voxel = "auto"`` finds smaller
        than voxels, and 2 for larger ones.
    normalisation : {"column", "paper"}
        See above.
    accelerate : bool
        False iterates without momentum, as in the formulas above. Then, without sieve and tolerance, 5 iterations and 7
        more with the first volume as `first` equal 12 exactly. Momentum starts anew with every call.
    sieve_voxel : float or "auto"
        Standard deviation [voxel] of a sieve: the volume is a sum of Gaussians of this size, E = G c, and SMART
        iterates their brightnesses c with w G in place of w (`lfpiv.reconstruction.steps`). 0 for none. "auto": matched
        to the size of the particles, which is measured in the images (`lfpiv.reconstruction.particle_size`); none for
        particles smaller than voxels.
    tolerance : float
        Stop when the misfit falls by less than this fraction in an iteration; 0 runs all iterations.
    subsets : int or "auto"
        Number of ordered subsets of the rays, each of which makes a step (`lfpiv.reconstruction.ordered_subsets`): 1
        for SMART as above, or more. Where planes of voxels share profiles (`lfpiv.weights.forms.shared_profiles`) a
        subset is some rows of pixels under the lenses of all cameras, and there are up to 16, by default as many as
        possible, until they contradict each other or have made 128 steps. Otherwise it is a camera or half of its
        lenses: "auto" takes halves of one or two cameras, until they contradict each other, then whole cameras, as for
        more of them. An iteration is a pass over all subsets; the last two iterations, at most half of them, are
        SMART's own. "auto" is 1 without `accelerate`, or with "paper".
    first : ndarray, shape (z, y, x), optional
        First guess, to continue an iteration or to start from your own; with a sieve, of c. Finite and >= 0. Voxels
        that are zero stay zero and cost no time.
    mask : ndarray or DataArray, shape (z, y, x), optional
        True, or a number of 0.5 to 1, where a voxel holds no fluid. These voxels stay dark and cost no time.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    xarray.DataArray, shape (z, y, x), float32
        Volume [counts per unit weight] with coordinates in mm. If fewer than two of several cameras see some voxels,
        the coordinate ``views`` is the number of cameras that see each voxel. With a mask the coordinate ``masked`` is
        true where there is no fluid; `correlate` reads it. Attributes: `residual`, ||I - P|| /
        ||I||, and `misfit`, the Kullback-Leibler divergence sum P' log(P'/I') - P' + I' with P' = P + b, I' = I + b,
        which SMART lowers [counts]: both before each iteration and after the last, over the pixels that voxels light,
        and of iterations over subsets but the first the sums of each subset's own before its step;
        `light_outside`, by camera, the part of an image's light in the other pixels: from particles beyond the volume,
        or reflections; `camera_gain`, by camera, its brightness relative to the brightest, in whose counts the volume
        is; `stop`, why the iteration ended; the settings.

    Raises
    ------
    ValueError
        If an argument is out of its range, or an image is missing, has the wrong shape or holds no finite light where
        the volume is seen.
    RuntimeError
        If `progress` projects with the same weights, or reconstructs.
    """
    settings = SmartSettings(
        iterations=iterations,
        relaxation=relaxation,
        floor_share=floor_share,
        intensity_cap=intensity_cap,
        normalisation=normalisation,
        accelerate=accelerate,
        sieve_voxel=sieve_voxel,
        tolerance=tolerance,
        subsets=subsets,
    )
    solver = SmartSolver(weights, settings)
    return solver.solve(images, floor=floor, mask=mask, first=first, progress=progress).to_dataarray()
