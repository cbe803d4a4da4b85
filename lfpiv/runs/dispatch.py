"""Pairs side by side in several processes, on this machine or on a cluster: Dask starts the processes and watches them.

A pair whose worker dies is tried once more, in another worker and after all others; then it is a pair that failed.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import queue
from collections import deque
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

from lfpiv.errors import ClusterError, InputError, StorageError
from lfpiv.runs import cluster_workers, local_workers, worker
from lfpiv.runs.local_workers import Width
from lfpiv.runs.pair import Outcome
from lfpiv.runs.worker_plan import Plan
from lfpiv_kernels.runtime import cores

log = logging.getLogger(__name__)

FETCH_S = 600.0
"""A scheduler that does not hand out a result for so long is given up [s]."""
TICK_S = 0.5
"""How often a waiting parent looks whether the cluster is well, and tells how far the pairs are [s]."""


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
    ClusterError
        If the cluster is lost.
    RuntimeError
        If the workers cannot run what is sent to them.
    """
    with contextlib.ExitStack() as stack:
        if scheduler is None:
            assert planned is not None
            client, width = stack.enter_context(local_workers.workers(planned, shared))
        else:
            client, width = stack.enter_context(cluster_workers.workers(scheduler, shared))
        yield from _outcomes(client, width, shared, todo, progress, peak)


def _outcomes(
    client: Any,
    width: Width,
    shared: Path,
    todo: Sequence[int],
    progress: Callable[[float], None],
    peak: Callable[[float], None],
) -> Generator[Outcome, None, None]:
    from distributed import CancelledError, KilledWorker, TimeoutError

    arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
    waiting, again, number = deque(todo), deque[int](), itertools.count()
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
                name = f"lfpiv-{shared.name}-{pair}-{next(number)}"
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
            result = None
            if future.status == "finished":
                try:
                    result = future.result(timeout=FETCH_S)
                except TimeoutError:
                    raise ClusterError(
                        f"the scheduler keeps the result of pair {pair} back. {cluster_workers.GO_ON}"
                    ) from None
                except (CancelledError, OSError):  # the connection to the scheduler broke just now
                    pass
            if result is not None:
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
            elif future.status == "error":
                raise RuntimeError(f"the workers cannot do pair {pair}: {_first_line(future.exception())}")
            else:  # the scheduler forgot it, when the connection to it broke
                waiting.append(pair)
                continue
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
        host = get_address_host(here.address)
        near = [address for address in client.nthreads() if get_address_host(address) == host]
        places = list(client.run(_place, workers=near, on_error="return").values())
        return max(_cores() // max(places.count(_place()), 1), 1)

    return worker.work_on(Path(shared), pair, report, threads)


def _place() -> tuple[Any, ...]:
    """Say what workers of one machine share: the job that a queue gave them, and the cores that they may use."""
    affinity = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    return os.environ.get("SLURM_JOB_ID"), *affinity


def _cores() -> int:
    """Cores to share there: fewer than there are where a queue says so and binds nobody to them."""
    granted = os.environ.get("SLURM_CPUS_PER_TASK", "")
    return min(cores(), int(granted)) if granted.isdigit() else cores()


def _log(result: worker.Result) -> None:
    for name, level, text in result.records:
        logging.getLogger(name).log(level, "%s", text)


def _first_line(error: BaseException | None) -> str:
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[0]}"
