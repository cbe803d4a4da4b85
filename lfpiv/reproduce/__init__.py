"""The paper's tables and figures, computed by this software and shown beside the paper's own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from lfpiv.progress import Progress
from lfpiv.reproduce.study import SCALES, Study, compute

__all__ = ["CASES", "PAPER", "SCALES", "reproduce"]

CASES = ("table1", "table3", "fig10", "fig12", "fig14", "fig19", "lsi")
"""Keys of the cases, in the paper's order."""
PAPER = Study(
    title="The paper's tables and figures, reproduced",
    about="Weight estimation of multi-camera light-field PIV by a back-propagation network",
    modules={key: f"lfpiv.reproduce.{key}" for key in CASES},
)


def reproduce(
    cases: Sequence[str] = CASES,
    out: str | Path = "reproduce",
    scale: str = "small",
    *,
    seed: int = 0,
    progress: Progress | None = None,
    finished: Callable[[str, dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Compute cases of the paper into ``out``: ``reproduce.json``, one PNG per figure, ``index.html``.

    Parameters
    ----------
    cases : sequence of str
        Keys of `CASES`, or "all".
    out : path
        Folder for the results. Finished cases and parts of the same scale and seed are not computed again.
    scale : {"small", "paper"}
        "paper": the sizes of the paper, which take hours. "small": smaller volumes and fewer densities.
    seed : int
        Seed of all random numbers.
    progress : callable, optional
        Called with (step, finished fraction).
    finished : callable, optional
        Called with (key, result) when a case is done.

    Returns
    -------
    dict
        The content of ``reproduce.json``: these cases, and those that the folder already holds.

    Raises
    ------
    InputError
        If a case, the scale or the seed is unknown or out of range, or the folder cannot be written or holds
        results of another scale or seed.
    """
    return compute(PAPER, cases, out, scale, seed=seed, progress=progress, finished=finished)
