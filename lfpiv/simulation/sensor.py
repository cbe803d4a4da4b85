"""Sensor of a simulated camera: noise, range, fixed patterns and bad pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from lfpiv.settings.bounds import NonNegative, Positive
from lfpiv.settings.table import Table

FULL_SCALE = 4095
"""Largest count of a camera of 12 bits."""

SmallShare = Annotated[float, Field(strict=True, ge=0, le=0.1)]


class Noise(Table):
    """Table ``[noise]``: noise of the cameras."""

    background: NonNegative = 40.0
    """Level without light [count]."""
    read_noise: NonNegative = 3.0
    """Standard deviation of the read-out [count]."""
    full_well_e: NonNegative = 10_000.0
    """Electrons at full scale, which determine the shot noise; 0 switches it off."""


class Sensor(Table):
    """Table ``[sensor]`` or ``[camera.sensor]``: fixed patterns and range of the sensor.

    Patterns are drawn once for each camera and are equal in all its images, dark image included.
    """

    gain_sd: Annotated[float, Field(strict=True, ge=0, le=0.3)] = 0.0
    """Standard deviation of the pixels' gain, relative."""
    column_sd_counts: NonNegative = 0.0
    """Standard deviation of the columns' offset [count]."""
    dark_counts: NonNegative = 0.0
    """Mean level of the dark current, which has shot noise [count]."""
    dark_log_sd: Annotated[float, Field(strict=True, ge=0, le=2)] = 0.0
    """Standard deviation of the logarithm of the pixels' dark current; its mean is unchanged."""
    hot_share: SmallShare = 0.0
    """Share of hot pixels."""
    hot_counts: Positive | None = None
    """Largest dark level of hot pixels, whose levels spread evenly below it [count]; absent: full scale."""
    dead_share: SmallShare = 0.0
    """Share of dead pixels, which record no light."""
    bits: Annotated[int, Field(strict=True, ge=8, le=16)] = 12
    """Bits of a stored pixel."""
    saturation_counts: Positive | None = None
    """Level at which pixels saturate, offsets included [count]; absent: full scale."""

    @model_validator(mode="after")
    def _saturates_within_bits(self) -> Sensor:
        if self.saturation_counts is not None and self.saturation_counts > self.full_scale:
            raise ValueError(f"saturation_counts up to {self.full_scale}, the full scale of {self.bits} bits")
        return self

    @property
    def full_scale(self) -> int:
        """Largest stored count."""
        return int(2**self.bits) - 1

    @property
    def largest(self) -> float:
        """Largest count that a pixel reaches."""
        return self.full_scale if self.saturation_counts is None else self.saturation_counts


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorPattern:
    """Fixed pattern of one camera's sensor; all arrays have shape (rows, columns), before `image_flip`."""

    gain: np.ndarray
    """Counts per count of light; 0 at dead pixels."""
    offset: np.ndarray
    """Offset of the read-out, without `Noise.background` [count]."""
    dark: np.ndarray
    """Dark current [count]."""
    hot: np.ndarray
    """Whether a pixel is hot."""
    dead: np.ndarray
    """Whether a pixel is dead."""


def draw_pattern(sensor: Sensor, shape: tuple[int, int], rng: np.random.Generator) -> SensorPattern:
    """Draw the fixed pattern of a sensor.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    rng : Generator
        Generator. Each table key draws the same whatever the other keys are.
    """
    gain = np.maximum(0, 1 + sensor.gain_sd * rng.standard_normal(shape))
    offset = np.broadcast_to(sensor.column_sd_counts * rng.standard_normal(shape[1]), shape)
    spread = sensor.dark_log_sd * rng.standard_normal(shape)
    dark = sensor.dark_counts * np.exp(spread - sensor.dark_log_sd**2 / 2)
    chosen, level = rng.random(shape), rng.random(shape)
    hot, dead = chosen < sensor.hot_share, chosen >= 1 - sensor.dead_share
    dark = np.where(hot, dark + level * (sensor.hot_counts or sensor.full_scale), np.where(dead, 0, dark))
    return SensorPattern(gain=np.where(dead, 0, gain), offset=offset, dark=dark, hot=hot, dead=dead)
