"""The commands; the only place that draws progress bars and configures logging."""

from __future__ import annotations

import contextlib
import signal
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from lfpiv.cli import terminal
from lfpiv.cli.terminal import Interrupted, Voice
from lfpiv.errors import ClusterError, InputError, StorageError
from lfpiv.reproduce import CASES
from lfpiv.version import __version__

app = typer.Typer(
    name="lfpiv",
    help="Multi-camera light-field PIV: raw plenoptic camera images in, 3D velocity volumes out.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_voice = Voice()
"""What the options of the present call ask for; `call` begins with a new one."""


def _set_debug(value: bool) -> None:
    _voice.debug = _voice.debug or value


def _set_quiet(value: bool) -> None:
    _voice.quiet = _voice.quiet or value


def _set_json(value: bool) -> None:
    _voice.json = _voice.json or value


def _show_version(value: bool) -> None:
    if value:
        print(f"lfpiv {__version__}")
        raise typer.Exit


def _examples(*commands: str) -> str:
    """Last lines of a command's help; the mark keeps them apart."""
    return "\b\nExamples:\n" + "\n".join(f"  {command}" for command in commands)


ExperimentFile = Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml", help="The experiment file.")]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for everything the run writes.")]
Pairs = Annotated[str, typer.Option("--pairs", metavar="A:B", help="Pairs A to B - 1 only; either may be left out.")]
Device = Annotated[
    Literal["auto", "cpu", "cuda"] | None,
    typer.Option("--device", help="Where kernels run; default: compute.device of the experiment file."),
]
Debug = Annotated[bool, typer.Option("--debug", callback=_set_debug, help="Show debug messages and tracebacks.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", callback=_set_quiet, help="Show warnings and errors only.")]
Json = Annotated[bool, typer.Option("--json", callback=_set_json, help="Print the result as JSON.")]


@app.callback()
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
    debug: Debug = False,
) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())


