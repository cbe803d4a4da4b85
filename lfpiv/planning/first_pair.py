"""The first pair of a campaign, done as in a run and timed: its images, volumes, vectors and their file.

Images that are not there yet are simulated: white images are read in their place, and the volume is filled with
particles at random.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.calibration.board.board import measure_board
from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.planes import Planes
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.planning.cost import NOTHING, Cost, timed
from lfpiv.reconstruction.beyond import light_beyond
from lfpiv.reconstruction.refinement import measure_size
from lfpiv.results.folder import Folder
from lfpiv.results.pair_files import FrameVolume, PairFiles, PairVolumes
from lfpiv.runs import background, belonging, pair_figures, rig
from lfpiv.runs.frame_light import SAMPLED, FrameLight, frame_light, read_darks
from lfpiv.runs.pair_vectors import measure_vectors
from lfpiv.runs.pair_volumes import Reconstructor
from lfpiv.runs.run import Run
from lfpiv.selfcalibration.disparity import CameraVolumes
from lfpiv.warn import collected
from lfpiv.weights.checks import compare_with_count

if TYPE_CHECKING:
    import xarray as xr

    from lfpiv.calibration.camera import Calibration
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

PER_MICROLENS = 0.5
"""Simulated particles per microlens: a seeding that cameras of this kind resolve."""
BRIGHTEST, NOISE = 1000.0, 10.0
"""Light of the brightest simulated pixel, and standard deviation of the simulated noise [counts]."""
SHIFT_VOXEL = 1
"""Displacement of the simulated particles along each axis [reconstructed voxel]."""
SEED = 18
MEASURED_PLANES = (0.2, 0.8)
"""Places of the planes whose dots are measured, among all in their order. At 1 / sqrt(3) of the largest distance from
the middle a dot's image has as many pixels as in the mean over all."""


@dataclass(frozen=True, kw_only=True)
class FirstPair:
    """Costs of the steps on the first pair."""

    weights: Cost
    """Build the weights and check them."""
    cameras: Cost
    """Compare where the cameras show the particles of the pair."""
    images: Cost
    """Find standing light, light beyond the volume and the particles' size."""
    once: Cost
    """What only the first frame needs: loaded kernels, sums of subsets, the estimator of the particles' size."""
    steps: Mapping[str, Cost]
    """Costs of a further pair: "images", "reconstruction", "correlation", "writing"."""
    weights_bytes: int
    """Memory of the weights [byte]."""
    file_bytes: int
    """Size of the file of the vectors [byte]."""
    recorded: bool
    """Whether the images are the recorded ones."""


def measure(run: Run, calibration: Calibration, scratch: Path, *, calibrated: bool) -> FirstPair:
    """Do the first pair of a run and measure what it takes; its file goes to a scratch folder."""
    experiment = run.experiment
    weights, built = timed(lambda: _weights(run, calibration))
    light, read, recorded = _light(experiment, weights)
    images = _images_cost(experiment, calibration, light, read)
    _, cameras = timed(lambda: _compare(experiment, weights, light, recorded and calibrated))
    reconstructor = Reconstructor(
        experiment=experiment, weights=weights, guard=run.guard_layers, refinement=run.refinement_factor
    )
    _, first = timed(lambda: reconstructor.instant(light[0], _ignore))

    def solve() -> tuple[FrameVolume, FrameVolume]:
        if experiment.series is None:
            return reconstructor.pair(light, 0, _ignore)
        found = reconstructor.instant(light[1], _ignore)
        return found, found

    volumes, solved = timed(solve)
    frames = 2 if experiment.series is None else 1
    one, other = (found.volume for found in volumes)
    runs = [timed(lambda: measure_vectors(one, other, experiment)) for _ in range(2)]  # the first loads the kernels
    vectors, correlated = min(runs, key=lambda found: found[1].cpu_s)
    both = PairVolumes(frames=volumes, names=experiment.frames if experiment.series is None else ("a", "b"))
    file = replace(run, folder=Folder(scratch, experiment.series)).files(experiment.numbers[0])
    _, written = timed(lambda: _write(vectors, both, file, experiment))
    plain = 3 if experiment.smart.estimate == "joint" else 1
    return FirstPair(
        weights=built,
        cameras=cameras,
        images=images,
        once=(first - solved * (1 / (frames * plain))) + (runs[0][1] - correlated),
        steps={
            "images": read * frames,
            "reconstruction": solved,
            "correlation": correlated,
            "writing": written,
        },
        weights_bytes=weights.memory_bytes,
        file_bytes=file.vectors.stat().st_size,
        recorded=recorded,
    )


def _weights(run: Run, calibration: Calibration) -> Weights:
    """Build the weights and check them as a run does."""
    built = rig.weights_of(run, calibration)
    compare_with_count(built)
    return built


