"""What SMART needs to know of a rig besides the images: sums of the weights, which voxels are seen, and step sizes.

All of it is the same for every frame whose cameras are found equally bright, so it is computed once, and stays on the
device.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from lfpiv.reconstruction.ordered_subsets import (
    CONFLICT,
    FOLLOWING_TIME,
    JOINT_CONFLICT,
    POINT_CONFLICT,
    POINT_PASSES,
    WHOLE_PASSES,
    Partition,
    Subset,
    correcting_subset,
    step_sizes,
    subsets_of,
    whole_subset,
)
from lfpiv.reconstruction.settings import AUTO, SmartSettings
from lfpiv.reconstruction.sieve import Sieve
from lfpiv.reconstruction.steps import LEAST_SHARPENED_VOXEL, SharpenedStep, SmartStep, Step
from lfpiv.weights.operator import Weights
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.transfer import DeviceArray, to_device

COMPARED = 8
"""First guesses are compared on one subset in eight: the first subsets, which are far apart in the pupil."""
FOLLOWED_STEPS = 8
"""Number of steps by subsets of all cameras from the volume of the frame before, without a sieve."""
LEAST_PART = 0.02
"""Least share of a voxel's weights in the sum over a part of the rays. A part may not light each voxel."""
LEAST_COLUMN_SUM = 0.02
"""Least sum of the weights of a voxel that some camera sees, as a share of the largest one. Smaller sums are those of
voxels whose pixels are nearly all dead. Errors of the weights decide these sums, and steps divide by them."""


class Normalisation:
    """Sums, masks, gains and steps of a rig.

    Parameters
    ----------
    settings : SmartSettings
        Settings of the reconstruction.
    subsets : tuple of Subset
        The subsets to begin with.
    solid : ndarray, shape (z, y, x), or None
        True for voxels without fluid.
    camera_gains : mapping of str to float
        Brightness of each camera relative to the brightest.
    """

    def __init__(
        self,
        weights: Weights,
        settings: SmartSettings,
        subsets: tuple[Subset, ...],
        solid: np.ndarray | None,
        camera_gains: Mapping[str, float],
        sieve: Sieve,
    ):
        self.sieve = sieve
        self._weights, self._settings, self._subsets = weights, settings, subsets
        self._camera_gains = [np.float32(camera_gains[name]) for name in weights.cameras]
        first, *others = self.camera_sums
        self._column_sum: np.ndarray = sum(others, first)
        self._seen = self._column_sum > LEAST_COLUMN_SUM * self._column_sum.max()
        self._lit = self._seen if solid is None else self._seen & (weights.stored.store(~solid) > 0)
        self.column_sum: DeviceArray = to_device(self._column_sum, float)
        """Sum of the weights of each voxel, shape (voxel,), float32."""
        self.lit: DeviceArray = to_device(self._lit.astype(np.float32), float)
        """1 for voxels that some camera sees and that hold fluid, else 0, shape (voxel,), float32."""

    @property
    def camera_sums(self) -> list[np.ndarray]:
        """Sums of each voxel's weights over the pixels of each camera, shape (voxel,)."""
        return [gain * own for gain, own in zip(self._camera_gains, self._weights.camera_sums, strict=True)]

    @property
    def has_subsets(self) -> bool:
        """Whether the rays are divided into subsets."""
        return len(self._subsets) > 1

    @cached_property
    def gains(self) -> dict[str, DeviceArray]:
        """Camera name -> counts that a pixel records per unit of light, of the pixels that voxels light, float32."""
        gains = {}
        for name, relative in zip(self._weights.cameras, self._camera_gains, strict=True):
            gain = self._weights.gain(name)[self._weights.projector(name).map.pixel]
            gains[name] = to_device(gain if relative == 1 else gain * relative, float)
        return gains

    @cached_property
    def shown(self) -> list[DeviceArray]:
        """Of each camera 1 for pixels that a lit voxel lights, else 0, of the pixels that voxels light, float32."""
        shown = []
        for name in self._weights.cameras:
            projector = self._weights.projector(name)
            image = projector.project(self.lit, np.zeros(self._weights.gain(name).size, np.float32))
            shown.append(to_device((image[projector.map.pixel] > 0).astype(np.float32), float))
        return shown

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        """Steps of an iteration, the fastest first. Sharpened steps come with a sieve and momentum."""
        relaxation = self._settings.relaxation
        if self._settings.normalisation == "column":
            size = self._quotient(relaxation, self.sieve(self._column_sum), self._lit)
            unblurred = self._quotient(relaxation, self._column_sum, self._lit)
        else:
            pixels = self._weights.stored.store(self._weights.affected_pixels)
            size = unblurred = self._quotient(relaxation / self._weights.largest, pixels, self._lit & (pixels > 0))
        plain = SmartStep(size, self.sieve)
        sharpened = self._settings.accelerate and self._may_sharpen
        return (SharpenedStep(unblurred, self.sieve), plain) if sharpened else (plain,)

    @property
    def _may_sharpen(self) -> bool:
        return self.sieve.sigma_voxel >= LEAST_SHARPENED_VOXEL

    def _quotient(self, numerator: float, denominator: np.ndarray, where: np.ndarray) -> DeviceArray:
        return to_device(np.divide(numerator, denominator, out=np.zeros_like(self._column_sum), where=where), float)


