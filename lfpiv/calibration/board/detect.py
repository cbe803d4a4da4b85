"""Find and name the dots of a calibration board in all planes of one camera.

A board has no mark, so the nominal rig names its dots: the orientation is known to about 10 degrees, and the board's
middle is the lattice site nearest to its planned position. All planes of a camera share one pose, which is fitted from
the plane nearest to z = 0 outwards. The edges of the board that are in view then correct the names.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv.calibration.board.dots import FEWEST_DOTS, Detection, DotBoard
from lfpiv.calibration.board.edges import MARGIN, find_extents, require_stated, sites_found
from lfpiv.calibration.board.first_lattice import (
    FIRST_PLANES,
    FirstLattice,
    first_lattice,
    lattice_of_plane,
    planes_from_middle,
)
from lfpiv.calibration.board.planes import Signals
from lfpiv.calibration.board.pose import BIN_PITCHES, Blobs, CameraPose, Rectified, Rectifier
from lfpiv.errors import InputError
from lfpiv.geometry.optics import Optics, spread_over_pupil
from lfpiv.geometry.orientation import Orientation
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.warn import Code, Warning, warn

log = logging.getLogger(__name__)

FULLY_SEEN = 0.9
"""Least share of a site's light on lit pixels for an empty site to mean something."""

_FEWEST_SHARE = 0.25  # least share of the dots in the field on the first lattice
_SEARCH_SPACINGS = 0.35  # largest distance of a dot from where the pose expects it
_JUDGED_DOTS = 6  # least number of blobs of a plane that distinguish a board from chance
_JUDGED_BINS = 3  # least search radius that distinguishes them [elements]
_BLOBS_PER_TERM = 4  # least number of blobs for each term in which the misses vary beyond the first order
_CHANCE = 0.2  # largest scatter of a board's dots about their sites [search radius],
_CHANCE_PITCHES = 0.5  # or [microlens pitch], because a focused dot is located to a lens only
_MISSED_PITCHES = 0.25  # median miss of a thin lens in air above which dots may lie behind the surface of a liquid
_MET = 0.8  # largest median miss behind it, relative to the thin lens in air
_PUPIL_PART = 0.4  # part of the pupil's radius through which dots behind a liquid are looked for
_LIT_GAIN = 0.3  # least gain of a lit pixel; less is a vignetted corner or a dead lens


def find_dots(signals: Signals, decoder: LightFieldDecoder, board: DotBoard, orientation: Orientation) -> Detection:
    """Find and name the dots: the lattice in the first plane that shows one, then each plane with the fitted pose.

    The nominal orientation must be correct to about 10 degrees.

    Raises
    ------
    InputError
        If no plane shows the board's lattice, or the board certainly has another number of dots than stated.
    """
    optics = decoder.optics
    plan = CameraPose.from_plan(optics, orientation)
    found = search_planes(signals, decoder, board, plan)
    _require_lattice(found.start, board, plan, f"the nominal orientation ({orientation})", optics)
    planes, pose = found.planes, found.pose
    shift = _shift_to_edges([plane.site for plane in planes], pose, decoder, board)
    named = [_name(planes[number], number, shift, board) for number in range(len(planes))]
    dot, chief = (np.concatenate(part) for part in zip(*named, strict=True))
    if any(shift):
        warn(log, Warning(code=Code.BOARD_RENAMED, figures={"columns": int(shift[0]), "rows": int(shift[1])}))
        pose = (plan.behind_liquid if pose.is_behind_liquid else plan).fitted(board.of_dots_mm(dot), chief, optics)
    visible = np.stack([in_field(pose, board.points_mm(plane), optics) for plane in range(len(planes))])
    return Detection(pose=pose, sign=found.start.sign, dot=dot, chief_mm=chief, in_field=visible)


