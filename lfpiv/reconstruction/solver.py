"""`SmartSolver`: SMART for one rig. Made once, it reconstructs the volume of every frame from its images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np
import xarray as xr

from lfpiv.geometry.volume import checked_mask
from lfpiv.reconstruction.depth_spread import rows_resolve_depth
from lfpiv.reconstruction.frame import PreparedFrame
from lfpiv.reconstruction.image_preparation import checked_images, prepare_images
from lfpiv.reconstruction.intensity_cap import CAP, POINT_CAP
from lfpiv.reconstruction.normalisation import LensSubsets, RowSubsets
from lfpiv.reconstruction.ordered_subsets import Subset, joint_subsets, subsets_of, whole_subset
from lfpiv.reconstruction.particle_size import UNLIKE, ParticleSizer
from lfpiv.reconstruction.result import Reconstruction
from lfpiv.reconstruction.settings import AUTO, SmartSettings
from lfpiv.reconstruction.sieve import Sieve
from lfpiv.reconstruction.smart import CameraEquation, ImageEquations
from lfpiv.weights.operator import Weights
from lfpiv_kernels.reconstruction.pixel_rays import ALL

FEW_CAMERAS = 2
"""Number of cameras up to which "auto" cuts the rays of each camera into two subsets."""
LEAST_ALONE = 0.8
"""Least share of a camera's pixels that see one set of rays only."""

Volume = np.ndarray | xr.DataArray


