"""Ordered subsets: SMART steps from a part of the rays each, so that one pass over all rays makes several steps.

A subset is some rows of pixels under every lens, of all cameras at once. Such rows see a part of the pupil each, and
all of the volume. Where weights have no rows, as of small volumes, a subset is the rays of one camera through every
other lens. Its pixels are those that see no other set of rays; a pixel between two of them takes part in whole passes
only. The exponent of subset n is sum_{i in n} w log((I + b) / (P + b)). Its step is as in
`lfpiv.reconstruction.steps`, with max(s_n, s / N) in place of s, where s_n are the weights' sums over the subset and N
is the number of subsets. For rows of pixels s_n is nearly the same part of s in all voxels, and that part of the
volume's light stands for it. Momentum goes on from subset to subset [1]_.

Different subsets ask for slightly different volumes, so their steps end in a cycle around the solution. Steps become
shorter from epoch to epoch, and the last passes take all rays: there the misfit falls in every pass [2]_.

What the volume cannot explain widens that cycle: particles that are not equally bright in all cameras, light of no
particle, particles smaller than voxels. Each subset then undoes what the others did, and the volume keeps the errors of
single subsets. The exponents g_n of the subsets in an epoch show it. With <a, b> = sum_j c_j a_j b_j, the agreement
|sum_n g_n|^2 / sum_n |g_n|^2 is N where all of N subsets ask for the same, 1 where their exponents are independent, and
0 where they cancel. Below a limit larger subsets follow, or the passes over all rays. Stochastic gradient methods
enlarge their samples by such a test of norms [3]_. Subsets of all cameras improve the volume until their exponents
nearly cancel (`JOINT_CONFLICT`). Without a sieve the volume begins to follow the noise earlier (`POINT_CONFLICT`).

The number of steps decides how near the volume comes to the solution. The share of the rays in each step hardly
matters. So epochs of many subsets end after `MOST_STEPS` steps. Where a first guess shows already where particles are,
steps by a part of the rays suffice (`RowSubsets.followed`, `RowSubsets.correcting`).

Sharpened steps can raise the misfit however short they are (`lfpiv.reconstruction.steps`). Where the misfit of an epoch
rises, the epoch is undone, the momentum starts anew, and SMART's own steps follow (here divided by sums that are not
blurred). Where it rises again, larger subsets follow, and then the passes over all rays. Each iteration of those lowers
the misfit.

.. [1] D. Kim, S. Ramani, J. A. Fessler, "Combining ordered subsets and momentum for accelerated X-ray CT image
   reconstruction", IEEE Trans. Med. Imaging 34 (2015) 167-178, doi:10.1109/TMI.2014.2350962.
.. [2] S. Ahn, J. A. Fessler, "Globally convergent image reconstruction for emission tomography using relaxed ordered
   subsets algorithms", IEEE Trans. Med. Imaging 22 (2003) 613-626, doi:10.1109/TMI.2003.812251.
.. [3] R. H. Byrd, G. M. Chin, J. Nocedal, Y. Wu, "Sample size selection in optimization methods for machine learning",
   Math. Program. 134 (2012) 127-155, doi:10.1007/s10107-012-0572-5.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.sieve import Sieve
from lfpiv.reconstruction.smart import ImageEquations, Misfit, State
from lfpiv.reconstruction.steps import Step
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.sums import Totals
from lfpiv_kernels.transfer import DeviceArray, duplicate, zeros

log = logging.getLogger(__name__)

SUBSET_MOMENTUM = 0.94
"""Largest exponent of the momentum from subset to subset: a memory of four passes over four subsets."""
WHOLE_PASSES = 2
"""Passes over all rays after the last epoch, at most half of all passes."""
POINT_PASSES = 5
"""The same after subsets of all cameras without a sieve, which are left early."""
FOLLOWING_TIME = 8.0
"""Nesterov's time at which the momentum begins in a frame that starts from the one before. Its few steps are longer
than plain ones. The time is 1 where there is no sieve and subsets are of lenses: longer steps by these follow the
noise."""
SHORTENING = 0.05
"""Steps of epoch k are 1 / (1 + k SHORTENING) as long as in the first epoch."""
CONFLICT = 0.5
"""Agreement of subsets of one camera each below which the next epochs take larger subsets: half that of independent
exponents."""
JOINT_CONFLICT, POINT_CONFLICT = 0.1, 0.5
"""Agreement of subsets of all cameras below which the passes over all rays follow, with a sieve and without."""
CORRECTING, FEWEST_ROWS = 4, 3
"""Number of parts of the ray rows, one of which corrects a frame, and the least number of rows of a part."""
MOST_STEPS = 128
"""Steps by subsets after which no other epoch of subsets of all cameras begins."""


@dataclass(frozen=True)
class Subset:
    """Rays that make a step."""

    parts: tuple[tuple[int, int], ...]
    """Index of a camera and number of a set of its rays, or ``ALL``, for each camera that takes part."""

    def sets_of(self, camera: int) -> list[int]:
        """Return the numbers of the sets of one camera's rays."""
        return [ray_set for number, ray_set in self.parts if number == camera]


