"""Find and name the dots of a calibration board in all planes of one camera.

A board carries no mark, so its dots are named by the nominal rig: the thin-lens image of the board, inverted, the angle
right to about 10 degrees, the board's middle nearest to where the plan puts it. The planes of a camera share one pose,
which is fitted from the plane nearest to z = 0 outwards.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from lfpiv.boardpose import CameraPose, Rectified, Rectifier, match_lattice, search_radius_mm, strong_enough
from lfpiv.dotfit import spread_over_pupil
from lfpiv.errors import InputError
from lfpiv.lightfield import LightFieldDecoder
from lfpiv.rig import Optics

log = logging.getLogger(__name__)

_FIRST_PLANES = 3  # planes in which the lattice is looked for with nothing but the nominal pose
FEWEST_DOTS = 4
"""Dots that make a board."""

_FEWEST_PART = 0.25  # of the dots in the field must be on the lattice
_MARGIN = 1  # lattice places around the board that tell a wrong name from a right one


@dataclass(frozen=True, kw_only=True)
class DotBoard:
    """A flat board with a square lattice of dots, moved along z."""

    dots: tuple[int, int]
    """Dots along x and y."""
    spacing_mm: float
    """Distance of neighbouring dots [mm]."""
    diameter_mm: float
    """Diameter of a dot [mm]."""
    planes_mm: tuple[float, ...]
    """Depth z of each plane [mm]."""

    @property
    def size(self) -> int:
        """Dots on the board."""
        return self.dots[0] * self.dots[1]

    def points_mm(self, plane: int, margin: int = 0) -> np.ndarray:
        """World positions of the dots of one plane, dot j * nx + i at column i and row j, shape (dot, 3) [mm].

        `margin` adds columns and rows of dots that are not there, around the board.
        """
        x, y = ((np.arange(-margin, n + margin) - (n - 1) / 2) * self.spacing_mm for n in self.dots)
        x, y = np.meshgrid(x, y)
        return np.stack([x.ravel(), y.ravel(), np.full(x.size, float(self.planes_mm[plane]))], axis=1)

    def of_dots_mm(self, dot: np.ndarray) -> np.ndarray:
        """World positions of dots numbered plane * (nx ny) + row * nx + column, shape (n, 3) [mm]."""
        plane, place = np.divmod(dot, self.size)
        points = self.points_mm(0)[place]
        points[:, 2] = np.asarray(self.planes_mm)[plane]
        return points


@dataclass(frozen=True, eq=False)
class Detection:
    """The dots as found in the rectified images, and the pose that names them."""

    pose: CameraPose
    """The pose fitted to them."""
    sign: int
    """+1 for dots brighter than the board, -1 for darker ones."""
    dot: np.ndarray
    """Numbers of the seen dots, plane * (nx ny) + row * nx + column, shape (d,)."""
    chief_mm: np.ndarray
    """Their rays through the pupil's centre on the array, to a fraction of a lens [mm], shape (d, 2)."""
    in_field: np.ndarray
    """Dots of which at least half of the light falls on the sensor, shape (plane, dot)."""


def find_dots(signals, decoder: LightFieldDecoder, board: DotBoard, nominal_angle_deg: float) -> Detection:
    """Find and name the dots: lattice in the first plane that shows one, then plane by plane with the fitted pose."""
    optics = decoder.optics
    half_width = tuple((n / 2 + 1.5) * board.spacing_mm for n in board.dots)
    rectify = Rectifier(decoder, half_width, board.diameter_mm)
    order = np.argsort(np.abs(np.asarray(board.planes_mm)), kind="stable")
    plan = CameraPose.from_plan(optics, nominal_angle_deg)

    first = []
    for plane in order[:_FIRST_PLANES]:
        rectified = rectify(signals[plane], plan, board.planes_mm[plane])
        first.append(_first_lattice(rectified, board, plan, plane))
    best = max(found[3] for found in first)
    points, chief, sign, _ = next(found for found in first if found[3] >= best / 2)  # the nearer to z = 0 the surer
    visible = max(_in_field(plan, board.points_mm(plane), optics).sum() for plane in order[:_FIRST_PLANES])
    if len(points) < min(max(FEWEST_DOTS, _FEWEST_PART * visible), board.size):
        raise InputError(
            f"board: expected a lattice of {board.dots[0]} x {board.dots[1]} dots, {board.spacing_mm:g} mm apart, near "
            f"z = {board.planes_mm[order[0]]:g} mm; found {len(points)} dots of it. Check the board images, the "
            f"board's numbers and the nominal angle ({nominal_angle_deg:g} degrees)."
        )
    pose = plan.fitted(points, chief, optics)

    columns = board.dots[0] + 2 * _MARGIN
    seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for plane in order:
        targets = board.points_mm(plane, _MARGIN)
        rectified = rectify(signals[plane], pose, board.planes_mm[plane])
        found, contrast = _near_lattice(rectified, targets[:, :2], board, sign)
        place = np.flatnonzero(strong_enough(contrast))
        at_plane = np.column_stack([found[place], np.full(len(place), board.planes_mm[plane])])
        seen[plane] = place, pose.rays(at_plane)[0]
        known = [(board.points_mm(p, _MARGIN)[places], rays) for p, (places, rays) in seen.items()]
        pose = pose.fitted(*(np.concatenate(part) for part in zip(*known, strict=True)), optics)

    shift = _misnamed_by([places for places, _ in seen.values()], columns, board)
    dots, chiefs = [], []
    for plane in range(len(signals)):
        places, rays = seen[plane]
        row, column = np.divmod(places, columns)
        column, row = column - _MARGIN - shift[0], row - _MARGIN - shift[1]
        named = (column >= 0) & (column < board.dots[0]) & (row >= 0) & (row < board.dots[1])
        dots.append(plane * board.size + (row * board.dots[0] + column)[named])
        chiefs.append(rays[named])
    dot, chief = np.concatenate(dots), np.concatenate(chiefs)
    if any(shift):
        log.warning("the board's dots were renamed by %s columns and %s rows to match its outline", *shift)
        pose = plan.fitted(board.of_dots_mm(dot), chief, optics)
    in_field = np.stack([_in_field(pose, board.points_mm(p), optics) for p in range(len(signals))])
    return Detection(pose, sign, dot, chief, in_field)


def _first_lattice(rectified: Rectified, board: DotBoard, pose: CameraPose, plane: int):
    """Board points and chief rays of a plane seen with the nominal pose, the dots' sign and the lattice's score."""
    best = np.empty((0, 3)), np.empty((0, 2)), 1, 0.0
    for sign in (1, -1):
        peaks, contrast = rectified.peaks(0.4 * board.spacing_mm, sign)
        index, member, score = match_lattice(peaks, contrast, board.dots, board.spacing_mm)
        if score > best[3]:
            z = np.full(len(member), board.planes_mm[plane])
            points = board.points_mm(plane)[index[:, 1] * board.dots[0] + index[:, 0]]
            best = points, pose.rays(np.column_stack([peaks[member], z]))[0], sign, score
    return best


def _near_lattice(rectified: Rectified, targets: np.ndarray, board: DotBoard, sign: int):
    """Blobs nearest to their predicted places; a common shift of all is allowed for first."""
    radius = search_radius_mm(board.spacing_mm)
    found, contrast = rectified.near(targets, radius, sign)
    sure = strong_enough(contrast)
    if sure.any():
        shift = np.median((found - targets)[sure], axis=0)
        found, contrast = rectified.near(targets + shift, radius, sign)
    return found, contrast


def _misnamed_by(places: list[np.ndarray], columns: int, board: DotBoard) -> tuple[int, int]:
    """Columns and rows by which the names must move so that the board covers the most dots; (0, 0) on a tie."""
    rows = board.dots[1] + 2 * _MARGIN
    counts = np.bincount(np.concatenate(places), minlength=rows * columns).reshape(rows, columns)
    best, gain = (0, 0), len(places) * min(board.dots) / 2  # half a column of new dots in every plane
    inner = counts[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN].sum()
    for j in range(-_MARGIN, _MARGIN + 1):
        for i in range(-_MARGIN, _MARGIN + 1):
            window = counts[_MARGIN + j :, _MARGIN + i :][: board.dots[1], : board.dots[0]]
            if window.sum() - inner > gain:
                best, gain = (i, j), window.sum() - inner
    return best


def _in_field(pose: CameraPose, points: np.ndarray, optics: Optics) -> np.ndarray:
    """Dots of which at least half of the light falls on the sensor."""
    chief, slope = pose.rays(points)
    pupil = spread_over_pupil(optics.pupil_radius_mm)
    array = chief[:, None] + slope[:, None, None] * pupil
    position = optics.sensor_px(array + (array - pupil) * optics.sensor_per_pupil)
    rows, columns = optics.sensor_shape
    return ((position > -0.5) & (position < np.array([columns, rows]) - 0.5)).all(-1).mean(1) >= 0.5
