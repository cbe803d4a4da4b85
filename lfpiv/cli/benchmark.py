"""Commands `lfpiv benchmark ...`: list and make the cases of the light-field PIV benchmark, and score results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from lfpiv.cli import benchmark_score, terminal

GROUP = typer.Typer(
    help="The light-field PIV benchmark: cases with known truth, for any program.",
    invoke_without_command=True,
    rich_markup_mode=None,
)
"""Group of the commands."""


@GROUP.callback()
def _help(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


def _list() -> None:
    """List the cases: what each varies, and its size."""
    from lfpiv.benchmark.listing import rows

    found = rows()
    terminal.OUTPUT.show(found, lambda: _print_cases(found))


def _make(
    cases: Annotated[list[str], typer.Argument(metavar="CASE", help="Names of cases, or all.")],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", metavar="DIR", help="Folder of the case; of several, each has one in it."),
    ],
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="DIR2", help="Folder of the truth, to keep it apart; default: DIR/truth."),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", metavar="N", help="Draw other particles and noise, for a test with unknown truth."),
    ] = None,
    tracers: Annotated[
        Path | None,
        typer.Option("--tracers", metavar="FILE", help="Tracers of the case sequence-dns; the case names the source."),
    ] = None,
) -> None:
    """Write images, boards and experiment file of cases, and their truth; say whether they are as recorded.

    DIR/README.txt says what to measure and how to hand it in. Cases that DIR holds complete are kept.
    """
    with terminal.OUTPUT.progress() as progress:
        from lfpiv.benchmark.make import make

        made = make(cases, out, truth=truth, seed=seed, tracers=tracers, progress=progress)
    found = [vars(one) for one in made]
    terminal.OUTPUT.show(found, lambda: _print_made(found))


COMMANDS: dict[str, tuple[Callable[..., None], tuple[str, ...]]] = {
    "list": (_list, ("lfpiv benchmark list", "lfpiv benchmark list --json")),
    "make": (
        _make,
        (
            "lfpiv benchmark make base --out base",
            "lfpiv benchmark make all --out cases --truth truth",
            "lfpiv benchmark make sequence-dns --out dns --tracers rayleigh_benard_series.npz",
        ),
    ),
    "score": (benchmark_score.score, benchmark_score.EXAMPLES),
}
"""Name -> function and examples of each command of the group."""

_COLUMNS: dict[str, Callable[[dict[str, Any]], str]] = {
    "case": lambda row: str(row["case"]),
    "varies": lambda row: str(row["varies"]),
    "cameras": lambda row: str(row["cameras"]),
    "per lens": lambda row: f"{row['per_microlens']:g}",
    "flow": lambda row: str(row["flow"]),
    "images": lambda row: next(f"{row[name]} {name}" for name in ("pairs", "instants") if name in row),
    "voxels": lambda row: " x ".join(map(str, row["voxels"])),
    "MiB": lambda row: "-" if row["size_mib"] is None else f"{row['size_mib']:.0f}",
    "make": lambda row: "-" if row["make_s"] is None else f"{row['make_s']:.0f} s",
}
"""Title -> cell of a row of the list."""


def _print_cases(rows: list[dict[str, Any]]) -> None:
    """Print one line per case."""
    lines = [list(_COLUMNS), *([cell(row) for cell in _COLUMNS.values()] for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(_COLUMNS))]
    for line in lines:
        terminal.say("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
    terminal.say("per lens: particles per microlens. make: time on one core. What each is for: --json.")


def _print_made(made: list[dict[str, Any]]) -> None:
    """Print where each case is, and how it compares with what is recorded."""
    for one in made:
        reason = f" ({one['reason']})" if one["reason"] else ""
        terminal.say(
            f"{one['case']}: {one['folder']}, truth in {one['truth']}; images and truth: {one['verdict']}{reason}"
        )
    terminal.say("what to measure: README.txt there")