@dataclass(frozen=True, eq=False)
class PlaneSearch:
    """Dots of all planes about a plan of the camera."""

    start: FirstLattice
    planes: list[PlaneDots]
    pose: CameraPose
    miss_mm: float
    """Median distance of the dots from the pose on the array [mm]; infinite without a lattice."""


def search_planes(
    signals: Signals, decoder: LightFieldDecoder, board: DotBoard, plan: CameraPose, plane: int | None = None
) -> PlaneSearch:
    """Find the dots of every plane, with the pose of a thin lens in air; if that misses them, behind a liquid.

    The search starts from one plane, or from the clearest if None. From one plane there is no search behind a liquid.
    """
    found = _search(signals, decoder, board, plan, plane)
    if plane is None and found.miss_mm > _MISSED_PITCHES * decoder.optics.microlens_pitch_mm:
        behind = _search(signals, decoder, board, plan.behind_liquid, plane)
        if behind.miss_mm < _MET * found.miss_mm and behind.pose.depth < 1:
            return behind
    return found


def _search(
    signals: Signals, decoder: LightFieldDecoder, board: DotBoard, plan: CameraPose, plane: int | None
) -> PlaneSearch:
    rectify, optics = rectifier(decoder, board, plan), decoder.optics
    if plane is None:
        start = first_lattice(signals, rectify, board, plan)
    else:
        rectified = rectify(signals.of_plane(plane), plan, board.planes_mm[plane])
        start = lattice_of_plane(rectified, board, plan, plane)
    if not start.regular:
        return PlaneSearch(start, [], plan, np.inf)
    pose = plan.fitted(start.points_mm, start.chief_mm, optics)
    planes, pose = find_in_planes(signals, rectify, board, pose, start.sign, optics)
    points = np.concatenate([board.points_mm(plane, MARGIN)[dots.site] for plane, dots in enumerate(planes)])
    chief = np.concatenate([dots.chief_mm for dots in planes])
    miss = np.median(np.hypot(*(pose.rays(points)[0] - chief).T)) if len(points) else np.inf
    return PlaneSearch(start, planes, pose, float(miss))


def rectifier(decoder: LightFieldDecoder, board: DotBoard, pose: CameraPose | None = None) -> Rectifier:
    """Return the rectifier of a camera to the board with its margin.

    Behind a liquid dots are astigmatic, and sharp only through a part of the pupil.
    """
    half_x, half_y = ((n / 2 + MARGIN + 0.5) * board.spacing_mm for n in board.dots)
    share = _PUPIL_PART if pose is not None and pose.is_behind_liquid else 1.0
    return Rectifier(decoder, (half_x, half_y), board.diameter_mm, pupil_share=share)


def _require_lattice(start: FirstLattice, board: DotBoard, plan: CameraPose, stated: str, optics: Optics) -> None:
    """Refuse a lattice of too few dots, and blobs that are no lattice. `stated` is what the message asks to check."""
    order = planes_from_middle(board)
    visible = max(in_field(plan, board.points_mm(plane), optics).sum() for plane in order[:FIRST_PLANES])
    fewest = min(max(FEWEST_DOTS, _FEWEST_SHARE * visible), board.size)
    if len(start.points_mm) < fewest or not start.regular:
        chance = len(start.points_mm) > 0 and not start.regular
        blobs = f"; only {start.share:.0%} of the blobs lie on one lattice" if chance else ""
        raise InputError(
            f"board: expected a lattice of {board.dots[0]} x {board.dots[1]} dots, {board.spacing_mm:g} mm apart, near "
            f"z = {board.planes_mm[order[0]]:g} mm; found {len(start.points_mm)} dots of it{blobs}. Check that these "
            f"are board images, the board's numbers and {stated}."
        )


@dataclass(frozen=True, eq=False)
class PlaneDots:
    """Dots of one plane, on the stated lattice with its margin."""

    site: np.ndarray
    """Numbers of their lattice sites, row by row, shape (d,)."""
    chief_mm: np.ndarray
    """Their chief rays on the array [mm], shape (d, 2)."""
    contrast: float
    """Sum of their contrasts."""
    light: float
    """The same in shares of the white image's light, so that planes can be compared."""


