"""Output of the command line: log lines or progress bars on standard error, results or JSON on standard output."""

from __future__ import annotations

import contextlib
import json
import logging
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from lfpiv.errors import InputError, printable
from lfpiv.progress import Progress, record
from lfpiv.quantities import duration, quantity
from lfpiv.warn import name_pairs

if TYPE_CHECKING:
    from rich.console import Console

    from lfpiv.cli.init import Written
    from lfpiv.prompt import Shown

log = logging.getLogger("lfpiv")

LOG_EVERY_S = 10.0
"""Shortest time between log lines of a step without a terminal [s]."""
LEAST_FRACTION = 0.02
"""Smallest finished fraction of a step for an estimate of its remaining time."""

LISTED_PAIRS = 20
"""Largest number of pairs listed at the end of a run."""
LISTED_WARNINGS = 20
"""Largest number of warnings listed at the end of a run. ``summary.json`` contains all."""


@dataclass
class Output:
    """Options for the output of a command."""

    debug: bool = False
    """Show debug messages and tracebacks."""
    quiet: bool = False
    """Show only warnings and errors."""
    json: bool = False
    """Print the result as JSON instead of text."""

    @property
    def is_text(self) -> bool:
        """Whether results are printed as text."""
        return not (self.json or self.quiet)

    def show(self, result: Any, print_text: Callable[[], None]) -> None:
        """Print the result of a command: as JSON, as text by `print_text`, or not at all."""
        if self.json:
            from lfpiv.files import plain

            print(json.dumps(plain(result), indent=2, allow_nan=False))
        elif self.is_text:
            print_text()

    @contextlib.contextmanager
    def progress(self) -> Iterator[Progress]:
        """Configure logging and yield the progress callback: bars on an interactive terminal, log lines otherwise."""
        from rich.console import Console

        console = Console(stderr=True)
        interactive = console.is_terminal and not self.quiet
        handler = _rich_handler(console) if interactive else _plain_handler()
        loggers = [logging.getLogger(name) for name in ("lfpiv", "lfpiv_kernels")]
        level = logging.DEBUG if self.debug else logging.WARNING if self.quiet else logging.INFO
        for logger in loggers:
            logger.addHandler(handler)
            logger.setLevel(level)
        try:
            if interactive:
                with _bars(console) as update:
                    yield update
            else:
                yield _log_lines()
        finally:
            for logger in loggers:
                logger.removeHandler(handler)


OUTPUT = Output()
"""Options for the output of the present command. Each call of the command line resets them."""


class _Printable(logging.Formatter):
    """Format log records; control characters of names and files do not reach the terminal."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record), keep="\n\t")


def _rich_handler(console: Console) -> logging.Handler:
    from rich.logging import RichHandler

    handler = RichHandler(console=console, show_path=False, markup=False, highlighter=None)
    handler.setFormatter(_Printable("%(message)s"))
    return handler


def _plain_handler() -> logging.Handler:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Printable("%(asctime)s %(levelname)s %(message)s", "%H:%M:%S"))
    return handler


@contextlib.contextmanager
def _bars(console: Console) -> Iterator[Progress]:
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"))
    with Bars(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console) as bars:
        tasks: dict[str, Any] = {}

        def update(step: str, fraction: float) -> None:
            if step not in tasks:
                tasks[step] = bars.add_task(step, total=1.0)
            bars.update(tasks[step], completed=fraction)

        yield update


def _log_lines() -> Progress:
    """Return a progress that writes log lines, and is recorded for the studio."""
    began: dict[str, tuple[float, float]] = {}  # time and fraction of the first report of each step
    last: dict[str, float] = {}  # time of its last log line

    def update(step: str, fraction: float) -> None:
        record(step, fraction)
        now = time.monotonic()
        if step not in last or (fraction < 1 and now - last[step] >= LOG_EVERY_S):
            start, done = began.setdefault(step, (now, fraction))
            part = fraction - done
            left = f", about {duration((now - start) / part * (1 - fraction))} left" if part >= LEAST_FRACTION else ""
            log.info("%s: %.0f %%%s", step, 100 * fraction, left)
            last[step] = now

    return update


def parse_pairs(text: str) -> tuple[int, int | None]:
    """Return the first pair and the one behind the last of A:B, of which either may be left out, or of one number."""
    first, colon, after = text.partition(":")
    try:
        if not colon:
            return int(first), int(first) + 1
        return int(first or 0), int(after) if after else None
    except ValueError:
        raise InputError(f"--pairs: expected A:B, or one number, in whole numbers, found {text!r}.") from None


def say(text: str, file: TextIO | None = None, flush: bool = False) -> None:
    """Print a line; control characters of names and files do not reach the terminal."""
    print(printable(text), file=file, flush=flush)


def print_card(value: Shown) -> None:
    """Print a value as the prompt of Python shows it."""
    for line in value.card().text().splitlines():
        say(line)


def print_run(summary: dict[str, Any], out: Path) -> None:
    """Print calibration, vectors, warnings, time and memory of a run, and the path of its report."""
    print_calibration(summary)
    print_vectors(summary, out)
    print_warnings(summary, out)
    say(f"{summary['timings_s']['total']:.0f} s, peak memory {summary['peak_memory_mib']:.0f} MiB")
    say(f"report: {out / 'report.html'}")


def print_init(experiment: Path, written: Written) -> None:
    """Print where the experiment file is, how many vectors it will give, what is missing, and the next command."""
    say(f"experiment: {experiment}")
    if written.taken:
        say(f"taken without a question, change it in the file where it is wrong: {', '.join(written.taken)}")
    say(f"a run measures {written.vectors}")
    for text in written.warnings:
        say(f"warning: {text}")
    if written.missing:
        say(f"not complete yet: {written.missing}")
    say(f"next: lfpiv check {experiment} --out results, which shows the axes, or lfpiv studio {experiment}")
    say(f"then: lfpiv calibrate, lfpiv preview and lfpiv run, each with {experiment} --out results")


def print_check(found: dict[str, Any]) -> None:
    """Print where x and y point, and the picture of the board that shows it."""
    say(f"axes: {found['axes']}")
    say(f"compare with the real board: {found['picture']}")


def print_preview(found: dict[str, Any]) -> None:
    """Print the light of each camera and frame, the warnings about the images, and the path of the picture."""
    for level in found["levels"]:
        say(
            f"{level['camera']}, {level['frame']}: typical peak {level['peak']:.0f} counts, noise "
            f"{level['noise']:.1f}, {100 * level['lit']:.0f} % of the microimages lit, particles: {level['verdict']}"
        )
    for text in found["warnings"]:
        say(f"warning: {text}")
    say(f"preview: {found['picture']}")


def print_demo(summary: dict[str, Any], out: Path) -> None:
    """Print the warnings of the demonstration, and three lines: what was measured, how well, and where to look."""
    print_warnings(summary, out)
    found, vectors = summary["demo"], out / "vectors"
    valid, speed = 100 * summary["valid_fraction"], found["speed_m_per_s"]
    error, largest = found["mean_error_voxel"], found["largest_displacement_voxel"]
    error_speed, largest_speed = (quantity(size * found["voxel_m_per_s"], "m/s", 2) for size in (error, largest))
    total_s = summary["timings_s"]["total"]
    say(f"measured  a ring vortex: {found['vectors']:,} vectors, {valid:.1f} % valid, {speed:.1f} m/s in the median")
    say(
        f"error     {error:.2f} voxel ({error_speed}) on average where the flow moves by up to {largest:.1f} voxel "
        f"({largest_speed}); {total_s:.0f} s"
    )
    say(f"look at   {out / 'report.html'} in a browser; the vectors are in {vectors}")


def print_warnings(summary: dict[str, Any], out: Path) -> None:
    """Print the warnings of a run, up to `LISTED_WARNINGS`."""
    warnings = summary["warnings"]
    for text in warnings[:LISTED_WARNINGS]:
        say(f"warning: {text}")
    if len(warnings) > LISTED_WARNINGS:
        say(f"{len(warnings) - LISTED_WARNINGS:,} more warnings are in {out / 'summary.json'}")


def print_case(key: str, result: dict[str, Any]) -> None:
    """Print the result of a case of `lfpiv reproduce`, the paper's value and the goal."""
    say(f"{key}: {result['title']}")
    for row in result["comparison"]:
        ours, paper = (
            "-" if row[name] is None else f"{row[name]:.4g}" if isinstance(row[name], float) else row[name]
            for name in ("ours", "paper")
        )
        unit = f" {row['unit']}" if row["unit"] else ""
        goal = "" if row["goal"] is None else f", goal {row['goal']}: {'reached' if row['reached'] else 'NOT reached'}"
        say(f"  {row['what']}: {ours}{unit}, paper {paper}{goal}", flush=True)


