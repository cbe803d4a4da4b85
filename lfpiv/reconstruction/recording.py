"""Images as SMART takes them: the light that voxels can show, its noise floor, and how bright each camera is.

What no voxel lights, a reflection or particles beyond the volume, no volume can explain: it is left out, and its share
stated. Cameras at unlike scattering angles, exposures or gains see the same particles at unlike brightness, which no
volume can explain either: SMART would end halfway between them. The light of particles that all cameras see, over what
each would see of an evenly lit volume, tells how bright they are, wherever in that volume the particles are. It becomes
part of what a camera records per unit of light, so a dim camera counts by the light it has, not by its noise.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from lfpiv.geometry.volume import is_finite
from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

BRIGHTEST = 99.9
"""Percentile of the counts above the noise at which they are cut, so that no hot pixel outweighs the rest. Even a lone
particle lights some hundred pixels, and noise counts for nothing, so it is never the particles that are cut."""
NOISE_SIGMA = 3.0
"""Standard deviations above which a count is no noise."""
LEAST_FLOOR, LEAST_GIVEN = 1e-4, 1e-6
"""Least floor, as a share of an image's brightest counts, and least one that a caller may ask for: with none at all the
misfit of a dark pixel is infinite, and no step lowers it."""
GAIN_STEP = 1.25
"""Brightnesses of cameras are powers of it: below half a step they cost nothing, and frames agree about them."""
DIMMEST = 0.04
"""Least brightness of a camera relative to the brightest one: below, its image is hardly that of the same particles."""
LEAST_LIGHT = 0.2
"""Least mean count of a camera's image, over its noise, that tells its brightness: an image without its background
still has some tenths of its noise."""
WHOLLY_SEEN = 0.5
"""Least sum of a voxel's weights in a camera that sees it wholly, as a share of the largest one in the volume."""
SHARED_LIGHT = 0.95
"""Least part of a pixel's light, of an evenly lit volume, from voxels that all cameras see wholly: it shows what all
cameras do."""
LEAST_SHARED = 0.25
"""Least part of a camera's light in such pixels that tells its brightness."""
GLARE = 10.0
"""Counts beyond this many times the median above the noise tell nothing of a camera's brightness: hardly a particle has
them, and a reflection would outweigh all particles."""
UNSURE = 2.0
"""Ratio up to which cameras count as alike where not all see all voxels: where in the volume few particles are matters
then, by up to 1.5."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What one camera recorded of a volume."""

    image: np.ndarray
    """Counts >= 0, 0 where no voxel lights a pixel, shape (pixel,), float32."""
    floor: float
    """Noise floor [counts]."""
    peak: float
    """Count of the brightest pixels, hot ones left out."""
    camera_gain: float
    """Brightness relative to the brightest camera: 1, or a power of `GAIN_STEP` below it."""
    light_outside: float
    """Part of the image's light in pixels that no voxel lights."""


def record(
    weights: Weights,
    images: Mapping[str, np.ndarray],
    *,
    floor: float | Mapping[str, float] | None,
    floor_share: float,
) -> dict[str, Recording]:
    """Take images for reconstruction; arguments as in `lfpiv.reconstruct`.

    Returns
    -------
    dict of Recording
        By camera.

    Raises
    ------
    ValueError
        If an image or a floor is missing or out of its range, or an image holds no light where the volume is seen.
    """
    if not isinstance(images, Mapping):
        raise ValueError(f"images: expected a mapping from camera names to images, got {type(images).__name__}.")
    given = _given_floors(floor, weights)
    looks = {name: _Look(weights, images, name) for name in weights.cameras}
    gains = _camera_gains(weights, looks)
    recordings = {}
    for name, look in looks.items():
        noise, least = (look.noise, LEAST_FLOOR) if given is None else (given[name], LEAST_GIVEN)
        image = np.zeros(look.size, np.float32)
        image[look.pixels] = np.maximum(look.counts, 0)
        recordings[name] = Recording(
            image=image,
            floor=max(noise, least * look.peak, floor_share * look.brightness),
            peak=look.peak,
            camera_gain=gains[name],
            light_outside=look.outside,
        )
    return recordings


