"""The process of a run, `lfpiv run`, which lives on without the studio: start, pause, resume, stop, and its reports.

Beside its results a run that the studio starts leaves its log, `.run.log`, and its progress, `.run.jsonl`. A run that a
terminal started is known by its lock alone.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import psutil

from lfpiv.errors import InputError
from lfpiv.progress import PROGRESS_FILE
from lfpiv.quantities import duration
from lfpiv.records import RecordError, read_object, read_text, validate
from lfpiv.results.folder import Folder, Holder, make_writable
from lfpiv.warn import Warning

LOG, PROGRESS = ".run.log", ".run.jsonl"
PAIR_STEPS = ("image pairs", "instants")
SIGNALS = {"pause": (signal.SIGSTOP,), "resume": (signal.SIGCONT,), "stop": (signal.SIGCONT, signal.SIGINT)}
REPORT_S = 20.0
"""Time that the report of a run takes [s]."""
LEAST_FRACTION, SURE_FRACTION, SURE_S = 0.02, 0.1, 60.0
"""Smallest finished fractions of a step from which its remaining time is told: after `SURE_S`, and before [s]."""
SHOWN_PAIRS = 12
"""Pairs, the latest, that have a bar."""
LARGEST_BYTES = 1 << 20
"""Bytes at the end of log and progress that are read."""


def holder(out: Path) -> Holder | None:
    """Return the process of this machine that holds a folder, or None."""
    try:
        found = validate(Holder, read_object(read_text(Folder(out).lock)))
    except (OSError, RecordError):
        return None
    return found if found.host == socket.gethostname() and psutil.pid_exists(found.process) else None


def start(experiment: Path, out: Path, options: Sequence[str]) -> int:
    """Start `lfpiv run` in a session of its own; return its process. InputError if another run holds the folder."""
    if (other := holder(out)) is not None:
        raise InputError(
            f"{out}: expected a folder that no other run writes to, found it held by process {other.process} since "
            f"{other.since[:40]}. Wait for its end, stop it, or choose another folder."
        )
    make_writable(out)
    for name in (LOG, PROGRESS):
        (out / name).unlink(missing_ok=True)
    folder = os.path.relpath(out, experiment.parent)
    command = [sys.executable, "-m", "lfpiv", "run", experiment.name, "--out", folder, *options]
    with (out / LOG).open("wb") as log:
        log.write(("$ lfpiv " + " ".join(command[3:]) + "\n").encode(errors="replace"))
        log.flush()
        process = psutil.Popen(
            command, stdout=log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, start_new_session=True,
            env={**os.environ, PROGRESS_FILE: str(out / PROGRESS)}, cwd=experiment.parent,
        )  # fmt: skip
    children[process.pid] = process
    return int(process.pid)


children: dict[int, psutil.Popen] = {}
"""Runs that this studio started: they are asked for their status, or they stay as zombies."""


def status(process: int) -> str:
    """Return "running", "paused" or "ended"."""
    own = children.get(process)
    if own is not None and own.poll() is not None:
        return "ended"
    try:
        state = psutil.Process(process).status()
    except psutil.Error:
        return "ended"
    if state in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD):
        return "ended" if own is None else "running"  # the last threads of a process end after its first
    return "paused" if state in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP) else "running"


def control(process: int, what: str) -> None:
    """Let a run and its workers "pause" or "resume", or "stop" it as Ctrl-C does: Start goes on from there."""
    for number in SIGNALS[what]:
        with contextlib.suppress(OSError):
            leads = os.getpgid(process) == process and number != signal.SIGINT
            (os.killpg if leads else os.kill)(process, number)


def tail(path: Path) -> str:
    """Return the end of a text file; "" where there is none."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - LARGEST_BYTES))
        return file.read().decode("utf-8", errors="replace")
    return ""


def logged_warnings(out: Path) -> list[str]:
    """Return the warnings in the log of a run, each once."""
    found = re.findall(r"^\d\d:\d\d:\d\d WARNING (.*)$", tail(out / LOG), re.MULTILINE)
    return list(dict.fromkeys(found))


def stages(out: Path) -> list[dict[str, Any]]:
    """Return the steps of a run in order, as `_shown` has them; a step of pairs with its latest `SHOWN_PAIRS`."""
    steps: dict[str, dict[str, Any]] = {}
    for line in tail(out / PROGRESS).splitlines():
        with contextlib.suppress(ValueError, KeyError, TypeError):
            item = json.loads(line)
            now = {"at": float(item["at"]), "fraction": float(item["fraction"])}
            first = {"began": now["at"], "first": now["fraction"], "pair": item.get("pair")}
            steps[item["step"]] = steps.get(item["step"], first) | now
    shown = [_shown(name, step) for name, step in steps.items()]
    pairs = [stage for stage in shown if stage["pair"] is not None]
    stages = [stage for stage in shown if stage["pair"] is None]
    for stage in stages:
        stage["pairs"] = pairs[-SHOWN_PAIRS:] if stage["name"] in PAIR_STEPS else []
    return stages


def _shown(name: str, step: dict[str, Any]) -> dict[str, Any]:
    """Return a step as the page shows it."""
    seconds, part = None, step["fraction"] - step["first"]
    taken = max(step["at"] - step["began"], 1e-3)
    if part >= (LEAST_FRACTION if taken > SURE_S else SURE_FRACTION) and step["fraction"] < 1:
        seconds = (1 - step["fraction"]) / part * taken
    left = "" if seconds is None else f"about {duration(seconds)} left"
    percent = round(100 * step["fraction"], 1)
    return {"name": name, "percent": percent, "left": left, "seconds": seconds, "pair": step["pair"]}


def time_left(out: Path) -> str:
    """Return the time left of a whole run, report included, as soon as its pairs tell; "" before."""
    for stage in stages(out):
        if stage["name"] in PAIR_STEPS and stage["seconds"] is not None:
            return f"about {duration(stage['seconds'] + REPORT_S)} left, report included"
    return ""


def finished_warnings(out: Path) -> list[dict[str, Any]]:
    """Return the warnings of a finished run: its records, each with the sentence."""
    try:
        records = read_object(read_text(Folder(out).summary))["warning_records"]
        return [{**record, "text": Warning.from_json(record).sentence} for record in records]
    except (OSError, RecordError, KeyError, TypeError):
        return []
