"""Workers of a Dask cluster that the user started. The run watches the scheduler and does not stop the cluster."""

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
from lfpiv.runs.local_workers import CLOSE_S, Capacity, clock_watch, import_distributed

log = logging.getLogger(__name__)

CONNECT_S = 15.0
"""Longest time to connect to a scheduler, at the start and after a broken connection [s]."""
ASK_S = 5.0
"""Interval between two requests for the scheduler's number of workers [s]."""
SILENT_S = 600.0
"""Time without an answer after which a scheduler counts as lost [s]."""
REMIND_S = 60.0
"""Interval of log lines while a run waits for a worker or for an answer [s]."""

RESUME = "Finished results are complete; the same command goes on from there once the cluster runs again."
"""Advice in messages about a lost cluster."""


@contextlib.contextmanager
def workers(address: str, shared: Path) -> Iterator[tuple[Any, Capacity]]:
    """Connect to a running cluster; yield Dask's client and the capacity. The cluster forgets the run afterwards.

    Raises
    ------
    InputError
        If no scheduler answers at `address`.
    """
    dask = import_distributed("--scheduler")
    try:
        client = dask.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = (str(error).strip().splitlines() or [""])[0]
        raise InputError(
            f"--scheduler: expected the address of a running Dask scheduler such as tcp://host:8786, found {address!r} "
            f"({type(error).__name__}: {reason})."
        ) from None
    try:
        yield client, SchedulerWatch(client, address).capacity
    finally:
        if client.status == "running":
            # in a thread, so that a scheduler that hangs cannot stop this process from ending
            release = threading.Thread(target=_release, args=(client, shared), daemon=True)
            release.start()
            release.join(CLOSE_S)
        with contextlib.suppress(Exception):
            client.close(timeout=CLOSE_S)


class SchedulerWatch:
    """State of a scheduler. Requests are sent at intervals, without waiting for their answers."""

    def __init__(self, client: Any, address: str):
        self.client, self.address = client, address
        self.count = 1
        """Number of workers in the last answer."""
        self.answered_s = self.reminded_s = self.asked_s = time.monotonic()
        self.broken = False
        """Whether the connection is broken."""
        self.require_clock = clock_watch()
        """Raises ClusterError if the clock was set back."""
        self.answer: Future[int] | None = None
        """Answer to the last request; None if it arrived."""

    def capacity(self) -> float:
        """Return how many pairs may be submitted; raise ClusterError if the scheduler is lost."""
        self.require_clock()
        now = time.monotonic()
        if self.client.status != "running":
            if self.client.status == "closed" or now - self.answered_s > SILENT_S:
                raise ClusterError(f"the scheduler at {self.address} is gone. {RESUME}")
            if not self.broken:
                log.info("the connection to the scheduler at %s broke: trying to get it back", self.address)
            self.broken = True
            return 0
        if self.broken:
            self.answered_s, self.broken = now, False
        self._ask(now)
        silent = now - self.answered_s
        if silent > SILENT_S:
            raise ClusterError(f"the scheduler at {self.address} has not answered for {silent:.0f} s. {RESUME}")
        if now - self.reminded_s > REMIND_S:
            self.reminded_s = now
            if silent > REMIND_S:
                log.info("the scheduler at %s has not answered for %.0f s: waiting", self.address, silent)
            elif not self.count:
                log.info("%s has no workers: waiting for some", self.address)
        return math.inf

    def _ask(self, now: float) -> None:
        """Take the answer if it arrived; send the next request after the interval."""
        if self.answer is None:
            if now - self.asked_s > ASK_S:
                self.asked_s = now
                self.answer = asyncio.run_coroutine_threadsafe(_count(self.client), self.client.loop.asyncio_loop)
        elif self.answer.done():
            with contextlib.suppress(Exception):  # the request failed
                self.count, self.answered_s = self.answer.result(), now
            self.answer = None


async def _count(client: Any) -> int:
    return len(await client.scheduler.ncores())


def _release(client: Any, shared: Path) -> None:
    with contextlib.suppress(Exception):  # the cluster may be lost
        client.run(worker.release, shared)
