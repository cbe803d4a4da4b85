"""Answer a run at once where nothing changed since the same command finished: keep results, summary and report.

A finished run leaves a digest of its command, of this program, and of size and times of all files that it read and
wrote. The same command looks at these files and opens none of them. If one differs, the run checks settings, images and
results as ever: it compares contents, verifies digests and repeats what does not fit.

This module loads no kernels and no library for numerics, which takes longer than the answer.
"""

from __future__ import annotations

import hashlib
import logging
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lfpiv import files
from lfpiv.files import writing
from lfpiv.records import RecordError, digest, read_object, read_text, validate
from lfpiv.results import summary_file
from lfpiv.results.folder import Folder
from lfpiv.version import __version__

if TYPE_CHECKING:
    from lfpiv.experiment.experiment import Experiment

log = logging.getLogger(__name__)

MOST_FILES = 50_000
"""Largest number of files in a record. Runs with more make none, and check everything every time."""

State = tuple[int, int, int] | None
"""Size [byte] and times of the last change of a file's content and of its entry [ns]; None for a missing file."""


@dataclass(frozen=True, kw_only=True)
class _Record:
    """What is known of a run that finished."""

    stamp: str
    """Digest of command, places, program, and the states of the files."""
    files: tuple[str, ...]
    """Paths of all files that were read or written."""
    reused: tuple[str, ...]
    """Names of the results."""


def repeat(command: Mapping[str, Any], out: str | Path) -> dict[str, Any] | None:
    """Return the summary of a finished run if the same command finds nothing changed, None otherwise.

    `command` has the arguments of `lfpiv.runs.pipeline.run`, ``experiment`` as it was given.

    Raises
    ------
    InputError
        If another run holds the folder.
    StorageError
        If the summary cannot be written.
    """
    start, folder = time.perf_counter(), Folder(Path(out))
    try:
        known = validate(_Record, read_object(read_text(folder.record)))
        if len(known.files) > MOST_FILES:
            return None
        with folder.held():
            if known.stamp != _stamp(command, folder, map(state_of, known.files)):
                return None
            summary = read_object(read_text(folder.summary))
            log.info("nothing changed since the same command finished: results and report are kept")
            summary["reused"] = list(known.reused)
            summary["timings_s"] |= {"total": time.perf_counter() - start}
            written = summary_file.write(summary, folder.summary)
            _write(replace(known, stamp=_stamp(command, folder, map(state_of, known.files))), folder)
            return written
    except (FileNotFoundError, RecordError):
        return None


def look_at(experiment: Experiment) -> dict[str, State]:
    """Return the states of all files that a run reads; empty if they are too many."""
    found: dict[str, State] = {}
    for path in _read_files(experiment):
        found.setdefault(str(path.absolute()), None)
        if len(found) > MOST_FILES:
            return {}
    return {path: state_of(path) for path in found}


def record(
    command: Mapping[str, Any],
    folder: Folder,
    experiment: Experiment,
    read: Mapping[str, State],
    summary: Mapping[str, Any],
) -> None:
    """Write the record of a run that finished; remove an earlier one if pairs failed or there are too many files.

    `read` is from `look_at` before the run read anything, `summary` what the run returns.
    """
    written = {str(path.absolute()): state_of(path) for path in _written_files(folder)}
    if summary["failed"] or not read or len(read) + len(written) > MOST_FILES:
        with writing(folder.record):
            folder.record.unlink(missing_ok=True)
        return
    first, after = command["pairs"] or (0, None)
    numbers = [pair for pair in experiment.numbers if first <= pair and (after is None or pair < after)]
    reused = ("calibration", *(f"vectors of {experiment.name_of(pair)}" for pair in numbers))
    states = {**read, **written}
    _write(_Record(stamp=_stamp(command, folder, states.values()), files=tuple(states), reused=reused), folder)


def state_of(path: str | Path) -> State:
    """Return the state of a file; None if it is missing or no file."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def program() -> str:
    """Return a digest of this program: of its version, and of names, sizes and times of its files."""
    digest = hashlib.blake2b(__version__.encode(), digest_size=16)
    kernels = find_spec("lfpiv_kernels")
    folders = [Path(__file__).parents[1], *(map(Path, (kernels.submodule_search_locations or ()) if kernels else ()))]
    for folder in folders:
        for place, inner, names in os.walk(folder):
            inner[:] = sorted(name for name in inner if name != "__pycache__")
            for name in sorted(names):
                status = os.stat(Path(place, name))
                digest.update(f"{place}/{name} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()


def _read_files(experiment: Experiment) -> Iterator[Path]:
    """Yield the files that a run of an experiment reads, some of them more than once."""
    yield experiment.path
    yield experiment.path.parent / "truth" / "spec.json"  # of a simulated experiment, for the report
    yield from experiment.mask_files(experiment.all_frames())
    yield from (image.file for image in experiment.calibration_images())
    for camera in experiment.cameras:
        backgrounds = (experiment.background_path(camera.name, frame) for frame in experiment.frames)
        yield from (path for path in backgrounds if path is not None)
    for pair in experiment.numbers:
        yield from (image.file for image in experiment.pair_images(pair))


def _written_files(folder: Folder) -> Iterable[Path]:
    """Return the files of results, and the places of those that a run may write."""
    single = [folder.calibration, folder.self_calibration, folder.background, folder.guard, folder.refinement]
    single += [folder.bootstrap, folder.tracks, folder.summary, folder.pairs, folder.report]
    places = (folder.vectors(0).parent, folder.volume(0, 0).parent, folder.particles(0).parent)
    return [*single, *(path for place in places for path in sorted(place.glob("*.nc")))]


def _stamp(command: Mapping[str, Any], folder: Folder, states: Iterable[State]) -> str:
    """Return the digest of a command on a folder and of files; of a copy of the folder it is another one."""
    places = os.path.abspath(command["experiment"]), os.path.abspath(folder.path)
    return digest({"known": files.plain([command, places, program(), list(states)])})


def _write(found: _Record, folder: Folder) -> None:
    with writing(folder.record):
        files.write_json(vars(found), folder.record)
