"""Estimate the memory that a run needs on a GPU, and refuse a run that cannot fit, before any work."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.files import size_text
from lfpiv.prompt import count
from lfpiv.runs import memory
from lfpiv_kernels import runtime
from lfpiv_kernels.runtime import Device

if TYPE_CHECKING:
    from lfpiv.weights.memory_left import DeviceNeed


def estimate_need(experiment: Experiment, *, weights: bool = True) -> DeviceNeed:
    """Estimate the memory that a process needs on a GPU from the nominal rig, before any image is read.

    Without `weights` volumes are correlated only.
    """
    from lfpiv.weights.checks import estimate_device_need
    from lfpiv.weights.memory_left import DeviceNeed, beside_bytes

    if not weights:
        return DeviceNeed((), beside_bytes((), experiment.grid))
    return estimate_device_need(memory.nominal_cameras(experiment), experiment.grid, memory.weights_form(experiment))


def require(experiment: Experiment, need: DeviceNeed, device: Device, *, sharing: int = 1) -> None:
    """Refuse a run whose arrays cannot fit into the memory of its GPU.

    Parameters
    ----------
    experiment : Experiment
        Experiment with the grid that is reconstructed.
    need : DeviceNeed
        Memory that one process needs.
    device : Device
        The running device, which the message names. Its free memory is asked of `runtime`; a run on the CPU passes.
    sharing : int
        Number of processes that share a GPU.

    Raises
    ------
    InputError
        If the memory does not suffice. The message states the need, the free memory, and what to change.
    """
    free = runtime.free_bytes()
    if free is not None and sharing * need.whole > free:
        raise InputError(_refusal(experiment, need, device, sharing, free))


def _refusal(experiment: Experiment, need: DeviceNeed, device: Device, sharing: int, free: int) -> str:
    """Return the message for a run that cannot fit."""
    shape = " x ".join(map(str, experiment.grid.shape))
    needs = f"{size_text(sharing * need.whole)} of the GPU's memory"
    fits = free // max(need.whole, 1)
    remedy = f"Use at most {count(fits, 'worker')} per GPU, raise volume.voxel_mm" if fits else "Raise volume.voxel_mm"
    return (
        f"{experiment.path}: volume: {shape} voxels (z, y, x) and {len(experiment.cameras)} camera(s) need about "
        f"{needs}; {size_text(free)} are free on {device.name or device.kind}. "
        f"{remedy}, set smart.refinement = 1.0, shrink volume.size_mm, or use --device cpu."
    )
