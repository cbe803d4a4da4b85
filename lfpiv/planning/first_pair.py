"""The first pair of a campaign, done as in a run and timed.

Images that are not there yet are simulated: white images are read in their place, and the volume is filled with
particles at random.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from lfpiv.calibration.board.board import measure_board
from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.planes import Planes
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.planning.result import Cost
from lfpiv.reconstruction.beyond import light_beyond
from lfpiv.reconstruction.refinement import measure_size
from lfpiv.results.folder import Folder
from lfpiv.results.pair_files import FrameVolume, PairVolumes
from lfpiv.runs import background, belonging, rig
from lfpiv.runs.frame_light import SAMPLED, FrameLight, frame_light, read_darks
from lfpiv.runs.run import Run
from lfpiv.selfcalibration.disparity import CameraVolumes
from lfpiv.warn import collected
from lfpiv.weights.checks import compare_with_count

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

Result = TypeVar("Result")

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
    """What only the first pair needs: loaded kernels, sums of subsets, the estimator of the particles' size."""
    steps: Mapping[str, Cost]
    """Costs of a further pair: "images", "reconstruction", "correlation", "writing"."""
    weights_bytes: int
    """Memory of the weights [byte]."""
    file_bytes: int
    """Size of the file of the vectors [byte]."""
    recorded: bool
    """Whether the images are the recorded ones."""


def _timed(work: Callable[[], Result]) -> tuple[Result, Cost]:
    """Do some work in this process; return its result and its cost."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, Cost(time.perf_counter() - wall, time.process_time() - cpu)


def measure(run: Run, calibration: Calibration, scratch: Path, *, calibrated: bool) -> FirstPair:
    """Do the first pair of a run and measure what it takes; its file goes to a scratch folder."""
    experiment, number = run.experiment, run.experiment.numbers[0]
    weights, built = _timed(lambda: rig.weights_of(run, calibration))
    _, counted = _timed(lambda: compare_with_count(weights))
    light, read, recorded = _light(experiment, weights)
    images = _before_weights(experiment, calibration, light, read)
    _, cameras = _timed(lambda: _compare(experiment, weights, light, recorded and calibrated))
    work = rig.pair_work(replace(run, folder=Folder(scratch, experiment.recording)), weights, keep_volumes=False)
    coming = iter(light)

    def solve() -> tuple[FrameVolume, FrameVolume]:
        if not experiment.recording.is_series:
            return work.reconstructor.pair(light, lambda _: None)
        found = work.reconstructor.frame(next(coming), lambda _: None)
        return found, found

    (_, first), (volumes, solved) = _timed(solve), _timed(solve)
    both = PairVolumes(frames=volumes, names=experiment.frames)
    (_, loaded), (vectors, correlated) = (_timed(lambda: work.vectors_between(number, both)) for _ in range(2))
    file = work.files(number)
    _, written = _timed(lambda: work.result(file, vectors, both)[1]())
    return FirstPair(
        weights=built + counted,
        cameras=cameras,
        images=images,
        once=(first - solved) + (loaded - correlated),
        steps={
            "images": read * experiment.recording.lasers,
            "reconstruction": solved,
            "correlation": correlated,
            "writing": written,
        },
        weights_bytes=weights.memory_bytes,
        file_bytes=file.vectors.stat().st_size,
        recorded=recorded,
    )


def _light(experiment: Experiment, weights: Weights) -> tuple[tuple[FrameLight, FrameLight], Cost, bool]:
    """Return the light of both frames, the cost of reading one, and whether recorded images were read."""
    first, second = experiment.pair_frames(experiment.numbers[0])
    read = partial(frame_light, experiment, weights.cameras, read_darks(experiment))
    try:
        one = read(first)
        other, cost = _timed(lambda: read(second))
        return (one, other), cost, True
    except InputError as error:
        log.debug("plan: white images stand for particle images: %s", error)
    white = partial(read, read=lambda name, _: experiment.white(name))
    white(first)
    found, cost = _timed(lambda: white(second))
    one, other = (
        replace(
            found,
            frame=frame,
            images=images,
            noise=dict.fromkeys(images, NOISE),
            structure=dict.fromkeys(images, 1.0),
            warnings=(),
        )
        for frame, images in zip((first, second), _simulated(weights), strict=True)
    )
    return (one, other), cost, False


def _simulated(weights: Weights) -> list[dict[str, np.ndarray]]:
    """Return images of particles at random in the volume, and of the same particles a little farther."""
    lenses = [
        len(weights.projector(name).map.pixel) / camera.optics.microimage_pitch_px**2
        for name, camera in weights.cameras.items()
    ]
    rng, found = np.random.default_rng(SEED), []
    light = np.zeros(weights.grid.shape, np.float32)
    light.ravel()[rng.integers(0, light.size, max(round(PER_MICROLENS * min(lenses)), 1))] = 1.0
    for shift in (0, SHIFT_VOXEL):
        images = weights(np.roll(light, (shift,) * 3, (0, 1, 2)))
        for image in images.values():
            image *= BRIGHTEST / max(float(image.max()), 1e-30)
            image += np.float32(NOISE) * rng.standard_normal(image.shape, np.float32)
        found.append(images)
    return found


def _before_weights(
    experiment: Experiment, calibration: Calibration, light: tuple[FrameLight, FrameLight], read: Cost
) -> Cost:
    """Return the cost of what a run finds in its images before the weights; `read` is the cost of reading a frame."""
    images = [one.images for one in light]
    _, cost = _timed(lambda: light_beyond(calibration, experiment.grid, [images]))
    if experiment.smart.refinement == "auto":
        cost += _timed(lambda: measure_size(calibration, experiment.grid, images))[1]
    standing = len(background.series(experiment)) * experiment.recording.lasers
    return cost + read * (standing + 2 * min(SAMPLED, experiment.pairs))


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


def board_cost(experiment: Experiment, calibration: Calibration) -> Cost | None:
    """Measure the dots of the first camera in `MEASURED_PLANES` planes; return the cost for all cameras and planes.

    None if two planes do not show it.
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
        return _timed(measured)[1] * (len(board.planes_mm) / len(chosen) * len(experiment.cameras))
    except (ValueError, np.linalg.LinAlgError) as error:
        log.debug("plan: the board's dots were not measured: %s", error)
        return None
