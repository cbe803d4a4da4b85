"""Estimate the memory that a run needs, and find out how much memory this process may take."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import LEAST_BYTES_PER_CAMERA, LEAST_BYTES_PER_VOXEL, memory_of_machine
from lfpiv.experiment.segments import REACH
from lfpiv.files import MIB

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration

GIB = 1 << 30

KEPT_BYTES = 20
"""Memory per voxel that the solver keeps between instants [byte]: sum of the weights, lit voxels, two step sizes."""

BYTES_PER_VOXEL = LEAST_BYTES_PER_VOXEL
"""Memory per voxel [byte]: `KEPT_BYTES`, and 100 that the correlation works on, both volumes included; SMART less."""

BYTES_PER_VOXEL_AND_CAMERA = LEAST_BYTES_PER_CAMERA
"""Memory per voxel and camera that is kept [byte]: sums of the weights of all and of half of the lenses, step sizes of
these."""

JOINT_BYTES = 60
"""Memory per voxel that a joint fit needs beyond the correlation [byte]: both frames by themselves, displacement."""

BYTES_PER_PIXEL = 72
"""Memory per sensor pixel [byte]: images, those of the next pair, light-field blocks, the decoder's arrays."""

BYTES_PER_VALUE = 4
"""Memory of a voxel or a pixel of an instant that is held [byte]."""

BASE_BYTES = GIB // 2
"""Memory of Python, its libraries and compiled kernels [byte]."""

GROUPS = Path("/sys/fs/cgroup")
"""Folder of the control groups of the system or the container."""

OWN_GROUPS = Path("/proc/self/cgroup")
"""File that names the control groups of this process."""


def weights_bytes(experiment: Experiment, particle_voxel: float = 0.0) -> int:
    """Estimate the memory of the weights [byte] from the nominal rig, for particles of a size if it is known."""
    from lfpiv.weights.checks import estimate_memory

    return estimate_memory(nominal_cameras(experiment), experiment.grid, weights_form(experiment), particle_voxel)


def weights_form(experiment: Experiment) -> str:
    """Return the form of the weights as far as the experiment states it."""
    compute = experiment.compute
    return compute.weights_form if compute.weights == "footprint" else "pixels"  # counts: as pixels, without planes


def worker_bytes(experiment: Experiment) -> int:
    """Estimate the memory of one worker process without the weights, which all workers share [byte]."""
    pixels = sum(math.prod(camera.optics.sensor_shape) for camera in experiment.cameras)
    return BASE_BYTES + _volumes_bytes(experiment) + BYTES_PER_PIXEL * pixels + _sequence_bytes(experiment, pixels)


def _volumes_bytes(experiment: Experiment) -> int:
    """Estimate the memory of a process for what it has of each voxel, but the weights [byte]."""
    each = BYTES_PER_VOXEL + BYTES_PER_VOXEL_AND_CAMERA * len(experiment.cameras)
    each += JOINT_BYTES * experiment.is_joint
    return each * experiment.grid.size


def _sequence_bytes(experiment: Experiment, pixels: int) -> int:
    """Estimate the memory of the instants that a process holds beyond a pair, to reconstruct others from them [byte].

    These are the instants between the two of a pair, with their images; an instant and all that correct it, with
    splines of their volumes, the later of them with their images twice; and the three volumes of a prediction.
    """
    if not experiment.in_sequence:
        return 0
    between = experiment.recording.step - 1
    volumes, images = between + 4 * REACH + 5, between + 2 * (REACH + 1)
    return BYTES_PER_VALUE * (volumes * experiment.grid.size + images * pixels)


def run_bytes(experiment: Experiment, weights: int, workers: int) -> int:
    """Estimate the memory of a run [byte]. Several workers have a process beside them, which made the weights."""
    beside = BASE_BYTES if workers > 1 else 0
    return beside + weights + workers * worker_bytes(experiment)


def fitting_workers(experiment: Experiment, weights: int, workers: int) -> int:
    """Return the largest number of workers, up to `workers`, that fits into the memory; at least 1."""
    limit = allowed_bytes(experiment)
    while workers > 1 and run_bytes(experiment, weights, workers) > limit:
        workers -= 1
    return workers