def find_in_planes(
    signals: Signals, rectify: Rectifier, board: DotBoard, pose: CameraPose, sign: int, optics: Optics
) -> tuple[list[PlaneDots], CameraPose]:
    """Find the dots of every plane near where the pose expects them; fit the pose again after each plane.

    Planes without dots are searched again with the pose of the others, as long as that finds dots in some.
    """
    seen: dict[int, PlaneDots] = {}
    left, before = [*map(int, planes_from_middle(board))], 0
    while len(left) != before:
        before = len(left)
        for plane in left:
            seen[plane] = _dots_of_plane(signals, rectify, board, pose, plane, sign)
            points = np.concatenate([board.points_mm(p, MARGIN)[dots.site] for p, dots in seen.items()])
            pose = pose.fitted(points, np.concatenate([dots.chief_mm for dots in seen.values()]), optics)
        left = [plane for plane in left if not len(seen[plane].site)]
    return [seen[plane] for plane in range(len(seen))], pose


def _dots_of_plane(
    signals: Signals, rectify: Rectifier, board: DotBoard, pose: CameraPose, plane: int, sign: int
) -> PlaneDots:
    """Find the dots of a plane near where the pose expects them; none if they are not on the board's lattice."""
    z_mm, sites = board.planes_mm[plane], board.points_mm(plane, MARGIN)
    rectified = rectify(signals.of_plane(plane), pose, z_mm)
    blobs = _near_sites(rectified, sites[:, :2], board, sign)
    site = np.flatnonzero(blobs.strong)
    found = blobs.position_mm[site]
    if not on_lattice(found - sites[site, :2], sites[site, :2], board, rectified.bin_mm):
        site, found = site[:0], found[:0]
    at = np.column_stack([found, np.full(len(site), z_mm)])
    contrast = float(blobs.contrast[site].sum())
    return PlaneDots(site, pose.rays(at)[0], contrast, contrast * rectified.noise)


def _near_sites(rectified: Rectified, sites_mm: np.ndarray, board: DotBoard, sign: int) -> Blobs:
    """Return the blobs near the expected sites, after a shift common to all."""
    radius = search_radius_mm(board)
    blobs = rectified.near(sites_mm, radius, sign)
    if blobs.strong.any():
        shift = np.median((blobs.position_mm - sites_mm)[blobs.strong], axis=0)
        blobs = rectified.near(sites_mm + shift, radius, sign)
    return blobs


def search_radius_mm(board: DotBoard) -> float:
    """Return the largest distance of a dot from where the pose expects it [mm]."""
    return _SEARCH_SPACINGS * board.spacing_mm


def on_lattice(miss: np.ndarray, sites_mm: np.ndarray, board: DotBoard, bin_mm: float) -> bool:
    """Return whether blobs found near the expected sites are a board's dots, not chance.

    The misses of a board's dots vary smoothly over the sites, here by a robust polynomial, at most cubic: windows and
    liquids bend them beyond the first order. Chance spreads the misses over the whole search radius. `miss` is the
    position of each blob minus its site, `bin_mm` the spacing of the elements of the rectified image [mm].
    """
    radius = search_radius_mm(board)
    if len(miss) < _JUDGED_DOTS or radius < _JUDGED_BINS * bin_mm:
        return True
    x, y = sites_mm.T / board.spacing_mm
    degree = max(d for d in (1, 2, 3) if d == 1 or len(miss) >= _BLOBS_PER_TERM * (d + 1) * (d + 2) // 2)
    design = np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=1)
    weight = np.ones(len(miss))
    for _ in range(10):
        solution = np.linalg.lstsq(design * weight[:, None], miss * weight[:, None], rcond=None)[0]
        distance = np.hypot(*(miss - design @ solution).T)
        weight = 1 / (1 + (distance / (2 * max(np.median(distance), 1e-9))) ** 2)
    return bool(np.median(distance) < max(_CHANCE * radius, _CHANCE_PITCHES * bin_mm / BIN_PITCHES))


