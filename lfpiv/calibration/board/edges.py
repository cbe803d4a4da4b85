"""Find the edges of a board in a camera's view, and compare the enclosed columns and rows with the stated ones.

All dots look alike, so only the board's edges identify a column. An edge is seen where the view continues beyond the
lattice but no dots do. One edge names the dots. Two edges that enclose another number of columns than stated refuse the
board, because the names would then be wrong by half a spacing or more, by different amounts in different cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from lfpiv.errors import InputError

MARGIN = 2
"""Columns and rows of lattice sites that are searched around the stated board."""
FEWEST_SITES = 3
"""Sites of a column that must be in view, over all planes, to judge whether the column has dots."""
OCCUPIED, EMPTY = 0.5, 0.2
"""Share of sites with a dot, relative to the typical column: a column above the first is on the board, one below the
second is not."""
LENSES_APART = 2.0
"""Least distance of dots, as the camera sees them, at which each is told from its neighbours [microlens]."""


@dataclass(frozen=True)
class Extent:
    """Columns (or rows) that hold dots, numbered as the stated board's: 0 to stated - 1."""

    stated: int
    """Columns stated."""
    first: int
    """First column with dots."""
    last: int
    """Last column with dots."""
    starts: bool
    """Whether the view continues before the first column, which is then the board's edge."""
    ends: bool
    """Whether the view continues after the last column."""

    @property
    def count(self) -> int:
        """Columns with dots."""
        return self.last - self.first + 1

    @property
    def fits(self) -> bool:
        """Whether the stated number may be correct."""
        return self.count == self.stated if self.starts and self.ends else self.count <= self.stated or self.open

    @property
    def open(self) -> bool:
        """Whether no edge is in view."""
        return not (self.starts or self.ends)

    @property
    def shift(self) -> int:
        """Columns by which the names must move; 0 where no edge is in view."""
        if self.starts:
            return self.first
        return self.last - (self.stated - 1) if self.ends else 0


def sites_found(sites: Sequence[np.ndarray], dots: tuple[int, int]) -> np.ndarray:
    """Return the lattice sites with a dot, bool, shape (plane, rows + 2 MARGIN, columns + 2 MARGIN).

    `sites` are their numbers in each plane, row by row over the lattice with its margin. `dots` are the stated columns
    and rows.
    """
    columns, rows = (n + 2 * MARGIN for n in dots)
    found = np.zeros((len(sites), rows * columns), bool)
    for plane, site in enumerate(sites):
        found[plane, site] = True
    return found.reshape(len(sites), rows, columns)


def find_extents(found: np.ndarray, in_view: np.ndarray, dots: tuple[int, int]) -> tuple[Extent, Extent] | None:
    """Find the columns and rows that hold dots.

    Parameters
    ----------
    found : ndarray of bool, shape (plane, rows + 2 MARGIN, columns + 2 MARGIN)
        Lattice sites where a dot was found.
    in_view : ndarray of bool, same shape
        Sites whose dot would be fully in view.
    dots : (int, int)
        Stated columns and rows.

    Returns
    -------
    (Extent, Extent) or None
        Extents of the columns and of the rows; None where too few dots are in view.
    """
    found = found & in_view
    columns = _extent(found, in_view, dots[0])
    rows = _extent(found.swapaxes(1, 2), in_view.swapaxes(1, 2), dots[1])
    return None if columns is None or rows is None else (columns, rows)


def require_stated(extents: tuple[Extent, Extent], found: np.ndarray, apart: float = np.inf) -> None:
    """Refuse a board that is certainly larger or smaller than stated.

    Parameters
    ----------
    extents : (Extent, Extent)
        From `find_extents`.
    found : ndarray of bool, shape (plane, rows + 2 MARGIN, columns + 2 MARGIN)
        As of `find_extents`.
    apart : float
        Least distance of neighbouring dots as the camera sees them [microlens].

    Raises
    ------
    InputError
        Names the columns and rows that each plane shows, and what to set; of dots too near each other, their distance.
    """
    if all(extent.fits for extent in extents):
        return
    columns, rows = (extent.stated if extent.fits else extent.count for extent in extents)
    stated = " x ".join(str(extent.stated) for extent in extents)
    seen = " and ".join(
        f"{extent.count}{'' if extent.starts and extent.ends else ' or more'} {name}"
        for extent, name in zip(extents, ("columns", "rows"), strict=True)
        if not extent.fits
    )
    if apart < LENSES_APART:
        raise InputError(
            f"board.spacing_mm: expected dots at least {LENSES_APART:g} microlenses apart as the camera sees them, "
            f"found {apart:.1f}: it sees the board at so flat an angle, or with so coarse lenses, that a dot is not "
            f"told from the next, and {seen} seem to be there ({_per_plane(found)}). Use a board with a larger spacing."
        )
    turned = [columns, rows] == [extent.stated for extent in reversed(extents)]
    remedy = "turn this camera's pictures by 90 degrees if other cameras see them so" if turned else "uncover its edge"
    raise InputError(
        f"board.dots: expected the {stated} dots stated (columns x rows), found {seen}, and no dots beyond them where "
        f"the camera would see some ({_per_plane(found)}). Set dots = [{columns}, {rows}], or {remedy}: all dots get "
        "wrong names if their stated number is wrong."
    )


def _extent(found: np.ndarray, in_view: np.ndarray, stated: int) -> Extent | None:
    """Find the extent along the last axis from the lines across it that hold dots."""
    lines = np.stack([_occupied(counts) for counts in found.sum(2)])[:, :, None]
    seen, sites = (found & lines).sum((0, 1)), (in_view & lines).sum((0, 1))
    known = sites >= FEWEST_SITES
    share = np.divide(seen, sites, out=np.zeros(len(seen)), where=known)
    if not share.any():
        return None
    share /= np.median(share[share > EMPTY * share.max()])
    occupied = np.flatnonzero(known & (share >= OCCUPIED))
    first, last = occupied[0], occupied[-1]
    empty = known & (share < EMPTY)
    return Extent(
        stated=stated,
        first=int(first) - MARGIN,
        last=int(last) - MARGIN,
        starts=bool(first > 0 and empty[first - 1]),
        ends=bool(last < len(share) - 1 and empty[last + 1]),
    )


def _occupied(counts: np.ndarray) -> np.ndarray:
    """Return the lines of one plane that hold about as many dots as the typical one, bool."""
    typical = np.median(counts[counts > 0]) if (counts > 0).any() else np.inf
    return counts >= OCCUPIED * typical


def _per_plane(found: np.ndarray) -> str:
    """Return columns and rows of each plane in words: ``planes 0-3: 7 x 7, plane 4: 6 x 7``."""
    sizes = [" x ".join(str(_occupied(plane.sum(axis)).sum()) for axis in (0, 1)) for plane in found]
    words, plane = [], 0
    for size, group in groupby(sizes):
        last = plane + len(list(group)) - 1
        words.append(f"plane {plane}: {size}" if last == plane else f"planes {plane}-{last}: {size}")
        plane = last + 1
    return ", ".join(words)