def print_calibration(summary: dict[str, Any]) -> None:
    """Print one line per camera."""
    for name, figures in summary["calibration"].items():
        say(
            f"{name}: {figures['dots_found']} of {figures['dots_expected']} dots, "
            f"sigma_nor {figures['sigma_nor_test']:.4f} pitch, "
            f"lens array fitted to {figures['lens_array_rms_px']:.3f} px"
        )


def print_vectors(summary: dict[str, Any], out: Path) -> None:
    """Print one line per pair, up to `LISTED_PAIRS`."""
    pairs = summary["pairs"]
    for pair in pairs[:LISTED_PAIRS]:
        say(f"{out / 'vectors' / pair['file']}: {100 * pair['valid_fraction']:.1f} % valid vectors")
    if len(pairs) > LISTED_PAIRS:
        count, share = summary.get("pairs_finished", len(pairs)), 100 * summary["valid_fraction"]
        say(f"{count} {_noun(summary)}s in all, {share:.1f} % valid vectors on average")


def print_failed(summary: dict[str, Any], where: TextIO) -> None:
    """List the pairs that failed, and print the number of pairs that failed in earlier runs and were not repeated."""
    failed = failed_now(summary)
    for item in failed[:LISTED_PAIRS]:
        say(f"failed: {_noun(summary)} {item['pair']}: {item['reason']}", file=where)
    total, earlier = summary["experiment"]["pairs"], len(summary["failed"]) - len(failed)
    unnamed = summary.get("pairs_failed", len(summary["failed"])) - len(summary["failed"])
    if failed:
        count = len(failed) + unnamed
        say(f"{count} of {total} {_noun(summary)}s failed; the same command tries them again", file=where)
    if earlier:
        say(f"{earlier} of {total} {_noun(summary)}s failed in earlier runs and were not tried in this one", file=where)


def print_without_vectors(summary: dict[str, Any], where: TextIO) -> None:
    """Name the pairs of this run that have no valid vector."""
    noun, pairs = _noun(summary), summary["without_vectors"]
    say(
        f"no vector is valid in {name_pairs(pairs[:LISTED_PAIRS], noun, len(pairs))}: see the warnings, and light and "
        "volumes in the report",
        file=where,
    )


def _noun(summary: dict[str, Any]) -> str:
    """Return what the results are numbered by."""
    return "instant" if "series" in summary["experiment"] else "pair"


def failed_now(summary: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the entries of the pairs that failed in this run."""
    return [item for item in summary["failed"] if not item.get("earlier")]