def _shift_to_edges(
    sites: Sequence[np.ndarray], pose: CameraPose, decoder: LightFieldDecoder, board: DotBoard
) -> tuple[int, int]:
    """Return the columns and rows by which the names must move to match the board's edges in view."""
    found = sites_found(sites, board.dots)
    points = [board.points_mm(plane, MARGIN) for plane in range(len(sites))]
    in_view = np.stack([lit_share(pose, at, decoder) >= FULLY_SEEN for at in points]).reshape(found.shape)
    extents = find_extents(found, in_view, board.dots)
    if extents is None:
        return 0, 0
    require_stated(extents, found, lenses_apart(pose, board, decoder.optics))
    for extent, axis in zip(extents, ("x", "y"), strict=True):
        if extent.open and extent.count != extent.stated:
            figures = {"axis": axis, "count": extent.count, "stated": extent.stated}
            figures |= {"half_spacing_mm": board.spacing_mm / 2}
            warn(log, Warning(code=Code.BOARD_EDGE_UNSEEN, figures=figures))
    return extents[0].shift, extents[1].shift


def lenses_apart(pose: CameraPose, board: DotBoard, optics: Optics) -> float:
    """Return the distance of neighbouring dots along the direction the camera sees most foreshortened [microlens]."""
    middle = np.array([0.0, 0.0, float(np.median(board.planes_mm))])
    chief, _ = pose.rays(middle + board.spacing_mm * np.eye(3)[[0, 1]])
    steps = chief - pose.rays(middle[None])[0]
    return float(np.linalg.svd(steps, compute_uv=False)[-1]) / optics.microlens_pitch_mm


def _name(dots: PlaneDots, plane: int, shift: tuple[int, int], board: DotBoard) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers and chief rays of the dots of a plane that are on the board."""
    row, column = np.divmod(dots.site, board.dots[0] + 2 * MARGIN)
    column, row = column - MARGIN - shift[0], row - MARGIN - shift[1]
    on_board = (column >= 0) & (column < board.dots[0]) & (row >= 0) & (row < board.dots[1])
    return plane * board.size + (row * board.dots[0] + column)[on_board], dots.chief_mm[on_board]


def lit_share(pose: CameraPose, points: np.ndarray, decoder: LightFieldDecoder) -> np.ndarray:
    """Return the share of each dot's light on pixels that respond to light, shape (n,)."""
    column, row = np.moveaxis(np.rint(_light_px(pose, points, decoder.optics)), -1, 0)
    rows, columns = decoder.optics.sensor_shape
    on_sensor = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    at = np.where(on_sensor, row, 0).astype(int), np.where(on_sensor, column, 0).astype(int)
    return (on_sensor & (decoder.smooth_gain[at] > _LIT_GAIN)).mean(1)


def in_field(pose: CameraPose, points: np.ndarray, optics: Optics) -> np.ndarray:
    """Return the dots with at least half of their light on the sensor, bool, shape (n,)."""
    position = _light_px(pose, points, optics)
    rows, columns = optics.sensor_shape
    inside = (position > -0.5) & (position < np.array([columns, rows]) - 0.5)
    return np.all(inside, axis=-1).mean(1) >= 0.5


def _light_px(pose: CameraPose, points: np.ndarray, optics: Optics) -> np.ndarray:
    """Return where rays spread over the pupil meet the sensor (column, row) [pixel], shape (n, rays, 2)."""
    chief, slope = pose.rays(points)
    pupil = spread_over_pupil(optics.pupil_radius_mm)
    array = chief[:, None] + slope[:, None, None] * pupil
    return optics.sensor_px(array + (array - pupil) * optics.sensor_per_pupil)