def allowed_bytes(experiment: Experiment) -> int:
    """Return the memory a run may take [byte]: the available memory, limited by ``compute.memory_gib``."""
    allowed = experiment.compute.memory_gib
    return available_bytes() if allowed is None else min(int(allowed * GIB), available_bytes())


def available_bytes() -> int:
    """Return the memory this process may take [byte]: the free memory, limited by its control groups."""
    free = meminfo("MemAvailable")
    if free is None:
        free = memory_of_machine()
    return max(0, min([free, *_left_in_groups()]))


def left_for_weights(experiment: Experiment) -> int:
    """Return the memory left for the weights [byte], after the volumes, which are allocated later."""
    left = available_bytes() - _volumes_bytes(experiment)
    if experiment.compute.memory_gib is not None:
        left = min(left, int(experiment.compute.memory_gib * GIB) - worker_bytes(experiment))
    return left


def require(needed: int, experiment: Experiment, what: str) -> None:
    """Refuse work that needs more memory than is available or than ``compute.memory_gib`` allows.

    Raises
    ------
    InputError
        With both numbers and the volume's size.
    """
    allowed, limit = experiment.compute.memory_gib, allowed_bytes(experiment)
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


def meminfo(key: str) -> int | None:
    """Return a figure of the operating system's memory by its key in /proc/meminfo [byte], None where there is none."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(key + ":")), None)


def _left_in_groups() -> Iterator[int]:
    """Yield the memory that the control group of this process and each group above it leave it [byte]."""
    names = ("memory.max", "memory.current", "inactive_file", "active_file")
    older = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file", "total_active_file")
    for controller, place, files in (("", GROUPS, names), ("memory", GROUPS / "memory", older)):
        for group in _groups(controller, place):
            yield _left_in(group, files)


def _groups(controller: str, place: Path) -> list[Path]:
    """List the folders of this process's group and of the groups above it up to `place`.

    `controller` is empty for control groups of version 2.
    """
    try:
        lines = [line.split(":", 2) for line in OWN_GROUPS.read_text().splitlines()]
    except OSError:
        lines = []
    own = next((group for _, names, group in lines if controller in names.split(",")), "/")
    if ".." in own:  # not visible in the container
        own = "/"
    path = place / own.strip("/")
    return [path, *(parent for parent in path.parents if parent.is_relative_to(place))]


def _left_in(group: Path, names: tuple[str, str, str, str]) -> int:
    """Return the memory that one group leaves its processes [byte]; `sys.maxsize` without such a group or limit.

    Files in the page cache count as used, but the kernel drops them when memory is needed. So they are added.
    """
    limit, used, *droppable = names
    try:
        left = int((group / limit).read_text()) - int((group / used).read_text())
    except (OSError, ValueError):  # no such group, or the limit is "max"
        return sys.maxsize
    with contextlib.suppress(OSError):
        lines = (line.split() for line in (group / "memory.stat").read_text().splitlines())
        left += sum(int(value) for name, value in lines if name in droppable)
    return left


def nominal_cameras(experiment: Experiment) -> Calibration:
    """Return the nominal rig of the experiment file. Reads no image."""
    from lfpiv.calibration.camera import CalibratedCamera, Calibration
    from lfpiv.calibration.thin_lens_model import thin_lens_model
    from lfpiv.geometry.optics import LensLattice
    from lfpiv.geometry.orientation import Orientation

    cameras = {}
    for setup in experiment.cameras:
        pitch, half = setup.optics.microlens_pitch_mm, setup.optics.microlens_pitch_mm / 2
        second = (half, half * 3**0.5) if setup.optics.layout == "hexagonal" else (0.0, pitch)
        cameras[setup.name] = CalibratedCamera(
            name=setup.name,
            optics=setup.optics,
            lattice=LensLattice(origin_mm=(0.0, 0.0), basis_mm=((pitch, 0.0), second), layout=setup.optics.layout),
            decoder=None,  # type: ignore[arg-type]  # made from images
            baseline=thin_lens_model(setup.optics, setup.orientation or Orientation(0.0)),
        )
    return Calibration(cameras)
