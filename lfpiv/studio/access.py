"""Who may ask the studio, and for which files: a token in the address, this machine's names, and the folders given."""

from __future__ import annotations

import contextlib
import hmac
import os
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from aiohttp import web

from lfpiv.errors import InputError, printable
from lfpiv.records import RecordError, open_regular, read_object, read_text
from lfpiv.results.folder import Folder

HOSTS = ("127.0.0.1", "localhost")  # names by which a browser of this machine asks
DEEPEST = 3
"""Levels of folders below a given one that are searched for experiments and results."""
MOST_FOLDERS = 5000
"""Largest number of folders that are searched."""
MOST_BYTES = 200_000
"""Size of the start of a file in which the tables of an experiment are looked for."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


def guard(token: str) -> Callable[[web.Request, Handler], Awaitable[web.StreamResponse]]:
    """Return what refuses requests without the token or its cookie, by other names of this machine, or of others."""

    @web.middleware
    async def guarded(request: web.Request, handler: Handler) -> web.StreamResponse:
        host = urlsplit(f"//{request.headers.get('Host', '')}")
        origin = request.headers.get("Origin")
        if host.hostname not in HOSTS or (origin and urlsplit(origin).netloc != host.netloc):
            raise web.HTTPForbidden(text="lfpiv studio answers its own page only.")
        name, asked = f"lfpiv_{host.port}", request.query.get("token", "")
        known = (asked, request.cookies.get(name, ""))
        if not any(hmac.compare_digest(word.encode(), token.encode()) for word in known):
            raise web.HTTPForbidden(text="Open the address that lfpiv studio printed; it holds a token.")
        try:
            response = await handler(request)
        except web.HTTPException as error:
            response = error
        except ConnectionError:  # the page was closed while something was sent to it
            response = web.Response()
        if not response.prepared:
            response.headers["Referrer-Policy"] = "no-referrer"
            if asked:
                response.set_cookie(name, token, httponly=True, samesite="Strict")
        return response

    return guarded


@dataclass(frozen=True)
class Places:
    """The folder that the studio was given. It opens nothing outside on behalf of the page."""

    root: Path

    def within(self, text: str | Path) -> Path:
        """Return a path, links followed, if it lies in the folder; InputError if it lies outside."""
        path = (self.root / os.path.expanduser(text)).resolve()
        if not path.is_relative_to(self.root):
            raise InputError(f"{path}: expected a place in {self.root}. Start `lfpiv studio` with a folder above it.")
        return path

    def name(self, path: Path) -> str:
        """Return a path as the page shows it: relative to the folder where it lies there."""
        return printable(str(path.relative_to(self.root) if self.root in path.parents else path))

    def folders(self) -> Iterator[Path]:
        """Yield the folder and those below, hidden ones left out, no link followed."""
        level, left = [self.root], MOST_FOLDERS
        for _ in range(DEEPEST + 1):
            yield from (level := level[:left])
            left -= len(level)
            inner = (path for folder in level for path in sorted(folder.glob("[!.]*/")))  # none where it may not look
            level = [path for path in inner if path.is_dir() and not path.is_symlink()]

    def experiments(self) -> list[Path]:
        """Return the experiment files in the folders: TOML files with a table of cameras and one of a volume."""
        found = []
        for folder in self.folders():
            for path in sorted(folder.glob("*.toml"))[:50]:
                with contextlib.suppress(OSError, RecordError), open_regular(path) as file:
                    text = file.read(MOST_BYTES).decode("utf-8", errors="replace")
                    if all(part in text for part in ("[[camera]]", "[volume]", "white_image")):
                        found.append(path)
        return found

    def results(self) -> list[Path]:
        """Return the folders of runs."""
        return list(filter(is_run, self.folders()))


def root_of(given: Path) -> Path:
    """Return the folder that may be looked at: a given folder, or the folder of a given file, run or store."""
    from lfpiv.results.stores import is_store  # imports xarray, for which the browser does not wait

    return given if given.is_dir() and not is_store(given) and not is_run(given) else given.parent


def is_run(folder: Path) -> bool:
    """Return whether a folder has results of a run: vectors, or a calibration."""
    return any((folder / "vectors").glob("*.nc")) or Folder(folder).calibration.is_file()


def belongs(experiment: Path, results: Path) -> bool:
    """Return whether results are of an experiment file, by its name in their summary and by their places."""
    near = experiment.is_relative_to(results) or results.is_relative_to(experiment.parent)
    try:
        stated = Path(read_object(read_text(Folder(results).summary))["experiment"]["file"])
    except (OSError, RecordError, KeyError, TypeError):
        return near
    named = len(stated.parts) > 1 and experiment.parts[-len(stated.parts) :] == stated.parts
    return named or (near and stated.name == experiment.name)
