"""Figures of quality of one camera's calibration, as files and the summary store them under the fields' names."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class LensArrayQuality:
    """Figures of a camera's microlens array, found in its white image."""

    lens_array_rms_px: float
    """Root mean square distance between measured microimage centres and the lattice [pixel]."""
    lens_array_pitch_px: float
    """Distance of neighbouring microimages [pixel]."""
    lens_array_rotation_deg: float
    """Rotation of the lattice on the sensor, from +column towards +row [degree]."""
    lenses: int
    """Microimages whose centres lie on the sensor."""

    def __getitem__(self, name: str) -> Any:
        """Return a figure by its name, so that scripts can read the report as they read the summary."""
        return self.to_json()[name]

    def to_json(self) -> dict[str, Any]:
        """Return the figures by name. `from_json` is the inverse."""
        return dataclasses.asdict(self)

    @staticmethod
    def from_json(stored: Mapping[str, Any]) -> LensArrayQuality:
        """Read figures that `to_json` returned, of the class that was stored. Ignore other keys.

        Raises
        ------
        TypeError
            If a figure is missing.
        """
        kind = CalibrationQuality if "sigma_nor_test" in stored else LensArrayQuality
        return kind(**{field.name: stored[field.name] for field in dataclasses.fields(kind) if field.name in stored})


@dataclass(frozen=True, kw_only=True)
class CalibrationQuality(LensArrayQuality):
    """Figures of a camera's mapping and of the board's dots as well."""

    turn_from_nominal_deg: float
    """Rotation of the camera from its nominal orientation [degree]. nan without one."""
    magnification: float
    """Magnification at the middle of the board."""
    sigma_nor_test: float
    """Estimated mean error of the mapping within 0.9 of the pupil's radius [microlens pitch]: of the labels' noise, of
    the training, and of what all labels share. Errors of the board are corrected."""
    sigma_nor_stated: float = math.nan
    """Mean distance of the mapping to held-out dots where they are stated to be, Eq. 8 [microlens pitch]: errors of the
    dots' labels, of the mapping and of the board together."""
    dots_found: int
    """Dots measured in all planes."""
    dots_expected: int
    """Dots of all planes in the camera's field."""
    dots_found_per_plane: list[int]
    """Dots measured in each plane."""
    dots_expected_per_plane: list[int]
    """Dots of each plane in the camera's field."""
    dots_rejected: int
    """Dots seen but not used: a poor fit, or in disagreement with their neighbours."""
    labels: int
    """Labelled rays used for the mapping."""
    epochs: int
    """Epochs of the training."""
    stop: str
    """Reason why the training ended."""
    training_s: float
    """Wall time of the training [s]."""
    network_shrinkage: float
    """Factor on the network's correction of the thin lens, from 0 to 1. 1 without a thin lens."""
    dot_diameter_mm: float
    """Diameter of the dots as they appear [mm]."""
    blur_px: float
    """Standard deviation of the blur of sensor and microlenses [pixel]. nan for the Gaussian estimator."""
    response_share: float
    """Part of the white image's variance from pixel to pixel that is pixel response. nan for the Gaussian estimator."""
