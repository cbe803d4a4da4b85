"""The output folder of a run: paths of its files, a check that it can be written, and a lock for one run at a time."""

from __future__ import annotations

import contextlib
import errno
import functools
import json
import logging
import operator
import os
import re
import secrets
import shutil
import socket
import stat
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lfpiv.errors import InputError, StorageError
from lfpiv.experiment.recording import Recording
from lfpiv.files import remove_leftovers, writing
from lfpiv.records import RecordError, read_object, validate
from lfpiv.warn import Code, Warning, warn

log = logging.getLogger(__name__)

TRACKS = "tracks.nc"
"""Name of the table of tracks in the folder of a run."""

MOST_DIGITS = 19
"""Digits from which on the number in a file's name is no number of a pair."""

_NUMBER = re.compile(r"\d+")

RETIRED = ".outdated"
"""Suffix, in place of ``.nc``, of older results of a pair that failed after its images changed."""


@dataclass(frozen=True)
class Folder:
    """Paths of the files of a run."""

    path: Path
    recording: Recording = field(default_factory=Recording)
    """Names of the pairs and frames whose results are here."""

    @property
    def calibration(self) -> Path:
        """Calibration of all cameras."""
        return self.path / "calibration.h5"

    @property
    def self_calibration(self) -> Path:
        """Calibration corrected for movements of the cameras."""
        return self.path / "self_calibration.h5"

    def camera(self, name: str) -> Path:
        """Return the path of what the calibration has measured of one camera, until it is finished."""
        return self.path / f"calibration_{name}.h5"

    @property
    def background(self) -> Path:
        """Light that stands still in the particle images."""
        return self.path / "background.h5"

    @property
    def guard(self) -> Path:
        """Guard layers that the particle images demand."""
        return self.path / "guard.json"

    @property
    def bootstrap(self) -> Path:
        """Damping by ghosts, measured in simulated pairs."""
        return self.path / "bootstrap.json"

    @property
    def refinement(self) -> Path:
        """Size of the particles, and the voxels that it demands."""
        return self.path / "refinement.json"

    @property
    def tracks(self) -> Path:
        """Tracks of single particles over a time series."""
        return self.path / TRACKS

    @property
    def summary(self) -> Path:
        """Figures of the run as JSON."""
        return self.path / "summary.json"

    @property
    def pairs(self) -> Path:
        """Figures of all pairs, a line of JSON each, where they are too many for the summary."""
        return self.path / "pairs.jsonl"

    @property
    def report(self) -> Path:
        """Report of the run as HTML."""
        return self.path / "report.html"

    @property
    def record(self) -> Path:
        """Files that the last run read and wrote, with their sizes and times."""
        return self.path / ".record.json"

    @property
    def lock(self) -> Path:
        """Lock file of the run that writes here. It names the process."""
        return self.path / ".lock"

    @property
    def shared(self) -> Path:
        """Files that the workers of a run share; removed at its end."""
        return self.path / ".shared"

    def vectors(self, pair: int) -> Path:
        """Return the path of one pair's vectors; in a series it has the number of the pair's first instant."""
        return self.path / "vectors" / f"{self.recording.stem(pair)}.nc"

    def particles(self, pair: int) -> Path:
        """Return the path of one pair's linked particles, named as its vectors."""
        return self.path / "particles" / self.vectors(pair).name

    def volume(self, pair: int, frame: int) -> Path:
        """Return the path of a pair's volume of frame 0 or 1; two pairs of a series share an instant's volume."""
        return self.path / "volumes" / f"{self.recording.frame_of(pair, frame).stem}.nc"

    def new_volumes(self, pair: int) -> list[Path]:
        """Return the paths of a pair's volumes that no later pair has: both, or in a series the first one."""
        return [self.volume(pair, frame) for frame in range(self.recording.lasers)]

    def stored(self, numbers: range, *, vectors: bool, volumes: bool) -> bytearray:
        """Return for each pair 1 if all its files are there, 0 otherwise. This lists folders and opens no file."""
        wanted: list[Callable[[int], Path]] = [self.vectors] if vectors else []
        wanted += [functools.partial(self.volume, frame=frame) for frame in (0, 1)] if volumes else []
        found = bytearray(b"\x01") * len(numbers)
        for path_of in wanted:
            listed = self._listed(numbers, path_of)
            found = bytearray(map(operator.and_, found, listed))
        return found

    def _listed(self, numbers: range, path_of: Callable[[int], Path]) -> bytearray:
        """Return for each pair 1 if a file with the name of its result is in the folder of such results."""
        found, sample = bytearray(len(numbers)), path_of(0)
        first = int(_NUMBER.search(sample.name)[0])  # type: ignore[index]  # of the second frame of pair 0
        with contextlib.suppress(OSError), os.scandir(sample.parent) as entries:
            for entry in entries:
                match = _NUMBER.search(entry.name)
                pair = int(match[0]) - first if match and len(match[0]) < MOST_DIGITS else -1
                if pair in numbers and path_of(pair).name == entry.name:
                    found[numbers.index(pair)] = 1
        return found

    def sweep(self) -> None:
        """Remove half-written and shared files of a run that was killed. The caller must hold the lock."""
        for place in (self.path, self.vectors(0).parent, self.volume(0, 0).parent, self.particles(0).parent):
            for path in place.glob(".*.tmp"):
                with contextlib.suppress(OSError):  # a folder is nobody's half-written file
                    path.unlink(missing_ok=True)
        if self.shared.is_dir() and not self.shared.is_symlink():
            shutil.rmtree(self.shared, ignore_errors=True)
        else:
            self.shared.unlink(missing_ok=True)  # `rmtree` would wait for a pipe

    def require_kept(self) -> None:
        """Raise StorageError if the folder was removed or renamed after the calibration: later results make it anew."""
        if not self.calibration.exists():
            raise StorageError(
                f"{self.path}: it was removed or renamed during the run, with what it held. Put it back, or run the "
                "command again."
            )

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Lock the folder against other runs. The lock ends with the process at the latest.

        Raises
        ------
        InputError
            If another run holds the folder. The message names its process.
        """
        with writing(self.lock):
            file = _lock(self.lock)
        try:
            yield
        finally:
            if file is not None:
                with contextlib.suppress(OSError):  # while locked: no other run has the file open and locked
                    self.lock.unlink()
                os.close(file)


class VectorFiles(Mapping[int, Path]):
    """Pair -> path of its vectors, for some pairs of a folder; holds no path."""

    def __init__(self, folder: Folder, pairs: Collection[int]):
        self._folder, self._pairs = folder, pairs

    def __getitem__(self, pair: int) -> Path:
        if pair not in self._pairs:
            raise KeyError(pair)
        return self._folder.vectors(pair)

    def __iter__(self) -> Iterator[int]:
        return iter(self._pairs)

    def __len__(self) -> int:
        return len(self._pairs)


def _lock(path: Path) -> int | None:
    """Open and lock a file, and return its descriptor; None if the file system has no locks."""
    import fcntl

    while True:
        file = _open_lock(path)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.pread(file, 1000, 0)
            os.close(file)
            if error.errno not in (errno.EAGAIN, errno.EACCES):
                warn(log, Warning(code=Code.NO_LOCKS, subject=str(path.parent)))
                return None
            raise InputError(
                f"{path.parent}: expected a folder that no other run writes to, found it held by "
                f"{_process_name(holder)}. Wait for its end, stop it, or choose another --out. `lfpiv report` can "
                "read it meanwhile."
            ) from None
        try:
            same = os.path.samestat(os.fstat(file), os.stat(path))
        except FileNotFoundError:
            same = False
        if same:
            break
        os.close(file)  # its holder removed it after this process opened it
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    with contextlib.suppress(OSError):  # a full disk: the lock holds all the same, nameless
        os.ftruncate(file, 0)
        os.pwrite(file, json.dumps({"process": os.getpid(), "host": socket.gethostname(), "since": since}).encode(), 0)
    return file


def _open_lock(path: Path) -> int:
    """Open a lock file and return its descriptor; refuse at once a folder, a link or a pipe of that name."""
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    except OSError as error:
        if error.errno not in (errno.EISDIR, errno.ELOOP, errno.ENXIO):
            raise
        file = None
    if file is not None and stat.S_ISREG(os.fstat(file).st_mode):
        return file
    if file is not None:
        os.close(file)
    raise InputError(f"{path}: expected the lock file of a run, found a folder, a link or a pipe. Remove it.")


@dataclass(frozen=True, kw_only=True)
class Holder:
    """Content of a lock file."""

    process: int
    host: str
    since: str


def _process_name(holder: bytes) -> str:
    """Return the process that holds a lock, from the content of the lock file."""
    try:
        found = validate(Holder, read_object(holder))
    except RecordError:  # the holder has not written its name yet
        return "another process"
    return f"process {found.process} on {found.host[:80]} since {found.since[:40]}"


def retire(path: Path) -> Path:
    """Rename an outdated result and return its new path. The next result of the pair removes it."""
    return path.replace(path.with_suffix(RETIRED))


def make_writable(path: Path) -> list[Path]:
    """Make a folder and check that it can be written. Return the new folders, innermost first."""
    made = []
    try:
        for parent in (path, *path.parents):
            if parent.exists():
                break
            made.append(parent)
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".write-test-{os.getpid()}-{secrets.token_hex(4)}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        for parent in made:
            with contextlib.suppress(OSError):
                parent.rmdir()
        raise InputError(
            f"{path}: expected an output folder that can be written, found: {(error.strerror or str(error)).lower()}. "
            "Choose another one with --out."
        ) from None
    remove_leftovers(path)
    folder = Folder(path)
    for place in (folder.vectors(0).parent, folder.volume(0, 0).parent, folder.particles(0).parent):
        if place.exists() and not place.is_dir():
            raise InputError(
                f"{place}: expected a folder for results, found a file. Remove it or choose another --out."
            )
    results = (folder.calibration, folder.self_calibration, folder.background, folder.guard, folder.refinement)
    for place in (*results, folder.tracks, folder.summary, folder.report):
        if place.is_dir():
            raise InputError(
                f"{place}: expected a place for a file, found a folder. Remove it or choose another --out."
            )
    return made
