"""Compare two images of a camera, or of a pair: parts of a sensor that are dark, both exposures at once, copies.

Images of equal form can hold the wrong exposure: a shutter that covers a part of the sensor, a double exposure, or an
image stored twice all give volumes. Noise and moving particles make sound images differ everywhere.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lfpiv.errors import InputError
from lfpiv.warn import Code, Warning

UNEVEN = 4.0
"""Ratio of the light in a part of the sensor between two frames of a pair above which a warning is due."""
HELD = 0.6
"""Least share of a bright pixel's light that a frame which holds both exposures keeps, relative to the pulses."""
ALIKE = 0.3
"""Largest share that is kept the other way round, relative to it: particles that hardly move are kept either way."""
SAME = 0.9
"""Least share of bright pixels with the same counts in two images of one exposure. In two exposures of particles at
rest noise of 0.3 counts leaves 0.7, noise of a count 0.3."""
_MEDIAN_SAMPLES = 100_000  # pixels whose median is the background
_BRIGHT_SAMPLES, _BRIGHT = 1_000_000, 0.995  # pixels that are compared, part of them that is dimmer than the rest
_SAME_COUNTS = 0.01  # largest difference of the same counts above backgrounds that are measured one by one
_DIMMER = 0.5  # level from which pixels count, relative to the brightest ones
_LOST = 0.03  # part of these pixels that may lose light
_LIT_SHARE = 0.04  # least share of all light in a ninth of the sensor
_FIELDS = 4  # side of the square of fields into which a ninth is divided
_LOST_FIELDS = 3.0  # fields that lose their light, beyond their neighbours too: more than a particle that leaves


def dark_blocks(first: np.ndarray, second: np.ndarray) -> int:
    """Count the parts of the sensor, of three by three, that are lit in one of two frames and hardly in the other.

    Particles that cross the edge of a part are not counted: their light is in a neighbouring field of the other frame.

    Parameters
    ----------
    first, second : ndarray, shape (rows, columns)
        Frames of a camera [counts].
    """
    fields = np.array([_fields(frame) for frame in (first, second)])
    light = _by_part(fields).sum(axis=-1)
    lit = np.maximum(*light)
    dark = 0
    for bright, dim, own, other in zip(light, light[::-1], fields, fields[::-1], strict=True):
        uneven = (bright > _LIT_SHARE * lit.sum()) & (bright > UNEVEN * dim)
        lost = _by_part(np.where(own > UNEVEN * ndimage.maximum_filter(other, 3), own, 0))[uneven]
        if lost.sum() ** 2 > _LOST_FIELDS * (lost**2).sum():
            dark += int(np.count_nonzero(uneven))
    return dark


