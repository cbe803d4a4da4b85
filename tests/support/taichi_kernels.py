"""Results of Taichi's kernels, written to a file by a process of its own: `python taichi_kernels.py FILE`."""

import sys
from itertools import pairwise

import numpy as np
from support.ideal_rig import IdealCamera, IdealRig, lattice, optics, rotation
from support.simulated_cameras import camera

import lfpiv
from lfpiv.calibration.network import Network
from lfpiv.calibration.thin_lens_model import thin_lens_model
from lfpiv.geometry.grid import Grid
from lfpiv.simulation.camera_images import render_camera
from lfpiv_kernels import reference, runtime
from lfpiv_kernels.rays import mapping
from lfpiv_kernels.rendering import collect, render, surfaces

GLASS = {"point_mm": (0, 0, 20), "normal": (0.1, 0, 1), "thickness_mm": 5.0, "index": 1.5}
RIGS = {
    "misaligned": {},
    "hexagonal": {"array": {"pitch_drift": (0.03, -0.02), "cats_eye": 0.5}},
    "ideal": {"window": (GLASS,), "aberrations": {"spherical_pitch": 0.3, "distortion_percent": 1.0}},
}
"""Cameras of `simulated_cameras`, and what is changed, so that every branch of the kernels is taken."""
BOARD = {"dots": (9, 9), "spacing_mm": 0.1, "dot_diameter_mm": 0.05, "dot_light": 1.0, "board_light": 0.1}
COUNTED = {
    "square": IdealCamera("square", rotation(45), optics=optics(110, 150), coma=0.01),
    "hexagonal": IdealCamera(
        "hexagonal", rotation(-45), optics=optics(110, 150, "hexagonal"), lattice=lattice("hexagonal", roll_deg=0.4)
    ),
}
VOXELS = Grid(shape=(5, 3, 5), voxel_mm=0.1, first_centre_mm=(-0.1, -0.1, -0.2))
"""Cameras whose rays are counted, and the voxels: in focus, out of focus and partly beside the sensor."""
PATCH = (np.eye(3)[:2], (0.2, 0.05), (False, True))
"""Axes, half extents [mm], and whether the edges are Gaussian."""


def results():
    """Return the images and rays of all kernels by name."""
    found, rng = {}, np.random.default_rng(0)
    sizes = (5, 12, 9, 2)
    weights = [rng.normal(size=pair) / pair[0] for pair in pairwise(sizes)]
    arrays = {f"weight_{k}": weight for k, weight in enumerate(weights)}
    arrays |= {f"bias_{k}": rng.normal(size=weight.shape[1]) for k, weight in enumerate(weights)}
    arrays |= {"input_centre": np.zeros(5), "input_scale": np.array([10.0, 10, 10, 12, 12])}
    arrays |= {"output_centre": np.zeros(2), "output_scale": np.array([0.2, 0.2])}
    points = rng.uniform(-10, 10, (501, 3)).astype(np.float32)
    pupil = rng.uniform(-12, 12, (17, 2)).astype(np.float32)
    lens = thin_lens_model(camera("ideal").optics, 30.0).to_arrays()
    found["rays"] = mapping.evaluate(Network.from_arrays(arrays).to_arrays() | lens, points, pupil)
    for name, changes in RIGS.items():
        renderer = render_camera(camera(name, sensor_width_px=60, sensor_height_px=44, **changes), seed=2)
        place = np.array([0.02, 0.01, 0.2])
        sources, table = rng.normal(0, 0.05, (20, 3)) + place, render.ray_table(512, "ball", 1)
        found[f"{name} sources"] = render.render_sources(
            renderer, sources, np.full(20, 1e4), 0.02, table, rng=np.random.default_rng(3)
        )
        found[f"{name} white"] = collect.render_white(renderer, samples=32, seed=1)
        found[f"{name} board"] = collect.render_board(renderer, 0.1, **BOARD, samples=32, seed=1)
        found[f"{name} patch"] = surfaces.render_patch(renderer, place, *PATCH, samples=32, seed=1)
    for name, ideal in COUNTED.items():
        weights = lfpiv.build_weights(IdealRig({name: ideal}), VOXELS, "count", rays=4096)
        found[f"{name} counted"] = reference.dense(weights.projector(name).blocks)
    return found


if __name__ == "__main__":
    runtime.start("cpu", threads=1)
    np.savez(sys.argv[1], **results())
