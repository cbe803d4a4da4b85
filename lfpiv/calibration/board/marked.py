"""Find and name the dots of a marked board, with or without a nominal orientation of the camera.

The dots are first found on a larger lattice whose names are arbitrary, from the nominal orientation or from those that
one image allows (`lfpiv.calibration.board.unposed`). The mark then tells how that lattice is turned, mirrored and
shifted, and the dots are found again from the pose that follows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lfpiv.calibration.board.detect import (
    FULLY_SEEN,
    FirstLattice,
    PlaneDots,
    find_in_planes,
    first_lattice,
    in_field,
    lit_share,
    planes_from_middle,
    rectifier,
)
from lfpiv.calibration.board.dots import FEWEST_DOTS, Detection, DotBoard
from lfpiv.calibration.board.edges import MARGIN, sites_found
from lfpiv.calibration.board.mark import Naming, name_by_mark, search_board
from lfpiv.calibration.board.planes import Signals
from lfpiv.calibration.board.pose import CameraPose
from lfpiv.calibration.board.unposed import plans_without_pose, rotations_of
from lfpiv.errors import InputError
from lfpiv.geometry.orientation import Orientation
from lfpiv.lightfield.decoder import LightFieldDecoder

_FIRST_PLANES = 3  # planes that are searched for a lattice without a nominal orientation


def find_marked_dots(
    signals: Signals, decoder: LightFieldDecoder, board: DotBoard, orientation: Orientation | None
) -> Detection:
    """Find and name the dots of a marked board.

    Raises
    ------
    InputError
        If no plane shows a lattice of dots, the mark is not clearly seen, or it is seen mirrored.
    """
    search = search_board(board)
    plan, start = _start(signals, decoder, search, orientation)
    pose = plan.fitted(start.points_mm, start.chief_mm, decoder.optics)
    planes, pose = find_in_planes(signals, rectifier(decoder, search), search, pose, start.sign, decoder.optics)
    found = sites_found([plane.site for plane in planes], search.dots)
    in_view = np.stack(
        [lit_share(pose, search.points_mm(plane, MARGIN), decoder) >= FULLY_SEEN for plane in range(len(planes))]
    )
    naming = name_by_mark(found, in_view.reshape(found.shape), board)
    if naming.mirrored and orientation is not None:
        raise _mirrored()
    named, pose = max(
        (
            find_in_planes(signals, rectifier(decoder, board), board, named_pose, start.sign, decoder.optics)
            for named_pose in _named_poses(pose, naming, board.spacing_mm)
        ),
        key=lambda result: _contrast(result[0]),
    )
    if naming.mirrored and _contrast(named) < _contrast(planes):  # dots are in focus at the depths of the other side
        raise _mirrored()
    return _detection(named, pose, start.sign, board, decoder)


def _start(
    signals: Signals, decoder: LightFieldDecoder, search: DotBoard, orientation: Orientation | None
) -> tuple[CameraPose, FirstLattice]:
    """Return the plan that explains the lattice of a plane best, and the dots on it."""
    rectify, found = rectifier(decoder, search), list[tuple[CameraPose, FirstLattice]]()
    if orientation is not None:
        plan = CameraPose.from_plan(decoder.optics, orientation)
        found.append((plan, first_lattice(signals, rectify, search, plan)))
    else:
        for plane in planes_from_middle(search)[:_FIRST_PLANES]:
            plans = plans_without_pose(signals, decoder, search, int(plane))
            found += [(plan, first_lattice(signals, rectify, search, plan)) for plan in plans]
            if any(start.regular for _, start in found):
                break
    regular = [(plan, start) for plan, start in found if start.regular and len(start.points_mm) >= FEWEST_DOTS]
    if not regular:
        stated = "" if orientation is None else f" and the nominal orientation ({orientation})"
        raise InputError(
            f"board: expected a lattice of dots {search.spacing_mm:g} mm apart, found none. Check that these are board "
            f"images, the board's numbers{stated}."
        )
    return max(regular, key=lambda one: one[1].score)


def _named_poses(pose: CameraPose, naming: Naming, spacing_mm: float) -> list[CameraPose]:
    """Return the poses in the board's axes of a camera with a pose in the axes of the lattice."""
    turn = np.eye(3)
    turn[:2, :2] = naming.turn
    offset = turn @ pose.parameters[3:6]
    offset[:2] += spacing_mm * naming.shift
    rotations = [pose.rotation @ turn.T]
    if naming.mirrored:  # seen from the other side
        rotations = list(rotations_of(pose.rotation[:2, :2] @ naming.turn.T))
    lens = pose.parameters[6:]
    return [replace(pose, parameters=(0.0, 0.0, 0.0, *offset, *lens), nominal_rotation=one) for one in rotations]


def _contrast(planes: list[PlaneDots]) -> float:
    return sum(plane.contrast for plane in planes)


def _mirrored() -> InputError:
    return InputError(
        "board.mark: expected the mark as it is stated, found its mirror image. Change image_flip of this camera: "
        '"none" and "horizontal" for each other, or "vertical" and "both".'
    )


def _detection(
    planes: list[PlaneDots], pose: CameraPose, sign: int, board: DotBoard, decoder: LightFieldDecoder
) -> Detection:
    """Return the dots by number, without sites beyond the board and those of the mark."""
    dot, chief = [], []
    for number, plane in enumerate(planes):
        row, column = (part - MARGIN for part in np.divmod(plane.site, board.dots[0] + 2 * MARGIN))
        inside = (column >= 0) & (column < board.dots[0]) & (row >= 0) & (row < board.dots[1])
        inside[inside] = board.occupied[row[inside], column[inside]]
        dot.append(number * board.size + (row * board.dots[0] + column)[inside])
        chief.append(plane.chief_mm[inside])
    seen = np.stack([in_field(pose, board.points_mm(plane), decoder.optics) for plane in range(len(planes))])
    return Detection(
        pose=pose,
        sign=sign,
        dot=np.concatenate(dot),
        chief_mm=np.concatenate(chief),
        in_field=seen & board.occupied.ravel(),
    )