class _Look:
    """One camera's image, checked, in the pixels that voxels light."""

    def __init__(self, weights: Weights, images: Mapping[str, np.ndarray], name: str):
        camera = weights.cameras[name]
        if name not in images:
            raise ValueError(f"images: camera {name!r} is missing; found {', '.join(map(str, images)) or 'none'}.")
        image = np.asarray(images[name])
        if image.dtype.kind not in "fiub":
            raise ValueError(f"images[{name!r}]: expected an array of counts, got {image.dtype}.")
        if image.shape != camera.optics.sensor_shape:
            raise ValueError(f"images[{name!r}]: expected shape {camera.optics.sensor_shape}, got {image.shape}.")
        image = image.astype(np.float32, copy=False).reshape(-1)
        if not np.isfinite(image).all():
            raise ValueError(f"images[{name!r}]: expected finite counts, got NaN or infinity.")
        alive = np.asarray(camera.gain).reshape(-1) > 0
        if not (image[alive] > 0).any():
            raise ValueError(f"images[{name!r}]: expected some light, got no positive count; check the background.")
        lit = weights.projector(name).map.pixel
        self.size = image.size
        self.pixels: np.ndarray = lit[alive[lit]]
        """Pixels that voxels light and that are not dead."""
        self.counts: np.ndarray = image[self.pixels]
        if not (self.counts > 0).any():
            raise ValueError(
                f"images[{name!r}]: expected light where the volume is seen, got none there; check the volume's "
                "position and the calibration."
            )
        below = image[image < 0]
        self.noise = float(np.sqrt(np.mean(below**2))) if below.size else 0.0
        """Of the background: root mean square of the negative counts."""
        above = self.counts[self.counts > NOISE_SIGMA * self.noise]
        above = above if above.size else self.counts[self.counts > 0]
        self.peak = float(np.percentile(above, BRIGHTEST, method="higher"))
        self.plain = np.minimum(self.counts, np.float32(min(self.peak, GLARE * float(np.median(above)))))
        """The counts, cut where they are a reflection's, their noise as it is."""
        positive = np.clip(self.counts, 0, self.peak)
        self.brightness = float(np.square(positive, dtype=np.float64).sum() / positive.sum(dtype=np.float64))
        """Mean count, each weighted by itself: dark pixels do not count, nor do hot ones."""
        whole = float(image[alive].sum(dtype=np.float64))
        inside = float(self.counts.sum(dtype=np.float64))
        self.outside = float(np.clip(1 - inside / whole, 0, 1)) if whole > 0 else 0.0


def _given_floors(floor: float | Mapping[str, float] | None, weights: Weights) -> Mapping[str, float] | None:
    if floor is None:
        return None
    given = floor if isinstance(floor, Mapping) else dict.fromkeys(weights.cameras, floor)
    missing = [name for name in weights.cameras if name not in given]
    if missing:
        raise ValueError(f"floor: camera {missing[0]!r} is missing; found {', '.join(map(str, given)) or 'none'}.")
    if not all(is_finite(given[name]) and given[name] >= 0 for name in weights.cameras):
        raise ValueError(f"floor: expected a number >= 0, or one for each camera, got {floor!r}.")
    return given


# -- brightness of cameras


@dataclass(frozen=True)
class _Even:
    """What a camera sees of an evenly lit volume."""

    light: float
    """In the pixels that count."""
    shared: np.ndarray | None
    """Pixels that see voxels which all cameras see, shape (pixel,), bool; None for all."""


def _camera_gains(weights: Weights, looks: Mapping[str, _Look]) -> dict[str, float]:
    """Brightness of each camera relative to the brightest; 1 for all where it cannot be told of one."""
    alike = dict.fromkeys(looks, 1.0)
    if len(looks) == 1:
        return alike
    even = _even.get(weights)
    if even is None:
        even = _even[weights] = _project_even(weights)
    brightness, whole = {}, True
    for name, look in looks.items():
        if name not in even:
            return alike
        seen, shared = look.plain, even[name].shared
        if shared is not None:
            seen, whole = seen[shared[look.pixels]], False
        light = float(seen.sum(dtype=np.float64))  # in which noise and its negative counts cancel
        if not light > LEAST_LIGHT * look.noise * len(seen):
            return alike
        brightness[name] = light / even[name].light
    brightest = max(brightness.values())
    gains = {}
    for name, value in brightness.items():
        ratio = max(value / brightest, DIMMEST)
        sure = whole or ratio < 1 / UNSURE
        gains[name] = GAIN_STEP ** round(np.log(ratio) / np.log(GAIN_STEP)) if sure else 1.0
    return gains


def _project_even(weights: Weights) -> dict[str, _Even]:
    """Light of an evenly lit volume in each camera, in pixels that see what all do; nothing where too few do."""
    gains = {name: np.asarray(camera.gain, np.float32).reshape(-1) for name, camera in weights.cameras.items()}
    partly = np.zeros(weights.grid.size, bool)
    for seen in weights.camera_sums:
        partly |= seen < WHOLLY_SEEN * seen.max()
    even = {}
    for name, gain in gains.items():
        projector, shared = weights.projector(name), None
        image = projector.project(np.ones(weights.grid.size, np.float32), np.empty_like(gain))
        if partly.any():
            other = projector.project(partly.astype(np.float32), np.empty_like(gain))
            shared = (image > 0) & (other <= (1 - SHARED_LIGHT) * image)
        image *= gain
        light = float(image.sum(dtype=np.float64, where=True if shared is None else shared))
        if not light > LEAST_SHARED * float(image.sum(dtype=np.float64)):
            log.info("%s: too little of the volume is seen by all cameras to compare their brightness", name)
            return {}
        even[name] = _Even(light, shared)
    return even


_even: WeakKeyDictionary[Weights, dict[str, _Even]] = WeakKeyDictionary()
