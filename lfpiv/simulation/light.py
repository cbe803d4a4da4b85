"""Light of a scene: the sheet and its two pulses, brightness of the particles, and stray light."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from lfpiv.settings.bounds import Coordinate, Direction, Length, NonNegative
from lfpiv.settings.table import Table

Pulses = tuple[NonNegative, NonNegative]
LogSd = Annotated[float, Field(strict=True, ge=0, le=2)]

DIM_SHARE = 0.05
"""Share of a sheet's light below which it lights no particle worth mentioning."""

MODES = 24
"""Cosines that make up the slow variation of stray light."""


class Brightness(Table):
    """Table ``[brightness]``: log-normal scatter of the particles' brightness, in addition to `intensity_sd`.

    Both scatters leave the mean brightness unchanged. A particle keeps its brightness in both frames.
    """

    camera_log_sd: LogSd = 0.0
    """Standard deviation of the logarithm of a particle's brightness, drawn separately for each camera. Small particles
    scatter light unevenly over directions, so two cameras see the same particle unlike bright."""
    size_log_sd: LogSd = 0.0
    """Standard deviation of the logarithm of the particles' diameter, equal for all cameras."""
    size_exponent: Annotated[float, Field(strict=True, ge=0, le=6)] = 2.0
    """Exponent with which brightness grows with the diameter: 2 for particles larger than the wavelength, 6 for much
    smaller ones."""

    def diameters(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw diameters relative to the median, shape (count,)."""
        return np.exp(self.size_log_sd * rng.standard_normal(count))

    def intensity_of(self, diameter: np.ndarray) -> np.ndarray:
        """Return the brightness of particles of given relative diameters, of mean 1 over the distribution."""
        spread = self.size_exponent * self.size_log_sd
        return diameter**self.size_exponent * np.exp(-(spread**2) / 2)

    def camera_factors(self, cameras: int, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw the particles' brightness in each camera, of mean 1, shape (cameras, count)."""
        drawn = self.camera_log_sd * rng.standard_normal((cameras, count))
        return np.exp(drawn - self.camera_log_sd**2 / 2)


class Sheet(Table):
    """Table ``[sheet]``: the light sheet of the two pulses.

    A list of two values states first and second pulse; one value holds for both. In a time series the two pulses take
    turns, the first one at the first instant. The sheet lights particles only. Bright surfaces and stray light through
    the lens follow the pulses' power.
    """

    profile: Literal["even", "top_hat", "gaussian"] = "even"
    """Profile across the sheet: even everywhere, even inside the thickness, or Gaussian."""
    thickness_mm: Length | tuple[Length, Length] | None = None
    """Thickness: the width of a top hat, the width between 1/e^2 of the middle of a Gaussian [mm]."""
    position_mm: Coordinate | tuple[Coordinate, Coordinate] = 0.0
    """Position of the sheet's middle along `direction`, from the world's origin [mm]."""
    direction: Direction = (0.0, 0.0, 1.0)
    """Direction across the sheet (x, y, z), of any length."""
    power: Pulses = (1.0, 1.0)
    """Power of the first and the second pulse."""
    power_sd: Annotated[float, Field(strict=True, ge=0, le=0.3)] = 0.0
    """Standard deviation of each pulse's power from pair to pair or instant to instant, relative to its mean."""

    @model_validator(mode="after")
    def _thickness_fits_profile(self) -> Sheet:
        if self.profile == "even" and self.thickness_mm is not None:
            raise ValueError('thickness_mm only with profile = "top_hat" or "gaussian"')
        if self.profile != "even" and self.thickness_mm is None:
            raise ValueError(f'thickness_mm with profile = "{self.profile}"')
        return self

    def distance_mm(self, points_mm: np.ndarray, pulse: int) -> np.ndarray:
        """Return the signed distance of points (n, 3) from the middle of a pulse's sheet, shape (n,) [mm]."""
        direction = np.asarray(self.direction, float) / np.linalg.norm(self.direction)
        return np.asarray(points_mm, float) @ direction - _of_pulse(self.position_mm, pulse)

    def light(self, points_mm: np.ndarray, pulse: int) -> np.ndarray:
        """Return the light of a pulse at points (n, 3) [mm], relative to its middle, shape (n,)."""
        if self.thickness_mm is None:
            return np.ones(len(points_mm))
        distance, half = self.distance_mm(points_mm, pulse), _of_pulse(self.thickness_mm, pulse) / 2
        top_hat: np.ndarray = np.abs(distance) <= half
        gaussian: np.ndarray = np.exp(-2 * (distance / half) ** 2)
        return top_hat.astype(float) if self.profile == "top_hat" else gaussian

    def lit_mm(self, pulse: int) -> tuple[float, float]:
        """Return from where to where along `direction` a pulse has more than `DIM_SHARE` of its light [mm]."""
        if self.thickness_mm is None:
            return -np.inf, np.inf
        half, middle = _of_pulse(self.thickness_mm, pulse) / 2, _of_pulse(self.position_mm, pulse)
        reach = half if self.profile == "top_hat" else half * float(np.sqrt(-np.log(DIM_SHARE) / 2))
        return middle - reach, middle + reach

    def powers(self, rng: np.random.Generator) -> np.ndarray:
        """Draw the power of both pulses of one pair, shape (2,)."""
        return np.clip(np.asarray(self.power) * (1 + self.power_sd * rng.standard_normal(2)), 0, None)


def _of_pulse(value: float | tuple[float, float], pulse: int) -> float:
    return value[pulse] if isinstance(value, tuple) else value


class StrayLight(Table):
    """Table ``[stray_light]``: smooth light that is not from particles."""

    lens_counts: NonNegative = 0.0
    """Mean level of a pixel that is completely inside a microimage, of light through main lens and microlenses, which
    the microlenses modulate as in a white image [count]. It follows the pulses' power."""
    ambient_counts: NonNegative = 0.0
    """Mean level of light that reaches the sensor directly, equal between and inside microimages [count]. It is equal
    in both frames."""
    variation: Annotated[float, Field(strict=True, ge=0, le=0.5)] = 0.0
    """Standard deviation of the slow variation over the sensor, relative to the mean."""
    length_mm: Length = 2.0
    """Length of the variation on the sensor: the inverse of its standard wave number [mm/rad]."""

    def fields(
        self, sensor_shape: tuple[int, int], pixel_mm: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Draw the slow variation of light through the lens and of ambient light, each (rows, columns), of mean 1."""
        first, second = (self._field(sensor_shape, pixel_mm, rng) for _ in range(2))
        return first, second

    def _field(self, shape: tuple[int, int], pixel_mm: float, rng: np.random.Generator) -> np.ndarray:
        """Draw a smooth random field of mean 1, without negative values."""
        wave = rng.standard_normal((MODES, 2)) / self.length_mm
        phase = rng.uniform(0, 2 * np.pi, MODES)
        row, column = (np.arange(n) * pixel_mm for n in shape)
        along, across = np.exp(1j * np.outer(wave[:, 0], row)), np.exp(1j * (np.outer(wave[:, 1], column).T + phase)).T
        field = np.einsum("mr,mc->rc", along, across, optimize=True).real
        deviation = field.std()
        field = (field - field.mean()) / deviation if deviation > 0 else np.zeros(shape)
        return np.maximum(0, 1 + self.variation * field)


class PairLight(NamedTuple):
    """Light of one pair."""

    power: np.ndarray
    """Power of both pulses, shape (2,)."""
    brightness: np.ndarray
    """Brightness of each particle in each camera and frame, power included, shape (cameras, 2, particle)."""


def pair_light(
    sheet: Sheet | None,
    brightness: np.ndarray,
    at_frames: tuple[np.ndarray, np.ndarray],
    rng: np.random.Generator,
) -> PairLight:
    """Return the brightness of the particles of one pair in each camera and frame.

    Parameters
    ----------
    sheet : Sheet or None
        The light sheet; without one both pulses are even and equal.
    brightness : ndarray, shape (cameras, particle)
        Brightness in each camera, in the middle of a sheet of power 1.
    at_frames : (ndarray, ndarray), each of shape (particle, 3)
        Positions in both frames [mm].
    rng : Generator
        Generator of the pulses' power.
    """
    if sheet is None:
        return PairLight(np.ones(2), np.repeat(brightness[:, None], 2, axis=1))
    power = sheet.powers(rng)
    lit = np.stack([power[pulse] * sheet.light(at, pulse) for pulse, at in enumerate(at_frames)])
    return PairLight(power, brightness[:, None] * lit)


def pulse_light(
    sheet: Sheet | None, brightness: np.ndarray, at_mm: np.ndarray, pulse: int, rng: np.random.Generator
) -> tuple[float, np.ndarray]:
    """Return the power of a pulse, and the brightness of particles in each camera, shape (cameras, particle).

    Parameters as of `pair_light`; `at_mm` (particle, 3) are the positions in the light of the pulse, 0 or 1 [mm].
    """
    if sheet is None:
        return 1.0, brightness
    power = float(sheet.powers(rng)[pulse])
    return power, brightness * power * sheet.light(at_mm, pulse)
