"""Pairs side by side in several processes, on this machine or on a cluster: Dask starts the processes and watches them.

A pair whose worker dies is tried once more, in another worker and after all others; then it is a pair that failed.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import queue
import signal
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Any

from lfpiv import worker
from lfpiv.batch import Plan
from lfpiv.errors import InputError, StorageError
from lfpiv.pair import Outcome
from lfpiv_kernels.runtime import cores

log = logging.getLogger(__name__)

CONNECT_S = 15.0
"""A scheduler that does not answer within this time is not there [s]."""
START_S = 300.0
"""Worker processes of this machine that are not up after this time never will be [s]."""
REMIND_S = 60.0
"""Without any worker, a cluster's user is told so this often [s]."""
TICK_S = 0.5
"""How often a waiting parent looks whether the cluster is well, and tells how far the pairs are [s]."""
CLOSE_S = 10.0
"""Time that a cluster is given to close [s]."""

Width = Callable[[], float]
"""How many pairs may be under way now; raises where the cluster is lost."""


def together(
    shared: Path,
    todo: Sequence[int],
    planned: Plan | None,
    scheduler: str | None,
    progress: Callable[[float], None],
    peak: Callable[[float], None],
) -> Generator[Outcome, None, None]:
    """Do pairs side by side, in any order.

    Parameters
    ----------
    shared : Path
        What the workers need, from `worker.share`.
    todo : sequence of int
        Pairs to do.
    planned : Plan, optional
        Processes to start on this machine; None with `scheduler`.
    scheduler : str, optional
        Address of a Dask scheduler whose workers see `shared`.
    progress : callable
        Called with the finished fraction of all pairs.
    peak : callable
        Called with the largest memory that a worker held so far [MiB].

    Yields
    ------
    Outcome
        One for each pair.

    Raises
    ------
    InputError
        If the scheduler does not answer, or a worker cannot use what it is given.
    StorageError
        If results cannot be written.
    RuntimeError
        If the cluster is lost.
    """
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            assert planned is not None
            client, width = stack.enter_context(_machine(planned, shared))
        else:
            client, width = stack.enter_context(_cluster(scheduler, shared))
        yield from _outcomes(client, width, shared, todo, progress, peak)


def _outcomes(
    client: Any,
    width: Width,
    shared: Path,
    todo: Sequence[int],
    progress: Callable[[float], None],
    peak: Callable[[float], None],
) -> Generator[Outcome, None, None]:
    from distributed import KilledWorker

    arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
    waiting, again = deque(todo), deque[int]()
    running: dict[str, tuple[Any, int]] = {}
    fractions: dict[int, float] = {}
    tried: set[int] = set()
    largest, done = 0.0, 0
    topic = f"lfpiv-{shared.name}"
    client.subscribe_topic(topic, lambda event: fractions.update([event[1]]))
    try:
        while done < len(todo):
            if not waiting and not running:
                waiting, again = again, waiting
            room = width() - len(running)
            while waiting and room > 0:
                pair, room = waiting.popleft(), room - 1
                name = f"lfpiv-{shared.name}-{pair}-{len(tried) if pair in tried else 0}"
                future = client.submit(_in_worker, str(shared), pair, topic, key=name, pure=False)
                running[name] = future, pair
                future.add_done_callback(arrived.put)
            under_way = sum(fractions.get(pair, 0.0) for _, pair in list(running.values()))
            progress((done + min(under_way, len(running))) / len(todo))
            try:
                future = arrived.get(timeout=TICK_S)
            except queue.Empty:
                continue
            _, pair = running.pop(future.key)
            fractions.pop(pair, None)
            if future.status == "finished":
                result = future.result()
                _log(result)
                if result.outcome is None:
                    raise (StorageError if result.storage else InputError)(result.fatal)
                if result.peak_mib > largest:
                    largest = result.peak_mib
                    peak(largest)
                outcome = result.outcome
            elif future.status == "error" and isinstance(future.exception(), KilledWorker):
                if pair not in tried:
                    tried.add(pair)
                    again.append(pair)
                    log.info("pair %d: its worker died; it is tried once more in another one", pair)
                    continue
                outcome = Outcome(
                    pair=pair,
                    reason="its worker died, in each of two trials: killed, a crash, or too little memory",
                )
            else:
                what = _first_line(future.exception()) if future.status == "error" else f"it was {future.status}"
                raise RuntimeError(f"the workers cannot do pair {pair}: {what}")
            done += 1
            yield outcome
    finally:
        with contextlib.suppress(Exception):  # the cluster may be lost
            client.unsubscribe_topic(topic)