@app.command(
    "run",
    epilog=_examples(
        "lfpiv run experiment.toml --out results",
        "lfpiv run experiment.toml --out results --pairs 0:100 --workers 2",
        "lfpiv run experiment.toml --out results --scheduler tcp://head:8786",
    ),
)
def _run(
    experiment: ExperimentFile,
    out: Out,
    pairs: Pairs = ":",
    device: Device = None,
    keep_volumes: Annotated[bool, typer.Option("--keep-volumes", help="Write the volumes too.")] = False,
    workers: Annotated[
        int | None,
        typer.Option("--workers", metavar="N", help="Processes that do pairs side by side; default: 1, one per GPU."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers do the pairs instead."),
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Do the whole job: calibrate, reconstruct, correlate, report. Finished parts in DIR are kept.

    A pair that cannot be done is left out and named; then the exit status is 3.
    """
    selected = _parse_pairs(pairs)
    with _voice.speaking() as progress:
        from lfpiv.runs import pipeline

        summary = pipeline.run(
            experiment,
            out,
            pairs=selected,
            device=device,
            keep_volumes=keep_volumes,
            workers=workers,
            scheduler=scheduler,
            progress=progress,
        )
    _voice.answer(summary, lambda: terminal.tell_run(summary, out))
    _end(summary)


@app.command(
    "calibrate",
    epilog=_examples(
        "lfpiv calibrate experiment.toml --out results", "lfpiv calibrate experiment.toml --out results --json"
    ),
)
def _calibrate(
    experiment: ExperimentFile,
    out: Out,
    device: Device = None,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Calibrate the cameras: first step of a run."""
    with _voice.speaking() as progress:
        from lfpiv.runs import pipeline

        summary = pipeline.calibrate(experiment, out, device=device, progress=progress)
    _voice.answer(summary, lambda: terminal.tell_calibration(summary))


@app.command("reconstruct", epilog=_examples("lfpiv reconstruct experiment.toml --out results --pairs 0:10"))
def _reconstruct(
    experiment: ExperimentFile,
    out: Out,
    pairs: Pairs = ":",
    device: Device = None,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Reconstruct volumes and keep them in DIR/volumes."""
    selected = _parse_pairs(pairs)
    with _voice.speaking() as progress:
        from lfpiv.runs import pipeline

        summary = pipeline.reconstruct(experiment, out, pairs=selected, device=device, progress=progress)
    _voice.answer(summary, lambda: print(f"volumes: {out / 'volumes'}"))
    _end(summary)


@app.command("correlate", epilog=_examples("lfpiv correlate experiment.toml --out results --pairs 0:10"))
def _correlate(
    experiment: ExperimentFile,
    out: Out,
    pairs: Pairs = ":",
    device: Device = None,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Correlate the volumes in DIR/volumes into vectors."""
    selected = _parse_pairs(pairs)
    with _voice.speaking() as progress:
        from lfpiv.runs import pipeline

        summary = pipeline.correlate(experiment, out, pairs=selected, device=device, progress=progress)
    _voice.answer(summary, lambda: terminal.tell_vectors(summary, out))
    _end(summary)


@app.command("report", epilog=_examples("lfpiv report experiment.toml --out results"))
def _report(
    experiment: ExperimentFile,
    out: Out,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Write summary and report anew from what DIR holds."""
    with _voice.speaking():
        from lfpiv.runs import pipeline

        summary = pipeline.report(experiment, out)
    _voice.answer(summary, lambda: print(f"report: {out / 'report.html'}"))


@app.command(
    "export",
    epilog=_examples("lfpiv export results --to vti", "lfpiv export results --to pivpy --depth 1.5 --out planes"),
)
def _export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run: its --out.")],
    to: Annotated[
        Literal["vti", "netcdf", "csv", "pivpy"],
        typer.Option("--to", help="ParaView images; one NetCDF over all pairs; tables; planes for pivpy."),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR2", help="Folder to write to; default: DIR/export.")
    ] = None,
    pairs: Pairs = ":",
    depth: Annotated[
        float | None, typer.Option("--depth", metavar="Z_MM", help="pivpy: only the plane nearest to this z [mm].")
    ] = None,
    interval: Annotated[
        float | None,
        typer.Option("--interval", metavar="S", help="Time between pairs [s]; default: times are pair numbers."),
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Write the vectors of a run for other programs: ParaView, xarray, spreadsheets, pivpy."""
    selected = _parse_pairs(pairs)
    with _voice.speaking() as progress:
        from lfpiv.results.export import export_results

        written = export_results(
            folder, to, out=out, pairs=selected, depth_mm=depth, interval_s=interval, progress=progress
        )
    said = f"export: {written[0]}" if len(written) == 1 else f"export: {len(written)} files in {written[0].parent}"
    _voice.answer({"files": [str(path) for path in written]}, lambda: print(said))


@app.command("simulate", epilog=_examples("lfpiv simulate scene.toml --out data"))
def _simulate(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Rig, flow and noise to simulate.")],
    out: Out,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Write a simulated data set in the form of an experiment, with the truth beside it."""
    with _voice.speaking() as progress:
        from lfpiv.simulation.simulator import simulate

        path = simulate(scene, out, progress=lambda what, done, total: progress(what, done / total))
    _voice.answer({"experiment": str(path)}, lambda: print(f"experiment: {path}"))


@app.command("demo", epilog=_examples("lfpiv demo", "lfpiv demo --out somewhere --device cpu"))
def _demo(
    out: Out = Path("lfpiv-demo"),
    device: Device = None,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Simulate a small two-camera experiment and run everything on it."""
    with _voice.speaking() as progress:
        from lfpiv.cli import demo

        summary = demo.run(out, device=device, progress=progress)
    _voice.answer(summary, lambda: terminal.tell_demo(summary, out))


@app.command(
    "reproduce", epilog=_examples("lfpiv reproduce --out paper", "lfpiv reproduce fig10 fig14 --out paper --seed 1")
)
def _reproduce(
    out: Out,
    cases: Annotated[
        list[str] | None, typer.Argument(metavar="[CASE]...", help=f"{', '.join(CASES)}, or all (the default).")
    ] = None,
    scale: Annotated[
        Literal["small", "paper"], typer.Option("--scale", help="Smaller volumes, or the paper's own sizes: hours.")
    ] = "small",
    seed: Annotated[int, typer.Option("--seed", help="Whole number that every random draw derives from.")] = 0,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Compute the paper's tables and figures, ours beside the paper's. Finished cases in DIR are kept."""
    with _voice.speaking() as progress:
        from lfpiv.reproduce import reproduce

        told = None if _voice.quiet or _voice.json else terminal.tell_case
        done = reproduce(cases or ["all"], out, scale, seed=seed, progress=progress, finished=told)
    _voice.answer(done, lambda: print(f"page: {out / 'index.html'}"))


@app.command("doctor", epilog=_examples("lfpiv doctor", "lfpiv doctor --device cuda"))
def _doctor(
    device: Literal["auto", "cpu", "cuda"] = "auto",
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Show devices, versions and memory, and test the kernels."""
    with _voice.speaking():
        from lfpiv.cli.doctor import examine

        found = []
        for item, finding, good in examine(device):
            found.append({"item": item, "finding": finding, "good": good})
            if not _voice.json and not (_voice.quiet and good):
                print(f"{'  ' if good else '! '}{item:24s} {finding}", flush=True)
    _voice.answer(found, lambda: None)
    if not all(item["good"] for item in found):
        raise typer.Exit(1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process with its exit status."""
    with contextlib.suppress(ValueError):  # not the main thread: no handler, no matter
        signal.signal(signal.SIGTERM, _terminate)
        if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup ignores it
            signal.signal(signal.SIGHUP, _terminate)
    sys.exit(call(arguments))


def call(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit status: 0 done, 3 done but for some pairs, 2 bad input or usage, 1 else."""
    _voice.debug = _voice.quiet = _voice.json = False
    try:
        status = app(args=None if arguments is None else list(arguments), prog_name="lfpiv", standalone_mode=False)
        return status if isinstance(status, int) else 0
    except InputError as error:
        return _fail(2, str(error), error)
    except (Interrupted, KeyboardInterrupt, typer.Abort) as error:
        return _fail(1, "interrupted. What is finished is kept; the same command goes on from there.", error)
    except (StorageError, ClusterError) as error:
        return _fail(1, str(error), error)
    except MemoryError as error:
        return _fail(1, "out of memory. Raise volume.voxel_mm, shrink volume.size_mm, or free memory.", error)
    except Exception as error:
        if hasattr(error, "format_message"):  # a usage error of the command line parser
            return _fail(2, f"{error.format_message()} Try 'lfpiv --help'.", None)
        text = " ".join(str(error).split())
        hint = (
            "" if _voice.debug else " Run again with --debug for details; `lfpiv doctor` shows what a bug report needs."
        )
        return _fail(1, f"unexpected {type(error).__name__}: {text}.{hint}", error)


def _fail(status: int, message: str, error: BaseException | None) -> int:
    if _voice.debug and error is not None:
        traceback.print_exception(error)
    print(f"lfpiv: {' '.join(message.split())}", file=sys.stderr)
    return status


def _terminate(signum: int, frame: Any) -> None:
    raise KeyboardInterrupt


def _parse_pairs(text: str) -> tuple[int, int | None]:
    first, colon, after = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return int(first or 0), int(after) if after else None
    except ValueError:
        raise InputError(f"--pairs: expected A:B with whole numbers, found {text!r}.") from None


def _end(summary: dict[str, Any]) -> None:
    """Name the pairs that failed; with any of this invocation, the exit status is 3."""
    if summary["failed"]:
        terminal.tell_failed(summary, sys.stderr if _voice.quiet or _voice.json else sys.stdout)
    if terminal.failed_now(summary):
        raise typer.Exit(3)


if __name__ == "__main__":
    main()
