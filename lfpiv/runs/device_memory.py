"""Estimate the memory that a run needs on a GPU, and refuse a run that cannot fit, before any work.

A GPU holds the weights of all cameras, the volumes that SMART works on, and the images; then the volumes, the spline
coefficients and a batch of windows of the correlation.
"""

from __future__ import annotations

import math

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.files import MIB
from lfpiv.runs.memory import GIB
from lfpiv_kernels import runtime
from lfpiv_kernels.runtime import Device

VOLUMES, VOLUMES_PER_CAMERA = 10, 4
"""Largest number of volumes that SMART has on the GPU at once: coefficients, light, exponent, momentum, their sums and
those that are copied; for each camera the sums of its weights and of its subsets, and the steps of these."""
ARRAYS_PER_PIXEL = 6
"""The same of images per camera: image, gain, light that is held, logarithm, and those that are copied."""
CORRELATED_BYTES, BATCH_BYTES = 100, 192 * MIB
"""Memory of the correlation per voxel, and beside that [byte]: both volumes, deformed and as splines, and windows with
their spectra. Counted in volumes of 48 to 128 voxels along each edge, with windows up to 48."""
VALUE_BYTES = 4
"""Memory of a voxel or a pixel in one array [byte]."""
BASE_BYTES = 3 * GIB // 2
"""Memory of the driver's context, the kernels, and 1 GiB that Taichi reserves at its start [byte]."""


def needed_bytes(experiment: Experiment, weights: int) -> int:
    """Estimate the memory that a process needs on its GPU [byte].

    Parameters
    ----------
    experiment : Experiment
        With the grid that is reconstructed.
    weights : int
        Memory of the weights and of the maps between rays and pixels [byte], from `lfpiv.runs.memory.weights_bytes`.
    """
    cameras = experiment.cameras
    pixels = sum(math.prod(camera.optics.sensor_shape) for camera in cameras)
    volumes = VALUE_BYTES * (VOLUMES + VOLUMES_PER_CAMERA * len(cameras)) * experiment.grid.size
    smart = weights + volumes + VALUE_BYTES * ARRAYS_PER_PIXEL * pixels
    return BASE_BYTES + max(smart, weights + BATCH_BYTES + CORRELATED_BYTES * experiment.grid.size)


def require(experiment: Experiment, weights: int, device: Device, *, sharing: int = 1, free: int | None = None) -> None:
    """Refuse a run whose arrays cannot fit into the memory of its GPU; a run on the CPU passes.

    Parameters
    ----------
    experiment, weights
        As of `needed_bytes`.
    device : Device
        Where the kernels run.
    sharing : int
        Number of processes that share a GPU.
    free : int, optional
        Free memory of the GPU [byte]; default: that of the running one.

    Raises
    ------
    InputError
        With the memory that is needed and that is free, and what to change.
    """
    free = runtime.free_bytes() if free is None else free
    needed = sharing * needed_bytes(experiment, weights)
    if free is None or needed <= free:
        return
    shape = " x ".join(map(str, experiment.grid.shape))
    remedy = (
        f"Use at most {max(free * sharing // needed, 1)} workers per GPU" if sharing > 1 else "Raise volume.voxel_mm"
    )
    raise InputError(
        f"{experiment.path}: volume: {shape} voxels (z, y, x) and {len(experiment.cameras)} camera(s) need about "
        f"{needed / GIB:,.1f} GiB of the GPU's memory, {free / GIB:,.1f} GiB are free on {device.name or device.kind}. "
        f"{remedy}, set smart.refinement = 1.0, shrink volume.size_mm, or use --device cpu."
    )
