"""Name the dots of a marked board: match the sites without a dot to the stated mark, in all turns and mirrors.

A mark is a set of lattice sites without a dot that no turn or mirror of the lattice carries over into itself. The
sites that hold dots are compared with the stated board, its edges included, at every shift and in all eight turns and
mirrors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.signal

from lfpiv.calibration.board.dots import DotBoard
from lfpiv.errors import InputError

OCCUPIED, EMPTY = 0.6, 0.25
"""Share of the planes in which a site shows a dot: one above the first holds a dot, one below the second holds none."""
FEWEST_VIEWS = 2
"""Least number of planes in which a site must be in view to be judged."""
CLEAR_SITES = 2
"""Least number of sites by which the best match must surpass the second."""
WRONG_SITES = 0.1
"""Largest share of the judged sites that contradict the best match."""

TURNS = tuple(
    np.array(turn) @ mirror
    for mirror in (np.eye(2, dtype=int), np.diag([-1, 1]))
    for turn in (((1, 0), (0, 1)), ((0, -1), (1, 0)), ((-1, 0), (0, -1)), ((0, 1), (-1, 0)))
)
"""Turns of a square lattice, the four without a mirror first, shape (2, 2) each."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Naming:
    """Turn and shift from a lattice with arbitrary names to the board's."""

    turn: np.ndarray
    """One of `TURNS`: from the lattice's to the board's directions, shape (2, 2)."""
    shift: np.ndarray
    """Place of the lattice's middle on the board, from the board's middle [spacing], shape (2,)."""

    @property
    def mirrored(self) -> bool:
        """Whether the lattice is seen mirrored."""
        return float(np.linalg.det(self.turn)) < 0

    @property
    def turned(self) -> bool:
        """Whether the lattice is seen turned or mirrored."""
        return not np.array_equal(self.turn, TURNS[0])


def search_board(board: DotBoard) -> DotBoard:
    """Return a square lattice of sites, an odd number along each edge, on which any part of the board may lie."""
    edge = 2 * max(board.dots) - 1
    return replace(board, dots=(edge, edge), mark=())


def name_by_mark(found: np.ndarray, in_view: np.ndarray, board: DotBoard) -> Naming:
    """Match the occupied sites of a lattice to a marked board.

    Parameters
    ----------
    found, in_view : ndarray of bool, shape (plane, n, n)
        Sites with a dot, and sites whose dot would be fully in view. The lattice's middle is site (n - 1) / 2.

    Raises
    ------
    InputError
        If no match is clearly the best.
    """
    views, hits = in_view.sum(0), (found & in_view).sum(0)
    share = np.divide(hits, views, out=np.zeros(views.shape), where=views > 0)
    known = views >= min(FEWEST_VIEWS, len(found))
    row, column = np.nonzero(known & ((share >= OCCUPIED) | (share <= EMPTY)))
    occupied = share[row, column] >= OCCUPIED
    place = np.stack([column, row], axis=1) - (found.shape[1] - 1) // 2
    ranked = sorted(
        (
            (wrong, number, shift)
            for number in range(len(TURNS))
            for wrong, shift in _shifts(place, occupied, board, number)
        ),
        key=lambda match: match[0],
    )
    (wrong, number, shift), (second, *_) = ranked[:2]
    if wrong > WRONG_SITES * len(place) or second - wrong < CLEAR_SITES:
        fault = f"{wrong} of {len(place)} sites in view contradict the best match"
        if wrong <= WRONG_SITES * len(place):
            fault = "several places and turns of the board fit what is in view"
        raise InputError(
            f"board.mark: expected the {len(board.mark)} places without a dot in view, and dots around them; {fault}. "
            "Check board.mark and board.dots, and that the mark is in the view of every camera."
        )
    return Naming(turn=TURNS[number], shift=shift)


def _shifts(place: np.ndarray, occupied: np.ndarray, board: DotBoard, turn: int) -> list[tuple[int, np.ndarray]]:
    """Return the two best shifts of sites in one turn, each with the number of sites that contradict it."""
    turned = place @ TURNS[turn].T
    low = turned.min(0)
    judged, dots = np.zeros((2, *(np.ptp(turned, axis=0) + 1)))
    judged[tuple((turned - low).T)] = 1
    dots[tuple((turned[occupied] - low).T)] = 1
    stated = board.occupied.T.astype(float)
    on_judged, on_dots = (scipy.signal.correlate(stated, sites) for sites in (judged, dots))
    wrong = np.rint(occupied.sum() + on_judged - 2 * on_dots).astype(int)
    best = np.argsort(wrong, axis=None, kind="stable")[:2]
    first = 1 - np.array(judged.shape) - low - (np.array(board.dots) - 1) / 2
    return [(int(wrong.flat[at]), first + np.unravel_index(at, wrong.shape)) for at in best]
