"""What the studio has open: folders, experiment file, results, and what its tabs share."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Callable, Coroutine, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv.errors import InputError
from lfpiv.results.stores import is_store
from lfpiv.studio.access import Places, belongs, is_run

if TYPE_CHECKING:
    from lfpiv.studio.draft import Draft

log = logging.getLogger(__name__)

NO_EXPERIMENT = "No experiment file is open: choose one in the tab Experiment."


@dataclass
class Session:
    """An open studio: the server of the page, and the files that its tabs look at."""

    server: Any
    places: Places
    experiment: Path | None = None
    """The experiment file."""
    results: Path | None = None
    """Folder of a run, or a store."""
    draft: Draft | None = None
    """The experiment file as it is edited."""
    listeners: list[Callable[[str], None]] = field(default_factory=list)
    """Called with "experiment" or "results" for others that are opened, "saved", "draft" or "typed" for the draft."""
    closers: list[Callable[[], None]] = field(default_factory=list)
    """Called when the studio ends."""
    tasks: set[asyncio.Task[Any]] = field(default_factory=set)

    @property
    def state(self) -> Any:
        """The state that page and server share."""
        return self.server.state

    @property
    def edited(self) -> Draft:
        """The experiment file as it is edited; InputError where none that can be read is open."""
        if self.draft is None:
            raise InputError("experiment: expected a readable experiment file, found none. Open one in tab Experiment.")
        return self.draft

    def open(self, given: Path) -> None:
        """Open an experiment file or results, and what belongs to it; of a folder what lies nearest to it."""

        def nearest(found: Iterable[Path], to: Path = given) -> Path | None:
            return max(found, key=lambda path: len(os.path.commonpath([path, to])), default=None)

        files, runs = self.places.experiments(), self.places.results()
        if is_store(given) or is_run(given):
            self.experiment, self.results = nearest(path for path in files if belongs(path, given)), given
        else:
            self.experiment = own = given if given.is_file() else nearest(files)
            self.results = nearest((run for run in runs if own is None or belongs(own, run)), own or given)

    def choose(self, path: str) -> None:
        """Open another experiment file or other results with what belongs to it, unless changes would be lost."""
        before = {"experiment": self.experiment, "results": self.results}
        if not path or (found := self.places.within(path)) in before.values():
            return
        if not (kept := self.draft is not None and self.draft.changed):
            self.open(found)
        self.changed(*(what for what, was in before.items() if getattr(self, what) != was))
        if kept:
            raise InputError("experiment: the form has changes that are not saved. Save them first, or undo them.")

    def changed(self, *whats: str) -> None:
        """Say what is open, and tell all tabs what changed."""
        for name, path in (("experiment", self.experiment), ("results", self.results)):
            self.state[f"{name}_open"] = str(path or "")
            self.state[f"{name}_name"] = self.places.name(path) if path else ""
        for what in whats:
            self.told(what)

    def told(self, what: str) -> None:
        """Call the listeners."""
        for listener in self.listeners:
            self.guarded(listener)(what)

    def guarded(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose errors are shown on the page; a coroutine is done beside it."""

        def call(*given: Any, **named: Any) -> Any:
            try:
                result = function(*given, **named)
            except Exception as error:
                self.tell(error)
                return None
            return self.start(result) if asyncio.iscoroutine(result) else result

        return call

    def tell(self, error: BaseException | str) -> None:
        """Show an error or a message on the page. Unexpected errors are logged with their trace."""
        expected = isinstance(error, str | InputError | OSError | ValueError)
        if not expected:
            log.error("studio", exc_info=error)  # type: ignore[arg-type]
        self.state.message = str(error) if expected else f"unexpected {type(error).__name__}: {error}"
        self.state.message_shown = True

    def on_change(self, function: Callable[..., Any], *names: str) -> None:
        """Call a function, guarded, when values of the state change."""
        self.state.change(*names)(lambda **_: self.guarded(function)())

    def start(self, work: Coroutine[Any, Any, Any]) -> None:
        """Do work beside the page, which stays alive; its errors are shown there."""

        async def watched() -> None:
            try:
                await work
            except Exception as error:
                with self.state:
                    self.tell(error)

        task = asyncio.get_running_loop().create_task(watched())
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    @contextlib.contextmanager
    def busy(self, name: str, what: str) -> Iterator[None]:
        """Say in a value of the state what is done meanwhile."""
        with self.state:
            self.state[name] = what
        try:
            yield
        finally:
            with self.state:
                self.state[name] = ""


def sent(picture: np.ndarray) -> dict[str, Any]:
    """Return a picture of counts, (rows, columns) or (rows, columns, 3), as a value of the state."""
    rows, columns, channels = (*picture.shape, 1)[:3]
    values = np.ascontiguousarray(picture, "<f4").tobytes()
    return {"values": values, "rows": rows, "columns": columns, "channels": channels}
