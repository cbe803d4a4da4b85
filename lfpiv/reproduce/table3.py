"""Table 3: number of samples of the mapping, and time of training and of weights."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.calibration.board.dots import BoardDots
from lfpiv.calibration.camera import Calibration
from lfpiv.calibration.training import TrainingSettings, train
from lfpiv.geometry.grid import Grid
from lfpiv.progress import Progress
from lfpiv.reproduce import page
from lfpiv.reproduce.rigs import Rig, numerical_rig, volume_grid
from lfpiv.weights.checks import compare_with_count
from lfpiv.weights.operator import build_weights
from lfpiv_kernels import runtime

TITLE = "Table 3: data and computing time"

PAPER_SAMPLES = 197_570
PAPER_CORES = 44
PAPER_TRAINING_MIN, PAPER_WEIGHTS_MIN, PAPER_DRT_MIN = 15, 115, 118
PARTS = (0.70, 0.15, 0.15)
"""Training, validation and test."""
EPOCHS = {"small": 300, "paper": 1000}
"""Largest number of epochs. Training stops earlier when the validation error no longer falls."""
VOLUME_MM = {"small": (4.0, 4.0, 4.0), "paper": (10.0, 10.0, 10.0)}
DOT_RAYS = {"small": 37, "paper": 192}
"""Rays of each dot. 192 rays of 21 planes of 49 dots are the paper's 197,570 samples."""
PUPIL_PART = 0.92
"""Rays of the dots lie within this part of the pupil's radius, as the labels do."""
MATCH_TRAINING_S, MATCH_WEIGHTS_S = 60.0, 30.0
"""The goals at paper scale [s]."""


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Time training and weights; see `lfpiv.reproduce.study` for the arguments."""
    rig = numerical_rig(work.parent / "rig", scale, seed, progress)
    return compute(rig, scale, seed=seed, progress=progress)


def compute(rig: Rig, scale: str, *, seed: int, progress: Progress) -> dict[str, Any]:
    """Time training and weights on a calibrated rig. The kernels are compiled before the clock starts."""
    trained = {}
    for number, name in enumerate(rig.calibration.cameras):
        progress(f"training of {name}", number / 4)
        trained[name] = _time_training(rig, name, scale, seed)
    grid = volume_grid(VOLUME_MM[scale])
    built = {}
    for number, mapping in enumerate(("network", "drt")):
        progress(f"weights, {mapping}", 0.5 + number / 4)
        built[mapping] = _time_weights(rig.calibration if mapping == "network" else rig.ray_tracing(mapping), grid)
    progress("weights", 1.0)
    return _result(trained, built, grid, scale)


def _time_training(rig: Rig, name: str, scale: str, seed: int) -> dict[str, Any]:
    """Train one camera's network on the paper's number of samples."""
    camera = rig.calibration.cameras[name]
    points, pupil, array, dot = dense_labels(rig.labels(name), DOT_RAYS[scale], camera.optics.pupil_radius_mm)
    cpu = time.process_time()
    training = train(
        np.hstack([points, pupil]),
        array,
        TrainingSettings(epochs=EPOCHS[scale], split=PARTS, seed=seed),
        groups=dot,
        unit=camera.lattice.pitch_mm,
    )
    return {
        "samples": len(points),
        "epochs": training.epochs,
        "stop": training.stop.value,
        "sigma_nor": training.sigma_nor,
        "wall_s": training.seconds,
        "cpu_s": time.process_time() - cpu,
    }


def _time_weights(calibration: Calibration, grid: Grid) -> dict[str, float]:
    """Build the weights of a grid, and compare some with counted rays."""
    build_weights(calibration, volume_grid((0.8, 0.8, 0.8)))  # compiles the kernels
    wall, cpu = time.perf_counter(), time.process_time()
    weights = build_weights(calibration, grid)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    errors = [error for camera in compare_with_count(weights).values() for error in camera]
    return {
        "wall_s": wall,
        "cpu_s": cpu,
        "memory_mib": weights.memory_bytes / 2**20,
        "from_counted_rays_l2": float(np.mean(errors)) if errors else float("nan"),
    }


def _result(
    trained: Mapping[str, Mapping[str, Any]], built: Mapping[str, Mapping[str, float]], grid: Grid, scale: str
) -> dict[str, Any]:
    device, at_paper = runtime.device(), scale == "paper"
    training_s = sum(camera["wall_s"] for camera in trained.values())
    weights_s, drt_s = built["network"]["wall_s"], built["drt"]["wall_s"]
    samples = max(camera["samples"] for camera in trained.values())
    voxels = " x ".join(str(n) for n in grid.shape[::-1])
    small = (
        f"This is the small scale: {samples} samples and {voxels} voxels. The goals (training 60 s, weights 30 s) are "
        "for 197,570 samples and 100 x 100 x 100 voxels; run with --scale paper."
    )
    return page.result(
        {
            "samples": samples,
            "split": PARTS,
            "epochs": {name: camera["epochs"] for name, camera in trained.items()},
            "training_s": training_s,
            "weights_s": weights_s,
            "weights_drt_s": drt_s,
            "voxels": grid.size,
            "cores": device.threads,
            "device": device.kind,
            "training": trained,
            "weights": built,
        },
        comparison=[
            page.compare(
                f"training, both cameras, {samples} samples each",
                training_s,
                paper=60.0 * PAPER_TRAINING_MIN,
                unit="s",
                at_most=MATCH_TRAINING_S if at_paper else None,
            ),
            page.compare(
                f"weights by the network, {voxels} voxels, two cameras",
                weights_s,
                paper=60.0 * PAPER_WEIGHTS_MIN,
                unit="s",
                at_most=MATCH_WEIGHTS_S if at_paper else None,
            ),
            page.compare("weights by DRT", drt_s, paper=60.0 * PAPER_DRT_MIN, unit="s"),
        ],
        tables=[_table(trained, built, samples, voxels)],
        notes=[
            "Times are wall times of this run, with the machine's other load. CPU time is the sum over all threads.",
            *([] if at_paper else [small]),
            f"Each dot gives {DOT_RAYS[scale]} rays, evaluated from its fitted rays over the pupil; training stops "
            "when the error of the validation dots no longer falls.",
        ],
    )


def _table(
    trained: Mapping[str, Mapping[str, Any]], built: Mapping[str, Mapping[str, float]], samples: int, voxels: str
) -> dict[str, Any]:
    device = runtime.device()
    training_s = sum(camera["wall_s"] for camera in trained.values())
    return {
        "caption": "Ours beside the paper's",
        "columns": ["", "ours", "the paper's"],
        "rows": [
            ["samples per camera", samples, PAPER_SAMPLES],
            ["training, validation, test", ", ".join(f"{100 * part:.0f} %" for part in PARTS), "70 %, 15 %, 15 %"],
            ["division", "whole dots at random", "random"],
            ["network", "one per camera, 5-20-2", "one, 7 - 15 layers of 10 - 4"],
            ["epochs", ", ".join(str(camera["epochs"]) for camera in trained.values()), 1000],
            ["training [s]", training_s, 60.0 * PAPER_TRAINING_MIN],
            ["voxels", voxels, "100 x 100 x 100"],
            ["weights, network [s]", built["network"]["wall_s"], 60.0 * PAPER_WEIGHTS_MIN],
            ["weights, DRT [s]", built["drt"]["wall_s"], 60.0 * PAPER_DRT_MIN],
            ["CPU time of training, of weights [s]", _cpu(trained, built), ""],
            ["weights from counted rays, relative L2", built["network"]["from_counted_rays_l2"], ""],
            [
                "run on",
                f"{device.threads} {'threads' if device.kind == 'cpu' else 'host threads and a GPU'}",
                f"{PAPER_CORES} cores",
            ],
        ],
    }


def _cpu(trained: Mapping[str, Mapping[str, Any]], built: Mapping[str, Mapping[str, float]]) -> str:
    return f"{sum(camera['cpu_s'] for camera in trained.values()):.1f}, {built['network']['cpu_s']:.1f}"


def dense_labels(dots: BoardDots, rays: int, pupil_radius_mm: float) -> tuple[np.ndarray, ...]:
    """Sample rays of every dot at `rays` points of the pupil, from a quadratic fit to the dot's labels.

    Returns
    -------
    tuple of ndarray
        Points (n, 3), pupil points (n, 2), array positions (n, 2) [mm], and each ray's dot (n,).
    """
    number = np.arange(rays) + 0.5
    radius, angle = np.sqrt(number / rays), np.pi * (1 + np.sqrt(5)) * number  # sunflower: evenly over the disc
    wanted = PUPIL_PART * np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)

    def terms(pupil: np.ndarray) -> np.ndarray:
        u, v = pupil.T
        return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)

    points, array, names = [], [], []
    for name in np.unique(dots.dot):
        mine = dots.dot == name
        if mine.sum() < 2 * terms(wanted).shape[1]:
            continue
        fitted = np.linalg.lstsq(terms(dots.pupil_mm[mine] / pupil_radius_mm), dots.array_mm[mine], rcond=None)[0]
        points.append(np.broadcast_to(dots.points_mm[mine][0], (rays, 3)))
        array.append(terms(wanted) @ fitted)
        names.append(np.full(rays, name))
    pupil = np.tile(pupil_radius_mm * wanted, (len(points), 1))
    return np.concatenate(points), pupil, np.concatenate(array), np.concatenate(names)
