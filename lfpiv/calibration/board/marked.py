"""Find and name the dots of a marked board, with or without a nominal orientation of the camera.

The dots are first found on a larger lattice whose names are arbitrary, from the nominal orientation or from those that
one image allows (`lfpiv.calibration.board.unposed`). The mark then tells how that lattice is turned, mirrored and
shifted, and the dots are found again from the pose that follows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lfpiv.calibration.board.detect import (
    FULLY_SEEN,
    PlaneDots,
    find_in_planes,
    in_field,
    lit_share,
    rectifier,
    search_planes,
)
from lfpiv.calibration.board.dots import FEWEST_DOTS, Detection, DotBoard
from lfpiv.calibration.board.edges import MARGIN, sites_found
from lfpiv.calibration.board.first_lattice import lattice_of_plane, planes_from_middle
from lfpiv.calibration.board.mark import Naming, name_by_mark, search_board
from lfpiv.calibration.board.planes import Signals
from lfpiv.calibration.board.pose import CameraPose
from lfpiv.calibration.board.unposed import plans_without_pose
from lfpiv.errors import InputError
from lfpiv.geometry.orientation import Orientation
from lfpiv.lightfield.decoder import LightFieldDecoder

_FIRST_PLANES = 3  # planes that are searched for a lattice without a nominal orientation
_LEAST_FILLED = 0.9  # least filling of a lattice, relative to the best candidate's; a harmonic has half of it
_CLEAR = 1.1  # least ratio of contrasts that shows on which side of the board the camera is
_OTHER_SIDE = np.diag([-1.0, 1.0, -1.0])  # the same picture of the plane z = 0, with depth and one axis reversed


@dataclass(frozen=True, eq=False, kw_only=True)
class _Found:
    """Dots of all planes on the lattice with arbitrary names."""

    planes: list[PlaneDots]
    pose: CameraPose
    sign: int

    @property
    def contrast(self) -> float:
        """Sum of the dots' contrasts, large if they are in focus at the depths of the planes."""
        return sum(plane.contrast for plane in self.planes)


def find_marked_dots(
    signals: Signals, decoder: LightFieldDecoder, board: DotBoard, orientation: Orientation | None
) -> Detection:
    """Find and name the dots of a marked board.

    A nominal orientation helps to find them. Where it does not lead to the mark, the search does without.

    Raises
    ------
    InputError
        If no plane shows a lattice of dots, the mark is not clearly seen, or it is seen mirrored.
    """
    if orientation is not None:
        try:
            found = _on_lattice(signals, decoder, board, CameraPose.from_plan(decoder.optics, orientation), None)
            naming = _name(found, decoder, board)
            if not naming.mirrored:
                return _named(signals, decoder, board, found, naming)
        except InputError:
            pass
    found, naming = _without_plan(signals, decoder, board)
    return _named(signals, decoder, board, found, naming)


def _without_plan(signals: Signals, decoder: LightFieldDecoder, board: DotBoard) -> tuple[_Found, Naming]:
    """Find and name the dots from what the images show; refuse mirrored ones."""
    plan, plane = _plan(signals, decoder, search_board(board))
    sides = [plan, replace(plan, nominal_rotation=plan.nominal_rotation @ _OTHER_SIDE)]
    found = sorted((_on_lattice(signals, decoder, board, side, plane) for side in sides), key=lambda one: -one.contrast)
    naming = _name(found[0], decoder, board)
    if naming.mirrored and found[0].contrast < _CLEAR * found[1].contrast:  # the planes do not show the side
        found, naming = found[1:], _name(found[1], decoder, board)
    if naming.mirrored:
        raise InputError(
            "board.mark: expected the mark as it is stated, found its mirror image. Change image_flip of this camera: "
            '"none" and "horizontal" for each other, or "vertical" and "both".'
        )
    return found[0], naming


def _plan(signals: Signals, decoder: LightFieldDecoder, search: DotBoard) -> tuple[CameraPose, int]:
    """Return the pose, on the side of +z, that explains the lattice of a plane best, and the plane."""
    rectify = rectifier(decoder, search)
    for plane in map(int, planes_from_middle(search)[:_FIRST_PLANES]):
        signal = signals.of_plane(plane)
        tried = []
        for plan in plans_without_pose(signals, decoder, search, plane):
            start = lattice_of_plane(rectify(signal, plan, search.planes_mm[plane]), search, plan, plane)
            if start.regular and len(start.points_mm) >= FEWEST_DOTS:
                sites = in_field(plan, search.points_mm(plane), decoder.optics).sum()
                tried.append((start.share * len(start.points_mm) / max(sites, 1), start.score, plan))
        if tried:
            least = _LEAST_FILLED * max(filled for filled, _, _ in tried)
            return max((one for one in tried if one[0] >= least), key=lambda one: one[1])[2], plane
    raise InputError(
        f"board: expected a lattice of dots {search.spacing_mm:g} mm apart, found none. Check that these are board "
        "images and the board's numbers, or state nominal_direction."
    )


def _on_lattice(
    signals: Signals, decoder: LightFieldDecoder, board: DotBoard, plan: CameraPose, plane: int | None
) -> _Found:
    """Find the dots on a larger lattice with arbitrary names, starting from one plane, or from the clearest if None."""
    found = search_planes(signals, decoder, search_board(board), plan, plane)
    if not found.start.regular:
        raise InputError("board: found no lattice of dots.")
    return _Found(planes=found.planes, pose=found.pose, sign=found.start.sign)


def _name(found: _Found, decoder: LightFieldDecoder, board: DotBoard) -> Naming:
    search = search_board(board)
    sites = sites_found([plane.site for plane in found.planes], search.dots)
    points = [search.points_mm(plane, MARGIN) for plane in range(len(found.planes))]
    in_view = np.stack([lit_share(found.pose, at, decoder) >= FULLY_SEEN for at in points])
    return name_by_mark(sites, in_view.reshape(sites.shape), board)


def _named(signals: Signals, decoder: LightFieldDecoder, board: DotBoard, found: _Found, naming: Naming) -> Detection:
    """Find the dots again from the pose in the board's axes."""
    turn = np.eye(3)
    turn[:2, :2] = naming.turn
    offset = turn @ found.pose.parameters[3:6]
    offset[:2] += board.spacing_mm * naming.shift
    pose = replace(
        found.pose,
        parameters=(0.0, 0.0, 0.0, *offset.tolist(), *found.pose.parameters[6:]),
        nominal_rotation=found.pose.rotation @ turn.T,
    )
    planes, pose = find_in_planes(signals, rectifier(decoder, board, pose), board, pose, found.sign, decoder.optics)
    return _detection(planes, pose, found.sign, board, decoder)


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
