"""Threads beside the computation of a process: one reads the next images, one writes finished results.

Neither changes a number. Kernels of Warp run without the lock of Python's interpreter, and so do file systems and
decoders; what these threads do then costs no time of its own.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import Future
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from lfpiv.experiment.experiment import Experiment
    from lfpiv.experiment.recording import Frame

Images = dict[str, np.ndarray]
"""Camera -> image as recorded [counts]."""


class ReadAhead:
    """Images of the frames that come next, read and decoded by a thread.

    It holds the images of the frames of one pair: 8 bytes per pixel of the sensors.
    """

    def __init__(self, experiment: Experiment):
        self._experiment = experiment
        self._coming: dict[Frame, Future[Images]] = {}

    def start(self, coming: Iterable[Frame], present: Collection[Frame] = ()) -> None:
        """Start to read the frames that come next, keep what is read of the present ones, and forget all others."""
        self._coming = {frame: known for frame, known in self._coming.items() if frame in present}
        new: dict[Frame, Future[Images]] = {frame: Future() for frame in coming if frame not in present}
        self._coming |= new
        if new:
            threading.Thread(target=self._read, args=(new,), name="lfpiv images", daemon=True).start()

    def image(self, camera: str, frame: Frame) -> np.ndarray:
        """Take an image of a camera, which is read now if it was not read before; raise what reading it raised."""
        if (coming := self._coming.get(frame)) is not None and (known := coming.result().pop(camera, None)) is not None:
            return known
        return self._experiment.frame_image(camera, frame)

    def _read(self, frames: dict[Frame, Future[Images]]) -> None:
        for frame, future in frames.items():
            try:
                cameras = (camera.name for camera in self._experiment.cameras)
                future.set_result({name: self._experiment.frame_image(name, frame) for name in cameras})
            except BaseException as error:
                future.set_exception(error)


class Writer:
    """Write results in a thread, one after the other, in the order in which they are handed over."""

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[tuple[Callable[[], None], Future[None]]] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._large: list[Future[None]] = []
        self._last: Future[None] | None = None

    def start(self, write: Callable[[], None], *, large: bool = False) -> Future[None]:
        """Start to write a result; return the future that knows when it is done. `large` results hold much memory."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="lfpiv results", daemon=True)
            self._thread.start()
        self._last = Future()
        if large:
            self._large.append(self._last)
        self._jobs.put((write, self._last))
        return self._last

    def wait_large(self) -> None:
        """Wait until no large result is held any more; its errors stay with its future."""
        for future in self._large:
            future.exception()
        self._large.clear()

    def wait(self) -> None:
        """Wait until everything is written, or failed."""
        if self._last is not None:
            self._last.exception()

    def _run(self) -> None:
        while True:
            write, future = self._jobs.get()
            try:
                write()
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(None)
            del write, future  # and what they hold, until the next job comes
