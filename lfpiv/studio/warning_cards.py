"""Cards of warnings: what is wrong, what to do, the image in which it is seen, and the page that says more."""

from __future__ import annotations

import html
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt  # which rich brings

import lfpiv
from lfpiv.warn import SENTENCES, Code

WHITE = ("aperture", "lens_pitch", "white_saturated", "lenses_unlit", "lenses_distorted", "lenses_irregular")
"""Codes of what is seen in the white image."""
BOARD = ("board", "dot", "plane", "turned", "magnified", "medium", "mapping", "pupil")
"""First letters of codes of what is seen in images of the board."""
FIGURE = re.compile(r"\{[^}]*\}")
"""Place of a figure in a sentence."""
PARTS = re.compile(r"((?:\([^)]*\)|.)*?(?:[;.] |: (?=check|look)|$))(.*)", re.DOTALL)
"""What a sentence says, up to the first stop outside brackets, and what to do."""

REGION = ("left", "top", "right", "bottom")


def card(record: Mapping[str, Any], cameras: Sequence[str]) -> dict[str, Any]:
    """Return the card of a stored warning, or of one of a log, which has its ``text`` alone.

    A stored warning also has ``code``, ``subject``, ``figures``, ``pairs`` and ``instants``. The card has ``what``,
    ``remedy``, ``code``, ``link``, and ``place``: camera, image and region [pixel] if known.
    """
    text = str(record["text"])
    code = str(record.get("code") or _code_of(text))
    what, remedy = PARTS.findall(text)[0]
    figures, named = record.get("figures") or {}, str(record.get("subject") or text)
    camera = next((name for name in cameras if re.match(rf"{re.escape(name)}([,:]|$)", named)), "")
    region = [int(figures[name]) for name in REGION] if all(name in figures for name in REGION) else []
    place = {"camera": camera, "image": _image(code, text, record), "region": region} if camera else None
    link = f"pages/troubleshooting#{code}"
    return {"what": what.rstrip(" ;:"), "remedy": remedy, "code": code, "place": place, "link": link}


def _code_of(text: str) -> str:
    """Return the code of the warning that says a text, or "" where none does."""
    for code, sentence in SENTENCES.items():
        pattern = ".*".join(map(re.escape, FIGURE.split(sentence)))
        if code is not Code.OTHER and re.search(f"{pattern}$", text, re.DOTALL):
            return str(code.value)
    return ""


def _image(code: str, text: str, record: Mapping[str, Any]) -> str:
    """Return the name of the image in which a warning is seen, "" where it is not known."""
    if code in WHITE:
        return "white"
    if code.startswith(BOARD):
        return next(iter(re.findall(r"\bplane \d+", text)), "plane 0")
    frame = re.match(r"[^:]*?, (frame \w+|instant \d+|plane \d+|white)\b", str(record.get("subject") or text))
    pair = next(iter(record.get("pairs") or re.findall(r"\bpairs? (\d+)", text)), None)
    if frame is not None and not frame[1].startswith("frame"):
        return frame[1]
    return "" if pair is None else f"pair {pair}, {frame[1] if frame is not None else 'frame a'}"


def page(name: str) -> str | None:
    """Return a page of the documentation as HTML; None where there is none of this name."""
    folders = (Path(lfpiv.__file__).parent.parent / "docs", Path(sys.prefix) / "share" / "doc" / "lfpiv")
    file = next((path for folder in folders if (path := folder / f"{name}.md").is_file()), None)
    if file is None or not name.isidentifier():
        return None
    text = file.read_text("utf-8").replace("```{warning-list}\n```", "@")
    body = MarkdownIt("commonmark", {"html": False}).enable("table").render(text)
    body = re.sub(r'href="(\w+)\.md', r'href="\1', body)
    listed = "".join(
        f'<dt id="{code.value}"><code>{code.value}</code></dt><dd>{html.escape(FIGURE.sub("...", sentence))}</dd>'
        for code, sentence in SENTENCES.items()
        if code is not Code.OTHER
    )
    head = (
        f'<meta charset="utf-8"><link rel="stylesheet" href="../lfpiv_studio/studio.css"><title>lfpiv: {name}</title>'
    )
    body = body.replace("<p>@</p>", f"<dl>{listed}</dl>")
    return f'<!doctype html><html lang="en">{head}<body class="lf-doc">{body}'
