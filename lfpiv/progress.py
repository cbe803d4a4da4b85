"""Progress callbacks: a run reports the name of a step and its finished fraction, a step reports its fraction only."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, float], None]
"""Called as ``progress(step, fraction)``, fraction from 0 to 1."""

PROGRESS_FILE = "LFPIV_PROGRESS_FILE"
"""Variable of the environment that names a file to which progress is appended as lines of JSON. The studio reads it."""

StepProgress = Callable[[float], None]
"""Called as ``progress(fraction)``, fraction from 0 to 1."""


def ignore_progress(step: str, fraction: float) -> None:
    """Do nothing; the default progress of a run."""


def part_of(progress: StepProgress, first: float, last: float) -> StepProgress:
    """Return the progress of a part of a step that runs from fraction `first` to fraction `last`."""
    return lambda fraction: progress(first + (last - first) * fraction)
