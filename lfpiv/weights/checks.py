"""How much memory the weights of a grid will need, and how far built weights are from counted rays."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from lfpiv.geometry.grid import Grid
from lfpiv.weights.blocks import BLOCK_BYTES, CHUNK_VOXELS, VOXEL_BYTES, PackedCamera, sample_blocks
from lfpiv.weights.choice import form_errors, warn_of_errors
from lfpiv.weights.depth_planes import choose_planes
from lfpiv.weights.device_share import DeviceNeed, DeviceShare, beside_bytes, rays_bytes
from lfpiv.weights.operator import Weights
from lfpiv.weights.separable import possible_planes
from lfpiv.weights.separable_planes import Planes
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.projector import Projector
from lfpiv_kernels.reconstruction.projector_gpu import device_bytes
from lfpiv_kernels.weights.ray_model import MODEL_SIZE

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera, Calibration


def estimate_memory(calibration: Calibration, grid: Grid, form: str = "auto", particle_voxel: float = 0.0) -> int:
    """Estimate the memory that the weights of a grid will need [byte], from a sample of its voxels.

    Nothing large is allocated. The form "auto" is taken for profiles if the microlens layout is square.
    """
    if (separable := _planes(calibration, grid, form)) is not None:
        return sum(planes.estimated_bytes for planes in separable.values())
    total = 0.0
    for camera, (_, size, blocks, values) in _samples(calibration, grid, form, particle_voxel):
        rays = rays_bytes(camera)
        total += (BLOCK_BYTES * blocks + values + VOXEL_BYTES) * size + 4 * MODEL_SIZE * CHUNK_VOXELS + rays
    return int(total)


def estimate_device_need(calibration: Calibration, grid: Grid, form: str = "auto") -> DeviceNeed:
    """Do as `estimate_memory` for the memory of a GPU, volumes, images and correlation included."""
    beside = beside_bytes(calibration.cameras.values(), grid)
    if (separable := _planes(calibration, grid, form)) is not None:
        return DeviceNeed(tuple(planes.device_bytes for planes in separable.values()), beside)
    sizes = tuple(
        device_bytes(chosen, size, int(blocks * size), int(values * size), edge=camera.microimages.edge)
        for camera, (chosen, size, blocks, values) in _samples(calibration, grid, form, 0.0)
    )
    return DeviceNeed(sizes, beside)


def _planes(calibration: Calibration, grid: Grid, form: str) -> dict[str, Planes] | None:
    """Return the planes of each camera whose profiles are shared, if these may suit."""
    if form == "pixels":
        return None
    runtime.device()
    cameras = calibration.cameras
    stored = StoredGrid.for_cameras(grid, cameras.values(), columns_inmost=True)
    return possible_planes(stored, cameras, DeviceShare(cameras.values(), grid))


def _samples(
    calibration: Calibration, grid: Grid, form: str, particle_voxel: float
) -> Iterator[tuple[CalibratedCamera, tuple[str, int, float, float]]]:
    """Yield each camera, its form, its number of voxels or nodes, and the mean numbers of their blocks and values."""
    runtime.device()
    stored = StoredGrid(grid, (0, 1, 2))
    for camera in calibration.cameras.values():
        chosen = form if form != "auto" else "profiles" if camera.lattice.layout == "square" else "pixels"
        places = choose_planes(stored, camera, chosen, particle_voxel=particle_voxel) or stored
        yield camera, (chosen, places.size, *sample_blocks(PackedCamera.of(camera), places, chosen))


def compare_with_count(weights: Weights) -> dict[str, list[float]]:
    """Compare weights with counted rays in a few random voxels of every camera.

    Weights of nodes and profiles of planes stand for those of particles, so there the voxels' own footprints are
    compared; `choose_planes` and `choose_separable` compared the others. Warn of weights whose error exceeds the aim,
    unless `choose_form` did so before.

    Returns
    -------
    dict of str to list of float
        Camera name -> relative L2 difference per voxel that the camera sees, the noise of the count subtracted.
    """
    errors = {name: _count_errors(weights, name) for name in weights.cameras}
    for name, some in errors.items():
        if name not in weights.profile_errors and weights.method == "footprint":
            warn_of_errors(weights.counted(name), weights.forms[name], some, requested=True)
    return errors


def _count_errors(weights: Weights, name: str) -> list[float]:
    """Return the relative L2 differences of one camera's counted voxels."""
    counted, projector = weights.counted(name), weights.projector(name)
    if isinstance(projector, Projector) and projector.planes is None:
        return counted.errors(projector)
    return form_errors(counted, weights.forms[name], weights.cuts[name])