def _in_worker(shared: str, pair: int, topic: str) -> worker.Result:
    """Run in a worker of Dask."""
    from distributed import get_client, get_worker
    from distributed.comm.addressing import get_address_host

    here = get_worker()

    def report(pair: int, fraction: float) -> None:
        here.log_event(topic, (pair, fraction))

    def threads() -> int:
        if here.state.nthreads > 1:
            return int(here.state.nthreads)
        client: Any = get_client()
        hosts = [get_address_host(address) for address in client.nthreads()]
        return max(cores() // hosts.count(get_address_host(here.address)), 1)

    return worker.work_on(Path(shared), pair, report, threads)


def _log(result: worker.Result) -> None:
    for name, level, text in result.records:
        logging.getLogger(name).log(level, "%s", text)


def _first_line(error: BaseException | None) -> str:
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[0]}"


def _dask(key: str) -> Any:
    """Import Dask's engine, which does not say its types."""
    try:
        import distributed
    except ImportError:
        raise InputError(
            f"{key}: expected the package `distributed`, which several processes need, found none. "
            "Install it: pip install 'lfpiv[distributed]'."
        ) from None

    return distributed


@contextlib.contextmanager
def _machine(planned: Plan, shared: Path) -> Iterator[tuple[Any, Width]]:
    """Start worker processes on this machine; nothing is left of them afterwards, however that comes."""
    dask = _dask("--workers")
    options = {
        "nthreads": 1,
        "memory_limit": 0,
        "host": "127.0.0.1",
        "local_directory": str(shared / "dask"),
        "silence_logs": logging.CRITICAL,
        "dashboard": False,
    }
    envs = [{} if device is None else {"CUDA_VISIBLE_DEVICES": device} for device in planned.devices]
    processes = {number: {"cls": dask.Nanny, "options": {**options, "env": env}} for number, env in enumerate(envs)}
    with _unheard_by_children():
        cluster = dask.SpecCluster(
            scheduler={
                "cls": dask.Scheduler,
                # a worker's death is final for what it did; here is decided what is tried again
                "options": {"host": "127.0.0.1", "dashboard": False, "allowed_failures": 0, "worker_ttl": None},
            },
            silence_logs=logging.CRITICAL,
        )
    finished = False
    try:
        with dask.Client(cluster, set_as_default=False) as client:
            cluster.worker_spec.update(processes)
            cluster.scale(len(processes))  # starts them
            alive = time.monotonic()

            def width() -> float:
                nonlocal alive
                count = len(cluster.scheduler.workers)
                if count:
                    alive = time.monotonic()
                elif time.monotonic() - alive > START_S:
                    raise RuntimeError(
                        "no worker process starts. A script that calls lfpiv.run with workers must do so below "
                        '`if __name__ == "__main__":`'
                    )
                return count

            yield client, width
            finished = True
    finally:
        if not finished:
            _kill(cluster)
        with contextlib.suppress(Exception):  # what is left of it ends with this process
            cluster.close(timeout=CLOSE_S)


@contextlib.contextmanager
def _unheard_by_children() -> Iterator[None]:
    """Block Ctrl-C for the threads and processes started here: it is the parent that answers it, and ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _kill(cluster: Any) -> None:
    """End the workers of a run that is given up, at once: what they write appears whole or not at all."""
    for nanny in list(cluster.workers.values()):
        with contextlib.suppress(Exception):
            nanny.auto_restart = False
            if nanny.pid is not None:
                os.kill(nanny.pid, signal.SIGKILL)


@contextlib.contextmanager
def _cluster(address: str, shared: Path) -> Iterator[tuple[Any, Width]]:
    """Connect to a cluster that others started; it goes on afterwards and keeps nothing of the run."""
    dask = _dask("--scheduler")
    try:
        client = dask.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"--scheduler: expected the address of a running Dask scheduler such as tcp://host:8786, found {address!r} "
            f"({_first_line(error)})."
        ) from None
    told = well = time.monotonic()

    def width() -> float:
        nonlocal told, well
        now = time.monotonic()
        if client.status == "running":
            well = now
        elif now - well > CONNECT_S:
            raise RuntimeError(f"the scheduler at {address} is gone; what is finished is kept")
        if now - told > REMIND_S and not client.scheduler_info()["workers"]:
            told = now
            log.info("%s has no workers: waiting for some", address)
        return math.inf

    try:
        yield client, width
    finally:
        with contextlib.suppress(Exception):  # it may be gone
            client.run(_release, str(shared), wait=client.status == "running")
        with contextlib.suppress(Exception):
            client.close(timeout=CLOSE_S)


def _release(shared: str) -> None:
    """Run in a worker of Dask."""
    worker.release(Path(shared))
