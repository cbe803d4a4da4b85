"""Draw the board as each camera shows it, with arrows along x and y, to be compared with the real board."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.calibration import contradictions
from lfpiv.calibration.board.board import find_board
from lfpiv.calibration.board.detect import rectifier
from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.first_lattice import planes_from_middle
from lfpiv.calibration.board.planes import Signals, board_images
from lfpiv.calibration.board.pose import CameraPose
from lfpiv.calibration.measured_camera import decode, likely_cause
from lfpiv.errors import InputError
from lfpiv.experiment import axes
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.experiment.images import FLIPS
from lfpiv.experiment.opening import read_experiment
from lfpiv.files import writing
from lfpiv.progress import Progress
from lfpiv.report.board_view import BoardView, draw
from lfpiv.warn import collected

log = logging.getLogger(__name__)


def check(experiment: Experiment | str | Path, out: str | Path, *, progress: Progress | None = None) -> dict[str, Any]:
    """Draw the board as each camera shows it into ``check/board.png`` of an output folder.

    White and board images are needed, particle images are not.

    Parameters
    ----------
    experiment : Experiment or path
        The experiment, or its file.
    out : path
        Output folder.
    progress : callable, optional
        Called with the step and its finished fraction.

    Returns
    -------
    dict
        ``picture``, the file; ``axes``, where x and y point and whether they are right-handed; ``contradiction``,
        what contradicts the board images, or None.

    Raises
    ------
    InputError
        If an image cannot be used.
    """
    if not isinstance(experiment, Experiment):
        experiment = read_experiment(experiment)
    views: list[BoardView] = []
    stretches: list[float] = []
    with collected(quiet=True):  # a calibration says them again
        for number, setup in enumerate(experiment.cameras):
            view, found = _view(experiment, setup)
            views.append(view)
            stretches = stretches if found else contradictions.likely_stretches(None)
            if progress is not None:
                progress("board", (number + 1) / len(experiment.cameras))
        contradiction = likely_cause(experiment, stretches)
    said = f"in the recorded pictures {axes.directions(experiment)}; {axes.handedness(experiment)}"
    picture = Path(out) / "check" / "board.png"
    with writing(picture):
        picture.parent.mkdir(parents=True, exist_ok=True)
    draw(views, contradiction or said, picture)
    return {"picture": str(picture), "axes": said, "contradiction": contradiction}


def _view(experiment: Experiment, setup: CameraSetup) -> tuple[BoardView, bool]:
    """Return what one camera shows of the plane nearest to z = 0, and whether its dots were found."""
    decoder, board = decode(experiment, setup).decoder, DotBoard.from_settings(experiment.board)
    signals = Signals.from_images(board_images(experiment, setup.name), decoder, experiment.dark(setup.name))
    plane = int(planes_from_middle(board)[0])
    found = True
    try:
        pose = find_board(signals, decoder, board, setup.orientation).pose
    except InputError:
        if setup.orientation is None:
            raise
        found, pose = False, CameraPose.from_plan(decoder.optics, setup.orientation)
    z_mm, signal = board.planes_mm[plane], signals.of_plane(plane)
    rectified = rectifier(decoder, board, pose)(signal, pose, z_mm)
    reach = board.spacing_mm * (max(board.dots) - 1) / 2
    chief, _ = pose.rays(np.array([[0, 0, z_mm], [reach, 0, z_mm], [0, reach, z_mm]]))
    on_sensor = decoder.optics.sensor_px(chief * (1 + decoder.optics.sensor_per_pupil))
    rows, columns = decoder.optics.sensor_shape
    flip = FLIPS[setup.image_flip]
    for axis, n in ((0, columns), (1, rows)):
        if flip[1 - axis].step == -1:
            on_sensor[:, axis] = n - 1 - on_sensor[:, axis]
    view = BoardView(
        camera=setup.name,
        plane=plane,
        z_mm=z_mm,
        stated_flip=setup.stated_flip,
        recorded=np.nan_to_num(signal, nan=float(np.nanmax(signal)))[flip],
        pitch_px=decoder.optics.microimage_pitch_px,
        arrows_px=on_sensor,
        light=rectified.light,
        corner_mm=rectified.corner_mm,
        bin_mm=rectified.bin_mm,
        reach_mm=reach,
    )
    return view, found