class LensSubsets(Normalisation):
    """Subsets of one camera each: all its lenses or half of them; or one subset of all rays."""

    suffice = False
    """Whether passes that are left when the subsets contradict each other are left out."""
    part: tuple[Subset, DeviceArray] | None = None
    """Rays by which frames are compared quickly, and the sum of each voxel's weights over them; None for all."""

    @property
    def sample(self) -> tuple[Subset, ...]:
        """Subsets by which guesses are compared: one of each camera. None without subsets."""
        return tuple(subset for subset in self._subsets if subset.parts[0][1] != 1) if self.has_subsets else ()

    @cached_property
    def partitions(self) -> tuple[Partition, ...]:
        """The subsets to begin with, and the whole cameras that may follow if "auto" began with halves."""
        cameras = len(self._weights.cameras)
        may_grow = self._settings.subsets == AUTO and len(self._subsets) > cameras
        in_turn = (self._subsets, subsets_of(cameras)) if may_grow else (self._subsets,)
        last = in_turn[-1]
        return tuple(self._partition(subsets, 0.0 if subsets is last else CONFLICT) for subsets in in_turn)

    @property
    def followed(self) -> tuple[Partition, ...]:
        """The subsets by which a frame is reconstructed from the volume of the one before; none for whole passes."""
        return self.partitions if self.has_subsets else ()

    @property
    def following_time(self) -> float:
        """Nesterov's time at which the momentum begins there."""
        return FOLLOWING_TIME if self.sieve.sigma_voxel > 0 else 1.0

    @cached_property
    def correcting(self) -> Partition:
        """The subset by which a frame is corrected after its comparison with those beside it: all rays."""
        return Partition((whole_subset(len(self._weights.cameras)),), self.steps[:1])

    def passes(self, count: int, whole: int | None) -> tuple[int, int]:
        """Return the most epochs of `count` passes, and the passes over all rays after them; `whole` if stated."""
        whole = min(WHOLE_PASSES, -(-count // 2)) if whole is None else whole
        return (max(count - whole, 0) if self.has_subsets else 0), whole

    def _partition(self, subsets: tuple[Subset, ...], conflict: float) -> Partition:
        """Return the subsets with the step of each."""
        sizes = step_sizes(self._column_sum, [self._subset_sum(one) for one in subsets], self._seen)
        mu = np.float32(self._settings.relaxation)
        on_device = [to_device(mu * size, float) for size in sizes]
        plain = tuple(SmartStep(size, self.sieve) for size in on_device)
        if not self._may_sharpen:
            return Partition(subsets, plain, conflict=conflict)
        sharpened = tuple(SharpenedStep(size, self.sieve) for size in on_device)
        return Partition(subsets, sharpened, plain, conflict=conflict)

    def _subset_sum(self, subset: Subset) -> np.ndarray:
        """Return the sum of each voxel's weights over the pixels of a subset."""
        names = list(self._weights.cameras)
        total = np.zeros_like(self._column_sum)
        for camera, part in subset.parts:
            own = self._weights.camera_sums[camera] if part == ALL else self._kept_sums(names[camera], part)
            total += self._camera_gains[camera] * own
        return total

    def _kept_sums(self, name: str, ray_set: int) -> np.ndarray:
        """Return the sums of one set of rays, which later frames need, too."""
        derived, key = self._weights.derived, ("sums of a set", name, ray_set)
        if key not in derived:
            derived[key] = self._weights.sums_of_set(name, ray_set)
        return derived[key]


class RowSubsets(Normalisation):
    """Subsets of all cameras: rows of pixels under every lens."""

    suffice = True

    @property
    def sample(self) -> tuple[Subset, ...]:
        """Subsets by which guesses are compared."""
        return self._subsets[: -(-len(self._subsets) // COMPARED)]

    @cached_property
    def partitions(self) -> tuple[Partition, ...]:
        """The subsets."""
        return (self._partition(self._subsets),)

    @cached_property
    def followed(self) -> tuple[Partition, ...]:
        """The subsets by which a frame is reconstructed from the volume of the one before.

        Without a sieve `FOLLOWED_STEPS` of them.
        """
        return self.partitions if self.sieve.sigma_voxel > 0 else (self.partitions[0].part(slice(FOLLOWED_STEPS)),)

    following_time = FOLLOWING_TIME

    @cached_property
    def correcting(self) -> Partition:
        """The subset by which a frame is corrected after its comparison with those beside it.

        It has some ray rows of all cameras, see `correcting_subset`.
        """
        parts, chosen = correcting_subset(len(self._weights.cameras), self._weights.rows)
        return self._partition(parts).part(slice(chosen, chosen + 1))

    @cached_property
    def part(self) -> tuple[Subset, DeviceArray]:
        """The rays of `correcting` and their sum; that is at least `LEAST_PART` of the sum over all rays."""
        (subset,), total = self.correcting.subsets, np.zeros_like(self._column_sum)
        for camera, name in enumerate(self._weights.cameras):
            gain = self._weights.gain(name) * self._camera_gains[camera]
            self._weights.projector(name).back_project(gain, total, *subset.sets_of(camera))
        return subset, to_device(np.maximum(total, LEAST_PART * self._column_sum), float)

    def passes(self, count: int, whole: int | None) -> tuple[int, int]:
        """Return the most epochs of `count` passes, and the passes over all rays after them; `whole` if stated."""
        after = WHOLE_PASSES if self.sieve.sigma_voxel > 0 else POINT_PASSES
        whole = min(after, -(-count // 2)) if whole is None else whole
        return min(max(count - whole, 0), self.partitions[0].most_epochs), whole

    def _partition(self, subsets: tuple[Subset, ...]) -> Partition:
        """Return subsets of all cameras. All have the same step, of another length each."""
        derived, key = self._weights.derived, ("lengths of joint subsets", len(subsets))
        if key not in derived:
            derived[key] = joint_lengths(self._weights, subsets)
        lengths, excess = derived[key]
        size = self._quotient(self._settings.relaxation, self._column_sum * excess, self._seen)
        plain = (SmartStep(size, self.sieve),) * len(subsets)
        if not self._may_sharpen:
            return Partition(subsets, plain, lengths=lengths, conflict=POINT_CONFLICT)
        sharpened = (SharpenedStep(size, self.sieve),) * len(subsets)
        return Partition(subsets, sharpened, plain, lengths, JOINT_CONFLICT)


def joint_lengths(weights: Weights, subsets: tuple[Subset, ...]) -> tuple[tuple[float, ...], np.ndarray]:
    """Return how long the steps of subsets of all cameras are, so that none is longer than 1 / max(s_n, s / N).

    With the share r_n of subset n in the light of all, its step is a_n / (s q), a_n = N / max(N r_n, 1), where q is the
    largest quotient max(N s_n / s, 1) / max(N r_n, 1) of all subsets. It is little more than 1 for most voxels. Sums of
    all cameras are nowhere a larger part than the sums of a single camera, so brightnesses of cameras do not matter.

    Returns
    -------
    lengths : tuple of float
        a_n of each subset.
    excess : ndarray, shape (voxel,), float32
        q of each voxel.
    """
    names, count = list(weights.cameras), len(subsets)
    of_sets = [weights.light_of_sets(name) for name in names]
    light = np.array([sum(of_sets[camera][ray_set] for camera, ray_set in subset.parts) for subset in subsets])
    least = np.maximum(count * light / light.sum(), 1)
    excess = np.ones(weights.grid.size, np.float32)
    for subset, own in zip(subsets, least, strict=True):
        for camera, name in enumerate(names):
            sums = np.zeros_like(excess)
            for ray_set in subset.sets_of(camera):
                sums += weights.sums_of_set(name, ray_set)
            of_all = weights.camera_sums[camera]
            share = np.divide(count * sums, of_all, out=np.zeros_like(sums), where=of_all > 0)
            np.maximum(excess, share / np.float32(own), out=excess)
    return tuple((count / least).tolist()), excess
