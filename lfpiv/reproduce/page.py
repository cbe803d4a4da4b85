"""Write the results of a study: ``reproduce.json``, PNGs, and a self-contained page."""

from __future__ import annotations

import base64
import html
import json
import logging
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lfpiv import files

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

STYLE = """
:root { --ink: #1d2329; --dim: #5c6670; --line: #d9dee3; --paper: #fff; --good: #1f7a4d; --bad: #b3431e; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e9ec; --dim: #a0a9b2; --line: #3a4249; --paper: #15191d; --good: #58c58f; --bad: #f0906a; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 62rem; color: var(--ink); background: var(--paper);
  font: 1rem/1.5 system-ui, sans-serif; }
h1 { font-size: 1.5rem; line-height: 1.25; margin: .5rem 0; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .4rem; padding-top: .8rem; border-top: 1px solid var(--line); }
p, li, figcaption, dd { max-width: 44rem; }
.dim, figcaption, .caption { color: var(--dim); font-size: .9rem; }
.caption { margin: 1.1rem 0 .2rem; }
nav { font-size: .9rem; margin: 1rem 0; }
nav ul { margin: .2rem 0; padding-left: 1.1rem; }
details { margin: 1rem 0; } summary { cursor: pointer; }
dl { font-size: .9rem; margin: .5rem 0; } dt { font-weight: 600; } dd { margin: 0 0 .4rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .9rem; margin: .4rem 0 .6rem; }
th, td { text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { font-weight: 600; }
td:first-child:not(.number, .case) { min-width: 7rem; }
td.what { min-width: 11rem; }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
th.number { text-align: right; }
.yes { color: var(--good); font-weight: 600; } .no { color: var(--bad); font-weight: 600; }
figure { margin: 1rem 0; }
figure img { max-width: 100%; height: auto; background: #fff; display: block; }
@media (max-width: 40rem) { body { padding: .7rem; } table { font-size: .8rem; } th, td { padding-right: .45rem; }
  td.what, td:first-child:not(.number, .case) { min-width: 6.5rem; }
  figure img { max-width: none; width: 44rem; } }
"""


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
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        f"<p>{html.escape(about)}, computed by lfpiv "
        f"{html.escape(str(content['version']))} on simulated images: scale <b>{content['scale']}</b>, seed "
        f"{content['seed']}. {sum(judged)} of {len(judged)} goals reached. Cameras are calibrated from simulated "
        "images, volumes are reconstructed and measured. Only the simulator knows the truth. "
        "<a href='reproduce.json'>reproduce.json</a> holds all figures.</p>",
    ]
    if missing:
        parts.append(f"<p class='dim'>Not computed yet: {', '.join(missing)}.</p>")
    links = "".join(f"<li><a href='#{key}'>{html.escape(content[key]['title'])}</a></li>" for key in present)
    parts.append(f"<nav aria-label='contents'><ul>{links}</ul></nav>")
    terms = "".join(f"<dt>{html.escape(word)}</dt><dd>{html.escape(text)}</dd>" for word, text in TERMS.items())
    parts.append(f"<details><summary>What the words mean</summary><dl>{terms}</dl></details>")
    parts += [_comparison([row for row in rows if row["goal"]], cases=True)] if judged else []
    parts += [_section(out, key, content[key]) for key in present]
    return (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        f"<title>lfpiv: {html.escape(title)}</title><style>{STYLE}</style></head><body>\n"
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _section(out: Path, key: str, case: Mapping[str, Any]) -> str:
    seconds = case["time"]
    parts = [
        f"<h2 id='{key}'>{html.escape(case['title'])}</h2>",
        f"<p class='dim'>{key}; took {_duration(seconds['wall_s'])}, {_duration(seconds['cpu_s'])} of processor "
        "time.</p>",
        _comparison(case["comparison"]) if case["comparison"] else "",
    ]
    for figure in case["figures"]:
        caption = html.escape(figure["caption"])
        image = base64.b64encode((out / figure["file"]).read_bytes()).decode("ascii")
        parts.append(
            f"<figure><div class='scroll'><img alt='{html.escape(figure['caption'], quote=True)}' "
            f"src='data:image/png;base64,{image}'></div><figcaption>{caption}</figcaption></figure>"
        )
    parts += [_table(table["caption"], table["columns"], table["rows"]) for table in case["tables"]]
    if case["notes"]:
        parts.append("<ul>" + "".join(f"<li>{html.escape(note)}</li>" for note in case["notes"]) + "</ul>")
    return "\n".join(parts)


def _comparison(rows: Sequence[Mapping[str, Any]], *, cases: bool = False) -> str:
    shown = [name for name in ("paper", "goal") if any(row[name] is not None for row in rows)]
    columns = (["case"] if cases else []) + ["what", "ours", *shown] + (["met"] if "goal" in shown else [])
    body = []
    for row in rows:
        unit = f" [{row['unit']}]" if row["unit"] else ""
        verdict = {None: "", True: "<span class='yes'>yes</span>", False: "<span class='no'>no</span>"}[row["reached"]]
        cells = [f"<td class='case'><a href='#{row['case']}'>{row['case']}</a></td>"] if cases else []
        cells.append(f"<td class='what'>{html.escape(row['what'] + unit)}</td>")
        figures = [_text(row[name]).replace("&lt;=", "≤").replace("&gt;=", "≥") for name in ("ours", *shown)]
        cells += [f"<td class='number'>{figure}</td>" for figure in figures]
        cells += [f"<td>{verdict}</td>"] if "goal" in shown else []
        body.append(f"<tr>{''.join(cells)}</tr>")
    heads = "".join(
        f"<th{' class=number' if name in ('ours', 'paper', 'goal') else ''}>{name}</th>" for name in columns
    )
    return f"<div class='scroll'><table><thead><tr>{heads}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"


def _table(caption: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    numeric = [all(not isinstance(row[k], str) for row in rows) for k in range(len(columns))]
    mark = [" class='number'" if number else "" for number in numeric]
    head = "".join(f"<th{mark[k]}>{html.escape(name)}</th>" for k, name in enumerate(columns))
    body = "".join(
        "<tr>" + "".join(f"<td{mark[k]}>{_text(value)}</td>" for k, value in enumerate(row)) + "</tr>" for row in rows
    )
    return (
        f"<p class='caption'>{html.escape(caption)}</p><div class='scroll'>"
        f"<table aria-label='{html.escape(caption, quote=True)}'><thead><tr>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table></div>"
    )


def _text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float) and abs(value) < ROUNDING:
        return "0"
    if isinstance(value, float):
        return f"{value:.{4 if abs(value) >= 0.1 else 3}g}" if abs(value) < 1e5 else f"{value:.3e}"
    return html.escape(str(value))


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
