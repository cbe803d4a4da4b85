"""`reconstruct`: SMART, Eq. 5 of the paper, in the normalised form of the design notes (docs/conventions.md)."""

from __future__ import annotations

import enum
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import ndimage

from lfpiv.weights import Weights
from lfpiv_kernels import project

log = logging.getLogger(__name__)

NORMALISATIONS = ("column", "paper")
DIVERGENCE = 1.5
"""Rise of the misfit over its first value that counts as divergence; smoothing alone may raise it a little."""


class Stop(enum.Enum):
    """Why the iteration ended; the text is the advice."""

    CONVERGED = "misfit no longer falls by more than the tolerance"
    ITERATION_LIMIT = "iteration limit reached: raise smart.iterations if the misfit still falls"
    DIVERGED = "misfit rises: lower smart.relaxation"


@dataclass(frozen=True)
class _Camera:
    """One camera's padded arrays for the iteration."""

    name: str
    image: np.ndarray
    gain: np.ndarray
    projected: np.ndarray
    ratio: np.ndarray


def reconstruct(
    weights: Weights,
    images: Mapping[str, np.ndarray],
    iterations: int = 10,
    relaxation: float = 1.0,
    *,
    floor: float | Mapping[str, float] | None = None,
    normalisation: str = "column",
    smoothing_voxel: float = 0.0,
    tolerance: float = 0.0,
    first: np.ndarray | None = None,
    progress: Callable[[float], None] | None = None,
) -> xr.DataArray:
    """Reconstruct a particle volume from the cameras' images by SMART.

    With E the volume, w the weights, I the images, P = sum w E their projection and b the noise floor, one iteration is

    - "column" (default): ``E *= exp(mu sum_i w log((I + b) / (P + b)) / sum_i w)``;
    - "paper": Eq. 5, ``E *= exp(mu sum_i w log((I + b) / (P + b)) / N_i)``, w scaled to a largest weight of 1.

    The first guess is ``exp(sum_i w log(I + b) / sum_i w)``, less the floor's own share, scaled to the images' light.

    Parameters
    ----------
    weights : Weights
        The operator.
    images : mapping of str to ndarray
        Camera name -> image, shape (rows, columns) [counts], background subtracted; negative counts are taken as zero.
    iterations : int
        Number of iterations, >= 0.
    relaxation : float
        Relaxation parameter mu, > 0; 1 is safe, 3 diverges.
    floor : float or mapping of str to float, optional
        Noise floor b [counts] added to images and projections alike: one dark pixel must not kill a voxel. Default: the
        noise of each image's background, the root mean square of its negative counts, and at least 1e-4 of its
        brightest count.
    normalisation : {"column", "paper"}
        See above.
    smoothing_voxel : float
        Standard deviation [voxel] of a Gaussian that smooths the volume after each iteration but the last; 0 for none.
    tolerance : float
        Stop when the misfit falls by less than this fraction in an iteration; 0 runs all iterations.
    first : ndarray, shape (z, y, x), optional
        First guess, to continue an iteration or to start from one of your own; positive.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    xarray.DataArray, shape (z, y, x), float32
        Volume [counts per unit weight] with coordinates in mm. Attributes: `residual`, ||I - P|| / ||I||, and `misfit`,
        the Kullback-Leibler divergence sum P' log(P'/I') - P' + I' with P' = P + b, I' = I + b, which SMART lowers
        [counts]: both before each iteration and after the last; `stop`, the verdict; the settings.

    Raises
    ------
    ValueError
        If an argument is out of its range, or an image is missing, has the wrong shape or holds no finite light.
    """
    _check(iterations, relaxation, normalisation, smoothing_voxel, first, weights)
    cameras = [_prepare(weights, images, name) for name in weights.cameras]
    floors = _floors(floor, weights, images)

    column_sum = weights.stored.store(weights.column_sum)
    lit = column_sum > 1e-6 * column_sum.max()
    if normalisation == "column":
        step = np.divide(relaxation, column_sum, out=np.zeros_like(column_sum), where=lit)
    else:
        pixels = weights.stored.store(weights.affected_pixels)
        step = np.divide(relaxation / weights.largest, pixels, out=np.zeros_like(column_sum), where=lit & (pixels > 0))

    if first is not None:
        volume = weights.stored.store(first) * lit
    else:
        volume = _first_guess(weights, cameras, floors, column_sum, lit)

    light = float(np.sqrt(sum(np.square(camera.image, dtype=np.float64).sum() for camera in cameras)))
    residual: list[float] = []
    misfit: list[float] = []
    stop = Stop.ITERATION_LIMIT
    exponent = np.empty_like(volume)
    for iteration in range(iterations + 1):
        exponent[:] = 0.0
        squares = divergence = 0.0
        for camera in cameras:
            weights.projector(camera.name).project(volume, camera.projected)
            project.log_ratio(camera.image, camera.gain, floors[camera.name], camera.projected, camera.ratio)
            np.multiply(camera.projected, camera.gain, out=camera.projected)
            difference = camera.image - camera.projected
            squares += float(np.dot(difference, difference))
            divergence += _divergence(camera, floors[camera.name], difference)
            if iteration < iterations:
                weights.projector(camera.name).back_project(camera.ratio, exponent, active=volume)
        residual.append(float(np.sqrt(squares)) / light)
        misfit.append(divergence)
        if progress is not None:
            progress((iteration + 1) / (iterations + 1))
        if iteration == iterations:
            break
        if iteration > 0 and misfit[-1] > DIVERGENCE * misfit[0]:
            stop = Stop.DIVERGED
            break
        if iteration > 0 and tolerance > 0 and misfit[-2] - misfit[-1] < tolerance * misfit[-2]:
            stop = Stop.CONVERGED
            break
        project.update(volume, exponent, step)
        if smoothing_voxel > 0 and iteration + 1 < iterations:
            shape = weights.stored.shape
            volume = ndimage.gaussian_filter(
                volume.reshape(shape), smoothing_voxel, mode="nearest", truncate=3.0
            ).ravel()
            volume *= lit
    if stop is Stop.DIVERGED:
        log.warning("SMART: %s", stop.value)
    grid = weights.grid
    return xr.DataArray(
        weights.stored.restore(volume),
        dims=("z", "y", "x"),
        coords={name: (name, grid.axis_mm(axis), {"units": "mm"}) for axis, name in enumerate("zyx")},
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
            "normalisation": normalisation,
            "smoothing_voxel": smoothing_voxel,
        },
    )


