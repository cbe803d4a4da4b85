"""Command `lfpiv benchmark score`: figures of merit of anybody's vectors on a data set with known truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from lfpiv.cli import terminal
from lfpiv.errors import InputError

if TYPE_CHECKING:
    from lfpiv.benchmark.score import Score

EXAMPLES = (
    "lfpiv benchmark score base results",
    "lfpiv benchmark score base mine.nc theirs.csv --truth truth/base --out score.html",
    "lfpiv benchmark score base table.csv --unit position=mm --unit velocity=m/s --window-mm 1.2",
)
WIDEST = 24
"""Most characters of a label in the table."""
ENDINGS = (".html", ".json")
"""Endings of files that are written."""


def score(
    data: Annotated[Path, typer.Argument(metavar="DIR", help="The data set: what `lfpiv benchmark make` wrote.")],
    results: Annotated[
        list[Path],
        typer.Argument(
            metavar="RESULT",
            help="NetCDF file, table (CSV), folder of either with a file per pair, or output folder of a run. Several "
            "are compared.",
        ),
    ],
    truth: Annotated[
        Path | None, typer.Option("--truth", metavar="DIR2", help="Folder of the truth; default: DIR/truth.")
    ] = None,
    volumes: Annotated[
        Path | None, typer.Option("--volumes", metavar="FILE", help="Reconstructed volume, or a folder of them, for Q.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="Write a page (.html) or all figures (.json).")
    ] = None,
    window_mm: Annotated[
        str,
        typer.Option(
            "--window-mm",
            metavar="X[,Y,Z]",
            help="Edges of the interrogation window, over which the truth is averaged; default: as the file states.",
        ),
    ] = "",
    name: Annotated[
        list[str] | None,
        typer.Option(
            "--name", metavar="ROLE=NAME", help="Variable or column of x, y, z, u, v, w, dx, ..., valid, pair."
        ),
    ] = None,
    unit: Annotated[
        list[str] | None,
        typer.Option("--unit", metavar="WHAT=UNIT", help="Unit of position, velocity, displacement or uncertainty."),
    ] = None,
    kind: Annotated[
        Literal["auto", "vectors", "particles"],
        typer.Option("--kind", help="What the vectors are; auto: particles where they lie on no lattice."),
    ] = "auto",
    pairs: Annotated[
        str, typer.Option("--pairs", metavar="A:B", help="Score pairs or instants A to B - 1 only.")
    ] = ":",
    number: Annotated[
        int | None, typer.Option("--number", metavar="N", help="Pair of a file that does not state it.")
    ] = None,
    outlier: Annotated[
        float,
        typer.Option("--outlier", metavar="VOXEL", help="Length of the error above which a vector is an outlier."),
    ] = 1.0,
    seconds: Annotated[
        float | None, typer.Option("--seconds", metavar="S", help="Computing time of a pair; default: as stated.")
    ] = None,
    label: Annotated[
        list[str] | None, typer.Option("--label", metavar="TEXT", help="Name of a result, one for each.")
    ] = None,
) -> None:
    """Score vectors of any program against the truth: errors, slopes, outliers, completeness, uncertainty, time.

    What has no vector counts as not measured, so leaving out difficult vectors does not help. The page of the benchmark
    defines every figure.
    """
    if out is not None and out.suffix.lower() not in ENDINGS:
        raise InputError(f"--out {out}: expected a file that ends in {' or '.join(ENDINGS)}.")
    if out is not None and (not out.parent.is_dir() or out.is_dir()):
        obstacle = "a folder of that name" if out.is_dir() else f"no folder {out.parent}. Make it first"
        raise InputError(f"--out {out}: expected a file in a folder that exists, found {obstacle}.")
    selected = terminal.parse_pairs(pairs)
    with terminal.OUTPUT.progress() as progress:
        from lfpiv.benchmark import page
        from lfpiv.benchmark.readers import ReadOptions
        from lfpiv.benchmark.score import ScoreOptions, report, score_results
        from lfpiv.benchmark.truth import open_truth
        from lfpiv.files import write_json, writing

        reading = ReadOptions(
            names=_pairs_of("--name", name), units=_pairs_of("--unit", unit), window_mm=_edges(window_mm), kind=kind,
            number=number, seconds=seconds,
        )  # fmt: skip
        options = ScoreOptions(reading=reading, pairs=selected, outlier_voxel=outlier, volumes=volumes)
        opened = open_truth(data, truth)
        scores = score_results(
            opened, results, options, labels=label or (), progress=lambda done: progress("score", done)
        )
        found = report(opened, scores)
        with writing(out or Path()):
            if out is not None and out.suffix.lower() == ".json":
                write_json(found, out)
            elif out is not None:
                page.write_page(opened, scores, out)
    terminal.OUTPUT.show(found, lambda: print_scores(scores, out))


def _pairs_of(option: str, given: Sequence[str] | None) -> dict[str, str]:
    """Return what an option KEY=VALUE states."""
    from lfpiv.benchmark import names

    known = (*names.ROLES, *names.GROUPS) if option == "--unit" else names.ROLES
    found = {}
    for text in given or ():
        key, equals, value = text.partition("=")
        key = {"pair": names.NUMBER, "instant": names.NUMBER}.get(key, key)
        if not (equals and value and key in known):
            raise InputError(f"{option}: expected KEY=VALUE, KEY of {', '.join(known)}, found {text!r}.")
        found[key] = value
    return found


def _edges(text: str) -> tuple[float, float, float] | None:
    """Return the edges of a window, one or three numbers."""
    if not text:
        return None
    try:
        edges = [float(part) for part in text.split(",")]
    except ValueError:
        edges = []
    if len(edges) not in (1, 3) or not all(0 < edge < float("inf") for edge in edges):
        raise InputError(f"--window-mm: expected one length above 0 mm, or three as X,Y,Z, found {text!r}.")
    x, y, z = edges * (3 // len(edges))
    return x, y, z


def print_scores(scores: Sequence[Score], out: Path | None) -> None:
    """Print a table of the figures, a column for each result, and what was assumed."""
    from lfpiv.benchmark.page import noted, rows

    lines = [["", *(one.label[:WIDEST] for one in scores)], *([title, *cells] for title, cells in rows(scores))]
    widths = [max(len(line[column]) for line in lines) for column in range(len(scores) + 1)]
    for line in lines:
        cells = [
            line[0].ljust(widths[0]),
            *(cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)),
        ]
        terminal.say("  ".join(cells).rstrip())
    for note in noted(scores):
        terminal.say(note)
    if out is not None:
        terminal.say(f"written: {out}")
