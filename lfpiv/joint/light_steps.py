"""Steps of the light by ordered subsets of both frames' rays, with the displacement fixed.

Each frame takes a string of subsets by itself, from the light as it moved it there. Each subset gives SMART's logarithm
of a step, sharpened as in `lfpiv.reconstruction.steps`. The sum of a string's logarithms is pulled back along the
displacement and averaged over the frames: string averaging [1]_. The momentum goes on from string to string.

.. [1] Y. Censor, T. Elfving, G. T. Herman, "Averaging strings of sequential iterations for convex feasibility
   problems", in: Inherently Parallel Algorithms in Feasibility and Optimization, Elsevier 2001, 101-113,
   doi:10.1016/S1570-579X(01)80009-4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lfpiv.joint.model import LARGEST_LOSS, JointModel
from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.normalisation import LensSubsets, RowSubsets
from lfpiv.reconstruction.ordered_subsets import SHORTENING, SUBSET_MOMENTUM, Partition, whole_subset
from lfpiv.reconstruction.sieve import TRUNCATE, Sieve
from lfpiv.reconstruction.steps import LARGEST_STEP, SHARPENED_VOXEL, SHARPENING, SharpenedStep, SmartStep
from lfpiv_kernels.filters.blur import GaussianBlur
from lfpiv_kernels.reconstruction.transport import SPREAD, Transport
from lfpiv_kernels.reconstruction.update import sharpen
from lfpiv_kernels.reconstruction.voxels import add, multiply
from lfpiv_kernels.transfer import DeviceArray, duplicate, to_device, to_host, zeros

LOSS_STEP, LOSS_SHRINK = 0.5, 0.005
"""Length of a step of rho, and the share by which each step shrinks it towards equally bright frames."""
STRING = 4
"""Subsets that each frame takes by itself."""
LATEST_TIME = 8.0
"""Largest t_k of Nesterov's momentum after a step of the displacement."""


@dataclass(frozen=True)
class Light:
    """Light midway in time, and the state of its iteration."""

    values: np.ndarray
    """Shape (z, y, x), float32; zeros stay zero."""
    time: float = 1.0
    """Nesterov's t_k."""
    epochs: int = 0
    """Epochs since the last start."""


class LightSteps:
    """Epochs over the subsets of both frames.

    Parameters
    ----------
    model : JointModel
        The model of the frames.
    """

    def __init__(self, model: JointModel):
        self.model = model
        self._stored = model.weights.stored
        self.partitions = tuple(_partition(frame.normalisation, len(frame.images)) for frame in model.frames)
        """Subsets of both frames' rays."""
        shape = model.frames[0].normalisation.sieve.shape
        self._rest = Sieve(model.rest_voxel, shape)
        self._spread, self._wide = (
            GaussianBlur(width, shape, truncate=TRUNCATE, border="nearest")
            for width in (math.sqrt(SPREAD), SHARPENED_VOXEL)
        )

    def epochs(self, light: Light, transports: tuple[Transport, Transport], count: int) -> Light:
        """Return the light after some epochs."""
        subsets = len(self.partitions[0].subsets)
        ahead = to_device(light.values.reshape(-1).copy(), float)
        momentum = Momentum(duplicate(ahead), min(light.time, LATEST_TIME), SUBSET_MOMENTUM)
        for epoch in range(light.epochs, light.epochs + count):
            for first in range(0, subsets, STRING):
                string = slice(first, first + STRING)
                ahead, momentum = self._step(ahead, momentum, transports, string, 1 / (1 + SHORTENING * epoch))
        values = to_host(ahead).reshape(light.values.shape).copy()
        return Light(values, momentum.time, light.epochs + count)

    def _step(
        self,
        ahead: DeviceArray,
        momentum: Momentum,
        transports: tuple[Transport, Transport],
        string: slice,
        length: float,
    ) -> tuple[DeviceArray, Momentum]:
        """Return the light and the momentum after the steps of one string."""
        light = to_host(ahead).reshape(self.model.lit.shape)
        logs = list[np.ndarray]()
        for frame, transport in enumerate(transports):
            moved = transport.push(self.model.light_of(frame, light))
            logs.append(transport.pull(self._logarithm(frame, moved, string, length), self.model.lit))
        if self.model.rho is not None:
            self._step_loss(light, logs[1] - logs[0])
        mean = to_device(np.ascontiguousarray((logs[0] + logs[1]) / 2).reshape(-1), float)
        extrapolation = momentum.extrapolation(ahead)
        stepped = momentum.previous
        sharpen(ahead, mean, mean, 0.0, LARGEST_STEP, extrapolation=extrapolation, stepped=stepped)
        return extrapolation.ahead, momentum.after(stepped)

    def _logarithm(self, frame: int, moved: np.ndarray, string: slice, length: float) -> np.ndarray:
        """Return the sum of the logarithms of a frame's own steps by a string of subsets, shape (z, y, x), float32.

        The frame's light (z, y, x) follows the steps, blurred as the spline will blur the sum.
        """
        stored, partition, equations = self._stored, self.partitions[frame], self.model.frames[frame].equations
        light = to_device(stored.store(moved), float)
        share = SHARPENING if isinstance(partition.steps[0], SharpenedStep) else 0.0
        total, below = zeros(stored.size), zeros(stored.size)
        with equations.locked():
            equations.begin()
            for number in range(len(partition.subsets))[string]:
                step = partition.steps[number]
                assert isinstance(step, (SharpenedStep, SmartStep))
                own = partition.lengths[number] if partition.lengths else 1.0
                exponent = equations.exponent_of(partition.subsets[number].parts, self._rest(light))
                logarithm = multiply(exponent, step.size, factor=length * own)
                spread = self._spread(logarithm)
                wide = self._wide(logarithm) if share else spread
                sharpen(light, spread, wide, share, LARGEST_STEP, stepped=light)
                add(logarithm, total)
                add(wide, below)
        whole = to_host(total)
        return np.ascontiguousarray(stored.restore(whole + np.float32(share) * (whole - to_host(below))), np.float32)

    def _step_loss(self, light: np.ndarray, difference: np.ndarray) -> None:
        """Change rho by what the frames ask for, smooth and weighted by the light."""
        model = self.model
        assert model.rho is not None
        below = model.smoothed(light)
        asked = model.smoothed(light * difference) / np.maximum(below, np.float32(1e-3) * below.mean())
        rho = (model.rho + np.float32(LOSS_STEP) * asked) * np.float32(1 - LOSS_SHRINK)
        model.rho = np.clip(rho, -LARGEST_LOSS, LARGEST_LOSS)


def _partition(normalisation: LensSubsets | RowSubsets, cameras: int) -> Partition:
    """Return the subsets to iterate over: as in the reconstruction, or all rays at once."""
    if normalisation.has_subsets:
        return normalisation.partitions[0]
    return Partition((whole_subset(cameras),), normalisation.steps[:1])