def _floors(floor, weights: Weights, images: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Noise floor of every camera [counts]."""
    if floor is None:
        floors = {}
        for name in weights.cameras:
            image = np.asarray(images[name], np.float32)
            below = image[image < 0]
            noise = float(np.sqrt(np.mean(below**2))) if below.size else 0.0
            floors[name] = max(noise, 1e-4 * float(image.max()))
        return floors
    missing = [name for name in weights.cameras if isinstance(floor, Mapping) and name not in floor]
    if missing:
        raise ValueError(f"floor: camera {missing[0]!r} is missing; found {', '.join(floor) or 'none'}.")
    floors = {name: floor[name] if isinstance(floor, Mapping) else floor for name in weights.cameras}
    if any(not value >= 0 for value in floors.values()):
        raise ValueError(f"floor: expected a number >= 0, got {floor}.")
    return floors


def _prepare(weights: Weights, images: Mapping[str, np.ndarray], name: str) -> _Camera:
    camera = weights.cameras[name]
    if name not in images:
        raise ValueError(f"images: camera {name!r} is missing; found {', '.join(images) or 'none'}.")
    image = np.asarray(images[name], np.float32)
    if image.shape != camera.optics.sensor_shape:
        raise ValueError(f"images[{name!r}]: expected shape {camera.optics.sensor_shape}, got {image.shape}.")
    if not np.isfinite(image).all():
        raise ValueError(f"images[{name!r}]: expected finite counts, got NaN or infinity.")
    image = np.where(camera.gain > 0, np.maximum(image, 0.0), 0.0)
    if not image.any():
        raise ValueError(f"images[{name!r}]: expected some light, got no positive count; check the background.")
    flat, gain = image.reshape(-1), np.ascontiguousarray(camera.gain, np.float32).reshape(-1)
    return _Camera(name, flat, gain, np.empty_like(flat), np.empty_like(flat))


def _first_guess(weights, cameras, floors, column_sum, lit) -> np.ndarray:
    """Multiplicative first guess, scaled so that its projection holds the images' light."""
    logarithm = np.zeros_like(column_sum)
    for camera in cameras:
        floor = max(floors[camera.name], 1e-3 * float(camera.image.max()))
        weights.projector(camera.name).back_project(camera.gain * np.log1p(camera.image / floor), logarithm)
    guess = np.expm1(np.divide(logarithm, column_sum, out=np.zeros_like(column_sum), where=lit))
    guess = np.where(lit, np.maximum(guess, 1e-6 * guess.max()), 0.0).astype(np.float32)
    seen = light = 0.0
    for camera in cameras:
        weights.projector(camera.name).project(guess, camera.projected)
        modelled = camera.gain * camera.projected
        seen += float(camera.image[modelled > 0].sum(dtype=np.float64))
        light += float(modelled.sum(dtype=np.float64))
    if not seen > 0:
        raise ValueError("images: no light where the volume is seen; check the volume's position and the calibration.")
    return (guess * (seen / light)).astype(np.float32)


def _divergence(camera: _Camera, floor: float, difference: np.ndarray) -> float:
    """Kullback-Leibler divergence of the projection from the image, the misfit that SMART lowers.

    sum (P + b) log((P + b) / (I + b)) - P + I; `camera.projected` already holds P, `camera.ratio` gain * log ratio.
    """
    logarithm = np.divide(camera.ratio, camera.gain, out=np.zeros_like(camera.ratio), where=camera.gain > 0)
    return float(difference.sum(dtype=np.float64) - np.dot(camera.projected + np.float32(floor), logarithm))


def _check(iterations, relaxation, normalisation, smoothing_voxel, first, weights) -> None:
    if isinstance(iterations, bool) or int(iterations) != iterations or iterations < 0:
        raise ValueError(f"iterations: expected a whole number >= 0, got {iterations!r}.")
    if not relaxation > 0:
        raise ValueError(f"relaxation: expected a number > 0, got {relaxation!r}.")
    if normalisation not in NORMALISATIONS:
        raise ValueError(f"normalisation: expected one of {', '.join(NORMALISATIONS)}, got {normalisation!r}.")
    if not smoothing_voxel >= 0:
        raise ValueError(f"smoothing_voxel: expected a number >= 0, got {smoothing_voxel!r}.")
    if first is not None and (np.shape(first) != weights.grid.shape or not (np.asarray(first) > 0).all()):
        raise ValueError(f"first: expected positive values of shape {weights.grid.shape}, got shape {np.shape(first)}.")
