"""Measure the calibration board with one camera: find its dots in all planes, and label their rays.

`measure_board` takes the raw board images and returns `BoardDots`, the labels that the camera's mapping is trained on.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from lfpiv.calibration.board.detect import find_dots
from lfpiv.calibration.board.dots import BoardDots, Detection, DotBoard, Labels
from lfpiv.calibration.board.label import label_by_integral
from lfpiv.calibration.board.label_gaussian import label_by_gaussian
from lfpiv.calibration.board.marked import find_marked_dots
from lfpiv.calibration.board.planes import Signals
from lfpiv.errors import InputError
from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation
from lfpiv.lightfield.decoder import NORMAL_MAD, LightFieldDecoder

log = logging.getLogger(__name__)

ESTIMATORS = ("lens_integral", "gaussian")
"""The dot model integrated over the microlenses on raw pixels, and the paper's Gaussian fit in sub-aperture views."""
OUTLIER, OUTLIER_PITCH = 6.0, 0.1
"""Disagreement of a dot with its neighbours above which it is left out: both this many times the typical disagreement
and this share of the microlens pitch."""
NEIGHBOURS = 16
"""Neighbouring dots in space that a dot is compared with."""
FEW_ACROSS_PX = 7.0
"""Diameter of microimages below which focused dots may light too few pixels for the integrated model [pixel]."""


def measure_board(
    images: Sequence[np.ndarray],
    decoder: LightFieldDecoder,
    board: DotBoard,
    *,
    orientation: Orientation | None = None,
    estimator: str = "lens_integral",
    dark: np.ndarray | None = None,
) -> BoardDots:
    """Find, name and label the dots of one camera in all planes of its board.

    Parameters
    ----------
    images : sequence of ndarray, shape (rows, columns)
        Raw image of each plane [counts], dark level included; dots brighter or darker than the board.
    decoder : LightFieldDecoder
        The camera's decoder.
    board : DotBoard
        The board and the depths of its planes.
    orientation : Orientation, optional
        Planned orientation of the camera, correct to about 10 degrees. A board with a mark needs none.
    estimator : {"lens_integral", "gaussian"}
        "lens_integral" fits each dot to all its raw pixels, integrated over the microlenses. "gaussian" fits a Gaussian
        to the lenses around the dot in each sub-aperture view (section 3.1 (2) of the paper).
    dark : ndarray, shape (rows, columns), optional
        Image with the lens capped [counts].

    Raises
    ------
    InputError
        If the images do not match the board or the camera, or no plane shows the board's dots.
    ValueError
        If `estimator` is unknown, the angle is not finite, or not exactly one of angle and orientation is given.
    """
    if estimator not in ESTIMATORS:
        raise ValueError(f"estimator: expected one of {', '.join(map(repr, ESTIMATORS))}, got {estimator!r}.")
    if orientation is None and not board.mark:
        raise ValueError("orientation: expected the planned orientation of the camera, or a board with a mark.")
    if len(images) != len(board.planes_mm):
        raise InputError(f"images: expected one per plane, {len(board.planes_mm)}, got {len(images)}.")
    signals = Signals.from_images(images, decoder, dark)
    with threadpool_limits(1, user_api="blas"):  # threads slow down operations on small matrices
        detection = find_board(signals, decoder, board, orientation)
        if estimator == "gaussian":
            labels = label_by_gaussian(signals, decoder, board, detection)
        else:
            try:
                labels = label_by_integral(signals, decoder, board, detection)
            except InputError as error:
                raise InputError(f"{error}{few_pixels(decoder.optics)}") from None
    return _count(labels, board, detection)


def find_board(
    signals: Signals, decoder: LightFieldDecoder, board: DotBoard, orientation: Orientation | None
) -> Detection:
    """Find and name the dots of one camera in all planes, by the board's mark if it has one.

    Raises
    ------
    InputError
        If no plane shows the board's dots.
    """
    if board.mark:
        return find_marked_dots(signals, decoder, board, orientation)
    assert orientation is not None
    return find_dots(signals, decoder, board, orientation)


def few_pixels(optics: Optics) -> str:
    """Return the advice that ends a message about missing dots where microimages are small, otherwise ""."""
    across = 2 * optics.pupil_radius_mm / optics.pupil_pixel_mm
    if across >= FEW_ACROSS_PX:
        return ""
    return (
        f" Microimages of {across:.1f} pixels across leave the dots few pixels to be fitted to: set "
        'network.estimator = "gaussian".'
    )


def agreeing_dots(dots: BoardDots, departure_mm: np.ndarray, pitch_mm: float) -> np.ndarray:
    """Return which labels are of dots that agree with their neighbours, shape (n,), bool, and log the others.

    Real optics depart smoothly from a thin lens. So each dot's mean departure is compared with the median departure of
    its neighbours in space.

    Parameters
    ----------
    departure_mm : ndarray, shape (n, 2)
        Each label minus the ray of a fitted thin lens [mm].
    pitch_mm : float
        Microlens pitch [mm].
    """
    number, first, inverse = np.unique(dots.dot, return_index=True, return_inverse=True)
    count = np.bincount(inverse)
    mean = np.stack([np.bincount(inverse, weights=column) / count for column in departure_mm.T], axis=1)
    _, neighbour = cKDTree(dots.points_mm[first]).query(dots.points_mm[first], k=min(NEIGHBOURS + 1, len(number)))
    misfit = np.linalg.norm(mean - np.median(mean[neighbour[:, 1:]], axis=1), axis=1)
    bad = misfit > max(OUTLIER * NORMAL_MAD * float(np.median(misfit)), OUTLIER_PITCH * pitch_mm)
    if bad.any():
        log.info("%d dots lie elsewhere than their neighbours demand and are left out", bad.sum())
    return ~bad[inverse]


def _count(labels: Labels, board: DotBoard, detection: Detection) -> BoardDots:
    planes = len(board.planes_mm)
    found = np.bincount(labels.measured_dot // board.size, minlength=planes)
    visible = detection.in_field.copy()
    visible.ravel()[labels.measured_dot] = True
    dots = BoardDots(
        points_mm=board.of_dots_mm(labels.dot),
        found=found,
        expected=visible.sum(1),
        rejected=np.bincount(labels.rejected_dot // board.size, minlength=planes),
        **vars(labels),
    )
    text = "board images: %d of the %d dots in view measured, %d others left out as no dots"
    log.info(text, found.sum(), dots.expected.sum(), dots.rejected.sum())
    return dots
