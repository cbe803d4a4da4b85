"""`reconstruct`: SMART, Eq. 5 of the paper, in the normalised form of the design notes (docs/conventions.md)."""

from __future__ import annotations

import enum
import logging
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage

from lfpiv.geometry.grid import AXES
from lfpiv.geometry.volume import VIEWS, in_order, is_finite
from lfpiv.reconstruction.particle_size import matching_sieve
from lfpiv.reconstruction.recording import Recording, record
from lfpiv.reconstruction.smart import View, gaussian, iterate, kept, sharpen
from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

NORMALISATIONS = ("column", "paper")
AUTO = "auto"
"""Sieve that suits the particles."""
FLOOR_SHARE = 0.1
"""Least floor, as a share of an image's brightness: voxels cannot show what is smaller than they are any better."""
DIVERGENCE = 1.5
"""Rise of the misfit over its first value that counts as divergence; smoothing alone may raise it a little."""


class Stop(enum.Enum):
    """Why the iteration ended; the text is the advice."""

    DONE = "all iterations asked for were done"
    CONVERGED = "misfit no longer falls by more than the tolerance"
    ITERATION_LIMIT = "iteration limit reached: raise smart.iterations if the misfit still falls"
    DIVERGED = "misfit rises: lower smart.relaxation"


def reconstruct(
    weights: Weights,
    images: Mapping[str, np.ndarray],
    iterations: int = 10,
    relaxation: float = 1.0,
    *,
    floor: float | Mapping[str, float] | None = None,
    floor_share: float = FLOOR_SHARE,
    normalisation: str = "column",
    accelerate: bool = True,
    smoothing_voxel: float = 0.0,
    sieve_voxel: float | str = 0.0,
    active_share: float = 0.0,
    tolerance: float = 0.0,
    first: np.ndarray | None = None,
    progress: Callable[[float], None] | None = None,
) -> xr.DataArray:
    """Reconstruct a particle volume from the cameras' images by SMART.

    With E the volume, w the weights, I the images, P = sum w E their projection and b the noise floor, one iteration is

    - "column" (default): ``E *= exp(mu sum_i w log((I + b) / (P + b)) / sum_i w)``;
    - "paper": Eq. 5, ``E *= exp(mu sum_i w log((I + b) / (P + b)) / N_i)``, w scaled to a largest weight of 1.

    For mu <= 1 the first lowers the misfit in every iteration. By default momentum speeds it up (`lfpiv.reconstruction.smart`): half
    the iterations or fewer reach the same misfit, it still falls in every one, and the limit is the same. The first
    guess is ``exp(sum_i w log(I + b) / sum_i w)``, less the floor's own share, scaled to the images' light.

    Parameters
    ----------
    weights : Weights
        The operator. Threads that share it take turns; while one reconstructs, its `progress` may not project.
    images : mapping of str to ndarray
        Camera name -> image, shape (rows, columns) [counts], background subtracted; negative counts are taken as zero,
        and pixels that no voxel lights are left out. Cameras may be of unlike brightness: `lfpiv.reconstruction.recording` finds it.
    iterations : int
        Number of iterations, >= 0.
    relaxation : float
        Relaxation parameter mu, > 0; 1 is safe, 3 diverges.
    floor : float or mapping of str to float, optional
        Noise floor b [counts] added to images and projections alike: one dark pixel must not kill a voxel. Default: the
        noise of each image's background, the root mean square of its negative counts, and at least 1e-4 of its
        brightest counts, hot pixels left out. A floor given is at least 1e-6 of these.
    floor_share : float
        The floor is at least this share of each image's brightness, sum I^2 / sum I, hot pixels left out: particles
        smaller than a voxel light fewer pixels than it, and the dark ones beside them are no evidence against it. 0
        takes `floor` as it is.
    normalisation : {"column", "paper"}
        See above.
    accelerate : bool
        False iterates without momentum, as the formulas above say. Only then 5 iterations and 7 more, with the first
        ones' volume as `first`, are exactly 12: momentum starts anew with every call.
    smoothing_voxel : float
        Standard deviation [voxel] of a Gaussian that smooths the volume after each iteration but the last; 0 for none.
        The misfit may rise by it.
    sieve_voxel : float or "auto"
        Standard deviation [voxel] of a sieve: the volume is a sum of Gaussians of this size, and SMART iterates their
        brightnesses c, E = G c, with w G for w; with momentum by the sharper steps of `lfpiv.reconstruction.smart`. Unlike smoothing
        it keeps the misfit falling. 0 for none. "auto": what suits the size of the particles, which the images tell
        (`lfpiv.reconstruction.particle_size`), none for particles smaller than voxels.
    active_share : float
        Voxels below this share of the first guess's brightest are zero from the start and cost nothing. 0 keeps all.
    tolerance : float
        Stop when the misfit falls by less than this fraction in an iteration; 0 runs all iterations.
    first : ndarray, shape (z, y, x), optional
        First guess, to continue an iteration or to start from one of your own; with a sieve, of c. Finite and >= 0:
        voxels that are zero stay zero and cost nothing.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    xarray.DataArray, shape (z, y, x), float32
        Volume [counts per unit weight] with coordinates in mm; where fewer than two of a rig's cameras see part of it,
        with the coordinate ``views``, how many see each voxel. Attributes: `residual`, ||I - P|| / ||I||, and `misfit`,
        the Kullback-Leibler divergence sum P' log(P'/I') - P' + I' with P' = P + b, I' = I + b, which SMART lowers
        [counts]: both before each iteration and after the last, over the pixels that voxels light; `light_outside`, by
        camera, the part of an image's light in the others: from particles beyond the volume, or reflections;
        `camera_gain`, by camera, its brightness relative to the brightest, in whose counts the volume is; `stop`, the
        verdict; the settings.

    Raises
    ------
    ValueError
        If an argument is out of its range, or an image is missing, has the wrong shape or holds no finite light where
        the volume is seen.
    RuntimeError
        If `progress` projects with the same weights, or reconstructs.
    """
    _check(
        iterations,
        relaxation,
        normalisation,
        active_share,
        floor_share=floor_share,
        smoothing_voxel=smoothing_voxel,
        sieve_voxel=sieve_voxel,
        tolerance=tolerance,
    )
    recordings = record(weights, images, floor=floor, floor_share=floor_share)
    if isinstance(sieve_voxel, str):
        sieve_voxel = matching_sieve(weights, images)
    views = [_view(weights, name, recording) for name, recording in recordings.items()]

    sieve = gaussian(sieve_voxel, weights.stored.shape)
    gains = (np.float32(recording.camera_gain) for recording in recordings.values())
    column_sum = sum(gain * own for gain, own in zip(gains, weights.camera_sums, strict=True))
    lit = column_sum > 1e-6 * column_sum.max()
    if normalisation == "column":
        step, unblurred = (
            np.divide(relaxation, total, out=np.zeros_like(column_sum), where=lit)
            for total in (sieve(column_sum), column_sum)
        )
    else:
        pixels = weights.stored.store(weights.affected_pixels)
        step = np.divide(relaxation / weights.largest, pixels, out=np.zeros_like(column_sum), where=lit & (pixels > 0))
        unblurred = step
    if first is None:
        volume = _first_guess(views, [recording.peak for recording in recordings.values()], column_sum, lit)
    else:
        volume = _given(first, weights) * lit
    if active_share > 0:
        volume[volume < active_share * volume.max()] = 0.0

    def smooth(volume: np.ndarray) -> np.ndarray:
        if smoothing_voxel == 0:
            return volume
        shaped = volume.reshape(weights.stored.shape)
        blurred = ndimage.gaussian_filter(shaped, smoothing_voxel, mode="nearest", truncate=3.0)
        smoothed: np.ndarray = blurred.ravel() * lit
        return smoothed

    def sharp(exponent: np.ndarray) -> np.ndarray:
        return sharpen(exponent * unblurred, weights.stored.shape)

    norm = float(np.sqrt(sum(np.square(view.image, dtype=np.float64).sum() for view in views)))
    residual: list[float] = []
    misfit: list[float] = []
    stop = Stop.DONE if tolerance == 0 else Stop.ITERATION_LIMIT
    steps = iterate(
        views,
        volume,
        step,
        iterations=iterations,
        accelerate=accelerate,
        sieve=sieve,
        smooth=smooth,
        sharp=sharp if accelerate and sieve_voxel > 0 else None,
    )
    with kept(views):
        for count, (volume, current) in enumerate(steps):  # noqa: B007 - the last one is returned
            residual.append(float(np.sqrt(current.squares)) / norm)
            misfit.append(current.divergence)
            if progress is not None:
                progress((count + 1) / (iterations + 1))
            if count > 0 and not misfit[-1] <= DIVERGENCE * misfit[0]:  # NaN, too
                stop = Stop.DIVERGED
                break
            if tolerance > 0 and 0 < count < iterations and misfit[-2] - misfit[-1] < tolerance * misfit[-2]:
                stop = Stop.CONVERGED
                break
    if stop is Stop.DIVERGED:
        log.warning("SMART: %s", stop.value)
    grid = weights.grid
    coordinates: dict[str, Any] = {name: (name, grid.axis_mm(axis), {"units": "mm"}) for axis, name in enumerate("zyx")}
    if len(weights.cameras) > 1 and weights.views.min() < 2:
        about = {"units": "1", "long_name": "number of cameras that see the voxel"}
        coordinates[VIEWS] = (AXES, weights.views, about)
    return xr.DataArray(
        weights.stored.restore(volume),
        dims=AXES,
        coords=coordinates,
        name="intensity",
        attrs={
            "long_name": "particle intensity",
            "units": "counts",
            "voxel_mm": grid.voxel_mm,
            "residual": residual,
            "misfit": misfit,
            "stop": stop.value,
            "iterations": len(residual) - 1,
            "relaxation": relaxation,
            "floor": [recording.floor for recording in recordings.values()],
            "camera_gain": [recording.camera_gain for recording in recordings.values()],
            "light_outside": [recording.light_outside for recording in recordings.values()],
            "normalisation": normalisation,
            "accelerate": int(accelerate),
            "smoothing_voxel": smoothing_voxel,
            "sieve_voxel": sieve_voxel,
            "active_share": active_share,
        },
    )