class SmartSolver:
    """SMART with fixed weights and settings.

    Parameters
    ----------
    settings : SmartSettings
        Settings of every reconstruction.
    """

    def __init__(self, weights: Weights, settings: SmartSettings):
        self.weights = weights
        self.settings = settings
        self._last: tuple[tuple[object, ...], np.ndarray | None, LensSubsets | RowSubsets] | None = None

    def solve(
        self,
        images: Mapping[str, np.ndarray],
        *,
        floor: float | Mapping[str, float] | None = None,
        mask: Volume | None = None,
        iterations: int | None = None,
        first: np.ndarray | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Reconstruction:
        """Reconstruct one frame; arguments and exceptions as of `lfpiv.reconstruct`.

        `iterations` replaces that of the settings.
        """
        prepared = self.prepare(images, floor=floor, mask=mask)
        return prepared.solve(iterations=iterations, first=first, progress=progress)

    def prepare(
        self,
        images: Mapping[str, np.ndarray],
        *,
        floor: float | Mapping[str, float] | None = None,
        mask: Volume | None = None,
    ) -> PreparedFrame:
        """Measure what SMART needs to know of the images of one frame; arguments and exceptions as of `solve`."""
        images = checked_images(self.weights, images)
        solid = None if mask is None else checked_mask(mask, self.weights.grid.axes_mm)
        sieve, cap = self._sieve_and_cap(images)
        share = self.settings.floor_share
        prepared = prepare_images(self.weights, images, floor=floor, floor_share=share, intensity_cap=cap)
        normalisation = self._normalisation({name: one.camera_gain for name, one in prepared.items()}, sieve, solid)
        equations = ImageEquations(
            [
                CameraEquation(
                    image=one.image,
                    gain=normalisation.gains[name],
                    floor=one.floor,
                    projector=self.weights.projector(name),
                )
                for name, one in prepared.items()
            ]
        )
        return PreparedFrame(
            stored=self.weights.stored,
            settings=self.settings,
            images=prepared,
            normalisation=normalisation,
            intensity_cap=cap,
            solid=solid,
            views=self._views,
            equations=equations,
        )

    def _normalisation(
        self, camera_gains: dict[str, float], sieve: Sieve, solid: np.ndarray | None
    ) -> LensSubsets | RowSubsets:
        """Return what all frames with these brightnesses, sieve and mask share; the last is kept."""
        key = (*camera_gains.values(), sieve)
        if self._last is None or self._last[0] != key or not _same(self._last[1], solid):
            kind = RowSubsets if self.weights.rows > 1 and len(self.subsets) > 1 else LensSubsets
            made = kind(self.weights, self.settings, self.subsets, solid, camera_gains, sieve)
            self._last = key, solid, made
        return self._last[2]

    @cached_property
    def subsets(self) -> tuple[Subset, ...]:
        """The ordered subsets to begin with; one without any.

        Raises
        ------
        ValueError
            If the rays cannot be cut into the number of subsets that the settings ask for.
        """
        cameras, wanted = len(self.weights.cameras), self.settings.subsets
        automatic, may = isinstance(wanted, str), self.settings.allows_subsets
        projectors = [self.weights.projector(name) for name in self.weights.cameras]
        sets = min(projector.ray_sets for projector in projectors)
        if len({projector.rows for projector in projectors}) > 1:  # rows of some cameras, lenses of others
            sets = 1
        if not all(self._sees_alone(name) for name in self.weights.cameras):
            sets = 1
        rows = min(self.weights.rows, sets)
        if rows > 1:
            possible: Sequence[int] = range(1, rows + 1)
            most = rows if may and automatic and rows_resolve_depth(self.weights) else 1
            numbers = f"1 to {rows}"
        else:
            possible = sorted({1, cameras, sets * cameras})
            most = sets * cameras if cameras <= FEW_CAMERAS or sets == 1 else cameras
            numbers = "one of " + ", ".join(map(str, possible))
        count = (most if may else 1) if isinstance(wanted, str) else wanted
        if count not in possible:
            raise ValueError(f"subsets: with these cameras expected {numbers}, got {count}.")
        if count == 1:
            return (whole_subset(cameras),)
        return joint_subsets(cameras, rows, count) if rows > 1 else subsets_of(cameras, count // cameras)

    def _sees_alone(self, name: str) -> bool:
        """Return whether most of a camera's pixels see a single set of rays, and each set has some."""
        projector = self.weights.projector(name)
        alone = [len(projector.exclusive_pixels(number)) for number in range(projector.ray_sets)]
        return min(alone) > 0 and sum(alone) >= LEAST_ALONE * len(projector.exclusive_pixels(ALL))

    def _sieve_and_cap(self, images: Mapping[str, np.ndarray]) -> tuple[Sieve, float]:
        """Return the sieve and the limit of the counts. Those that the settings leave open follow from the images."""
        wanted, cap = self.settings.sieve_voxel, self.settings.intensity_cap
        sizer = self._particle_sizer if isinstance(wanted, str) or isinstance(cap, str) else None
        seen = {} if sizer is None else sizer.fluctuations(images)
        sigma = sizer.matching_sieve(seen) if sizer is not None and isinstance(wanted, str) else float(wanted)
        sieve = Sieve(sigma, self.weights.stored.shape)
        if sizer is None or not isinstance(cap, str):
            return sieve, float(cap)
        scatter = sizer.brightness_scatter(seen, sigma)
        if scatter is not None and scatter < UNLIKE:
            return sieve, 0.0
        return sieve, POINT_CAP if wanted == AUTO and sigma == 0 else CAP

    @property
    def _particle_sizer(self) -> ParticleSizer:
        """Return the estimator of the weights. Making it takes as long as two passes, so other solvers share it."""
        derived, key = self.weights.derived, ("particle sizer", self.weights.volume)
        if key not in derived:
            derived[key] = ParticleSizer(self.weights)
        return derived[key]

    @cached_property
    def _views(self) -> np.ndarray | None:
        """Number of cameras that see each voxel; None for one camera, or if two see every voxel."""
        if len(self.weights.cameras) == 1:
            return None
        views = self.weights.views
        return views if views.min() < 2 else None


def _same(one: np.ndarray | None, other: np.ndarray | None) -> bool:
    return one is other or (one is not None and other is not None and np.array_equal(one, other))
