"""Commands of the command line, and their exit status. Each command calls one function of the library."""

from __future__ import annotations

import os
import sys
import threading
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from lfpiv.cli import benchmark, init, interrupts, questions, terminal
from lfpiv.cli.app import Device, ExperimentFile, Out, Pairs, Workers, app, command
from lfpiv.errors import ClusterError, InputError, StorageError, printable
from lfpiv.reproduce import CASES

EXIT_S = 15.0
"""Longest time that the process may take to end after its work [s]."""

_output = terminal.OUTPUT


@command(
    "run",
    "lfpiv run experiment.toml --out results",
    "lfpiv run experiment.toml --out results --pairs 0:100 --workers 2",
    "lfpiv run experiment.toml -o results --pairs 0",
    "lfpiv run experiment.toml --out results --scheduler tcp://head:8786",
)
def _run(
    experiment: ExperimentFile,
    out: Out,
    pairs: Pairs = ":",
    device: Device = None,
    keep_volumes: Annotated[bool, typer.Option("--keep-volumes", help="Write the volumes too.")] = False,
    workers: Workers = None,
    scheduler: Annotated[
        str | None,
        typer.Option("--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers do the work instead."),
    ] = None,
) -> None:
    """Do all steps: calibrate, reconstruct, correlate, report. Finished parts in DIR are not repeated.

    A pair or instant that fails is left out and named; then the exit status is 3, as where no vector is valid.
    """
    selected = terminal.parse_pairs(pairs)
    with _output.progress() as progress:
        from lfpiv.runs import unchanged

        options: dict[str, Any] = {"pairs": selected, "device": device, "keep_volumes": keep_volumes}
        options |= {"workers": workers, "scheduler": scheduler}
        finished = unchanged.repeat({"experiment": str(experiment), **options}, out) or {}
        if not finished:
            from lfpiv.runs import pipeline

            finished = pipeline.run(experiment, out, **options, progress=progress)
    _output.show(finished, lambda: terminal.print_run(finished, out))
    _end(finished)


@command(
    "plan",
    "lfpiv plan experiment.toml",
    "lfpiv plan experiment.toml --pairs 10000 --workers 4",
    "lfpiv plan experiment.toml --out results --json",
)
def _plan(
    experiment: ExperimentFile,
    pairs: Annotated[
        int | None,
        typer.Option("--pairs", metavar="N", help="Number of pairs, or of instants of a series; default: all."),
    ] = None,
    workers: Workers = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="DIR", help="Folder of a run, whose calibration and voxels are taken."),
    ] = None,
    device: Device = None,
) -> None:
    """Say what a campaign will take: vectors, time, memory and disk, scaled from its first pair.

    The first pair is done as in a run, in as much time, and nothing is written. No particle images are needed.
    """
    with _output.progress() as progress:
        from lfpiv.planning.campaign import plan

        found = plan(experiment, pairs=pairs, workers=workers, out=out, device=device, progress=progress)
    _output.show(found.to_json(), lambda: terminal.print_card(found))


@command("init", "lfpiv init", f"lfpiv init jet/experiment.toml {questions.EXAMPLE}")
@questions.with_options
def _init(
    experiment: Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml", help="The file to write.")] = Path(
        "experiment.toml"
    ),
    **answers: str | None,
) -> None:
    """Write a commented experiment file from options. On a terminal, ask for what they leave out and has no default.

    No image needs to exist yet. The file says where each number is found; an existing one is not overwritten.
    """
    try:
        written = init.write_experiment(experiment, answers)
    except typer.Abort as error:
        raise typer.Exit(_fail(1, "interrupted; nothing is written.", error)) from None
    _output.show({"experiment": str(experiment), **written._asdict()}, lambda: terminal.print_init(experiment, written))


@command("calibrate", "lfpiv calibrate experiment.toml -o results", "lfpiv calibrate experiment.toml -o results --json")
def _calibrate(experiment: ExperimentFile, out: Out, device: Device = None) -> None:
    """Calibrate the cameras: first step of a run."""
    with _output.progress() as progress:
        from lfpiv.runs import pipeline

        summary = pipeline.calibrate(experiment, out, device=device, progress=progress)
    _output.show(summary, lambda: terminal.print_calibration(summary))


