"""Cards: what matters of a value, as text and as HTML, for people at a prompt or in a notebook."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

from lfpiv.quantities import quantity, scale_of


@dataclass(frozen=True)
class Card:
    """A title, named facts, and a table with a row per camera or the like."""

    title: str
    facts: tuple[tuple[str, str], ...] = ()
    """Name and value of each fact."""
    table: tuple[tuple[str, ...], ...] = ()
    """Rows of texts of the same number; the first one is the header."""

    def text(self) -> str:
        """Return the card as lines of text."""
        width = max((len(name) for name, _ in self.facts), default=0)
        lines = [self.title, *(f"  {name.ljust(width)}  {value}" for name, value in self.facts)]
        widths = [max(map(len, column)) for column in zip(*self.table, strict=True)]
        for row in self.table:
            lines.append("  " + "  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip())
        return "\n".join(lines)

    def html(self) -> str:
        """Return the card as HTML that takes its style from the notebook."""
        parts = [f"<div><strong>{html.escape(self.title)}</strong>"]
        if self.facts:
            parts.append(_rows([f"<th>{html.escape(n)}</th><td>{html.escape(v)}</td>" for n, v in self.facts]))
        if self.table:
            head, *rows = ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in self.table]
            parts.append(_rows([head.replace("td>", "th>"), *rows]))
        return "".join([*parts, "</div>"])


def _rows(rows: Sequence[str]) -> str:
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"


class Shown:
    """Base of values that a prompt shows as a card. A dataclass must be made with ``repr=False``."""

    def card(self) -> Card:
        """Return what matters of the value."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return self.card().text()

    def _repr_html_(self) -> str:
        return self.card().html()


def seconds(value: float) -> str:
    """Return a time [s] in the unit that people use for it.

    Examples
    --------
    >>> seconds(5e-05), seconds(0.002), seconds(3.0)
    ('50 us', '2 ms', '3 s')
    """
    scale = scale_of(value, "s")
    return f"{value * scale.factor:.4g} {scale.unit.replace('µ', 'u')}"  # plain letters, for any terminal


def movement(moved_voxel: float, voxel_mm: float, dt_s: float) -> str:
    """Return a displacement in voxels as length and speed, in the units that people use.

    Examples
    --------
    >>> movement(2.34, 0.1, 1e-4)
    '2.34 voxel = 234 um in 100 us, 2.34 m/s'
    """
    metres = moved_voxel * voxel_mm / 1000
    text = f"{moved_voxel:.3g} voxel = {quantity(metres, 'm')} in {seconds(dt_s)}, {quantity(metres / dt_s, 'm/s')}"
    return text.replace("µ", "u")  # plain letters, for any terminal


def times(values: Sequence[float]) -> str:
    """Return numbers with a sign of multiplication between them."""
    return " x ".join(f"{value:.4g}" for value in values)


def number(value: float, digits: str = ".3g") -> str:
    """Return a number, or a dash where it is not known."""
    return "-" if not math.isfinite(value) else f"{value:{digits}}"


def count(size: int, noun: str) -> str:
    """Return a number with its noun: 1 pair, 5,000 pairs."""
    return f"{size:,} {noun}{'' if size == 1 else 's'}"
