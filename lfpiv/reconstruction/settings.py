"""`SmartSettings`: the settings of SMART, checked. They are the keys of table ``[smart]`` of an experiment file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv.geometry.volume import is_finite

NORMALISATIONS = ("column", "paper")
AUTO = "auto"
"""Sieve and intensity cap that suit the size and the brightness of the particles."""
FLOOR_SHARE = 0.1
"""Default of the least noise floor, as a share of an image's brightness."""


@dataclass(frozen=True, kw_only=True)
class SmartSettings:
    """Settings of SMART; `lfpiv.reconstruct` describes each.

    Raises
    ------
    ValueError
        If a value is out of its range.
    """

    iterations: int = 10
    relaxation: float = 1.0
    floor_share: float = FLOOR_SHARE
    intensity_cap: float | str = 0.0
    normalisation: str = "column"
    accelerate: bool = True
    smoothing_voxel: float = 0.0
    sieve_voxel: float | str = 0.0
    active_share: float = 0.0
    tolerance: float = 0.0
    subsets: int | str = 1

    @property
    def allows_subsets(self) -> bool:
        """Whether the other settings leave ordered subsets possible."""
        return self.accelerate and self.normalisation == "column" and self.smoothing_voxel == 0

    def __post_init__(self) -> None:
        require_whole("iterations", self.iterations)
        if not (is_finite(self.relaxation) and self.relaxation > 0):
            raise ValueError(f"relaxation: expected a number > 0, got {self.relaxation!r}.")
        if self.normalisation not in NORMALISATIONS:
            raise ValueError(f"normalisation: expected one of {', '.join(NORMALISATIONS)}, got {self.normalisation!r}.")
        if not (is_finite(self.active_share) and 0 <= self.active_share < 1):
            raise ValueError(f"active_share: expected a number from 0 to below 1, got {self.active_share!r}.")
        if self.subsets != AUTO:
            require_whole("subsets", self.subsets)
            if self.subsets == 0:
                raise ValueError(f'subsets: expected a whole number >= 1 or "{AUTO}", got 0.')
            if self.subsets != 1 and not self.allows_subsets:
                raise ValueError(
                    "subsets: ordered subsets need momentum (`accelerate`), the normalisation by column sums and no "
                    "smoothing between iterations."
                )
        for name in ("floor_share", "intensity_cap", "smoothing_voxel", "sieve_voxel", "tolerance"):
            value, choice = getattr(self, name), f' or "{AUTO}"' if name in ("sieve_voxel", "intensity_cap") else ""
            if choice and isinstance(value, str) and value == AUTO:
                continue
            if not (is_finite(value) and value >= 0):
                raise ValueError(f"{name}: expected a number >= 0{choice}, got {value!r}.")


def require_whole(name: str, value: object) -> None:
    """Raise ValueError unless a value is a whole number >= 0."""
    if not (isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= 0):
        raise ValueError(f"{name}: expected a whole number >= 0, got {value!r}.")
