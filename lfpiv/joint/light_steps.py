"""Steps of the light by ordered subsets of both frames' rays, with the displacement fixed.

Each subset gives SMART's logarithm of a step in both frames. It is sharpened as in `lfpiv.reconstruction.steps`, pulled
back along the displacement, and averaged over the frames. The momentum goes on from subset to subset.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv.joint.model import LARGEST_LOSS, JointModel
from lfpiv.reconstruction.momentum import Momentum
from lfpiv.reconstruction.normalisation import LensSubsets, RowSubsets
from lfpiv.reconstruction.ordered_subsets import SHORTENING, SUBSET_MOMENTUM, Partition, whole_subset
from lfpiv.reconstruction.steps import LARGEST_STEP, SHARPENING, SharpenedStep, SmartStep
from lfpiv_kernels.reconstruction.transport import Transport
from lfpiv_kernels.reconstruction.update import sharpen
from lfpiv_kernels.transfer import DeviceArray, duplicate, to_device, to_host

LOSS_STEP, LOSS_SHRINK = 0.5, 0.005
"""Length of a step of rho, and the share by which each step shrinks it towards equally bright frames."""
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
        self.partitions = tuple(_partition(frame.normalisation, len(frame.images)) for frame in model.frames)
        """Subsets of both frames' rays."""

    def epochs(self, light: Light, transports: tuple[Transport, Transport], count: int) -> Light:
        """Return the light after some epochs."""
        subsets = range(len(self.partitions[0].subsets))
        ahead = to_device(light.values.reshape(-1).copy(), float)
        momentum = Momentum(duplicate(ahead), min(light.time, LATEST_TIME), SUBSET_MOMENTUM)
        for epoch in range(light.epochs, light.epochs + count):
            for number in subsets:
                ahead, momentum = self._step(ahead, momentum, transports, number, 1 / (1 + SHORTENING * epoch))
        values = to_host(ahead).reshape(light.values.shape).copy()
        return Light(values, momentum.time, light.epochs + count)

    def _step(
        self,
        ahead: DeviceArray,
        momentum: Momentum,
        transports: tuple[Transport, Transport],
        number: int,
        length: float,
    ) -> tuple[DeviceArray, Momentum]:
        """Return the light and the momentum after the step of one subset."""
        light = to_host(ahead).reshape(self.model.lit.shape)
        logs = [
            transport.pull(self._logarithm(frame, light, transport, number, length), self.model.lit)
            for frame, transport in enumerate(transports)
        ]
        if self.model.rho is not None:
            self._step_loss(light, logs[1] - logs[0])
        mean = to_device(np.ascontiguousarray((logs[0] + logs[1]) / 2).reshape(-1), float)
        extrapolation = momentum.extrapolation(ahead)
        stepped = momentum.previous
        sharpen(ahead, mean, mean, 0.0, LARGEST_STEP, extrapolation=extrapolation, stepped=stepped)
        return extrapolation.ahead, momentum.after(stepped)

    def _logarithm(self, frame: int, light: np.ndarray, transport: Transport, number: int, length: float) -> np.ndarray:
        """Return the logarithm of a frame's own step by one subset, sharpened, shape (z, y, x), float32."""
        model, partition = self.model, self.partitions[frame]
        stored, equations = model.weights.stored, model.frames[frame].equations
        volume = to_device(stored.store(model.volume(frame, light, transport)), float)
        with equations.locked():
            equations.begin()
            exponent = to_host(equations.exponent_of(partition.subsets[number].parts, volume))
        step = partition.steps[number]
        assert isinstance(step, (SharpenedStep, SmartStep))
        own = partition.lengths[number] if partition.lengths else 1.0
        logarithm = stored.restore(exponent * to_host(step.size) * np.float32(length * own))
        if model.sieve_voxel > 0:
            logarithm = (1 + SHARPENING) * logarithm - SHARPENING * model.smoothed(logarithm)
        return np.ascontiguousarray(logarithm, np.float32)

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
        found: Partition = normalisation.partitions[0]
        return found
    return Partition((whole_subset(cameras),), normalisation.steps[:1])