def _light(experiment: Experiment, weights: Weights) -> tuple[tuple[FrameLight, FrameLight], Cost, bool]:
    """Return the light of both frames, the cost of reading one, and whether recorded images were read."""
    darks, both = read_darks(experiment), experiment.pair_frames(experiment.numbers[0])

    read = partial(frame_light, experiment, weights.cameras, darks)
    try:
        one = read(both[0])
        other, cost = timed(lambda: read(both[1]))
        return (one, other), cost, True
    except InputError as error:
        log.debug("plan: white images stand for particle images: %s", error)
    white = partial(read, read=lambda name, _: experiment.white(name))
    white(both[0])
    found, cost = timed(lambda: white(both[1]))
    one, other = (
        replace(found, frame=frame, images=images, noise=dict.fromkeys(images, NOISE), warnings=())
        for frame, images in zip(both, _simulated(weights, weights.grid.shape), strict=True)
    )
    return (one, other), cost, False


def _simulated(weights: Weights, shape: tuple[int, int, int]) -> list[dict[str, np.ndarray]]:
    """Return images of particles at random in the volume, and of the same particles a little farther."""
    lenses = [
        len(weights.projector(name).map.pixel) / camera.optics.microimage_pitch_px**2
        for name, camera in weights.cameras.items()
    ]
    rng, found = np.random.default_rng(SEED), []
    light = np.zeros(shape, np.float32)
    light.ravel()[rng.integers(0, light.size, max(round(PER_MICROLENS * min(lenses)), 1))] = 1.0
    for shift in (0, SHIFT_VOXEL):
        images = weights(np.roll(light, (shift,) * 3, (0, 1, 2)))
        for image in images.values():
            image *= BRIGHTEST / max(float(image.max()), 1e-30)
            image += np.float32(NOISE) * rng.standard_normal(image.shape, np.float32)
        found.append(images)
    return found


def _images_cost(
    experiment: Experiment, calibration: Calibration, light: tuple[FrameLight, FrameLight], read: Cost
) -> Cost:
    """Return the cost of what a run finds in its images before the weights; `read` is the cost of reading a frame."""
    images, size = [one.images for one in light], NOTHING
    _, beyond = timed(lambda: light_beyond(calibration, experiment.grid, [images]))
    if experiment.smart.refinement == "auto":
        _, size = timed(lambda: measure_size(calibration, experiment.grid, images))
    standing = 2 * len(background.series(experiment)) // (1 if experiment.series is None else 2)
    return read * (standing + 2 * min(SAMPLED, experiment.pairs)) + beyond + size


def _compare(experiment: Experiment, weights: Weights, light: tuple[FrameLight, FrameLight], judged: bool) -> None:
    """Compare where the cameras show the particles; judge them as a run does, unless cameras are not calibrated."""
    if judged:
        with collected(quiet=True):
            belonging.check(experiment, weights, experiment.numbers[:1])
    elif len(weights.cameras) > 1 and weights.method == "footprint":
        volumes = CameraVolumes(weights)
        for one in light:
            volumes.add(one.images)
        volumes.disparities()


def _write(vectors: xr.Dataset, volumes: PairVolumes, file: PairFiles, experiment: Experiment) -> None:
    """Measure the figures of a pair and write the file of its vectors, as a run does."""
    condensed = volumes.condensed()
    vectors.attrs |= {"reconstruction_s": 0.0, "correlation_s": 0.0, "warnings": "[]"}
    figures = pair_figures.measure(vectors, condensed, volumes.warnings)
    attributes = {
        "experiment": experiment.name,
        "smart": experiment.smart.model_dump(),
        "correlation": experiment.correlation.model_dump(),
        "figures": figures.to_json(),
    }
    file.write_vectors(vectors, condensed, attributes)


def board_cost(experiment: Experiment, calibration: Calibration, assumptions: list[str]) -> dict[str, Cost]:
    """Measure the dots of the first camera in `MEASURED_PLANES` planes; return the cost for all cameras and planes.

    If two planes do not show it, an assumption says so and nothing is returned.
    """
    setup, board = experiment.cameras[0], experiment.board
    order = np.argsort(board.planes_mm)
    chosen = sorted(int(order[at]) for at in np.rint(np.multiply(MEASURED_PLANES, len(order) - 1)).astype(int))
    part = board.model_copy(update={"planes_mm": tuple(board.planes_mm[plane] for plane in chosen)})
    measured = partial(
        measure_board,
        Planes(lambda number: experiment.board_image(setup.name, chosen[number]), len(chosen)),
        calibration.cameras[setup.name].decoder,
        DotBoard.from_settings(part),
        orientation=setup.orientation,
        estimator=experiment.network.estimator,
        dark=experiment.dark(setup.name),
    )
    try:
        _, cost = timed(measured)
    except (ValueError, np.linalg.LinAlgError) as error:
        log.debug("plan: the board's dots were not measured: %s", error)
        assumptions.append("the time of the calibration is not in the plan: two planes of the board do not show it")
        return {}
    return {"calibration": cost * (len(board.planes_mm) / len(chosen) * len(experiment.cameras))}


def _ignore(_: float) -> None:
    pass
