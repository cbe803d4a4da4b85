"""What the studio has open: folders, experiment file, results, and what its tabs share."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.errors import InputError
from lfpiv.studio.access import Places
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

    def choose(self, what: str, path: str) -> None:
        """Open another "experiment" or other "results"."""
        found = self.places.within(path)
        if found != getattr(self, what):
            setattr(self, what, found)
            self.changed(what)

    def changed(self, what: str) -> None:
        """Tell all tabs that the experiment or the results changed."""
        self.state.experiment_name = self.places.name(self.experiment) if self.experiment else ""
        self.state.results_name = self.places.name(self.results) if self.results else ""
        self.told(what)

    def told(self, what: str) -> None:
        """Call the listeners."""
        for listener in self.listeners:
            self.guarded(listener)(what)

    def guarded(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function whose errors are shown on the page."""

        def call(*given: Any, **named: Any) -> Any:
            try:
                return function(*given, **named)
            except Exception as error:
                self.tell(error)
                return None

        return call

    def tell(self, error: BaseException | str) -> None:
        """Show an error or a message on the page. Unexpected errors are logged with their trace."""
        expected = isinstance(error, str | InputError | OSError | ValueError)
        if not expected:
            log.error("studio", exc_info=error)  # type: ignore[arg-type]
        self.state.message = str(error) if expected else f"unexpected {type(error).__name__}: {error}"
        self.state.message_shown = True

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
