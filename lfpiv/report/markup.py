"""Pieces of the report's HTML: figures with their numbers, tables, words for numbers. Every text is escaped here."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

import numpy as np

NONE = "–"
"""Stands for a number that is not known."""


def figure(panels: Sequence[str], caption: str, numbers: str = "", *, title: str = "Numbers") -> str:
    """Figure of SVG panels with its caption, and the table of its numbers folded away."""
    folded = details(title, numbers) if numbers else ""
    return (
        f'<figure><div class="panels">{"".join(panels)}</div><figcaption>{html.escape(caption)}</figcaption>'
        f"{folded}</figure>"
    )


def table(titles: Sequence[str], rows: Iterable[Sequence[str]], *, caption: str, words: bool = False) -> str:
    """Table whose first column names its rows, the others being numbers unless they are `words`.

    `caption` says what it holds to those who do not see the page.
    """
    mark = ' class="words"' if words else ""
    head = "".join(f'<th scope="col">{html.escape(title)}</th>' for title in titles)
    body = "".join(
        f'<tr><th scope="row">{html.escape(row[0])}</th>'
        + "".join(f"<td>{html.escape(cell)}</td>" for cell in row[1:])
        + "</tr>"
        for row in rows
    )
    return (
        f'<div class="scroll"><table{mark}><caption class="unseen">{html.escape(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def facts(rows: Iterable[tuple[str, str]]) -> str:
    """Names and what is said of each, as text."""
    body = "".join(f"<dt>{html.escape(name)}</dt><dd>{html.escape(text)}</dd>" for name, text in rows)
    return f'<dl class="facts">{body}</dl>'


def details(title: str, content: str) -> str:
    """Content under a line that opens it; `content` is HTML."""
    return f"<details><summary>{html.escape(title)}</summary>{content}</details>"


def paragraph(text: str, kind: str = "") -> str:
    """One paragraph of text."""
    mark = f' class="{kind}"' if kind else ""
    return f"<p{mark}>{html.escape(text)}</p>"


def escape(text: str) -> str:
    """Text for HTML, quotes included."""
    return html.escape(text)


def number(value: float | None, digits: int) -> str:
    """Put a number with so many decimals."""
    return NONE if value is None or not np.isfinite(value) else f"{value:.{digits}f}".replace("-", "−")


def significant(value: float | None, digits: int = 3) -> str:
    """Put a number with so many significant digits."""
    if value is None or not np.isfinite(value):
        return NONE
    rounded = float(f"{value:.{digits}g}")
    if rounded == 0 or 1e-4 <= abs(rounded) < 1e6:
        return np.format_float_positional(rounded, trim="-").replace("-", "−")
    mantissa, _, power = f"{rounded:.{digits - 1}e}".partition("e")
    mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
    return f"{mantissa}e{int(power)}".replace("-", "−")


def general(value: float) -> str:
    """Put a number that a person chose as that person wrote it."""
    return f"{value:g}".replace("-", "−")


def percent(share: float | None, digits: int = 0) -> str:
    """Put a share in percent."""
    return NONE if share is None or not np.isfinite(share) else f"{100 * share:.{digits}f} %"


def count(value: int, noun: str) -> str:
    """Put a count and its noun: 1 pair, 5,000 pairs."""
    return f"{value:,} {noun}{'' if value == 1 else 's'}"
