"""Estimate the memory of the weights of a grid before they are built, and compare built weights with counted rays."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lfpiv.geometry.grid import Grid
from lfpiv.weights.choice import Choice, warn_of_errors
from lfpiv.weights.forms.form import Form, Rig
from lfpiv.weights.forms.table import form_of, suitable_forms
from lfpiv.weights.memory_left import DeviceNeed, MemoryLeft, beside_bytes
from lfpiv.weights.operator import Weights
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels import runtime

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration


def estimate_memory(calibration: Calibration, grid: Grid, form: str = "auto", particle_voxel: float = 0.0) -> int:
    """Estimate the memory that the weights of a grid will need [byte], from a sample of its voxels.

    Nothing large is allocated. "auto" counts no rays here: it means profiles for square microlens layouts, else pixels.
    """
    forms = _forms(calibration, grid, form, particle_voxel)
    return sum(one.host_bytes(name) for name, one in forms.items())


def estimate_device_need(calibration: Calibration, grid: Grid, form: str = "auto") -> DeviceNeed:
    """Estimate the memory of a process on a GPU: weights as `estimate_memory`, volumes, images and correlation."""
    sizes = tuple(one.device_bytes(name) for name, one in _forms(calibration, grid, form).items())
    return DeviceNeed(sizes, beside_bytes(calibration.cameras.values(), grid))


def _forms(calibration: Calibration, grid: Grid, form: str, particle_voxel: float = 0.0) -> dict[str, Form]:
    """Return the form that suits each camera, chosen without counting rays."""
    runtime.device()  # `MemoryLeft` knows the free memory of a running device only
    cameras, choices = calibration.cameras, {}
    for name, camera in cameras.items():
        own = "profiles" if camera.lattice.layout == "square" else "pixels"
        choices[name] = Choice(form=own if form == "auto" else form)
    stored, memory = StoredGrid.for_cameras(grid, cameras.values()), MemoryLeft(cameras.values(), grid)
    rig = Rig(stored=stored, cameras=cameras, memory=memory, choices=choices, particle_voxel=particle_voxel)
    return suitable_forms(rig)


def compare_with_count(weights: Weights) -> dict[str, list[float]]:
    """Compare weights with counted rays in a few random voxels of every camera.

    Warn of footprints whose error exceeds the aim. Cameras for which `choose_forms` counted rays were warned of there.

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
    projector = weights.projector(name)
    return form_of(projector).count_errors(weights.counted(name), projector, weights.choice(name))
