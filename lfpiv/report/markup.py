"""Build the report's HTML: figures with tables of their numbers, paragraphs, formatted numbers. Escape all texts."""

from __future__ import annotations

import html
import importlib.resources
from collections.abc import Iterable, Sequence

import numpy as np

from lfpiv.quantities import UNKNOWN as NONE
from lfpiv.quantities import significant

__all__ = [
    "NONE",
    "asset",
    "details",
    "escape",
    "facts",
    "figure",
    "general",
    "number",
    "page",
    "paragraph",
    "percent",
    "significant",
    "table",
]


def page(title: str, body: Iterable[str], scripts: str = "") -> str:
    """Return a whole page that needs no other file, with `scripts` behind its text."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
        f"<style>{asset('report.css')}</style></head><body><main>\n"
        + "\n".join(body)
        + f"\n</main>{scripts}</body></html>\n"
    )


def asset(name: str) -> str:
    """Return the text of a file in ``static``."""
    return (importlib.resources.files("lfpiv.report") / "static" / name).read_text("utf-8")


def figure(panels: Sequence[str], caption: str, numbers: str = "", *, title: str = "Numbers") -> str:
    """Return a figure of SVG panels with its caption and a folded table of its numbers."""
    folded = details(title, numbers) if numbers else ""
    return (
        f'<figure><div class="panels">{"".join(panels)}</div><figcaption>{html.escape(caption)}</figcaption>'
        f"{folded}</figure>"
    )


def table(titles: Sequence[str], rows: Iterable[Sequence[str]], *, caption: str, words: bool = False) -> str:
    """Return a table whose first column names the rows. The other cells are numbers, or texts if `words`.

    `caption` is hidden on screen and read aloud by screen readers.
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
    """Return a list of names and texts."""
    body = "".join(f"<dt>{html.escape(name)}</dt><dd>{html.escape(text)}</dd>" for name, text in rows)
    return f'<dl class="facts">{body}</dl>'


def details(title: str, content: str, *, name: str = "") -> str:
    """Return HTML `content` folded under a line of text, with `name` as its identifier."""
    mark = f' id="{name}" class="fold"' if name else ""
    return f"<details{mark}><summary>{html.escape(title)}</summary>{content}</details>"


def paragraph(text: str, kind: str = "") -> str:
    """Return one paragraph of text, with `kind` as its CSS class."""
    mark = f' class="{kind}"' if kind else ""
    return f"<p{mark}>{html.escape(text)}</p>"


def escape(text: str) -> str:
    """Escape a text for HTML, quotes included."""
    return html.escape(text)


def number(value: float | None, digits: int) -> str:
    """Format a number with `digits` decimals."""
    if value is None or not np.isfinite(value):
        return NONE
    text = f"{value:.{digits}f}"
    return (text.lstrip("-") if float(text) == 0 else text).replace("-", "−")


def general(value: float) -> str:
    """Format a number of the experiment file as it is written there."""
    return f"{value:g}".replace("-", "−")


def percent(share: float | None, digits: int = 0) -> str:
    """Format a share in percent."""
    return NONE if share is None or not np.isfinite(share) else f"{100 * share:.{digits}f} %"
