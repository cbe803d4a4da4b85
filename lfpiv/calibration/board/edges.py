"""The outline of a board as a camera sees it, held against the stated one: it names the dots, or refuses to.

Dots look alike, so only the board's edges tell one column from the next. An edge is seen where the lattice goes on in
the camera's view but no dots do. Two edges that enclose another number of columns than stated mean that the board, or a
part of it, is not what was stated: the middle of the board, and with it the names, would then be off by half a spacing
or more, and not alike in all cameras. One edge, the other one outside the view, names the dots by itself. Where no edge
is in view the names rest on the nominal axis of the camera alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from lfpiv.errors import InputError

MARGIN = 2
"""Places around the stated board that are looked at: a board stated too small by two columns is still told."""
FEWEST_PLACES = 3
"""Places of a column that must be in view, over all planes, to say that its dots are there or not."""
OCCUPIED, EMPTY = 0.5, 0.2
"""Share of its places with a dot, relative to the typical column, above which a column is on the board and below which
it is not; dirt, reflections and noise leave the share of real columns above 0.9, of others below 0.1."""


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
    """Whether the view goes on before the first column, so that it is the board's edge."""
    ends: bool
    """Whether the view goes on behind the last column."""

    @property
    def count(self) -> int:
        """Columns with dots."""
        return self.last - self.first + 1

    @property
    def fits(self) -> bool:
        """Whether the stated number can be right."""
        return self.count == self.stated if self.starts and self.ends else self.count <= self.stated or self.open

    @property
    def open(self) -> bool:
        """Whether no edge is in view."""
        return not (self.starts or self.ends)

    @property
    def shift(self) -> int:
        """By how much the names are off."""
        if self.starts:
            return self.first
        return self.last - (self.stated - 1) if self.ends else 0


def outline(found: np.ndarray, in_view: np.ndarray, dots: tuple[int, int]) -> tuple[Extent, Extent] | None:
    """Columns and rows that hold dots.

    Parameters
    ----------
    found : ndarray of bool, shape (plane, rows + 2 MARGIN, columns + 2 MARGIN)
        Places of the lattice where a dot was found.
    in_view : ndarray of bool, same shape
        Places whose dot would be seen wholly.
    dots : (int, int)
        Stated columns and rows.

    Returns
    -------
    (Extent, Extent) or None
        Of the columns and of the rows; None where too few dots are in view to tell.
    """
    found = found & in_view
    columns = _extent(found, in_view, dots[0])
    rows = _extent(found.swapaxes(1, 2), in_view.swapaxes(1, 2), dots[1])
    return None if columns is None or rows is None else (columns, rows)


def require_stated(extents: tuple[Extent, Extent], found: np.ndarray) -> None:
    """Refuse a board that is certainly larger or smaller than stated.

    Raises
    ------
    InputError
        Says which planes show how many columns and rows, and what to set.
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
    raise InputError(
        f"board.dots: expected the {stated} dots stated (columns x rows), found {seen}, and no dots beyond them where "
        f"the camera would see some ({_per_plane(found)}). Set dots = [{columns}, {rows}], or uncover the board's "
        "edge: with another number of dots than there are all of them get wrong names."
    )


def _extent(found: np.ndarray, in_view: np.ndarray, stated: int) -> Extent | None:
    """Extent along the last axis, from the lines across it that hold dots in a plane."""
    across = found.sum(2)  # dots per plane and line across
    usual = np.array([np.median(counts[counts > 0]) if (counts > 0).any() else np.inf for counts in across])
    lines = (across >= OCCUPIED * usual[:, None])[:, :, None]
    seen, places = (found & lines).sum((0, 1)), (in_view & lines).sum((0, 1))
    known = places >= FEWEST_PLACES
    share = np.divide(seen, places, out=np.zeros(len(seen)), where=known)
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


def _per_plane(found: np.ndarray) -> str:
    """Columns and rows of each plane in words: ``planes 0-3: 7 x 7, plane 4: 6 x 7``."""
    sizes = []
    for plane in found:
        counts = [plane.sum(axis) for axis in (0, 1)]
        usual = [np.median(count[count > 0]) if (count > 0).any() else np.inf for count in counts]
        sizes.append(" x ".join(str((c >= OCCUPIED * u).sum()) for c, u in zip(counts, usual, strict=True)))
    words, plane = [], 0
    for size, group in groupby(sizes):
        last = plane + len(list(group)) - 1
        words.append(f"plane {plane}: {size}" if last == plane else f"planes {plane}-{last}: {size}")
        plane = last + 1
    return ", ".join(words)


def numbered(places: Sequence[np.ndarray], dots: tuple[int, int]) -> np.ndarray:
    """Places found in each plane as a bool array of shape (plane, rows + 2 MARGIN, columns + 2 MARGIN)."""
    columns, rows = (n + 2 * MARGIN for n in dots)
    grid = np.zeros((len(places), rows * columns), bool)
    for plane, place in enumerate(places):
        grid[plane, place] = True
    return grid.reshape(len(places), rows, columns)
