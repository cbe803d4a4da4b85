"""Progress callbacks: a run reports the name of a step and its finished fraction, a step reports its fraction only."""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called as ``progress(step, fraction)``, fraction from 0 to 1."""

PROGRESS_FILE = "LFPIV_PROGRESS_FILE"
"""Variable of the environment that names a file to which progress is appended as lines of JSON. The studio reads it."""

RECORD_EVERY_S = 0.2
"""Shortest time between two records of a step or a pair."""

StepProgress = Callable[[float], None]
"""Called as ``progress(fraction)``, fraction from 0 to 1."""


def ignore_progress(step: str, fraction: float) -> None:
    """Do nothing; the default progress of a run."""


def part_of(progress: StepProgress, first: float, last: float) -> StepProgress:
    """Return the progress of a part of a step that runs from fraction `first` to fraction `last`."""
    return lambda fraction: progress(first + (last - first) * fraction)


_recorded: dict[str, float] = {}
"""Step or pair -> time of its last record [s]."""


def record(step: str, fraction: float, pair: int | None = None) -> None:
    """Append the progress of a step, or of one pair, to the file that the environment names, if it names one."""
    path, now = os.environ.get(PROGRESS_FILE), time.time()
    if not path or (fraction < 1 and now - _recorded.get(step, 0.0) < RECORD_EVERY_S):
        return
    _recorded[step] = now
    with contextlib.suppress(OSError), open(path, "a", encoding="utf-8") as file:
        item = {"step": step, "fraction": round(fraction, 4), "at": round(now, 2)}
        file.write(json.dumps(item | ({} if pair is None else {"pair": pair})) + "\n")
