"""Field imposed on simulated particles: its means over the windows are the vectors."""

import json

import numpy as np
import xarray as xr

from lfpiv.velocity.imposed_field import ImposedField

VOXEL_MM, EDGE, STEP = 0.1, 12, 6
COUNTS = (4, 5, 6)


def vectors():
    axes = {axis: 3.0 + VOXEL_MM * STEP * np.arange(n) for axis, n in zip("zyx", COUNTS, strict=True)}
    settings = {"windows": [[EDGE] * 3], "overlap": 0.5, "max_displacement_voxel": None}
    settings |= {"smoothing_voxel": 0.5, "intensity_power": 0.5}
    return xr.Dataset({}, axes, {"voxel_mm": [VOXEL_MM] * 3, "settings": json.dumps(settings)})


def wave():
    z, y, x = np.meshgrid(*(np.arange(n) for n in COUNTS), indexing="ij")
    return np.stack([np.sin(0.9 * x + 0.3 * z), np.cos(0.8 * y), 0.2 * z + np.sin(0.7 * (x + y))], -1)


def test_means_over_windows_are_those_of_the_particles():
    like, field = vectors(), ImposedField(vectors(), wave())
    offsets = VOXEL_MM * (np.arange(EDGE) - (EDGE - 1) / 2)
    z, y, x = np.meshgrid(*(like["zyx"[k]].values[[1, 2, 3][k]] + offsets for k in range(3)), indexing="ij")
    mean = field(np.stack([x, y, z], -1).reshape(-1, 3)).mean(0) / VOXEL_MM
    assert np.allclose(mean[::-1], field.window_means[1, 2, 3], atol=1e-6)


def test_means_over_windows_come_close_to_the_vectors():
    field, wanted = ImposedField(vectors(), wave()), wave()
    slopes = [np.polyfit(wanted[..., k].ravel(), field.window_means[..., k].ravel(), 1)[0] for k in range(3)]
    assert np.allclose(slopes, 1, atol=0.05)  # a spline through the vectors has 0.75 to 0.9
    level = ImposedField(vectors(), np.full((*COUNTS, 3), 1.5))
    assert np.allclose(level.window_means, 1.5)
    assert np.allclose(level(np.array([[-50.0, 0.0, 99.0]])), 1.5 * VOXEL_MM)


def test_a_vortex_is_found_between_and_beyond_the_centres_of_windows():
    like = vectors()
    middle = {axis: float(like[axis].mean()) for axis in "zyx"}
    edges = {axis: like[axis].values[:, None] + VOXEL_MM * (np.arange(EDGE) - (EDGE - 1) / 2) for axis in "zyx"}
    along = {axis: np.exp(-(((edges[axis] - middle[axis]) / 0.9) ** 2)).mean(1) for axis in "zyx"}
    means = along["z"][:, None, None] * along["y"][:, None] * along["x"]
    field = ImposedField(like, np.stack([means] * 3, -1))
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(edges[axis].min(), edges[axis].max(), 2000) for axis in "xyz"], 1)
    true = np.exp(-(((points - [middle[axis] for axis in "xyz"]) / 0.9) ** 2).sum(1))
    error = field(points)[:, 0] / VOXEL_MM - true
    assert error.std() < 0.08 * true.std()  # a spline, constant beyond the centres, with these means has 0.13
    assert abs(error.mean()) < 0.02
