"""Truth of a case in plain form: particles as CSV, and the flow as NetCDF on the recommended grid."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from lfpiv.settings.bounds import Point
from lfpiv.simulation.flows import window_mean
from lfpiv.simulation.particles import lit_particles
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.series import place_series
from lfpiv.simulation.truth import particle_arrays

WINDOW_VOXEL, SPACING_VOXEL = 12, 6
"""Edge of the windows and spacing of the vectors [voxel]."""

FLOW_FILE, PARTICLES_FILE = "flow.nc", "particles.csv"
"""Files of the truth."""


@dataclass(frozen=True, kw_only=True)
class VectorGrid:
    """Centres and windows of vectors, arrays ordered (z, y, x)."""

    window_mm: float
    """Edge of the windows [mm]."""
    spacing_mm: float
    """Distance of neighbouring centres [mm]."""
    x: np.ndarray
    """Centres along x [mm]."""
    y: np.ndarray
    """Centres along y [mm]."""
    z: np.ndarray
    """Centres along z [mm]."""

    @property
    def centres_mm(self) -> np.ndarray:
        """Centres (x, y, z), x fastest, shape (n, 3) [mm]."""
        z, y, x = np.meshgrid(self.z, self.y, self.x, indexing="ij")
        return np.stack([x, y, z], axis=-1).reshape(-1, 3)


def recommended_grid(scene: Scene) -> VectorGrid:
    """Return the grid of as many windows of `WINDOW_VOXEL` as fit into the scene's volume, about its centre."""
    voxel = scene.volume.voxel_mm
    window, spacing = WINDOW_VOXEL * voxel, SPACING_VOXEL * voxel

    def axis(size: float, centre: float) -> np.ndarray:
        count = 1 + max(0, int((size - window) / spacing + 1e-9))
        return np.round(centre + (np.arange(count) - (count - 1) / 2) * spacing, 9)

    size: Point = scene.volume.size_mm
    x, y, z = (axis(edge, middle) for edge, middle in zip(size, scene.volume.centre_mm, strict=True))
    return VectorGrid(window_mm=round(window, 9), spacing_mm=round(spacing, 9), x=x, y=y, z=z)


def measured_numbers(scene: Scene) -> range:
    """Return the numbers of the pairs, or of the instants of a sequence that have a partner."""
    particles = scene.particles
    if particles.instants is None:
        return range(particles.pairs)
    return range(particles.first, particles.first + particles.instants - particles.step)


def true_particles(scene: Scene) -> dict[str, np.ndarray]:
    """Return the arrays of ``truth/particles.npz`` of a scene, without rendering its images."""
    particles = scene.particles
    if particles.instants is not None:
        return particle_arrays(scene, place_series(scene))
    return particle_arrays(scene, [lit_particles(scene, pair) for pair in range(particles.pairs)])


def flow_truth(scene: Scene) -> xr.Dataset:
    """Return the true displacement and velocity, averaged over the windows of the recommended grid.

    Returns
    -------
    Dataset
        ``u``, ``v``, ``w`` [m/s] and ``displacement_x``, ``_y``, ``_z`` [voxel], dimensions (pair, z, y, x); of a
        sequence (instant, z, y, x).
    """
    grid, voxel = recommended_grid(scene), scene.volume.voxel_mm
    number = "pair" if scene.particles.instants is None else "instant"
    numbers = measured_numbers(scene)
    shape = (len(grid.z), len(grid.y), len(grid.x))
    moved = np.stack([window_mean(scene.flow_of(one), grid.centres_mm, grid.window_mm) for one in numbers])
    moved = moved.reshape(len(numbers), *shape, 3)
    dims, variables = (number, "z", "y", "x"), {}
    for component, (axis, name) in enumerate(zip("xyz", "uvw", strict=True)):
        velocity = moved[..., component] / scene.dt_s / 1000
        variables[name] = (dims, velocity, {"units": "m/s", "long_name": f"velocity along {axis}, mean over window"})
        shift = moved[..., component] / voxel
        about = {"units": "voxel", "long_name": f"displacement along {axis} within dt_s, mean over window"}
        variables[f"displacement_{axis}"] = (dims, shift, about)
    coordinates = {axis: (axis, getattr(grid, axis), {"units": "mm", "axis": axis.upper()}) for axis in "zyx"}
    return xr.Dataset(
        variables,
        coords={number: np.array(numbers), **coordinates},
        attrs={
            "title": f"True flow of the light-field PIV benchmark's case {scene.name}",
            "dt_s": scene.dt_s,
            "voxel_mm": voxel,
            "window_mm": grid.window_mm,
        },
    )


def write_particles(particles: dict[str, np.ndarray], path: Path) -> None:
    """Write true particles as a table with units in the names of its columns.

    Parameters
    ----------
    particles : dict
        Arrays as in ``truth/particles.npz``. Positions of pairs are midway in time, those of instants at the instant.
    """
    groups = sorted({name.removesuffix("_positions_mm") for name in particles if name.endswith("_positions_mm")})
    number = groups[0].split("_")[0]
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        columns = [f"{name} [mm]" for name in ("x", "y", "z", "dx", "dy", "dz")]
        table.writerow([number, "index", *columns, "intensity"])
        for group in groups:
            position = particles[f"{group}_positions_mm"]
            moved = particles.get(f"{group}_displacement_mm", np.full(position.shape, np.nan))
            index = particles.get(f"{group}_index", np.arange(len(position)))
            rows = np.column_stack([position, moved, particles[f"{group}_intensity"]])
            label = int(group.split("_")[1])
            for one, row in zip(index, rows, strict=True):
                table.writerow([label, int(one), *("" if np.isnan(value) else f"{value:.7f}" for value in row)])
