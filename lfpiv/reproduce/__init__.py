"""The paper's tables and figures, computed by this software and shown beside the paper's own; and what it did not show.

A case is a module of this package named by its key in `CASES`. It provides

``TITLE`` : str
    Heading on the page: what the paper shows there.
``def run(scale, work, *, seed=0, progress) -> dict``
    Compute the case: ``scale`` is "small" or "paper", ``work`` an existing folder that is the case's own, ``seed`` a
    whole number that every random draw derives from, ``progress`` a callable taking (step, finished fraction).
    It returns a JSON-able dict made by `page.result`: the figures under the keys that ``reproduce.json`` promises,
    and what the page shows: ``comparison`` rows of `page.compare` (ours, the paper's, goal, reached), ``figures``
    (PNG files written into ``work``, with captions), ``tables``, ``notes``. NaN and NumPy values are converted.

`reproduce` keeps each case's result as ``result.json`` in its work folder by atomic rename and takes it from there on
a rerun. A long case keeps its own steps with `store.kept` (JSON) and `store.kept_arrays` (arrays) in the same way.
Case modules may import anything at module level: they are loaded when their case is run.
"""

from __future__ import annotations

import importlib
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from lfpiv.errors import InputError
from lfpiv.version import __version__

__all__ = ["BEYOND", "CASES", "PAPER", "SCALES", "reproduce"]

log = logging.getLogger(__name__)

PAPER = ("table1", "table3", "fig10", "fig12", "fig14", "fig19", "lsi")
"""Keys of the paper's cases, in its order."""
BEYOND = ("optics", "cameras", "sweeps", "choices")
"""Keys of the cases that the paper did not show."""
CASES = (*PAPER, *BEYOND)
"""All of them, in the order of the page."""

SCALES = ("small", "paper")

Progress = Callable[[str, float], None]


def reproduce(
    cases: Sequence[str] = CASES,
    out: str | Path = "reproduce",
    scale: str = "small",
    *,
    seed: int = 0,
    progress: Progress | None = None,
    finished: Callable[[str, dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Compute cases into ``out``: ``reproduce.json``, one PNG per figure, ``index.html``.

    Parameters
    ----------
    cases : sequence of str
        Keys of `CASES`, or "all".
    out : path
        Folder for the results. Finished cases of the same scale and seed are kept; so are finished parts of others.
    scale : {"small", "paper"}
        "paper": the paper's own sizes, hours; "small": smaller volumes and fewer densities.
    seed : int
        Every random draw derives from it.
    progress : callable, optional
        Called with (step, finished fraction).
    finished : callable, optional
        Called with (key, result) when a case is done.

    Returns
    -------
    dict
        The content of ``reproduce.json``: of the cases asked for, and of those the folder already holds.

    Raises
    ------
    InputError
        If a case, the scale or the seed is unknown or out of range, or the folder cannot be written or is of another
        scale or seed.
    """
    from lfpiv.reproduce import page, store

    keys = _checked_cases(cases)
    if scale not in SCALES:
        raise InputError(f"scale: expected one of {', '.join(SCALES)}, got {scale!r}.")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise InputError(f"seed: expected a whole number >= 0, got {seed!r}.")
    report = progress or (lambda step, fraction: None)
    settings = {"scale": scale, "seed": seed, "version": __version__}
    out = Path(out)
    store.open_folder(out, settings)
    for key in keys:
        case = importlib.import_module(f"lfpiv.reproduce.{key}")
        work = out / "work" / key
        work.mkdir(parents=True, exist_ok=True)
        kept = (work / "result.json").exists()

        def compute(case: ModuleType = case, key: str = key, work: Path = work) -> dict[str, Any]:
            start, start_cpu = time.perf_counter(), time.process_time()

            def step(what: str, fraction: float) -> None:
                report(f"{key}: {what}", fraction)

            result = case.run(scale, work, seed=seed, progress=step)
            spent = {"wall_s": time.perf_counter() - start, "cpu_s": time.process_time() - start_cpu}
            return {"title": case.TITLE, "time": spent, **result}

        result = store.kept(work / "result.json", settings, compute)
        if kept:
            log.info("%s: finished before, kept", key)
        page.write(out, settings)
        if finished is not None:
            finished(key, result)
    return page.write(out, settings)


def _checked_cases(cases: Sequence[str]) -> list[str]:
    """Keys asked for, each once, in the order of the page."""
    asked = [cases] if isinstance(cases, str) else list(cases)
    unknown = [key for key in asked if key not in (*CASES, "all")]
    if unknown or not asked:
        found = repr(unknown[0]) if unknown else "none"
        raise InputError(f"cases: expected some of {', '.join(CASES)} or all, got {found}.")
    return [key for key in CASES if key in asked or "all" in asked]