@command("check", "lfpiv check experiment.toml --out results")
def _check(experiment: ExperimentFile, out: Out) -> None:
    """Draw the board as each camera shows it, with arrows along x and y, to be compared with the real board.

    DIR/check/board.png is drawn before the first run, without particle images. Contradictions of the board and the
    stated rig end it with exit status 2.
    """
    with _output.progress() as progress:
        from lfpiv.runs.check import check

        found = check(experiment, out, progress=progress)
    _output.show(found, lambda: terminal.print_check(found))
    if found["contradiction"]:
        raise InputError(found["contradiction"])


@command("preview", "lfpiv preview experiment.toml --out results", "lfpiv preview experiment.toml -o results --pair 7")
def _preview(
    experiment: ExperimentFile,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder of a run, with its calibration.")],
    pair: Annotated[
        int | None, typer.Option("--pair", metavar="N", help="Pair, or instant of a series; default: the first.")
    ] = None,
    device: Device = None,
) -> None:
    """Draw one pair of a calibrated rig within seconds, to tune lasers, lenses and seeding.

    DIR/preview/pair_N.png shows a coarse volume, images refocused at several depths, and the light of each camera.
    """
    with _output.progress() as progress:
        from lfpiv.runs.preview import preview

        found = preview(experiment, out, pair, device=device, progress=progress)
    _output.show(found, lambda: terminal.print_preview(found))


@command("reconstruct", "lfpiv reconstruct experiment.toml --out results --pairs 0:10")
def _reconstruct(experiment: ExperimentFile, out: Out, pairs: Pairs = ":", device: Device = None) -> None:
    """Reconstruct volumes into DIR/volumes."""
    selected = terminal.parse_pairs(pairs)
    with _output.progress() as progress:
        from lfpiv.runs import pipeline

        summary = pipeline.reconstruct(experiment, out, pairs=selected, device=device, progress=progress)
    _output.show(summary, lambda: terminal.say(f"volumes: {out / 'volumes'}"))
    _end(summary)


@command("correlate", "lfpiv correlate experiment.toml --out results --pairs 0:10")
def _correlate(experiment: ExperimentFile, out: Out, pairs: Pairs = ":", device: Device = None) -> None:
    """Correlate the volumes in DIR/volumes into vectors."""
    selected = terminal.parse_pairs(pairs)
    with _output.progress() as progress:
        from lfpiv.runs import pipeline

        summary = pipeline.correlate(experiment, out, pairs=selected, device=device, progress=progress)
    _output.show(summary, lambda: terminal.print_vectors(summary, out))
    _end(summary)


@command("report", "lfpiv report experiment.toml --out results")
def _report(experiment: ExperimentFile, out: Out) -> None:
    """Write summary and report again from the results in DIR."""
    with _output.progress():
        from lfpiv.runs import pipeline

        summary = pipeline.report(experiment, out)
    _output.show(summary, lambda: terminal.say(f"report: {out / 'report.html'}"))


