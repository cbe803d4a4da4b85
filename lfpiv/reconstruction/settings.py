"""`SmartSettings`: the settings of SMART, checked. They are the keys of table ``[smart]`` of an experiment file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lfpiv.geometry.volume import is_finite
from lfpiv.settings.processing import Smart

NORMALISATIONS = ("column", "paper")
AUTO = "auto"
"""Value of `sieve_voxel`, `intensity_cap` and `subsets` that is chosen for the images."""
DEFAULTS = Smart()
"""Settings of SMART where none are stated."""
PLAIN: dict[str, Any] = {"intensity_cap": 0.0, "sieve_voxel": 0.0, "subsets": 1, "tolerance": 0.0}
"""Settings of SMART over all rays, without intensity cap and sieve, in a given number of iterations."""


@dataclass(frozen=True, kw_only=True)
class SmartSettings:
    """Settings of SMART. Its defaults hold for the table ``[smart]`` of an experiment file, too.

    Raises
    ------
    ValueError
        If a value is out of its range.
    """

    iterations: int = DEFAULTS.iterations
    """Largest number of iterations, >= 0."""
    relaxation: float = DEFAULTS.relaxation
    """Relaxation parameter mu, > 0; 1 is safe, 3 diverges."""
    floor_share: float = DEFAULTS.floor_share
    """Least floor as a share of each image's brightness, sum I^2 / sum I, hot pixels left out. Particles smaller than a
    voxel light fewer pixels than the voxel; the floor keeps the dark pixels beside them from counting against it. 0
    takes `floor` as it is."""
    intensity_cap: float | str = DEFAULTS.intensity_cap
    """Upper limit of the counts as a multiple of the typical peak: the brightest pixel of each lit microimage, median
    over microimages. 0 for none. It makes particles of unlike brightness more alike between cameras and frames
    (`lfpiv.reconstruction.intensity_cap`). "auto": none if the images show equally bright particles
    (`lfpiv.reconstruction.particle_size`); otherwise 1 for particles that ``sieve_voxel = "auto"`` finds smaller than
    voxels, and 2 for larger ones."""
    normalisation: str = DEFAULTS.normalisation
    """Which of the two iterations that `lfpiv.reconstruct` states: "column" or "paper"."""
    accelerate: bool = DEFAULTS.accelerate
    """False iterates without momentum, as those formulas do. Then, without sieve and tolerance, 5 iterations and 7
    more with the first volume as its `first` equal 12 exactly. Momentum starts anew with every call."""
    sieve_voxel: float | str = DEFAULTS.sieve_voxel
    """Standard deviation [voxel] of a sieve: the volume is a sum of Gaussians of this size, E = G c, and SMART iterates
    their brightnesses c with w G in place of w (`lfpiv.reconstruction.steps`). 0 for none. "auto": matched to the size
    of the particles, which is measured in the images (`lfpiv.reconstruction.particle_size`); none for particles smaller
    than voxels."""
    tolerance: float = DEFAULTS.tolerance
    """Stop when the misfit falls by less than this fraction in an iteration; 0 runs all iterations."""
    subsets: int | str = DEFAULTS.subsets
    """Number of ordered subsets of the rays, each of which makes a step (`lfpiv.reconstruction.ordered_subsets`): 1
    for SMART over all rays, or more. Where planes of voxels share profiles (`lfpiv.weights.forms.shared_profiles`) a
    subset is some rows of pixels under the lenses of all cameras, and there are up to 16, by default as many as
    possible, until they contradict each other or have made 128 steps. Otherwise it is a camera or half of its lenses:
    "auto" takes halves of one or two cameras, until they contradict each other, then whole cameras, as for more of
    them. An iteration is a pass over all subsets; the last two iterations, at most half of them, are SMART's own.
    "auto" is 1 without `accelerate`, or with "paper"."""

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
