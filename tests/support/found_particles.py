"""Found particles of given places, random places, and a field that predicts them."""

import numpy as np
import xarray as xr

from lfpiv.tracking.found import FoundParticles

VOXEL_MM = 0.1


def cloud(positions_mm, light=None, error_mm=0.001):
    count = len(positions_mm)
    return FoundParticles(
        positions_mm=np.asarray(positions_mm, float),
        errors_mm=np.full((count, 3), error_mm),
        light=np.full(count, 100.0) if light is None else np.asarray(light, float),
        residual=np.ones(count),
        sigma_voxel=0.7,
        voxel_mm=VOXEL_MM,
        explained=1.0,
        crowding=0.0,
        hidden=0.0,
        per_microlens=0.05,
        signal_to_noise=np.full(count, 30.0),
    )


def scattered(count=60, seed=0):
    return np.random.default_rng(seed).uniform(-2, 2, (count, 3))


def field(displacement_voxel):
    """A correlation's vectors of one displacement everywhere."""
    axis, dims = np.array([-1.5, 0.0, 1.5]), ("z", "y", "x")
    data = {
        f"displacement_{name}": (dims, np.full((3, 3, 3), value))
        for name, value in zip("xyz", displacement_voxel, strict=True)
    }
    return xr.Dataset(
        {**data, "valid": (dims, np.ones((3, 3, 3), bool))}, {name: axis for name in dims}, {"voxel_mm": [VOXEL_MM] * 3}
    )
