"""A Dask cluster that others started: watched while it does the pairs of a run, and left as it was."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from lfpiv.errors import ClusterError, InputError
from lfpiv.runs import worker
from lfpiv.runs.local_workers import CLOSE_S, Width, engine

log = logging.getLogger(__name__)

CONNECT_S = 15.0
"""A scheduler that cannot be reached within this time is not there, at the start and after a broken connection [s]."""
ASK_S = 5.0
"""How often a scheduler is asked how many workers it has [s]."""
SILENT_S = 600.0
"""A scheduler that has not answered for so long is given up [s]."""
REMIND_S = 60.0
"""A user whose run waits, for a worker or an answer, is told so this often [s]."""

GO_ON = "What is finished is kept and whole; the same command goes on from there once the cluster runs again."


@contextlib.contextmanager
def workers(address: str, shared: Path) -> Iterator[tuple[Any, Width]]:
    """Connect to a cluster that others started; it goes on afterwards and keeps nothing of the run.

    Raises
    ------
    InputError
        If no scheduler answers at `address`.
    """
    dask = engine("--scheduler")
    try:
        client = dask.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = (str(error).strip().splitlines() or [""])[0]
        raise InputError(
            f"--scheduler: expected the address of a running Dask scheduler such as tcp://host:8786, found {address!r} "
            f"({type(error).__name__}: {reason})."
        ) from None
    try:
        yield client, _Watch(client, address).width
    finally:
        if client.status == "running":
            # in a thread: a scheduler that hangs must not keep this process from its end
            release = threading.Thread(target=_release, args=(client, shared), daemon=True)
            release.start()
            release.join(CLOSE_S)
        with contextlib.suppress(Exception):
            client.close(timeout=CLOSE_S)


class _Watch:
    """How a scheduler is: asked now and then, without waiting for its answer."""

    def __init__(self, client: Any, address: str):
        self.client, self.address = client, address
        self.count = 1
        """Workers, as last heard."""
        self.heard = self.told = self.asked = time.monotonic()
        self.broken = False
        self.answer: Future[int] | None = None

    def width(self) -> float:
        """Say how many pairs may be submitted; ClusterError where the scheduler is gone or hangs."""
        now = time.monotonic()
        if self.client.status != "running":
            if self.client.status == "closed" or now - self.heard > SILENT_S:
                raise ClusterError(f"the scheduler at {self.address} is gone. {GO_ON}")
            if not self.broken:
                log.info("the connection to the scheduler at %s broke: trying to get it back", self.address)
            self.broken = True
            return 0
        if self.broken:
            self.heard, self.broken = now, False
        self._listen(now)
        silent = now - self.heard
        if silent > SILENT_S:
            raise ClusterError(f"the scheduler at {self.address} has not answered for {silent:.0f} s. {GO_ON}")
        if now - self.told > REMIND_S:
            self.told = now
            if silent > REMIND_S:
                log.info("the scheduler at %s has not answered for %.0f s: waiting", self.address, silent)
            elif not self.count:
                log.info("%s has no workers: waiting for some", self.address)
        return math.inf

    def _listen(self, now: float) -> None:
        """Take the answer to the last question, ask the next one."""
        if self.answer is None:
            if now - self.asked > ASK_S:
                self.asked = now
                self.answer = asyncio.run_coroutine_threadsafe(_count(self.client), self.client.loop.asyncio_loop)
        elif self.answer.done():
            with contextlib.suppress(Exception):  # no answer
                self.count, self.heard = self.answer.result(), now
            self.answer = None


async def _count(client: Any) -> int:
    return len(await client.scheduler.ncores())


def _release(client: Any, shared: Path) -> None:
    with contextlib.suppress(Exception):  # the cluster may be lost
        client.run(_release_in_worker, str(shared))


def _release_in_worker(shared: str) -> None:
    worker.release(Path(shared))
