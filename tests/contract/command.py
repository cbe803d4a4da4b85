"""The command line in processes of its own, and what a run leaves."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

WAIT_S = 600.0
"""Longest time that a process may take [s]."""


def start(*command, loops=None, **options):
    """Start a Python process with loops of the CPU or of a GPU; default: those of this process."""
    environment = os.environ | {"COLUMNS": "200"}
    if loops is not None:
        environment.pop("LFPIV_EMULATE_GPU", None)
        environment |= {"LFPIV_EMULATE_GPU": "1"} if loops == "gpu" else {}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, *map(str, command)], env=environment, **pipes, **options)


@dataclass(frozen=True)
class Done:
    """What a finished process left."""

    status: int
    output: str
    errors: str


def edit(file, old, new):
    """Replace a text in a file."""
    text = file.read_text("utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), "utf-8")


def finish(process):
    output, errors = process.communicate(timeout=WAIT_S)
    return Done(process.returncode, output, errors)


def lfpiv(*arguments):
    """Run the command line."""
    return finish(start("-m", "lfpiv", *arguments))


def done(*arguments):
    """Run the command line, which must succeed."""
    found = lfpiv(*arguments)
    assert found.status == 0, found.errors
    return found


@dataclass(frozen=True)
class Run:
    """An experiment and its results. Tests work on copies."""

    experiment: Path
    out: Path
    killed: int = 0
    """Exit status of an earlier invocation, which a signal ended."""
    early: bytes = b""
    """Vectors of the first pair as the killed invocation left them."""