@command("export", "lfpiv export results --to vti", "lfpiv export results --to pivpy --depth 1.5 --out planes")
def _export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run: its --out.")],
    to: Annotated[
        Literal["vti", "netcdf", "zarr", "csv", "tecplot", "vtp", "pivpy"],
        typer.Option(
            "--to",
            help="ParaView images; one NetCDF or Zarr file of all vectors; tables; text for Tecplot; particles for "
            "ParaView; planes for pivpy.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR2", help="Folder to write to; default: DIR/export.")
    ] = None,
    pairs: Pairs = ":",
    depth: Annotated[
        float | None, typer.Option("--depth", metavar="Z_MM", help="pivpy: only the plane nearest to this z [mm].")
    ] = None,
    interval: Annotated[
        float | None,
        typer.Option(
            "--interval",
            metavar="S",
            help="Time between image pairs [s]; default: times are pair numbers. Not for a series.",
        ),
    ] = None,
) -> None:
    """Write the vectors of a run for other programs: ParaView, xarray, spreadsheets, Tecplot, pivpy."""
    selected = terminal.parse_pairs(pairs)
    with _output.progress() as progress:
        from lfpiv.results.export import export

        done = export(folder, to, out=out, pairs=selected, depth_mm=depth, interval_s=interval, progress=progress)
    written, left_out = done.files, [{"what": list(one.what), "why": one.why} for one in done.left_out]
    text = f"export: {written[0]}" if len(written) == 1 else f"export: {len(written)} files in {written[0].parent}"
    _output.show({"files": [str(path) for path in written], "left_out": left_out}, lambda: terminal.say(text))


@command("schema", "lfpiv schema", "lfpiv schema --out schemas")
def _schema(out: Out = Path(".")) -> None:
    """Write the JSON Schema of experiment and scene files, by which editors complete and check them.

    DIR/lfpiv-experiment.schema.json and DIR/lfpiv-scene.schema.json; a first line `#:schema PATH` in a file names it.
    """
    from lfpiv.experiment.template import SCHEMA
    from lfpiv.files import write_json
    from lfpiv.settings.experiment import ExperimentTable
    from lfpiv.settings.keys import json_schema
    from lfpiv.simulation.scene import Scene

    out.mkdir(parents=True, exist_ok=True)
    models: dict[Path, type[Any]] = {out / SCHEMA: ExperimentTable, out / "lfpiv-scene.schema.json": Scene}
    for path, model in models.items():
        write_json(json_schema(model), path)
    written = [str(path) for path in models]
    _output.show({"files": written}, lambda: terminal.say(f"schema: {', '.join(written)}"))


