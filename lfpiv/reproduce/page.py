"""Write the results of a study: ``reproduce.json``, PNGs, and a self-contained page."""

from __future__ import annotations

import base64
import json
import logging
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lfpiv import files
from lfpiv.quantities import duration
from lfpiv.report import markup

log = logging.getLogger(__name__)

SHOWN = ("comparison", "figures", "tables", "notes")
"""Keys of a case's result that the page shows; all others are its figures."""


def compare(
    what: str,
    ours: float | None,
    *,
    paper: float | str | None = None,
    at_most: float | None = None,
    at_least: float | None = None,
    unit: str = "",
) -> dict[str, Any]:
    """Return one row that compares our figure with the paper's and with a goal.

    Without `at_most` and `at_least` there is no goal, and ``reached`` is None.
    """
    goals, met = [], True
    if at_most is not None:
        goals.append(f"<= {at_most:g}")
        met = met and ours is not None and bool(ours <= at_most)
    if at_least is not None:
        goals.append(f">= {at_least:g}")
        met = met and ours is not None and bool(ours >= at_least)
    goal, reached = (", ".join(goals), met) if goals else (None, None)
    return {"what": what, "ours": ours, "paper": paper, "goal": goal, "reached": reached, "unit": unit}


def result(
    figures_of_merit: Mapping[str, Any],
    *,
    comparison: Sequence[Mapping[str, Any]],
    figures: Sequence[tuple[str, str]] = (),
    tables: Sequence[Mapping[str, Any]] = (),
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """Return a case's result in the form that the page shows.

    Parameters
    ----------
    figures_of_merit : mapping
        Content of ``reproduce.json`` under the case's key, such as ``{"ssim": 0.98}``.
    comparison : sequence of mapping
        Rows made by `compare`.
    figures : sequence of (str, str)
        Name of a PNG file in the case's work folder, and its caption. Names are unique over all cases, "fig10.png".
    tables : sequence of mapping
        Each with ``caption``, ``columns`` (list of str) and ``rows`` (list of lists: str, number or null).
    notes : sequence of str
        Sentences about the method and its limits.
    """
    taken = [key for key in figures_of_merit if key in (*SHOWN, "title", "time")]
    if taken:
        raise ValueError(f"figures_of_merit: expected other keys than those of the page, got {taken[0]!r}.")
    for table in tables:
        widths = {len(row) for row in table["rows"]} - {len(table["columns"])}
        if widths:
            raise ValueError(
                f"tables: expected rows of {len(table['columns'])} values as {table['caption'][:40]!r} has columns, "
                f"got {widths.pop()}."
            )
    return {
        **figures_of_merit,
        "comparison": [dict(row) for row in comparison],
        "figures": [{"file": name, "caption": caption} for name, caption in figures],
        "tables": [dict(table) for table in tables],
        "notes": list(notes),
    }


def write(out: Path, settings: Mapping[str, Any], title: str, about: str, keys: Sequence[str]) -> dict[str, Any]:
    """Write ``reproduce.json``, the PNGs and ``index.html`` from all finished cases in a folder; return the JSON.

    Parameters
    ----------
    out : Path
        Folder of the reproduction; finished cases are ``work/<key>/result.json``.
    settings : mapping
        Scale, seed and version of the run. Cases with other settings are left out.
    title, about : str
        Heading and subject of the page.
    keys : sequence of str
        Keys of all cases, in the page's order.
    """
    content: dict[str, Any] = dict(settings)
    for key in keys:
        path = out / "work" / key / "result.json"
        if not path.exists():
            continue
        stored = json.loads(path.read_text("utf-8"))
        if stored["settings"] != files.plain(settings):
            continue
        content[key] = stored["value"]
        for figure in content[key]["figures"]:
            shutil.copyfile(path.parent / figure["file"], out / f".{figure['file']}")
            (out / f".{figure['file']}").replace(out / figure["file"])
    files.write_json(content, out / "reproduce.json")
    files.write_text(_page(out, content, title, about, keys), out / "index.html")
    return content


ROUNDING = 1e-12
"""Magnitude below which a number is shown as 0."""

TERMS = {
    "pitch, voxel": "One microlens, and one voxel of 0.1 mm: as large as a microlens seen in the volume.",
    "ppm": "Particles per microlens of the volume's x-y face.",
    "network, DRT": "Rays by the trained network; by direct ray tracing through ideal thin lenses at stated angles.",
    "sigma_nor": "Mean distance of mapped from measured rays of dots that training did not see, in pitches (Eq. 8).",
    "Q": "Agreement of a reconstructed volume with the true particles, drawn as blobs: 1 is perfect.",
    "R_acc, R_g": "Part of the true particles that is found; particles found for each true one (Eqs. 13 and 14).",
    "error of vectors": "Mean length of the difference from the true displacement, in voxels, all vectors; along x, y, "
    "z its mean absolute components. z is the depth axis between the cameras.",
    "took": "Time of the run that finished the case. Time of earlier, interrupted runs is not included.",
    "goal": "Aim of this software. Some figures have none.",
}
"""Explanations of the words on the page."""


def _page(out: Path, content: Mapping[str, Any], title: str, about: str, keys: Sequence[str]) -> str:
    present = [key for key in keys if key in content]
    rows = [{"case": key, **row} for key in present for row in content[key]["comparison"]]
    judged = [row["reached"] for row in rows if row["reached"] is not None]
    missing = [key for key in keys if key not in content]
    links = "".join(f'<a href="#{key}">{markup.escape(content[key]["title"].partition(":")[0])}</a>' for key in present)
    return markup.page(
        f"lfpiv: {title}",
        [
            f"<h1>{markup.escape(title)}</h1>",
            f"<p>{markup.escape(about)}, computed by lfpiv {markup.escape(str(content['version']))} on simulated "
            f"images: scale <b>{content['scale']}</b>, seed {content['seed']}. {sum(judged)} of {len(judged)} goals "
            "reached. Cameras are calibrated from simulated images, volumes are reconstructed and measured. Only the "
            'simulator knows the truth. <a href="reproduce.json">reproduce.json</a> holds all figures.</p>',
            markup.paragraph(f"Not computed yet: {', '.join(missing)}.", "quiet") if missing else "",
            f'<nav aria-label="contents">{links}</nav>',
            markup.details("What the words mean", markup.facts(TERMS.items())),
            _comparison("all figures with a goal", [row for row in rows if row["goal"]]) if judged else "",
            *(_section(out, key, content[key]) for key in present),
        ],
    )


def _section(out: Path, key: str, case: Mapping[str, Any]) -> str:
    spent = f"took {duration(case['time']['wall_s'])}, {duration(case['time']['cpu_s'])} of processor time"
    parts = [f'<h2 id="{key}">{markup.escape(case["title"])}</h2>', markup.paragraph(f"{key}; {spent}.", "quiet")]
    if case["comparison"]:
        parts.append(_comparison(f"figures of {key}", case["comparison"]))
    for figure in case["figures"]:
        caption = markup.escape(figure["caption"])
        image = base64.b64encode((out / figure["file"]).read_bytes()).decode("ascii")
        parts.append(
            f'<figure><div class="scroll"><img style="max-width: max(100%, 44rem); background: #fff" alt="{caption}" '
            f'src="data:image/png;base64,{image}"></div><figcaption>{caption}</figcaption></figure>'
        )
    for table in case["tables"]:
        parts.append(f'<p class="caption">{markup.escape(table["caption"])}</p>')
        rows = ([_text(value) for value in row] for row in table["rows"])
        parts.append(markup.table(table["columns"], rows, caption=table["caption"]))
    notes = "".join(f"<li>{markup.escape(note)}</li>" for note in case["notes"])
    return "\n".join([*parts, f"<ul>{notes}</ul>" if notes else ""])


def _comparison(caption: str, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a table of rows made by `compare`; those of several cases begin with the name of their case."""
    shown = [name for name in ("paper", "goal") if any(row[name] is not None for row in rows)]
    met = {None: "", True: "✓\u00a0yes", False: "✗\u00a0no"}
    body = []
    for row in rows:
        what = (
            (f"{row['case']}: " if "case" in row else "") + row["what"] + (f" [{row['unit']}]" if row["unit"] else "")
        )
        figures = [_text(row[name]).replace("<= ", "≤\u00a0").replace(">= ", "≥\u00a0") for name in ("ours", *shown)]
        body.append([what, *figures, *([met[row["reached"]]] if "goal" in shown else [])])
    return markup.table(["", "ours", *shown, *(["met"] if "goal" in shown else [])], body, caption=caption)


def _text(value: Any) -> str:
    if value is None:
        return markup.NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float) and abs(value) < ROUNDING:
        return "0"
    if isinstance(value, float):
        return f"{value:.{4 if abs(value) >= 0.1 else 3}g}" if abs(value) < 1e5 else f"{value:.3e}"
    return str(value)
