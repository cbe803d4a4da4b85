"""Folders of compiled kernels: found or replaced before Taichi and Warp start, and verified before they are used.

Both libraries keep compiled kernels in the user's cache folder, and trust what they find there. Taichi aborts the
process where there is no home directory, and either may crash on a damaged file. So `prepare` names a folder that can
be written. What has changed since it was recorded is removed at the start, and compiled again.
"""

import atexit
import contextlib
import hashlib
import json
import logging
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

log = logging.getLogger(__name__)

DIGESTS = "digests.json"
"""File with the digests of the files beside it."""

_MODULE = "wp_lfpiv_kernels.*"
"""Folders of this package's modules in Warp's cache."""
_UNFINISHED = re.compile(r"_p\d+_t\d+$")
"""End of the name of a module's folder while Warp builds it."""
_KERNEL, _INDEX = ".tic", ".tcb"
"""Suffixes of a kernel compiled by Taichi, and of the index of all of them."""
_SOURCES = (".cpp", ".cu", ".h")
"""Files of a module that Warp does not read again."""

_compilation_logged = False


def prepare() -> None:
    """Set the environment so that Taichi and Warp can start; call it before either is imported.

    Both need a home directory or a cache folder, and a cache folder that can be written. Where there is none, a folder
    in the temporary directory takes its place for this process and its children, and the log says so.

    Raises
    ------
    RuntimeError
        If the temporary directory cannot be written either.
    """
    os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # asks a server otherwise, and keeps the answer at home
    own = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    wanted = [
        own,
        *(os.environ[name] for name in ("WARP_CACHE_PATH", "TI_OFFLINE_CACHE_FILE_PATH") if name in os.environ),
    ]
    refused = next((folder for folder in wanted if not _is_writable(folder)), None)
    if refused is not None:
        temporary = _temporary_folder(refused)
        log.warning(
            "kernels are compiled into %s, because %s cannot be written. Set XDG_CACHE_HOME to keep them elsewhere.",
            temporary,
            refused,
        )
        for name in ("WARP_CACHE_PATH", "TI_OFFLINE_CACHE_FILE_PATH"):
            os.environ.pop(name, None)
        os.environ["XDG_CACHE_HOME"] = temporary
        os.environ.setdefault("MPLCONFIGDIR", os.path.join(temporary, "matplotlib"))


def _is_writable(folder: str) -> bool:
    """Return whether a folder exists or can be made, and takes a file."""
    if not os.path.isabs(folder):  # "~": a user without a home directory
        return False
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _temporary_folder(refused: str) -> str:
    """Return this user's cache in the temporary directory, which nobody else can write."""
    try:
        folder = os.path.join(tempfile.gettempdir(), f"lfpiv-cache-{os.getuid() if hasattr(os, 'getuid') else 'user'}")
        with contextlib.suppress(FileExistsError):
            os.mkdir(folder, 0o700)
        if _is_private(folder) and _is_writable(folder):
            return folder
        folder = tempfile.mkdtemp(prefix="lfpiv-cache-")
    except OSError as error:
        raise RuntimeError(
            f"compiled kernels: neither {refused} nor a temporary folder can be written ({error.strerror}). Set "
            "XDG_CACHE_HOME to a folder that can."
        ) from None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _is_private(folder: str) -> bool:
    """Return whether a folder, not a link to one, belongs to this user and nobody else can write into it."""
    about = os.lstat(folder)
    mine = not hasattr(os, "getuid") or about.st_uid == os.getuid()
    return stat.S_ISDIR(about.st_mode) and mine and not about.st_mode & 0o022


def taichi_folder() -> Path:
    """Return the folder of Taichi's compiled kernels, which other programs do not use."""
    named = os.environ.get("TI_OFFLINE_CACHE_FILE_PATH")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lfpiv" / "taichi"


def log_compilation(folder: Path) -> None:
    """Log, once per process, that kernels are compiled into a folder."""
    global _compilation_logged
    if not _compilation_logged:
        log.info("compiling kernels, once; they are kept in %s", folder)
    _compilation_logged = True


def verify_warp(folder: Path) -> None:
    """Remove modules of this package from Warp's cache whose files have changed; record the files of new modules."""
    removed = 0
    for module in folder.glob(_MODULE):
        if _UNFINISHED.search(module.name):
            continue
        try:
            files = [path for path in module.iterdir() if path.suffix not in _SOURCES and path.name != DIGESTS]
            known, found = _read_digests(module), {path.name: _digest(path) for path in files}
            for path in files:
                if path.suffix == ".meta" and path.name not in known:
                    json.loads(path.read_bytes())
            if any(found.get(name) != digest for name, digest in known.items()):
                raise ValueError
            if known != found:
                _write_digests(module, found)
        except ValueError:
            removed += 1
            shutil.rmtree(module, ignore_errors=True)
        except OSError:  # another process replaces the module now
            continue
    _tell(folder, removed, "modules")


def verify_taichi(folder: Path) -> bool:
    """Remove Taichi's compiled kernels that are not as `seal_taichi` recorded them; all of them if the index is not.

    Return whether some are left.
    """
    with _locked(folder):
        files = {path.name: path for path in _kernels(folder)}
        try:
            known = _read_digests(folder)
        except ValueError:
            known = dict.fromkeys(files, "")
        unrecorded = [name for name in files if name not in known]  # of a process that was killed
        changed = [name for name in files if name in known and known[name] != _digest(files[name])]
        if not all(name.endswith(_KERNEL) for name in (*unrecorded, *changed)):
            unrecorded = list(files)
        for name in {*unrecorded, *changed}:
            files.pop(name).unlink(missing_ok=True)
    _tell(folder, len(changed), "files")
    return bool(files)


def seal_taichi(folder: Path, finish: Callable[[], None]) -> None:
    """Let Taichi write its compiled kernels by `finish`, and record their digests."""
    with contextlib.suppress(OSError), _locked(folder):
        finish()
        _write_digests(folder, {path.name: _digest(path) for path in _kernels(folder)})


def _kernels(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix in (_KERNEL, _INDEX)]


def _tell(folder: Path, removed: int, noun: str) -> None:
    if removed:
        log.warning(
            "%s: %d %s of compiled kernels are not as recorded; they are compiled again.", folder, removed, noun
        )


def _read_digests(folder: Path) -> dict[str, str]:
    """Return the recorded digests by names of files, empty if there are none; raise ValueError for a damaged record."""
    try:
        known = json.loads((folder / DIGESTS).read_bytes())
    except FileNotFoundError:
        return {}
    except RecursionError:
        raise ValueError from None
    if not isinstance(known, dict):
        raise ValueError
    return known


def _write_digests(folder: Path, digests: dict[str, str]) -> None:
    """Write the record in one step, so that another process never reads a part of it."""
    scratch = folder / f".{DIGESTS}.{os.getpid()}.tmp"
    scratch.write_text(json.dumps(digests, sort_keys=True), "utf-8")
    os.replace(scratch, folder / DIGESTS)


def _digest(path: Path) -> str:
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder against other processes; do without where the file system has no locks."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / ".lock", "w") as file:
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield
