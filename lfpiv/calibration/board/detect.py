"""Find and name the dots of a calibration board in all planes of one camera.

A board carries no mark, so its dots are named by the nominal rig: the thin-lens image of the board, inverted, the angle
right to about 10 degrees, the board's middle nearest to where the plan puts it. The planes of a camera share one pose,
which is fitted from the plane nearest to z = 0 outwards. The board's edges that are in view then correct the names.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv.calibration.board.dot_model import spread_over_pupil
from lfpiv.calibration.board.edges import MARGIN, Extent, numbered, outline, require_stated
from lfpiv.calibration.board.pose import (
    BIN_PITCHES,
    CameraPose,
    Rectified,
    Rectifier,
    match_lattice,
    search_radius_mm,
    strong_enough,
)
from lfpiv.errors import InputError
from lfpiv.geometry.optics import Optics
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.warn import Code, Warning, warn

log = logging.getLogger(__name__)

_FIRST_PLANES = 3  # planes in which the lattice is looked for with nothing but the nominal pose
FEWEST_DOTS = 4
"""Dots that make a board."""

_FEWEST_PART = 0.25  # of the dots in the field must be on the lattice
_REGULAR = 0.5  # of the strongest blobs must lie on one lattice
_JUDGED_DOTS = 6  # fewer blobs of a plane, or a search radius of fewer elements, do not tell a board from chance
_JUDGED_BINS = 3
_CHANCE = 0.2  # of the search radius: boards scatter by less than 0.1 of it about their places, chance by 0.2 to 0.6
_CHANCE_PITCHES = 0.5  # but dots in focus are known to a lens only: they scatter by up to this
_WHOLLY_SEEN = 0.9  # of a dot's light on lit pixels: its absence means something
_LIT_GAIN = 0.3  # of a typical pixel's: less is a vignetted corner or a dead lens


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


def find_dots(
    signals: Sequence[np.ndarray], decoder: LightFieldDecoder, board: DotBoard, nominal_angle_deg: float
) -> Detection:
    """Find and name the dots: lattice in the first plane that shows one, then plane by plane with the fitted pose."""
    optics = decoder.optics
    half_x, half_y = ((n / 2 + MARGIN + 0.5) * board.spacing_mm for n in board.dots)
    rectify = Rectifier(decoder, (half_x, half_y), board.diameter_mm)
    order = np.argsort(np.abs(np.asarray(board.planes_mm)), kind="stable")
    plan = CameraPose.from_plan(optics, nominal_angle_deg)

    first: list[_FirstLattice] = []
    for plane in order:
        if len(first) >= _FIRST_PLANES and any(lattice.regular for lattice in first):
            break
        first.append(_first_lattice(rectify(signals[plane], plan, board.planes_mm[plane]), board, plan, plane))
    candidates = [lattice for lattice in first if lattice.regular] or first
    best = max(lattice.score for lattice in candidates)
    start = next(lattice for lattice in candidates if lattice.score >= best / 2)  # the nearer to z = 0 the surer
    visible = max(_in_field(plan, board.points_mm(plane), optics).sum() for plane in order[: len(first)])
    if len(start.points) < min(max(FEWEST_DOTS, _FEWEST_PART * visible), board.size) or not start.regular:
        chance = len(start.points) > 0 and not start.regular
        blobs = f" among blobs of which only {start.share:.0%} lie on one lattice" if chance else ""
        raise InputError(
            f"board: expected a lattice of {board.dots[0]} x {board.dots[1]} dots, {board.spacing_mm:g} mm apart, near "
            f"z = {board.planes_mm[order[0]]:g} mm; found {len(start.points)} dots of it{blobs}. Check that these are "
            f"board images, the board's numbers and the nominal angle ({nominal_angle_deg:g} degrees)."
        )
    points, chief, sign = start.points, start.chief_mm, start.sign
    pose = plan.fitted(points, chief, optics)

    seen: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for plane in order:
        targets = board.points_mm(plane, MARGIN)
        rectified = rectify(signals[plane], pose, board.planes_mm[plane])
        found, contrast = _near_lattice(rectified, targets[:, :2], board, sign)
        place = np.flatnonzero(strong_enough(contrast))
        if not _on_lattice(found[place] - targets[place, :2], targets[place, :2], board, rectified.bin_mm):
            place = place[:0]
        at_plane = np.column_stack([found[place], np.full(len(place), board.planes_mm[plane])])
        seen[plane] = place, pose.rays(at_plane)[0]
        known = [(board.points_mm(p, MARGIN)[places], rays) for p, (places, rays) in seen.items()]
        all_points, all_rays = (np.concatenate(part) for part in zip(*known, strict=True))
        pose = pose.fitted(all_points, all_rays, optics)

    shift = _shift_to_edges([seen[plane][0] for plane in range(len(signals))], pose, decoder, board)
    dots, chiefs = [], []
    for plane in range(len(signals)):
        places, rays = seen[plane]
        row, column = np.divmod(places, board.dots[0] + 2 * MARGIN)
        column, row = column - MARGIN - shift[0], row - MARGIN - shift[1]
        named = (column >= 0) & (column < board.dots[0]) & (row >= 0) & (row < board.dots[1])
        dots.append(plane * board.size + (row * board.dots[0] + column)[named])
        chiefs.append(rays[named])
    dot, chief = np.concatenate(dots), np.concatenate(chiefs)
    if any(shift):
        warn(log, Warning(code=Code.BOARD_RENAMED, figures={"columns": int(shift[0]), "rows": int(shift[1])}))
        pose = plan.fitted(board.of_dots_mm(dot), chief, optics)
    in_field = np.stack([_in_field(pose, board.points_mm(p), optics) for p in range(len(signals))])
    return Detection(pose, sign, dot, chief, in_field)


@dataclass(frozen=True, eq=False)
class _FirstLattice:
    """What one plane shows with the nominal pose."""

    points: np.ndarray
    """Board points of the dots, shape (d, 3) [mm]."""
    chief_mm: np.ndarray
    """Their chief rays on the array, shape (d, 2) [mm]."""
    sign: int
    """+1 for bright dots, -1 for dark ones."""
    score: float
    """Sum of their contrasts."""
    share: float
    """Part of the strongest blobs, as many as the board has dots, that lie on one lattice."""

    @property
    def regular(self) -> bool:
        """Whether the blobs are a board: a lattice drawn through blobs at random holds 0.2 to 0.3 of them."""
        return self.share >= _REGULAR


def _first_lattice(rectified: Rectified, board: DotBoard, pose: CameraPose, plane: int) -> _FirstLattice:
    """Look for the lattice in a plane seen with the nominal pose."""
    best = _FirstLattice(np.empty((0, 3)), np.empty((0, 2)), 1, 0.0, 0.0)
    for sign in (1, -1):
        peaks, contrast = rectified.peaks(0.4 * board.spacing_mm, sign)
        index, member, score, regular = match_lattice(peaks, contrast, board.dots, board.spacing_mm)
        if score > best.score:
            points = board.points_mm(plane)[index[:, 1] * board.dots[0] + index[:, 0]]
            at = np.column_stack([peaks[member], np.full(len(member), board.planes_mm[plane])])
            strongest = np.argsort(-contrast, kind="stable")[: board.size]
            best = _FirstLattice(points, pose.rays(at)[0], sign, score, float(regular[strongest].mean()))
    return best


def _on_lattice(miss: np.ndarray, targets: np.ndarray, board: DotBoard, bin_mm: float) -> bool:
    """Whether blobs found near the predicted places are a board's, not chance: they miss the places alike.

    What blobs miss their places by (n, 2) [mm] is a smooth function of the place for a board, here a robust linear one,
    and spread over the whole search radius for blobs that are there by chance.
    """
    radius = search_radius_mm(board.spacing_mm)
    if len(miss) < _JUDGED_DOTS or radius < _JUDGED_BINS * bin_mm:
        return True
    design = np.column_stack([np.ones(len(miss)), targets / board.spacing_mm])
    weight = np.ones(len(miss))
    for _ in range(10):
        solution = np.linalg.lstsq(design * weight[:, None], miss * weight[:, None], rcond=None)[0]
        distance = np.hypot(*(miss - design @ solution).T)
        weight = 1 / (1 + (distance / (2 * max(np.median(distance), 1e-9))) ** 2)
    return bool(np.median(distance) < max(_CHANCE * radius, _CHANCE_PITCHES * bin_mm / BIN_PITCHES))


def _near_lattice(
    rectified: Rectified, targets: np.ndarray, board: DotBoard, sign: int
) -> tuple[np.ndarray, np.ndarray]:
    """Blobs nearest to their predicted places; a common shift of all is allowed for first."""
    radius = search_radius_mm(board.spacing_mm)
    found, contrast = rectified.near(targets, radius, sign)
    sure = strong_enough(contrast)
    if sure.any():
        shift = np.median((found - targets)[sure], axis=0)
        found, contrast = rectified.near(targets + shift, radius, sign)
    return found, contrast


def _shift_to_edges(
    places: list[np.ndarray], pose: CameraPose, decoder: LightFieldDecoder, board: DotBoard
) -> tuple[int, int]:
    """Columns and rows by which the names must move so that the edges in view are the board's."""
    found = numbered(places, board.dots)
    points = [board.points_mm(plane, MARGIN) for plane in range(len(places))]
    in_view = np.stack([_lit_share(pose, at, decoder) >= _WHOLLY_SEEN for at in points]).reshape(found.shape)
    extents = outline(found, in_view, board.dots)
    if extents is None:
        return 0, 0
    require_stated(extents, found)
    for extent, name in zip(extents, ("x", "y"), strict=True):
        if extent.open and extent.count != extent.stated:
            _warn_of_open(extent, name, board)
    return extents[0].shift, extents[1].shift


def _warn_of_open(extent: Extent, axis: str, board: DotBoard) -> None:
    figures = {"axis": axis, "count": extent.count, "stated": extent.stated, "half_spacing_mm": board.spacing_mm / 2}
    warn(log, Warning(code=Code.BOARD_EDGE_UNSEEN, figures=figures))


def _lit_share(pose: CameraPose, points: np.ndarray, decoder: LightFieldDecoder) -> np.ndarray:
    """Part of each dot's light that falls on pixels which answer to light, shape (n,)."""
    column, row = np.moveaxis(np.rint(_light_px(pose, points, decoder.optics)), -1, 0)
    rows, columns = decoder.optics.sensor_shape
    on_sensor = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    at = np.where(on_sensor, row, 0).astype(int), np.where(on_sensor, column, 0).astype(int)
    share: np.ndarray = (on_sensor & (decoder.smooth_gain[at] > _LIT_GAIN)).mean(1)
    return share


def _in_field(pose: CameraPose, points: np.ndarray, optics: Optics) -> np.ndarray:
    """Dots of which at least half of the light falls on the sensor."""
    position = _light_px(pose, points, optics)
    rows, columns = optics.sensor_shape
    inside = (position > -0.5) & (position < np.array([columns, rows]) - 0.5)
    half: np.ndarray = np.all(inside, axis=-1).mean(1) >= 0.5
    return half


def _light_px(pose: CameraPose, points: np.ndarray, optics: Optics) -> np.ndarray:
    """Where rays spread over the pupil take each dot's light on the sensor (column, row) [pixel], (n, views, 2)."""
    chief, slope = pose.rays(points)
    pupil = spread_over_pupil(optics.pupil_radius_mm)
    array = chief[:, None] + slope[:, None, None] * pupil
    return optics.sensor_px(array + (array - pupil) * optics.sensor_per_pupil)
