"""What a run does before the first pair: calibration, and what it finds in the images."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from lfpiv.runs import background
from lfpiv.runs.frame_light import SAMPLED, frame_light, read_darks

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration

log = logging.getLogger(__name__)

MEASURED_PLANES = (0.2, 0.8)
"""Places of the planes whose dots are measured, among all in their order. At 1 / sqrt(3) of the largest distance from
the middle a dot's image has as many pixels as in the mean over all."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """Cost of reading and checking images."""

    frame: Cost
    """One frame of all cameras."""
    recorded: bool
    """Whether particle images were read; white images in their place have the same size."""


def read_light(experiment: Experiment, calibration: Calibration) -> Light:
    """Read one frame of all cameras, as for a reconstruction, twice: the first time loads what it needs."""
    darks, frame = read_darks(experiment), experiment.pair_frames(experiment.numbers[0])[0]

    def recorded() -> None:
        frame_light(experiment, calibration.cameras, darks, frame)

    def white() -> None:
        frame_light(experiment, calibration.cameras, darks, frame, lambda name, _: experiment.white(name))

    read, found = recorded, True
    try:
        recorded()
    except InputError as error:
        log.debug("plan: white images stand for particle images: %s", error)
        read, found = white, False
        white()
    _, cost = timed(read)
    return Light(frame=cost, recorded=found)


def look_at_images(
    experiment: Experiment, calibration: Calibration, images: Sequence[Mapping[str, np.ndarray]], frame: Cost
) -> Cost:
    """Return the cost of what a run finds in its images: standing light, light beyond the volume, size of particles.

    `images` are those of two instants, `frame` is the cost of reading one.
    """
    sampled = min(SAMPLED, experiment.pairs)
    _, beyond = timed(lambda: light_beyond(calibration, experiment.grid, [images]))
    size = NOTHING
    if experiment.smart.refinement == "auto":
        _, size = timed(lambda: measure_size(calibration, experiment.grid, images))
    series = 2 * len(background.series(experiment)) // (1 if experiment.series is None else 2)
    return frame * (series + 2 * sampled) + beyond + size


def measure_dots(experiment: Experiment, calibration: Calibration) -> Cost | None:
    """Measure the dots of the first camera in `MEASURED_PLANES` planes; return the cost for all cameras and planes.

    Returns
    -------
    Cost or None
        None if the board cannot be measured in these planes alone.
    """
    setup, board = experiment.cameras[0], experiment.board
    order = np.argsort(board.planes_mm)
    planes = sorted(int(order[at]) for at in np.rint(np.multiply(MEASURED_PLANES, len(order) - 1)).astype(int))
    part = board.model_copy(update={"planes_mm": tuple(board.planes_mm[plane] for plane in planes)})
    images = Planes(lambda number: experiment.board_image(setup.name, planes[number]), len(planes))
    try:
        _, cost = timed(
            lambda: measure_board(
                images,
                calibration.cameras[setup.name].decoder,
                DotBoard.from_settings(part),
                orientation=setup.orientation,
                estimator=experiment.network.estimator,
                dark=experiment.dark(setup.name),
            )
        )
    except (ValueError, np.linalg.LinAlgError) as error:
        log.debug("plan: the board's dots were not measured: %s", error)
        return None
    return cost * (len(board.planes_mm) / len(planes) * len(experiment.cameras))
