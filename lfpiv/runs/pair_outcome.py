"""Outcome of the work on a pair, its progress, and the wait until its results are written."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

from lfpiv.errors import StorageError
from lfpiv.progress import StepProgress
from lfpiv.runs.frames import failure

PREPARED, RECONSTRUCTED = 0.05, 0.9
"""Finished fractions of a pair before its first iteration and when its volumes are reconstructed, for progress bars."""

CORRELATED = 0.99
"""Finished fraction of a pair when only its vectors remain to be written."""

PairProgress = Callable[[int, float], None]
"""Called as ``progress(number, fraction)``: the place of a pair in its work unit, from 0, and its finished fraction."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of the work on a pair."""

    pair: int
    reason: str = ""
    """Why the pair failed; empty if it is finished."""
    died: bool = False
    """Whether the worker process died, perhaps after it finished the pair."""
    peak_memory_mib: float = 0.0
    """Largest memory that the worker process held so far; 0 for pairs done in the process of the run."""


@dataclass(frozen=True, kw_only=True)
class Computed:
    """A pair whose results are computed and perhaps not written yet."""

    pair: int
    reason: str
    """Why it failed; empty if it did not."""
    written: tuple[Future[None], ...]
    """Its results that are being written."""
    progress: StepProgress

    def outcome(self) -> Outcome:
        """Wait until the results are written and return the outcome; raise StorageError if they cannot be written."""
        reason = self.reason
        for future in self.written:
            try:
                future.result()
            except StorageError:
                raise
            except Exception as error:  # such as values that no file may hold
                reason = reason or str(failure(error))
        if not reason:
            self.progress(1.0)
        return Outcome(pair=self.pair, reason=reason)
