"""Light of a camera that stands still in its particle images: what to subtract, at which power, and what is left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.warn import Code, Warning

LEAST_RATIO_PIXELS = 500
"""Least number of bright pixels that give the brightness of the standing light in an image."""
POWER_RANGE = (0.5, 2.0)
"""Accepted brightness of the standing light in an image, relative to the estimate."""
LARGE_REMAINS = 3.0
"""Light left after subtraction where light stands, relative to other lit places, above which a warning is due."""
LEAST_REMAINS = 0.02
"""Least share of an image's light that such light has. Less hardly matters and may be that of bright particles."""

_DARK_PERCENTILE = 50.0  # percentile below which a pixel of an image of particles counts as dark
_BRIGHT = 50.0  # percentile of the standing light above which pixels tell its brightness


@dataclass(frozen=True, eq=False, kw_only=True)
class StandingLight:
    """Light of a camera that stands still, for both frames."""

    light: tuple[np.ndarray, np.ndarray]
    """Standing light of the first and of the second frame above the dark level [counts], shape (rows, columns)."""
    unusable: np.ndarray
    """Pixels that standing light saturates, or that never change, bool."""
    found: bool
    """Whether any light stands; without, `light` is 0."""
    region: np.ndarray
    """Pixels whose light stands, without smooth stray light, bool."""
    stray: float
    """Smooth stray light, median over the sensor [counts]."""
    ratio: float | None
    """Brightness of the second frame's standing light relative to the first's; None if the frames differ."""
    share: float = 0.0
    """Light in `pixels` as a share of all light of an image; 0 for a background image."""
    at_rest: bool = False
    """Whether light stands nearly everywhere, as that of particles at rest, and is therefore not taken."""

    @property
    def pixels(self) -> np.ndarray:
        """Pixels with light that stands, or unusable ones: no particle alone saturates them, bool."""
        return self.region | self.unusable

    @property
    def figures(self) -> dict[str, object]:
        """Fields that are no arrays."""
        return {"found": self.found, "stray": self.stray, "ratio": self.ratio, "share": self.share}

    @property
    def place(self) -> str:
        """Columns and rows of the sensor between which the largest area of standing light lies; empty for none."""
        areas, count = ndimage.label(self.pixels, np.ones((3, 3)))
        if not count:
            return ""
        largest = 1 + int(np.argmax(np.bincount(areas.ravel())[1:]))
        rows, columns = ndimage.find_objects(areas)[largest - 1]
        return f"columns {columns.start} to {columns.stop - 1}, rows {rows.start} to {rows.stop - 1}"

    def remains(self, first: np.ndarray, second: np.ndarray) -> float:
        """Return the light left in both frames where light stands, relative to that of other lit places.

        Parameters
        ----------
        first, second : ndarray, shape (rows, columns)
            Frames after `subtract` [counts].
        """
        both = np.minimum(first, second)
        inside, outside = self.region & ~self.unusable, ~self.pixels
        if np.count_nonzero(inside) < LEAST_RATIO_PIXELS or not outside.any():
            return 0.0
        usual = both[outside]
        usual = usual[usual > np.percentile(usual, _DARK_PERCENTILE)]
        return float(both[inside].mean() / usual.mean()) if usual.mean() > 0 else 0.0

    def subtract(self, light: np.ndarray, noise: float, frame: int) -> tuple[np.ndarray, float]:
        """Subtract the standing light from an image at the brightness that it has there.

        Parameters
        ----------
        light : ndarray, shape (rows, columns), float32
            Image without its dark level [counts].
        noise : float
            Its noise [counts].
        frame : int
            0 or 1.

        Returns
        -------
        light : ndarray
            Image of the particles; unusable pixels are 0.
        noise : float
            Noise, of the subtracted light too [counts].
        """
        standing = self.light[frame]
        power = self.power(light, frame)
        left = light - np.float32(power) * standing
        left[self.unusable] = 0
        part = self.region & ~self.unusable
        below = left[part & (left < 0)]
        if below.size:  # photon noise of the subtracted light
            share = np.count_nonzero(part) / part.size
            noise = float(np.sqrt((1 - share) * noise**2 + share * np.mean(below**2, dtype=float)))
        return left, noise

    def power(self, light: np.ndarray, frame: int) -> float:
        """Return the brightness of the standing light in an image relative to the estimate; 1 where it is too dim."""
        standing = self.light[frame]
        usable = self.region & ~self.unusable
        if np.count_nonzero(usable) < LEAST_RATIO_PIXELS:
            return 1.0
        bright = usable & (standing > np.percentile(standing[usable], _BRIGHT))
        if not bright.any():
            return 1.0
        found = mode(light[bright] / standing[bright])
        return found if POWER_RANGE[0] < found < POWER_RANGE[1] else 1.0


def nothing(decoder: LightFieldDecoder) -> StandingLight:
    """Return no standing light."""
    none = np.zeros(decoder.gain.shape, bool)
    dark = np.zeros(decoder.gain.shape, np.float32)
    return StandingLight(light=(dark, dark), unusable=none, found=False, region=none, stray=0.0, ratio=None)


def remains_warnings(standing: StandingLight, first: np.ndarray, second: np.ndarray, camera: str) -> list[Warning]:
    """Warn of light left in both frames of a camera where standing light was subtracted."""
    left = np.minimum(first, second).sum(where=standing.region, dtype=float)
    share = float(np.clip(left / max(float(first.sum(dtype=float)), 1e-9), 0, 1))
    if share < LEAST_REMAINS or standing.remains(first, second) <= LARGE_REMAINS:
        return []
    remedy = "what was subtracted does not fit this pair; record a background image (camera.background_image)"
    figures = {"place": standing.place, "share": share, "remedy": remedy}
    return [Warning(code=Code.STANDING, subject=camera, figures=figures)]


def mode(values: np.ndarray) -> float:
    """Return the half-sample mode: the place where values lie closest, which a tail on one side hardly moves."""
    values = np.sort(np.asarray(values, float))
    while len(values) > 3:
        half = (len(values) + 1) // 2
        widths = values[half - 1 :] - values[: len(values) - half + 1]
        narrowest = np.flatnonzero(widths == widths.min())
        first = int(narrowest[len(narrowest) // 2])
        values = values[first : first + half]
    return float(values.mean())