@dataclass(frozen=True)
class Partition:
    """All rays, divided into subsets."""

    subsets: tuple[Subset, ...]
    """The subsets in their order."""
    steps: tuple[Step, ...]
    """Step of each subset; all are of one kind."""
    safer: tuple[Step, ...] = ()
    """Step of each subset after the misfit of an epoch rose; empty for none."""
    lengths: tuple[float, ...] = ()
    """Factor of the exponent in each subset's step; empty for 1."""
    conflict: float = 0.0
    """Agreement of the subsets below which they are left."""

    def part(self, some: slice) -> Partition:
        """Return the partition's subsets of a slice: a part of the rays."""
        cut = (self.subsets[some], self.steps[some], self.safer[some], self.lengths[some])
        return Partition(*cut, self.conflict)

    @property
    def most_epochs(self) -> int:
        """Number of epochs that make `MOST_STEPS` steps."""
        return -(-MOST_STEPS // len(self.subsets))


@dataclass(frozen=True)
class Epoch:
    """What an epoch leaves."""

    state: State
    misfit: Misfit
    """Sum of the subsets' misfits, each before its own step: no exact misfit of any volume."""
    subsets: int
    """Number of subsets of the epoch."""
    rose: bool
    """Whether the misfit rose."""
    undone: bool = False
    """Whether the misfit rose, the state is that before the epoch, and other epochs can follow."""


class Agreement:
    """Measure whether the subsets of an epoch ask for the same change.

    Parameters
    ----------
    coefficients : array, shape (voxel,), float32
        Coefficients c before the epoch, on the device: the weights of <a, b> = sum_j c_j a_j b_j.
    """

    def __init__(self, coefficients: DeviceArray):
        self._weight = coefficients
        self._sum = zeros(coefficients.size)
        self._totals = Totals(2)

    def add(self, exponent: DeviceArray) -> None:
        """Add the exponent of a subset, shape (voxel,), float32."""
        self._totals.add_squares(0, self._weight, exponent, self._sum)

    def measured(self) -> float:
        """Return |sum_n g_n|^2 / sum_n |g_n|^2, from 0 to the number of subsets; 1 where all exponents are 0.

        Called once.
        """
        self._totals.add_squares(1, self._weight, self._sum)
        squares, square = self._totals.read()
        return square / squares if squares > 0 else 1.0


def whole_subset(cameras: int) -> Subset:
    """Return the subset of all rays of all cameras."""
    return Subset(tuple((camera, ALL) for camera in range(cameras)))


def subsets_of(cameras: int, sets: int = 1) -> tuple[Subset, ...]:
    """Return the subsets in their order: each set of the rays of each camera; one set is the whole camera."""
    numbers = range(sets) if sets > 1 else (ALL,)
    return tuple(Subset(((camera, number),)) for camera in range(cameras) for number in numbers)


def joint_subsets(cameras: int, sets: int, count: int) -> tuple[Subset, ...]:
    """Return subsets that each take some sets of the rays of all cameras.

    Subsets whose rows lie far apart in the pupil follow each other.
    """
    bits = max(count - 1, 1).bit_length()
    order = (int(f"{number:0{bits}b}"[::-1], 2) for number in range(1 << bits))
    return tuple(
        Subset(tuple((camera, ray_set) for camera in range(cameras) for ray_set in range(first, sets, count)))
        for first in order
        if first < count
    )


def correcting_subset(cameras: int, sets: int) -> tuple[tuple[Subset, ...], int]:
    """Divide the ray rows of all cameras into parts; return them and the number of the one that corrects a frame.

    There are `CORRECTING` parts, or fewer where parts would have less than `FEWEST_ROWS` rows. The chosen one has no
    row by which guesses are compared, unless it has all rows.
    """
    count = max(min(CORRECTING, sets // FEWEST_ROWS), 1)
    parts = joint_subsets(cameras, sets, count)
    return parts, next(number for number, one in enumerate(parts) if one.parts[0][1] == min(1, count - 1))


def step_sizes(column_sum: np.ndarray, subset_sums: Sequence[np.ndarray], lit: np.ndarray) -> list[np.ndarray]:
    """Return 1 / max(s_n, s / N) for each subset, shape (voxel,), float32; 0 where no camera sees a voxel."""
    least = column_sum / np.float32(len(subset_sums))
    sizes = []
    for own in subset_sums:
        total = np.maximum(own, least)
        sizes.append(np.divide(1, total, out=np.zeros_like(total), where=lit))
    return sizes


def iterate_epochs(
    equations: ImageEquations,
    state: State,
    sieve: Sieve,
    *,
    partitions: Sequence[Partition],
    epochs: int,
    time: float = 1.0,
) -> Iterator[Epoch]:
    """Iterate over the subsets; yield what each epoch leaves. End early where one subset is left or the misfit rises.

    The next epoch overwrites the state that one leaves.

    Parameters
    ----------
    equations : ImageEquations
        Locked.
    state : State
        Where to start. Its steps are kept for whole passes, its momentum starts anew.
    sieve : Sieve
        Sieve G, E = G c.
    partitions : sequence of Partition
        The one to begin with, and those that follow it one by one where subsets conflict.
    epochs : int
        Largest number of epochs.
    time : float
        Nesterov's t_k at which the momentum begins. From 1 on its exponent grows from 0.
    """
    coefficients = duplicate(state.coefficients)
    momentum = Momentum(duplicate(coefficients), time, SUBSET_MOMENTUM)
    course = _Course(partitions)
    for epoch in range(epochs):
        partition, start = course.partition, duplicate(coefficients)
        agreement = Agreement(start) if partition.conflict > 0 and epoch + 1 < epochs else None
        equations.begin()
        for subset, step, length in course.steps(1 / (1 + SHORTENING * epoch)):
            exponent = equations.exponent_of(subset.parts, sieve(coefficients))
            if agreement is not None:
                agreement.add(exponent)
            coefficients, after = step(coefficients, exponent, momentum, length=length, in_place=True)
            assert after is not None  # with a momentum there is one after it
            momentum = after
        misfit = equations.measured()
        rose = course.rises(misfit)
        if rose:
            coefficients, momentum = start, Momentum(duplicate(start), largest=SUBSET_MOMENTUM)
        undone = rose and course.can_change
        yield Epoch(State(coefficients, momentum, state.steps), misfit, len(partition.subsets), rose, undone)
        if not course.goes_on(misfit, rose, agreement):
            return


class _Course:
    """Which subsets and steps make an epoch, and what follows it.

    Parameters
    ----------
    partitions : sequence of Partition
        As of `iterate_epochs`.
    """

    def __init__(self, partitions: Sequence[Partition]):
        self.partition, self._following = partitions[0], list(partitions[1:])
        self._safely, self._before = False, math.inf

    def steps(self, length: float) -> Iterator[tuple[Subset, Step, float]]:
        """Yield each subset with its step and the factor of its exponent."""
        partition = self.partition
        steps = partition.safer if self._safely and partition.safer else partition.steps
        lengths = partition.lengths or (1.0,) * len(steps)
        for subset, step, own in zip(partition.subsets, steps, lengths, strict=True):
            yield subset, step, length * own

    @property
    def can_change(self) -> bool:
        """Whether safer steps or larger subsets can follow an epoch whose misfit rose."""
        return self._may_be_safer or bool(self._following)

    @property
    def _may_be_safer(self) -> bool:
        return bool(self.partition.safer) and not self._safely

    def rises(self, misfit: Misfit) -> bool:
        """Return whether the misfit of an epoch is larger than that of the epoch before by the same subsets."""
        return not misfit.divergence <= self._before  # true for NaN

    def goes_on(self, misfit: Misfit, rose: bool, agreement: Agreement | None) -> bool:
        """Choose subsets and steps of the next epoch; return whether there is one."""
        if rose and self._may_be_safer:
            log.debug("misfit rises, safer steps follow")
            self._safely = True
            return True
        if not rose:
            self._before = misfit.divergence
            if agreement is None or not agreement.measured() < self.partition.conflict:
                return True
        larger = bool(self._following) and len(self._following[0].subsets) > 1
        why, what = "misfit rises" if rose else "subsets conflict", "larger subsets" if larger else "whole passes"
        log.debug("%s, %s follow", why, what)
        if larger:
            self.partition, self._before = self._following.pop(0), math.inf
        return larger
