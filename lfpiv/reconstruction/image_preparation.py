"""Preparation of the images for SMART: which pixels count, their noise floor, and the brightness of each camera.

Pixels that no voxel lights are left out: no volume can explain their light, which comes from reflections or from
particles beyond the volume. Cameras with different scattering angles, exposures or gains record the same particles with
different brightness, which no volume can explain either. The brightness of a camera is the light of particles that all
cameras see, divided by the light it would record of an evenly lit volume. It becomes part of the camera's gain.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lfpiv.geometry.optics import Optics
from lfpiv.geometry.volume import is_finite
from lfpiv.reconstruction.dark_noise import dark_noise, light_cut_off
from lfpiv.reconstruction.intensity_cap import typical_peak
from lfpiv.weights.operator import Weights
from lfpiv_kernels import runtime

BRIGHTEST = 99.9
"""Percentile of the counts above the noise to which counts are limited, so that hot pixels have no weight."""
NOISE_SIGMA = 3.0
"""Least count that is no noise [standard deviation of the noise]."""
LEAST_FLOOR, LEAST_GIVEN = 1e-4, 1e-6
"""Least noise floor, measured or given by the caller, as a share of an image's brightest counts."""
GAIN_STEP = 1.25
"""Cameras' brightnesses are rounded to powers of this number."""
DIMMEST = 0.04
"""Least brightness of a camera relative to the brightest one."""
LEAST_LIGHT = 0.2
"""Least mean count of an image, relative to its noise, for the camera's brightness to be measured."""
GLARE = 10.0
"""Upper limit of counts used to compare cameras' brightness, as a multiple of the median count above the noise.
Brighter pixels are reflections."""
UNSURE = 2.0
"""Ratio of brightness up to which cameras count as equally bright if some voxels are not seen by all of them."""


@dataclass(frozen=True, kw_only=True)
class PreparedImage:
    """Image of one camera, prepared for SMART."""

    image: np.ndarray
    """Counts >= 0, shape (pixel,), float32; 0 where no voxel lights a pixel."""
    floor: float
    """Noise floor [counts]."""
    peak: float
    """Count of the brightest pixels, hot ones left out."""
    camera_gain: float
    """Brightness relative to the brightest camera: 1, or a power of `GAIN_STEP` below it."""
    light_outside: float
    """Part of the image's light in pixels that no voxel lights."""