@command("studio", "lfpiv studio experiment.toml", "lfpiv studio results", "lfpiv studio --no-browser --port 8100")
def _studio(
    path: Annotated[
        Path | None,
        typer.Argument(
            metavar="[EXPERIMENT.toml | RESULTS]", help="Experiment file, folder of a run, or a folder with either."
        ),
    ] = None,
    port: Annotated[int, typer.Option("--port", metavar="N", help="Port of this machine; default: a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
) -> None:
    """Look, tune and run on a page in the browser; only this machine can open it. Needs the extra `studio`."""
    with _output.progress():
        from lfpiv.studio.server import serve

        serve(path, port=port, browser=browser, ready=lambda address: terminal.say(f"studio: {address}", flush=True))


@command("simulate", "lfpiv simulate scene.toml --out data")
def _simulate(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Rig, flow and noise to simulate.")],
    out: Out,
) -> None:
    """Write a simulated data set in the form of an experiment, with the truth beside it."""
    with _output.progress() as progress:
        from lfpiv.simulation.simulator import simulate

        path = simulate(scene, out, progress=progress)
    _output.show({"experiment": str(path)}, lambda: terminal.say(f"experiment: {path}"))


@command("demo", "lfpiv demo", "lfpiv demo --out somewhere --device cpu")
def _demo(out: Out = Path("lfpiv-demo"), device: Device = None) -> None:
    """Simulate a small two-camera experiment and run everything on it."""
    with _output.progress() as progress:
        from lfpiv.cli import demo

        summary = demo.run(out, device=device, progress=progress)
    _output.show(summary, lambda: terminal.print_demo(summary, out))


@command("reproduce", "lfpiv reproduce --out paper", "lfpiv reproduce fig10 fig14 --out paper --seed 1")
def _reproduce(
    out: Out,
    cases: Annotated[
        list[str] | None, typer.Argument(metavar="[CASE]...", help=f"{', '.join(CASES)}, or all (the default).")
    ] = None,
    scale: Annotated[
        Literal["small", "paper"], typer.Option("--scale", help="Smaller volumes, or the paper's own sizes: hours.")
    ] = "small",
    seed: Annotated[int, typer.Option("--seed", help="Whole number that every random draw derives from.")] = 0,
) -> None:
    """Compute the paper's tables and figures, ours beside the paper's. Finished cases in DIR are not repeated."""
    with _output.progress() as progress:
        from lfpiv.reproduce import reproduce

        print_case = terminal.print_case if _output.is_text else None
        done = reproduce(cases or ["all"], out, scale, seed=seed, progress=progress, finished=print_case)
    _output.show(done, lambda: terminal.say(f"page: {out / 'index.html'}"))


app.add_typer(benchmark.GROUP, name="benchmark")
for _name, (_function, _examples) in benchmark.COMMANDS.items():
    command(_name, *_examples, group=benchmark.GROUP)(_function)


@command("doctor", "lfpiv doctor", "lfpiv doctor --device cuda")
def _doctor(device: Literal["auto", "cpu", "cuda"] = "auto") -> None:
    """Show devices, versions and memory, and test the kernels."""
    with _output.progress():
        from lfpiv.cli.doctor import examine

        found = []
        for one in examine(device):
            found.append(one._asdict())
            if not _output.json and not (_output.quiet and one.good):
                terminal.say(f"{'  ' if one.good else '! '}{one.item:24s} {one.finding}", flush=True)
    _output.show(found, lambda: None)
    if not all(item["good"] for item in found):
        raise typer.Exit(1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process with its exit status."""
    interrupts.watch()
    status = call(arguments)
    interrupts.end_with(status)
    last = threading.Timer(EXIT_S, os._exit, (status,))  # threads of a library may wait for something that never comes
    last.daemon = True
    last.start()
    sys.exit(status)


def call(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    0: done, 1: any other error, 2: bad input or usage, 3: done except for some pairs, which failed or have no vectors.
    """
    _output.debug = _output.quiet = _output.json = False
    try:
        with interrupts.raised():
            status = app(args=None if arguments is None else list(arguments), prog_name="lfpiv", standalone_mode=False)
        if status == interrupts.PARSED:
            raise KeyboardInterrupt
        return status if isinstance(status, int) else 0
    except InputError as error:
        return _fail(2, str(error), error)
    except (interrupts.Interrupted, KeyboardInterrupt, typer.Abort) as error:
        return _fail(1, interrupts.MESSAGE, error)
    except (StorageError, ClusterError) as error:
        return _fail(1, str(error), error)
    except OSError as error:
        if error.errno is None:
            return _unexpected(error)
        place = f"{error.filename}: " if error.filename else ""
        reason = (error.strerror or str(error)).lower()
        return _fail(
            1, f"{place}{reason}. Finished results are complete. Solve this, and run the command again.", error
        )
    except MemoryError as error:
        return _fail(1, "out of memory. Raise volume.voxel_mm, shrink volume.size_mm, or free memory.", error)
    except Exception as error:
        if hasattr(error, "format_message"):  # a usage error of the command line parser
            return _fail(2, f"{error.format_message()} Try 'lfpiv --help'.", None)
        return _unexpected(error)


def _unexpected(error: Exception) -> int:
    text = " ".join(str(error).split())
    hint = " Run again with --debug for details; `lfpiv doctor` shows what a bug report needs."
    return _fail(1, f"unexpected {type(error).__name__}: {text}.{'' if _output.debug else hint}", error)


def _fail(status: int, message: str, error: BaseException | None) -> int:
    if _output.debug and error is not None:
        traceback.print_exception(error)
    print(f"lfpiv: {printable(' '.join(message.split()))}", file=sys.stderr)
    return status


def _end(summary: dict[str, Any]) -> None:
    """List the pairs that failed. End with exit status 3 if any failed in this run, or has no valid vector."""
    where = sys.stdout if _output.is_text else sys.stderr
    if summary["failed"]:
        terminal.print_failed(summary, where)
    if summary.get("without_vectors"):
        terminal.print_without_vectors(summary, where)
    if terminal.failed_now(summary) or summary.get("without_vectors"):
        raise typer.Exit(3)
