"""`write_report`: one self-contained HTML page for people, its pictures, data and scripts inside.

The page opens without a network. Its size and the time it takes are bounded however many pairs a run has: charts over
pairs are drawn from the summary, `fields.MOST_READ` vector files are read at most. Views that move are drawn by the
scripts beside this file; still pictures stand in where scripts or WebGL are missing, and in print.
"""

from __future__ import annotations

import base64
import gzip
import importlib.resources
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lfpiv import files
from lfpiv.experiment.experiment import Experiment
from lfpiv.report import calibration as calibration_section
from lfpiv.report import markup, overview, pairs, volumes
from lfpiv.report import vectors as vector_section

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration

__all__ = ["write_report"]

_SCRIPTS = ("fields.js", "slices.js", "space.js", "page.js")


def write_report(
    experiment: Experiment,
    calibration: Calibration,
    summary: Mapping[str, Any],
    vectors: Mapping[int, Path],
    path: Path,
) -> None:
    """Write the report of a run.

    Parameters
    ----------
    experiment : Experiment
        What was run; its white and board images are shown.
    calibration : Calibration
        The calibration that was used.
    summary : dict
        The content of ``summary.json``; ``failed``, a list of ``{"pair": int, "reason": str}``, may be missing.
    vectors : dict
        Pair -> file of its vectors; a sample of them is read.
    path : Path
        Target; written whole or not at all.

    Raises
    ------
    InputError
        If an image or a file of vectors that is shown cannot be read.
    """
    sections = {
        "run": overview.what_was_run(experiment, summary),
        "calibration": calibration_section.section(experiment, calibration, summary),
        "volumes": volumes.section(summary, vectors) if vectors else "",
        "vectors": vector_section.section(vectors),
        "pairs": pairs.section(summary) if summary["pairs"] else "",
        "time": overview.timings(summary),
        "settings": overview.small_print(summary),
    }
    body = [
        overview.head(experiment, summary),
        overview.warnings(summary),
        overview.contents(sections),
        *sections.values(),
    ]
    scripts = "\n".join(_asset(name) for name in _SCRIPTS)
    files.write_text(
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{markup.escape(experiment.name)}: light-field PIV</title>"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,">'
        f"<style>{_asset('report.css')}</style></head><body><main>\n"
        + "\n".join(body)
        + f"\n</main>\n{_plotly() if vectors else ''}<script>\n{scripts}</script></body></html>\n",
        path,
    )


def _asset(name: str) -> str:
    """Text of a file beside this module."""
    return (importlib.resources.files("lfpiv.report") / "static" / name).read_text("utf-8")


def _plotly() -> str:
    """Pack the library that draws in space; the script that needs it unpacks it."""
    from plotly.offline import get_plotlyjs

    packed = base64.b64encode(gzip.compress(get_plotlyjs().encode(), 6, mtime=0)).decode()
    return f'<script type="text/plain" id="plotly-source">{packed}</script>\n'
