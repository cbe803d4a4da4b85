"""Compute the cases of a study into a folder, each once, and show them on one page.

A case is a module. It provides

``TITLE`` : str
    Heading on the page.
``def run(scale, work, *, seed=0, progress) -> dict``
    Compute the case: ``scale`` is "small" or "paper", ``work`` an existing folder of the case's own, ``seed`` a whole
    number that every random draw derives from, ``progress`` a callable taking (step, finished fraction). It returns a
    JSON-able dict made by `page.result`.

The result of each case is stored as ``work/<key>/result.json``, and a rerun reads it from there. A long case stores its
steps as well, by `store.cached` (JSON) and `store.cached_arrays`.
"""

from __future__ import annotations

import importlib
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from lfpiv.errors import InputError
from lfpiv.progress import Progress
from lfpiv.reproduce import page, store
from lfpiv.version import __version__

log = logging.getLogger(__name__)

SCALES = ("small", "paper")


@dataclass(frozen=True, kw_only=True)
class Study:
    """Cases that one page shows."""

    title: str
    """Heading of the page."""
    about: str
    """Subject of the cases, first part of a sentence on the page."""
    modules: Mapping[str, str]
    """Key of each case -> full name of its module, in the page's order. A module is imported when its case is run."""


def compute(
    study: Study,
    cases: Sequence[str],
    out: str | Path,
    scale: str,
    *,
    seed: int = 0,
    progress: Progress | None = None,
    finished: Callable[[str, dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Compute cases of a study; arguments, return and errors as of `lfpiv.reproduce.reproduce`."""
    keys = _checked_cases(study, cases)
    if scale not in SCALES:
        raise InputError(f"scale: expected one of {', '.join(SCALES)}, got {scale!r}.")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise InputError(f"seed: expected a whole number >= 0, got {seed!r}.")
    report = progress or (lambda step, fraction: None)
    settings = {"scale": scale, "seed": seed, "version": __version__}
    out = Path(out)
    store.open_folder(out, settings)
    for key in keys:
        work = out / "work" / key
        work.mkdir(parents=True, exist_ok=True)
        known = (work / "result.json").exists()
        case = importlib.import_module(study.modules[key])
        result = store.cached(work / "result.json", settings, _timed(case, key, scale, work, seed, report))
        if known:
            log.info("%s: finished before, not computed again", key)
        page.write(out, settings, study.title, study.about, list(study.modules))
        if finished is not None:
            finished(key, result)
    return page.write(out, settings, study.title, study.about, list(study.modules))


def _timed(
    case: ModuleType, key: str, scale: str, work: Path, seed: int, report: Progress
) -> Callable[[], dict[str, Any]]:
    """Return a function that runs a case and adds its title and time."""

    def run() -> dict[str, Any]:
        start, start_cpu = time.perf_counter(), time.process_time()
        result = case.run(scale, work, seed=seed, progress=lambda what, fraction: report(f"{key}: {what}", fraction))
        spent = {"wall_s": time.perf_counter() - start, "cpu_s": time.process_time() - start_cpu}
        return {"title": case.TITLE, "time": spent, **result}

    return run


def _checked_cases(study: Study, cases: Sequence[str]) -> list[str]:
    """Return the requested keys, each once, in the order of the page."""
    wanted = [cases] if isinstance(cases, str) else list(cases)
    unknown = [key for key in wanted if key not in (*study.modules, "all")]
    if unknown or not wanted:
        found = repr(unknown[0]) if unknown else "none"
        raise InputError(f"cases: expected some of {', '.join(study.modules)} or all, got {found}.")
    return [key for key in study.modules if key in wanted or "all" in wanted]