def checked_images(weights: Weights, images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the image of every camera as float32, shape (rows, columns).

    Raises
    ------
    ValueError
        If an image is missing, has the wrong shape or type, or is not finite.
    """
    if not isinstance(images, Mapping):
        raise ValueError(f"images: expected a mapping from camera names to images, got {type(images).__name__}.")
    return {name: _checked_image(images, name, camera.optics.sensor_shape) for name, camera in weights.cameras.items()}


def prepare_images(
    weights: Weights,
    images: Mapping[str, np.ndarray],
    *,
    floor: float | Mapping[str, float] | None,
    floor_share: float,
    intensity_cap: float,
) -> dict[str, PreparedImage]:
    """Prepare the images of all cameras, from `checked_images`; arguments as of `lfpiv.reconstruct`.

    Returns
    -------
    dict of PreparedImage
        By camera name.

    Raises
    ------
    ValueError
        If a floor is missing or out of its range, or an image holds no light where the volume is seen.
    """
    given = _given_floors(floor, weights)
    lit = _lit_pixels(weights, images, intensity_cap)
    gains = _camera_gains(weights, lit)
    prepared = {}
    for name, seen in lit.items():
        noise, least = (seen.noise, LEAST_FLOOR) if given is None else (given[name], LEAST_GIVEN)
        prepared[name] = PreparedImage(
            image=seen.image,
            floor=max(noise, least * seen.peak, floor_share * seen.brightness),
            peak=seen.peak,
            camera_gain=gains[name],
            light_outside=seen.outside,
        )
    return prepared


class _LitPixels:
    """Counts of one camera's image in the pixels that voxels light and that are not dead, checked, and their figures.

    `pixels` are the numbers of these pixels.
    """

    def __init__(self, weights: Weights, images: Mapping[str, np.ndarray], name: str, intensity_cap: float):
        image = images[name].reshape(-1)
        dead, self.pixels = _dead_and_lit(weights, name)
        alive = np.delete(image, dead) if dead.size else image
        if not alive.max(initial=0) > 0:
            raise ValueError(f"images[{name!r}]: expected some light, got no positive count; check the background.")
        self.size = image.size
        self.counts: np.ndarray = image[self.pixels]
        if not self.counts.max(initial=0) > 0:
            raise ValueError(
                f"images[{name!r}]: expected light where the volume is seen, got none there; check the volume's "
                "position and the calibration."
            )
        self.noise = dark_noise(images[name])
        """Noise of the dark pixels. A floor that the caller gives is no measure of it."""
        self.cut_off = light_cut_off(images[name])
        """Mean count of the pixels of 0 counts before the image was cut off."""
        whole = float(alive.sum(dtype=np.float64))
        inside = float(self.counts.sum(dtype=np.float64))
        self.outside = float(np.clip(1 - inside / whole, 0, 1)) if whole > 0 else 0.0
        if intensity_cap > 0:
            peak = self._typical_peak(weights.cameras[name].optics)
            self.counts = np.minimum(self.counts, np.float32(intensity_cap * peak) * weights.gain(name)[self.pixels])
        above = self.counts[self.counts > NOISE_SIGMA * self.noise]
        above = above if above.size else self.counts[self.counts > 0]
        median, self.peak = _median_and_peak(above)
        self.without_glare = np.minimum(self.counts, np.float32(min(self.peak, GLARE * median)))
        """The counts, those of reflections limited."""
        positive = np.clip(self.counts, 0, self.peak)
        self.brightness = float(np.einsum("i,i", positive, positive, dtype=np.float64) / positive.sum(dtype=np.float64))
        """Mean count weighted by the counts. Dark and hot pixels have no weight."""
        self.image = np.zeros(image.size, np.float32)
        """The counts, at least 0, and 0 in all other pixels, shape (pixel,)."""
        self.image[self.pixels] = np.maximum(self.counts, 0)

    def _typical_peak(self, optics: Optics) -> float:
        lit = np.zeros(self.size, np.float32)
        lit[self.pixels] = self.counts
        return typical_peak(lit.reshape(optics.sensor_shape), optics.microimage_pitch_px, self.noise)


def _lit_pixels(weights: Weights, images: Mapping[str, np.ndarray], intensity_cap: float) -> dict[str, _LitPixels]:
    """Return the counts of all cameras, measured side by side."""
    names = list(weights.cameras)
    found: dict[str, _LitPixels] = {}

    def measure(_: int, first: int, last: int) -> None:
        for name in names[first:last]:
            found[name] = _LitPixels(weights, images, name, intensity_cap)

    runtime.run_chunks(len(names), measure, chunks=len(names), warp_device="cpu")
    return {name: found[name] for name in names}


def _dead_and_lit(weights: Weights, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a camera's dead pixels, and the pixels that voxels light and that are not dead."""
    derived, key = weights.derived, ("dead and lit pixels", name)
    if key not in derived:
        alive, lit = weights.gain(name) > 0, weights.projector(name).map.pixel
        derived[key] = np.flatnonzero(~alive), lit[alive[lit]]
    dead, pixels = derived[key]
    return dead, pixels


def _shared(weights: Weights, name: str, shared: np.ndarray) -> np.ndarray:
    """Return where the pixels of `EvenLight.shared` are among a camera's lit ones: indices into `_LitPixels.counts`."""
    derived, key = weights.derived, ("shared pixels", name)
    if key not in derived:
        _, pixels = _dead_and_lit(weights, name)
        derived[key] = np.flatnonzero(shared[pixels])
    return derived[key]


def _median_and_peak(counts: np.ndarray) -> tuple[float, float]:
    """Return the median and the percentile `BRIGHTEST`, the higher of two neighbours, after one sort in part."""
    last = counts.size - 1
    middle, bright = (last // 2, counts.size // 2), math.ceil(last * (BRIGHTEST / 100))
    ordered = np.partition(counts, sorted({*middle, bright}))
    return float(ordered[list(middle)].mean()), float(ordered[bright])


def _checked_image(images: Mapping[str, np.ndarray], name: str, shape: tuple[int, int]) -> np.ndarray:
    """Return a camera's image as float32, shape (rows, columns), or raise ValueError."""
    if name not in images:
        raise ValueError(f"images: camera {name!r} is missing; found {', '.join(map(str, images)) or 'none'}.")
    image = np.asarray(images[name])
    if image.dtype.kind not in "fiub":
        raise ValueError(f"images[{name!r}]: expected an array of counts, got {image.dtype}.")
    if image.shape != shape:
        raise ValueError(f"images[{name!r}]: expected shape {shape}, got {image.shape}.")
    image = image.astype(np.float32, copy=False)
    if not np.isfinite(image).all():
        raise ValueError(f"images[{name!r}]: expected finite counts, got NaN or infinity.")
    return image


def _given_floors(floor: float | Mapping[str, float] | None, weights: Weights) -> Mapping[str, float] | None:
    """Return the caller's noise floors by camera name, or raise ValueError."""
    if floor is None:
        return None
    given = floor if isinstance(floor, Mapping) else dict.fromkeys(weights.cameras, floor)
    missing = [name for name in weights.cameras if name not in given]
    if missing:
        raise ValueError(f"floor: camera {missing[0]!r} is missing; found {', '.join(map(str, given)) or 'none'}.")
    if not all(is_finite(given[name]) and given[name] >= 0 for name in weights.cameras):
        raise ValueError(f"floor: expected a number >= 0, or one for each camera, got {floor!r}.")
    return given


def _camera_gains(weights: Weights, lit: Mapping[str, _LitPixels]) -> dict[str, float]:
    """Return the brightness of each camera relative to the brightest; 1 for all if that of one cannot be measured."""
    equal = dict.fromkeys(lit, 1.0)
    if len(lit) == 1:
        return equal
    even = weights.even_light
    brightness, all_see_all = {}, True
    for name, seen in lit.items():
        if name not in even:
            return equal
        counts, shared = seen.without_glare, even[name].shared
        if shared is not None:
            counts, all_see_all = counts[_shared(weights, name, shared)], False
        # positive and negative noise cancel in the sum
        light = float(counts.sum(dtype=np.float64)) + seen.cut_off * np.count_nonzero(counts == 0)
        if not light > LEAST_LIGHT * seen.noise * len(counts):
            return equal
        brightness[name] = light / even[name].light
    brightest = max(brightness.values())
    gains = {}
    for name, value in brightness.items():
        ratio = max(value / brightest, DIMMEST)
        sure = all_see_all or ratio < 1 / UNSURE
        gains[name] = GAIN_STEP ** round(np.log(ratio) / np.log(GAIN_STEP)) if sure else 1.0
    return gains