def _fields(frame: np.ndarray) -> np.ndarray:
    """Return the light above the background in each of 12 by 12 fields of a sensor [counts]."""
    above = np.maximum(frame - np.median(frame.ravel()[:: 1 + frame.size // _MEDIAN_SAMPLES]), 0)
    bands = np.array([band.sum(axis=0, dtype=float) for band in np.array_split(above, 3 * _FIELDS)])
    return np.array([field.sum(axis=1) for field in np.array_split(bands, 3 * _FIELDS, axis=1)]).T


def _by_part(fields: np.ndarray) -> np.ndarray:
    """Return the fields of each ninth of the sensor, shape (..., 9, fields)."""
    parts = fields.reshape(*fields.shape[:-2], 3, _FIELDS, 3, _FIELDS).swapaxes(-3, -2)
    return parts.reshape(*fields.shape[:-2], 9, _FIELDS**2)


def uneven_warnings(first: np.ndarray, second: np.ndarray, camera: str) -> list[Warning]:
    """Warn where the light of a camera's two frames differs. Parameters as for `dark_blocks`."""
    parts = dark_blocks(first, second)
    figures = {"parts": parts, "ratio": UNEVEN}
    return [Warning(code=Code.UNEVEN, subject=camera, figures=figures)] if parts else []


def double_warnings(first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray]) -> list[Warning]:
    """Warn of cameras one of whose frames holds the light of both.

    It is nowhere darker than the other one, which has no light where the second pulse's particles are. In a sound pair
    either frame keeps as much of the other. Pulses differ in energy, alike for all cameras: the least change of light
    tells their ratio, since an exposure of both pulses adds light.

    Parameters
    ----------
    first, second : mapping of str to ndarray, shape (rows, columns)
        Images of both frames, camera -> image without its dark level [counts].
    """
    frames = {
        order: {name: _BrightLight.from_image(image) for name, image in images.items()}
        for order, images in (("first", first), ("second", second))
    }
    told = []
    for held, holding in (("first", "second"), ("second", "first")):
        ratios = {name: light.mean and frames[holding][name].mean / light.mean for name, light in frames[held].items()}
        for name, light in frames[held].items():
            others = sorted(ratio for ratio in ratios.values() if 2 * ratio > ratios[name]) or [ratios[name]]
            pulses = others[(len(others) - 1) // 2]
            share, back = light.kept(frames[holding][name]), frames[holding][name].kept(light)
            if share > HELD * pulses and back * pulses < ALIKE * share / pulses:
                told.append((share / pulses, held, holding, name))
    clearest = max(told, default=(0.0, "", "", ""))[1]  # beside a camera whose light grew, others seem to lose light
    return [
        Warning(code=Code.DOUBLE, subject=name, figures={"held": held, "holding": holding})
        for _, held, holding, name in told
        if held == clearest
    ]


@dataclass(frozen=True, eq=False)
class _BrightLight:
    """Pixels of a frame, a sample of them in large images, and what its brightest ones show."""

    pixels: np.ndarray  # [counts], (n,)
    level: float  # of the dimmest of the brightest pixels [counts]
    mean: float  # of the brightest pixels, 0 without any [counts]

    @classmethod
    def from_image(cls, image: np.ndarray) -> _BrightLight:
        pixels = _sample(image)
        level = max(float(np.quantile(pixels, _BRIGHT)), 1e-9)
        bright = pixels[pixels >= level]
        return cls(pixels, level, float(bright.mean()) if bright.size else 0.0)

    def kept(self, other: _BrightLight) -> float:
        """Return the share of their light that all but a part `_LOST` of bright pixels keep in another frame.

        Pixels count from `_DIMMER` times the brightness of the brightest ones on, which may show a single particle.
        Without any the share is 0.
        """
        bright = self.pixels >= _DIMMER * self.level
        return float(np.quantile(other.pixels[bright] / self.pixels[bright], _LOST)) if bright.any() else 0.0


def _sample(image: np.ndarray) -> np.ndarray:
    """Return the pixels of an image; of a large one every n-th, `_BRIGHT_SAMPLES` at most."""
    return image.ravel()[:: 1 + image.size // _BRIGHT_SAMPLES]


def require_different(images: Iterable[tuple[str, bytes]]) -> None:
    """Refuse a pair with two equal images. Noise makes recorded images differ, so one is a copy.

    Parameters
    ----------
    images : iterable of (str, bytes)
        Origin and `fingerprint` of each image.

    Raises
    ------
    InputError
        Names both origins.
    """
    seen: dict[bytes, str] = {}
    for where, mark in images:
        other = seen.setdefault(mark, where)
        if other != where:
            raise InputError(
                f"{where}: expected an image of its own, found the same image as {other}. Check particles.images, and "
                "what was copied."
            )


def same_light(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether two images show one exposure: but for some pixels bright ones have the same counts in both.

    Clipped pixels do not count. A constant may be added, such as a background. Of images that were compressed with
    losses, or converted to fewer bits, counts differ.

    Parameters
    ----------
    first, second : ndarray, shape (rows, columns)
        Images [counts].
    """
    one, other = _sample(first), _sample(second)
    if one.shape != other.shape:
        return False
    lit = (one < one.max()) & (other < other.max())
    if not lit.any():
        return False
    level, background = np.quantile(one[lit], (_BRIGHT, 0.5))
    bright = lit & (one >= level) & (one > background)  # few particles on a background without noise: these alone
    if not bright.any():
        return False
    change = other[bright].astype(float) - one[bright]
    return float(np.mean(np.abs(change - np.median(change)) < _SAME_COUNTS)) >= SAME


def fingerprint(image: np.ndarray) -> bytes:
    """Return a hash of an image's pixels."""
    return hashlib.blake2b(image.tobytes(), digest_size=16).digest()
