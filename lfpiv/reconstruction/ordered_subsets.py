"""Ordered subsets: SMART steps from a part of the rays each, so that one pass over all rays makes several steps.

A subset is the rays of one camera through every other lens. Its pixels are those that see no other lens; a pixel
between two lenses takes part in whole passes only. The exponent of subset n is sum_{i in n} w log((I + b) / (P + b)).
Its step is that of `lfpiv.reconstruction.steps` with max(s_n, s / N) in place of s, where s_n are the weights' sums
over the subset and N is the number of subsets. Momentum goes on from subset to subset [1]_.

Different subsets ask for slightly different volumes, so their steps end in a cycle around the solution. Steps become
shorter from epoch to epoch, and the last passes take all rays: there the misfit falls in every pass [2]_.

.. [1] D. Kim, S. Ramani, J. A. Fessler, "Combining ordered subsets and momentum for accelerated X-ray CT image
   reconstruction", IEEE Trans. Med. Imaging 34 (2015) 167-178, doi:10.1109/TMI.2014.2350962.
.. [2] S. Ahn, J. A. Fessler, "Globally convergent image reconstruction for emission tomography using relaxed ordered
   subsets algorithms", IEEE Trans. Med. Imaging 22 (2003) 613-626, doi:10.1109/TMI.2003.812251.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.resting_voxels import RestingVoxels
from lfpiv.reconstruction.sieve import Sieve
from lfpiv.reconstruction.smart import ImageEquations, Misfit, State
from lfpiv.reconstruction.steps import Step
from lfpiv_kernels.reconstruction.projector import ALL, EVEN, ODD

SUBSET_MOMENTUM = 0.94
"""Largest exponent of the momentum from subset to subset: a memory of four passes over four subsets."""
WHOLE_PASSES = 2
"""Passes over all rays after the last epoch, at most half of all passes."""
SHORTENING = 0.05
"""Steps of epoch k are 1 / (1 + k SHORTENING) as long as those of the first one."""


@dataclass(frozen=True)
class Subset:
    """Rays of one camera."""

    camera: int
    """Index of the camera."""
    lenses: int
    """Lenses through which the rays go, ``projector.EVEN``, ``ODD`` or ``ALL``."""


def subsets_of(cameras: int, halves: bool) -> tuple[Subset, ...]:
    """Return the subsets in their order: whole cameras, or every other lens of each camera."""
    lenses = (EVEN, ODD) if halves else (ALL,)
    return tuple(Subset(camera, part) for camera in range(cameras) for part in lenses)


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
    subsets: Sequence[Subset],
    steps: Sequence[Step],
    epochs: int,
    resting: RestingVoxels | None = None,
) -> Iterator[tuple[State, Misfit]]:
    """Iterate over the subsets; yield the state after each epoch, and the sum of its subsets' misfits.

    The misfit of a subset is that before its own step, so the sum is no exact misfit of any volume.

    Parameters
    ----------
    equations : ImageEquations
        Locked.
    state : State
        Where to start. Its steps are kept for whole passes, its momentum starts anew.
    sieve : Sieve
        Sieve G, E = G c.
    subsets, steps : sequence
        The subsets in their order, and the step of each.
    epochs : int
        Number of epochs.
    resting : RestingVoxels, optional
        Lets dark voxels rest. Default: all voxels take part in all epochs.
    """
    coefficients, momentum = state.coefficients, Momentum(state.coefficients, largest=SUBSET_MOMENTUM)
    for epoch in range(epochs):
        misfit, length = Misfit(0.0, 0.0), np.float32(1 / (1 + SHORTENING * epoch))
        active = None if resting is None else resting.active_in(epoch, sieve(coefficients))
        if active is not None:
            momentum = momentum.stopped(coefficients, active == 0)
        for subset, step in zip(subsets, steps, strict=True):
            volume = sieve(coefficients) if active is None else sieve(coefficients) * active
            misfit += equations.compare_subset(subset.camera, subset.lenses, volume)
            exponent = equations.back_project_subset(subset.camera, subset.lenses, volume)
            exponent *= length
            coefficients, momentum = momentum.extrapolate(step(coefficients, exponent, active))
        yield State(coefficients, momentum, state.steps), misfit