def _view(weights: Weights, name: str, recording: Recording) -> View:
    gain = np.ascontiguousarray(weights.cameras[name].gain, np.float32).reshape(-1)
    if recording.camera_gain != 1:
        gain = gain * np.float32(recording.camera_gain)
    return View(image=recording.image, gain=gain, floor=recording.floor, projector=weights.projector(name))


def _first_guess(views: list[View], peaks: list[float], column_sum: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Multiplicative first guess, scaled so that its projection holds the images' light."""
    logarithm = np.zeros_like(column_sum)
    for view, peak in zip(views, peaks, strict=True):
        view.projector.back_project(view.gain * np.log1p(view.image / max(view.floor, 1e-3 * peak)), logarithm)
    guess = np.expm1(np.divide(logarithm, column_sum, out=np.zeros_like(column_sum), where=lit))
    guess = np.where(lit, np.maximum(guess, 1e-6 * guess.max()), 0.0).astype(np.float32)
    seen = light = 0.0
    for view in views:
        modelled = view.gain * view.projector.project(guess, np.empty_like(view.image))
        seen += float(view.image[modelled > 0].sum(dtype=np.float64))
        light += float(modelled.sum(dtype=np.float64))
    return (guess * (seen / light)).astype(np.float32)


def _given(first: np.ndarray, weights: Weights) -> np.ndarray:
    """First guess of the caller in stored order, checked."""
    values = np.asarray(in_order(first, "first"))
    if values.shape != weights.grid.shape:
        raise ValueError(f"first: expected shape {weights.grid.shape} (z, y, x), got {values.shape}.")
    if not np.isfinite(values).all() or values.min() < 0 or not values.any():
        raise ValueError("first: expected finite values >= 0, some above 0, got NaN, infinite, negative or only zeros.")
    return weights.stored.store(values)


def _check(
    iterations: int, relaxation: float, normalisation: str, active_share: float, **not_negative: float | str
) -> None:
    whole = isinstance(iterations, (int, np.integer)) and not isinstance(iterations, bool)
    if not (whole and iterations >= 0):
        raise ValueError(f"iterations: expected a whole number >= 0, got {iterations!r}.")
    if not (is_finite(relaxation) and relaxation > 0):
        raise ValueError(f"relaxation: expected a number > 0, got {relaxation!r}.")
    if normalisation not in NORMALISATIONS:
        raise ValueError(f"normalisation: expected one of {', '.join(NORMALISATIONS)}, got {normalisation!r}.")
    if not (is_finite(active_share) and 0 <= active_share < 1):
        raise ValueError(f"active_share: expected a number from 0 to below 1, got {active_share!r}.")
    for name, value in not_negative.items():
        if name == "sieve_voxel" and isinstance(value, str) and value == AUTO:
            continue
        if not (is_finite(value) and value >= 0):
            wanted = f'a number >= 0 or "{AUTO}"' if name == "sieve_voxel" else "a number >= 0"
            raise ValueError(f"{name}: expected {wanted}, got {value!r}.")
