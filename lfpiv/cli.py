"""The commands; the only place that draws progress bars and configures logging."""

from __future__ import annotations

import contextlib
import logging
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import lfpiv
from lfpiv.errors import InputError
from lfpiv.reproduce import CASES

log = logging.getLogger("lfpiv")

LOG_EVERY_S = 10.0
"""Without a terminal a long step writes a log line at most this often [s]."""

app = typer.Typer(
    name="lfpiv",
    help="Multi-camera light-field PIV: raw plenoptic camera images in, 3D velocity volumes out.",
    invoke_without_command=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_debug = False


class _Interrupted(Exception):
    """Ctrl-C or a request to terminate, in a form the command line parser leaves alone."""


def _set_debug(value: bool) -> None:
    global _debug
    _debug = _debug or value


def _show_version(value: bool) -> None:
    if value:
        print(f"lfpiv {lfpiv.__version__}")
        raise typer.Exit


ExperimentFile = Annotated[Path, typer.Argument(metavar="EXPERIMENT.toml", help="The experiment file.")]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for everything the run writes.")]
Pairs = Annotated[str, typer.Option("--pairs", metavar="A:B", help="Pairs A to B - 1 only; either may be left out.")]
Device = Annotated[
    Literal["auto", "cpu", "cuda"] | None,
    typer.Option("--device", help="Where kernels run; default: compute.device of the experiment file."),
]
Debug = Annotated[bool, typer.Option("--debug", callback=_set_debug, help="Show debug messages and tracebacks.")]


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


@app.command("run")
def _run(
    experiment: ExperimentFile,
    out: Out,
    pairs: Pairs = ":",
    device: Device = None,
    keep_volumes: Annotated[bool, typer.Option("--keep-volumes", help="Write the volumes too.")] = False,
    debug: Debug = False,
) -> None:
    """Do the whole job: calibrate, reconstruct, correlate, report. Finished parts in DIR are kept."""
    selected = _parse_pairs(pairs)
    with _terminal() as progress:
        from lfpiv import pipeline

        summary = pipeline.run(
            experiment, out, pairs=selected, device=device, keep_volumes=keep_volumes, progress=progress
        )
    _tell(summary, out)


@app.command("calibrate")
def _calibrate(experiment: ExperimentFile, out: Out, device: Device = None, debug: Debug = False) -> None:
    """Calibrate the cameras: first step of a run."""
    with _terminal() as progress:
        from lfpiv import pipeline

        summary = pipeline.calibrate(experiment, out, device=device, progress=progress)
    _tell_calibration(summary)


@app.command("reconstruct")
def _reconstruct(
    experiment: ExperimentFile, out: Out, pairs: Pairs = ":", device: Device = None, debug: Debug = False
) -> None:
    """Reconstruct volumes and keep them in DIR/volumes."""
    selected = _parse_pairs(pairs)
    with _terminal() as progress:
        from lfpiv import pipeline

        pipeline.reconstruct(experiment, out, pairs=selected, device=device, progress=progress)
    print(f"volumes: {out / 'volumes'}")


@app.command("correlate")
def _correlate(
    experiment: ExperimentFile, out: Out, pairs: Pairs = ":", device: Device = None, debug: Debug = False
) -> None:
    """Correlate the volumes in DIR/volumes into vectors."""
    selected = _parse_pairs(pairs)
    with _terminal() as progress:
        from lfpiv import pipeline

        summary = pipeline.correlate(experiment, out, pairs=selected, device=device, progress=progress)
    _tell_vectors(summary, out)


@app.command("report")
def _report(experiment: ExperimentFile, out: Out, debug: Debug = False) -> None:
    """Write summary and report anew from what DIR holds."""
    with _terminal():
        from lfpiv import pipeline

        pipeline.report(experiment, out)
    print(f"report: {out / 'report.html'}")


@app.command("simulate")
def _simulate(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Rig, flow and noise to simulate.")],
    out: Out,
    debug: Debug = False,
) -> None:
    """Write a simulated data set in the form of an experiment, with the truth beside it."""
    with _terminal() as progress:
        from lfpiv.simulate import simulate

        path = simulate(scene, out, progress=lambda what, done, total: progress(what, done / total))
    print(f"experiment: {path}")


@app.command("demo")
def _demo(
    out: Out = Path("lfpiv-demo"),
    device: Device = None,
    debug: Debug = False,
) -> None:
    """Simulate a small two-camera experiment and run everything on it."""
    with _terminal() as progress:
        from lfpiv import demo

        summary = demo.run(out, device=device, progress=progress)
    truth = summary["demo"]
    print(
        f"against the simulated flow: mean error {truth['mean_error_voxel']:.2f} voxel, "
        f"where displacements reach {truth['largest_displacement_voxel']:.2f} voxel"
    )
    _tell(summary, out)


@app.command("reproduce")
def _reproduce(
    out: Out,
    cases: Annotated[
        list[str] | None, typer.Argument(metavar="[CASE]...", help=f"{', '.join(CASES)}, or all (the default).")
    ] = None,
    scale: Annotated[
        Literal["small", "paper"], typer.Option("--scale", help="Smaller volumes, or the paper's own sizes: hours.")
    ] = "small",
    seed: Annotated[int, typer.Option("--seed", help="Whole number that every random draw derives from.")] = 0,
    debug: Debug = False,
) -> None:
    """Compute the paper's tables and figures, ours beside the paper's. Finished cases in DIR are kept."""
    with _terminal() as progress:
        from lfpiv.reproduce import reproduce

        reproduce(cases or ["all"], out, scale, seed=seed, progress=progress, finished=_tell_case)
    print(f"page: {out / 'index.html'}")


@app.command("doctor")
def _doctor(device: Literal["auto", "cpu", "cuda"] = "auto", debug: Debug = False) -> None:
    """Show devices, versions and memory, and test the kernels."""
    with _terminal():
        from lfpiv.doctor import examine

        healthy = True
        for item, finding, good in examine(device):
            healthy = healthy and good
            print(f"{'  ' if good else '! '}{item:24s} {finding}", flush=True)
    if not healthy:
        raise typer.Exit(1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process with its exit status."""
    with contextlib.suppress(ValueError):  # not the main thread: no handler, no matter
        signal.signal(signal.SIGTERM, _terminate)
    sys.exit(call(arguments))


def call(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status: 0 done, 2 bad input or usage, 1 anything else."""
    global _debug
    _debug = False
    try:
        status = app(args=None if arguments is None else list(arguments), standalone_mode=False)
        return status if isinstance(status, int) else 0
    except InputError as error:
        return _fail(2, str(error), error)
    except (_Interrupted, KeyboardInterrupt, typer.Abort) as error:
        return _fail(1, "interrupted. What is finished is kept; the same command goes on from there.", error)
    except MemoryError as error:
        return _fail(1, "out of memory. Raise volume.voxel_mm, shrink volume.size_mm, or free memory.", error)
    except Exception as error:
        if hasattr(error, "format_message"):  # a usage error of the command line parser
            return _fail(2, f"{error.format_message()} Try 'lfpiv --help'.", None)
        text = " ".join(str(error).split())
        hint = "" if _debug else " Run again with --debug for details; `lfpiv doctor` shows what a bug report needs."
        return _fail(1, f"unexpected {type(error).__name__}: {text}.{hint}", error)


def _fail(status: int, message: str, error: BaseException | None) -> int:
    if _debug and error is not None:
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


@contextlib.contextmanager
def _terminal() -> Iterator[Callable[[str, float], None]]:
    """Configure logging and give the progress callback: bars on an interactive terminal, log lines otherwise."""
    from rich.console import Console

    console = Console(stderr=True)
    interactive = console.is_terminal
    if interactive:
        from rich.logging import RichHandler

        handler: logging.Handler = RichHandler(console=console, show_path=False, markup=False, highlighter=None)
        handler.setFormatter(logging.Formatter("%(message)s"))
    else:
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%H:%M:%S"))
    loggers = [logging.getLogger(name) for name in ("lfpiv", "lfpiv_kernels")]
    for logger in loggers:
        logger.addHandler(handler)
        logger.setLevel(logging.DEBUG if _debug else logging.INFO)
    try:
        if interactive:
            with _bars(console) as update:
                yield update
        else:
            yield _log_lines()
    except KeyboardInterrupt as error:
        raise _Interrupted from error
    finally:
        for logger in loggers:
            logger.removeHandler(handler)


@contextlib.contextmanager
def _bars(console: Any) -> Iterator[Callable[[str, float], None]]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"))
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console) as progress:
        tasks: dict[str, Any] = {}

        def update(step: str, fraction: float) -> None:
            if step not in tasks:
                tasks[step] = progress.add_task(step, total=1.0)
            progress.update(tasks[step], completed=fraction)

        yield update


def _log_lines() -> Callable[[str, float], None]:
    last: dict[str, float] = {}

    def update(step: str, fraction: float) -> None:
        now = time.monotonic()
        if step not in last or (fraction < 1 and now - last[step] >= LOG_EVERY_S):
            log.info("%s: %.0f %%", step, 100 * fraction)
            last[step] = now

    return update


def _tell(summary: dict[str, Any], out: Path) -> None:
    _tell_calibration(summary)
    _tell_vectors(summary, out)
    for text in summary["warnings"]:
        print(f"warning: {text}")
    print(f"{summary['timings_s']['total']:.0f} s, peak memory {summary['peak_memory_mib']:.0f} MiB")
    print(f"report: {out / 'report.html'}")


def _tell_case(key: str, result: dict[str, Any]) -> None:
    print(f"{key}: {result['title']}")
    for row in result["comparison"]:
        ours, paper = (
            "-" if row[name] is None else f"{row[name]:.4g}" if isinstance(row[name], float) else row[name]
            for name in ("ours", "paper")
        )
        unit = f" {row['unit']}" if row["unit"] else ""
        goal = "" if row["goal"] is None else f", goal {row['goal']}: {'reached' if row['reached'] else 'NOT reached'}"
        print(f"  {row['what']}: {ours}{unit}, paper {paper}{goal}", flush=True)


def _tell_calibration(summary: dict[str, Any]) -> None:
    for name, figures in summary["calibration"].items():
        print(
            f"{name}: {figures['dots_found']} of {figures['dots_expected']} dots, "
            f"sigma_nor {figures['sigma_nor_test']:.4f} pitch on held-out dots, "
            f"lens array fitted to {figures['lens_array_rms_px']:.3f} px"
        )


def _tell_vectors(summary: dict[str, Any], out: Path) -> None:
    for pair in summary["pairs"]:
        print(f"{out / 'vectors' / pair['file']}: {100 * pair['valid_fraction']:.0f} % valid vectors")


if __name__ == "__main__":
    main()
