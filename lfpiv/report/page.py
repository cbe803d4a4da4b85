"""Write the report of a run: one HTML page for people, with its pictures, data and scripts inside.

The page opens without a network. Its size and the time to write it are bounded for any number of pairs: charts over
pairs are drawn from the summary, and at most `fields.MOST_READ` vector files are read. The scripts in ``static`` draw
the interactive views. Still pictures replace them where scripts or WebGL are missing, and in print.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lfpiv import files
from lfpiv.experiment.experiment import Experiment
from lfpiv.report import background, known_flow, markup, overview, pairs, raw_image, tracks, volumes
from lfpiv.report import calibration as calibration_section
from lfpiv.report import vectors as vector_section
from lfpiv.report.summary import Summary

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration

__all__ = ["write_report"]

_SCRIPTS = (
    "fields.js",
    "drawing.js",
    "streamlines.js",
    "profile.js",
    "slices.js",
    "meshes.js",
    "space.js",
    "page.js",
)


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
        Experiment of the run. The report shows its white and board images.
    calibration : Calibration
        Calibration of the run.
    summary : dict
        Content of ``summary.json``. ``failed``, a list of ``{"pair": int, "reason": str}``, may be missing.
    vectors : dict
        Pair -> file of its vectors. A sample of the files is read.
    path : Path
        Target file, written completely or not at all.

    Raises
    ------
    InputError
        If an image or a file of vectors that the report shows cannot be read.
    pydantic.ValidationError
        If a figure of the summary is missing or has the wrong type.
    """
    figures = Summary.model_validate(summary)
    recording = experiment.recording
    every = pairs.section(figures.pairs, figures.failed, figures.pairs_finished, recording) if figures.pairs else ""
    raw = raw_image.figure(experiment, figures.pairs[0].number) if figures.pairs else ""
    sections = {
        "truth": known_flow.section(experiment, vectors),
        "vectors": vector_section.section(vectors, recording, figures.damping),
        "volumes": volumes.section(figures.pairs, vectors, recording) if vectors else "",
        "pairs": every + tracks.section(figures.tracks, path.parent) if figures.pairs else "",
        "run": overview.run_facts(experiment, figures) + raw,
        "calibration": calibration_section.section(experiment, calibration, figures.calibration),
        "background": background.section(experiment, calibration),
        "time": overview.timings(figures, recording.noun),
        "settings": overview.settings_and_versions(figures),
    }
    body = [
        overview.head(experiment),
        overview.warnings(figures, recording.noun),
        overview.verdict(experiment, figures),
        overview.contents(sections, recording.noun),
        *sections.values(),
    ]
    scripts = "\n".join(markup.asset(name) for name in _SCRIPTS)
    drawn = f"\n{_plotly() if vectors else ''}<script>\n{scripts}</script>"
    files.write_text(markup.page(f"{experiment.name}: light-field PIV", body, drawn), path)


def _plotly() -> str:
    """Return plotly.js, gzipped, in a script element that ``space.js`` unpacks."""
    from plotly.offline import get_plotlyjs

    packed = base64.b64encode(gzip.compress(get_plotlyjs().encode(), 6, mtime=0)).decode()
    return f'<script type="text/plain" id="plotly-source">{packed}</script>\n'
