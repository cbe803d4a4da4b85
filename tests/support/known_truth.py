"""Data sets with a known flow but without images, and results on them in forms of any program."""

import json

import numpy as np
import xarray as xr
from support import scenes

from lfpiv.benchmark.truth import open_truth
from lfpiv.simulation.particles import lit_particles
from lfpiv.simulation.series import place_series
from lfpiv.simulation.truth import write_scene

SIZE_MM, VOXEL_MM, DT_S = (4.0, 4.0, 3.0), 0.1, 1e-3
RING = {"kind": "ring", "radius_mm": 1.1, "core_mm": 0.8, "peak_mm": 0.15}


def known_scene(**more):
    """Return a scene of a ring vortex in two pairs."""
    tables = {
        "planes_mm": (-1.0, 1.0),
        "size_mm": SIZE_MM,
        "particles": {"count": 400, "pairs": 2},
        "displacement_mm": (0.0, 0.0, 0.0),
        "flow": RING,
    }
    return scenes.scene("known", [scenes.camera("front", 0.0, (200, 200))], **(tables | more))


def write_truth(folder, scene=None):
    """Write the truth of a scene as the simulator does, without images; return the opened truth."""
    scene = scene or known_scene()
    (folder / "truth").mkdir(parents=True)
    series = scene.particles.instants is not None
    placed = place_series(scene) if series else [lit_particles(scene, pair) for pair in range(scene.particles.pairs)]
    write_scene(scene, placed, folder / "truth")
    return open_truth(folder)


def grid_axes(truth, step_voxel=4, margin_voxel=6):
    """Return centres along x, y, z [mm], this far inside the faces."""
    voxel = truth.voxel_mm
    axes = []
    for centre, size in zip(truth.scene.volume.centre_mm, truth.scene.volume.size_mm, strict=True):
        count = 1 + int(round(size / voxel - 2 * margin_voxel) // step_voxel)
        axes.append(centre + step_voxel * voxel * (np.arange(count) - (count - 1) / 2))
    return axes


def true_vectors(truth, pair, *, window_mm=None, change=lambda values: values, axes=None):
    """Return a dataset in the usual form, the truth of a pair itself, its displacements [mm] changed by a function."""
    x, y, z = axes or grid_axes(truth)
    points = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
    moved = change(truth.displacement(pair, points, window_mm)[0]).reshape(len(z), len(y), len(x), 3)
    speed = moved / 1000 / truth.scene.dt_s
    variables = {name: (("z", "y", "x"), speed[..., k], {"units": "m/s"}) for k, name in enumerate("uvw")}
    places = {name: (name, values, {"units": "mm"}) for name, values in zip("xyz", (x, y, z), strict=True)}
    attributes = {} if window_mm is None else {"window_mm": list(window_mm)}
    return xr.Dataset(variables, places, attributes)


def write_pairs(folder, datasets):
    """Write a dataset for each pair; return the folder."""
    folder.mkdir(parents=True)
    for pair, dataset in enumerate(datasets):
        dataset.to_netcdf(folder / f"pair_{pair:04d}.nc", engine="h5netcdf")
    return folder


def figures_of(path):
    """Return the figures of the first result of a JSON file of scores."""
    return json.loads(path.read_text("utf-8"))["results"][0]["figures"]
