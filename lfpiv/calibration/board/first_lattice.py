"""Find the lattice of a board's dots in a single plane, rectified with the nominal pose, to start the calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.planes import Signals
from lfpiv.calibration.board.pose import Blobs, CameraPose, Rectified, Rectifier

FIRST_PLANES = 3
"""Least number of planes that are searched with the nominal pose; further planes while none is regular."""

_REGULAR = 0.5  # least `FirstLattice.share` of a board; random blobs reach less
_PEAK_SPACINGS = 0.4  # least distance between two blobs [spacing]
_INLIER_SPACINGS = 0.2  # largest distance of a blob from its site [spacing]


@dataclass(frozen=True, eq=False)
class FirstLattice:
    """The lattice that one plane shows when it is rectified with a pose."""

    points_mm: np.ndarray
    """Stated positions (x, y, z) of the dots that were found, shape (dot, 3) [mm]."""
    chief_mm: np.ndarray
    """Points of the microlens array where the chief rays of the dots' images meet it, shape (dot, 2) [mm]."""
    sign: int
    """+1 for bright dots, -1 for dark ones."""
    score: float
    """Sum of the dots' contrasts."""
    share: float
    """Share on one lattice of the strongest blobs, as many as the board has dots."""

    @property
    def regular(self) -> bool:
        """Whether the blobs form a board's lattice, not one by chance."""
        return self.share >= _REGULAR


def first_lattice(signals: Signals, rectify: Rectifier, board: DotBoard, plan: CameraPose) -> FirstLattice:
    """Find the lattice in one of the planes nearest to z = 0, rectified with the pose `plan`.

    If no plane shows a regular lattice, the best irregular lattice is returned.
    """
    order = planes_from_middle(board)
    found: list[FirstLattice] = []
    for plane in order:
        if len(found) >= FIRST_PLANES and any(lattice.regular for lattice in found):
            break
        rectified = rectify(signals.of_plane(plane), plan, board.planes_mm[plane])
        found.append(lattice_of_plane(rectified, board, plan, plane))
    candidates = [lattice for lattice in found if lattice.regular] or found
    best = max(lattice.score for lattice in candidates)
    return next(lattice for lattice in candidates if lattice.score >= best / 2)  # planes near z = 0 are more certain


def planes_from_middle(board: DotBoard) -> np.ndarray:
    """Return the numbers of the planes in the order of their distances from z = 0."""
    return np.argsort(np.abs(np.asarray(board.planes_mm)), kind="stable")


def lattice_of_plane(rectified: Rectified, board: DotBoard, pose: CameraPose, plane: int) -> FirstLattice:
    """Match the lattice to the bright or the dark blobs of a plane; without a match it has no dots and score 0."""
    best = FirstLattice(np.empty((0, 3)), np.empty((0, 2)), 1, 0.0, 0.0)
    for sign in (1, -1):
        blobs = rectified.peaks(_PEAK_SPACINGS * board.spacing_mm, sign)
        match = _match_lattice(blobs, board)
        score = float(blobs.contrast[match.member].sum())
        if score > best.score:
            points = board.points_mm(plane)[match.index[:, 1] * board.dots[0] + match.index[:, 0]]
            at = np.column_stack([blobs.position_mm[match.member], np.full(len(points), board.planes_mm[plane])])
            strongest = np.argsort(-blobs.contrast, kind="stable")[: board.size]
            best = FirstLattice(points, pose.rays(at)[0], sign, score, float(match.regular[strongest].mean()))
    return best


@dataclass(frozen=True, eq=False)
class _LatticeMatch:
    """Blobs on the lattice of a board."""

    index: np.ndarray
    """Column and row of each blob that is a dot of the board, shape (dot, 2)."""
    member: np.ndarray
    """Numbers of these blobs, shape (dot,)."""
    regular: np.ndarray
    """Blobs on the lattice, on the board or beyond it, shape (blobs,), bool."""


def _match_lattice(blobs: Blobs, board: DotBoard) -> _LatticeMatch:
    """Find the lattice in a cloud of blobs that may lack dots and contain others.

    The stated pose is taken to be right within half a spacing: the middle of the board is the lattice site nearest to
    the origin, or the middle between sites where `board.dots` is even.
    """
    peaks, contrast = blobs.position_mm, blobs.contrast
    if len(peaks) < 1:
        return _LatticeMatch(np.empty((0, 2), int), np.empty(0, int), np.zeros(0, bool))
    inverse, phase = _lattice_waves(blobs, board)
    for _ in range(6):
        site = peaks @ inverse.T - phase
        index = np.rint(site)
        close = np.hypot(*(site - index).T) < _INLIER_SPACINGS
        if close.sum() < 3 or np.linalg.matrix_rank(index[close] - index[close].mean(0)) < 2:
            break
        design = np.column_stack([peaks[close], np.ones(close.sum())])
        fit = np.linalg.lstsq(design, index[close], rcond=None)[0]
        inverse, phase = fit[:2].T, -fit[2]
    site = peaks @ inverse.T - phase
    index = np.rint(site).astype(int)
    middle = (np.array(board.dots) - 1) / 2
    index += np.rint(middle + phase).astype(int)  # the origin's site is -phase
    regular = np.hypot(*(site - np.rint(site)).T) < _INLIER_SPACINGS
    member = np.flatnonzero(((index >= 0) & (index < board.dots)).all(1) & regular)
    member = member[np.argsort(-contrast[member], kind="stable")]  # so `unique` keeps the strongest blob of a site
    _, first = np.unique(index[member], axis=0, return_index=True)
    member = np.sort(member[first])
    return _LatticeMatch(index[member], member, regular)


def _lattice_waves(blobs: Blobs, board: DotBoard) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix and phase of site = matrix @ position - phase: the plane waves that fit the blobs best.

    A wave has its crests on the columns, or rows, of the lattice. The wave vectors are searched near (1, 0) and (0, 1)
    per spacing, and the nearest are preferred. A direction with a single dot takes the stated spacing.
    """
    weight = np.minimum(blobs.contrast, 3 * np.median(blobs.contrast))
    scale, turn = np.meshgrid(np.linspace(0.75, 1.35, 61), np.radians(np.linspace(-9, 9, 37)), indexing="ij")
    prior = np.exp(-0.5 * (np.log(scale) / 0.3) ** 2 - 0.5 * (turn / np.radians(9)) ** 2).ravel()
    along = np.stack([scale * np.cos(turn), scale * np.sin(turn)], -1).reshape(-1, 2) / board.spacing_mm
    waves, phases = [], []
    for axis, count in enumerate(board.dots):
        wave = along if axis == 0 else along[:, ::-1] * (-1, 1)
        sums = np.exp(2j * np.pi * wave @ blobs.position_mm.T) @ weight
        best = np.argmax(np.abs(sums) * prior) if count > 1 else np.argmax(prior)
        waves.append(wave[best])
        phases.append(np.angle(sums[best]) / (2 * np.pi))
    return np.array(waves), np.array(phases)
