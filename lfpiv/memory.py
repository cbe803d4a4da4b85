"""How much memory a run needs and how much there is."""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path

from lfpiv.errors import InputError
from lfpiv.experiment import Experiment

MIB = 1 << 20
GIB = 1 << 30

BYTES_PER_VOXEL = 64
"""Volume-sized float32 arrays held at once at the least: two frames, and SMART's or the correlation's work on them."""

BYTES_PER_VOXEL_AND_CAMERA = 64
"""Ray model of a voxel in one camera: chief ray, slopes, second-order terms, widths."""

BYTES_PER_PIXEL = 64
"""Per sensor pixel: images, their light-field blocks, the decoder's arrays."""

BASE_BYTES = GIB // 2
"""Python, its libraries and compiled kernels."""


def least_bytes(experiment: Experiment) -> int:
    """Estimate the least memory a run of the experiment takes [byte], from the volume and the sensors alone."""
    cameras = len(experiment.cameras)
    pixels = sum(math.prod(camera.optics.sensor_shape) for camera in experiment.cameras)
    voxel_bytes = BYTES_PER_VOXEL + BYTES_PER_VOXEL_AND_CAMERA * cameras
    return BASE_BYTES + voxel_bytes * experiment.grid.size + BYTES_PER_PIXEL * pixels


def available_bytes() -> int:
    """Return the memory this process may take [byte]: what the machine has free or its control group allows."""
    free = _meminfo("MemAvailable")
    if free is None:
        free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else sys.maxsize
    for limit, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ):
        try:
            free = min(free, int(Path(limit).read_text()) - int(Path(used).read_text()))
        except (OSError, ValueError):  # no such control group, or "max"
            continue
    return max(free, 0)


def left_for_weights(experiment: Experiment) -> int:
    """Return the memory that the weights may take [byte], beside volumes that are still to come."""
    left = available_bytes() - BYTES_PER_VOXEL * experiment.grid.size
    if experiment.compute.memory_gib is not None:
        left = min(left, int(experiment.compute.memory_gib * GIB) - least_bytes(experiment))
    return left


def require(needed: int, experiment: Experiment, what: str) -> None:
    """Refuse work that needs more memory than there is, or than ``compute.memory_gib`` allows.

    Raises
    ------
    InputError
        With both numbers and the volume's size.
    """
    allowed = experiment.compute.memory_gib
    limit = available_bytes() if allowed is None else min(int(allowed * GIB), available_bytes())
    if needed <= limit:
        return
    origin = "compute.memory_gib allows" if allowed is not None and limit == int(allowed * GIB) else "are available"
    shape = " x ".join(map(str, experiment.grid.shape))
    raise InputError(
        f"{experiment.path}: volume: {what} {shape} voxels (z, y, x) and {len(experiment.cameras)} camera(s) need at "
        f"least {needed / GIB:,.1f} GiB of memory, {limit / GIB:,.1f} GiB {origin}. Raise volume.voxel_mm or shrink "
        "volume.size_mm."
    )


def peak_mib() -> float:
    """Return the largest memory this process has held so far [MiB]."""
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / MIB if sys.platform == "darwin" else peak / 1024


def _meminfo(key: str) -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(key + ":")), None)
