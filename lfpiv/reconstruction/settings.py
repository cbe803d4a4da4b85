"""`SmartSettings`: the settings of SMART, checked. They are the keys of table ``[smart]`` of an experiment file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lfpiv.geometry.volume import is_finite
from lfpiv.settings.processing import Smart

NORMALISATIONS = ("column", "paper")
AUTO = "auto"
"""Sieve and intensity cap that suit the size and the brightness of the particles."""
DEFAULTS = Smart()
"""Settings of SMART where none are stated."""
PLAIN: dict[str, Any] = {"intensity_cap": 0.0, "sieve_voxel": 0.0, "subsets": 1, "tolerance": 0.0}
"""Settings of SMART over all rays, without limit of the counts and sieve, in a given number of iterations."""


@dataclass(frozen=True, kw_only=True)
class SmartSettings:
    """Settings of SMART; `lfpiv.reconstruct` describes each. The defaults are those of the table ``[smart]``.

    Raises
    ------
    ValueError
        If a value is out of its range.
    """

    iterations: int = DEFAULTS.iterations
    relaxation: float = DEFAULTS.relaxation
    floor_share: float = DEFAULTS.floor_share
    intensity_cap: float | str = DEFAULTS.intensity_cap
    normalisation: str = DEFAULTS.normalisation
    accelerate: bool = DEFAULTS.accelerate
    sieve_voxel: float | str = DEFAULTS.sieve_voxel
    tolerance: float = DEFAULTS.tolerance
    subsets: int | str = DEFAULTS.subsets

    @property
    def allows_subsets(self) -> bool:
        """Whether the other settings leave ordered subsets possible."""
        return self.accelerate and self.normalisation == "column"

    def __post_init__(self) -> None:
        require_whole("iterations", self.iterations)
        if not (is_finite(self.relaxation) and self.relaxation > 0):
            raise ValueError(f"relaxation: expected a number > 0, got {self.relaxation!r}.")
        if self.normalisation not in NORMALISATIONS:
            raise ValueError(f"normalisation: expected one of {', '.join(NORMALISATIONS)}, got {self.normalisation!r}.")
        if self.subsets != AUTO:
            require_whole("subsets", self.subsets)
            if self.subsets == 0:
                raise ValueError(f'subsets: expected a whole number >= 1 or "{AUTO}", got 0.')
            if self.subsets != 1 and not self.allows_subsets:
                raise ValueError(
                    "subsets: ordered subsets need momentum (`accelerate`) and the normalisation by column sums."
                )
        for name in ("floor_share", "intensity_cap", "sieve_voxel", "tolerance"):
            value, choice = getattr(self, name), f' or "{AUTO}"' if name in ("sieve_voxel", "intensity_cap") else ""
            if choice and isinstance(value, str) and value == AUTO:
                continue
            if not (is_finite(value) and value >= 0):
                raise ValueError(f"{name}: expected a number >= 0{choice}, got {value!r}.")


def require_whole(name: str, value: object) -> None:
    """Raise ValueError unless a value is a whole number >= 0."""
    if not (isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= 0):
        raise ValueError(f"{name}: expected a whole number >= 0, got {value!r}.")
