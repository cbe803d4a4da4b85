"""Distribute pairs: one after the other in this process, or in parallel to worker processes that Dask watches.

If a worker dies, its pair is tried once more, in another worker and after all other pairs. If that worker dies too, the
pair has failed.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import queue
from collections import deque
from collections.abc import Generator, Iterable
from operator import length_hint
from pathlib import Path
from typing import Any

from lfpiv.errors import ClusterError, InputError, StorageError
from lfpiv.progress import StepProgress, part_of
from lfpiv.runs import cluster_workers, local_workers, worker
from lfpiv.runs.local_workers import Capacity
from lfpiv.runs.pair import Outcome, PairWork
from lfpiv.runs.worker_plan import Plan
from lfpiv_kernels.runtime import cores

log = logging.getLogger(__name__)

FETCH_S = 600.0
"""Longest time to wait for a finished result from the scheduler [s]."""
TICK_S = 0.5
"""Interval at which the state of the cluster is checked and progress is reported [s]."""


def sequential(work: PairWork, todo: Iterable[int], progress: StepProgress) -> Generator[Outcome, None, None]:
    """Do pairs one after the other in this process; yield the outcome of each.

    Pairs are taken from `todo` when their turn comes. `operator.length_hint` says how many may come.
    """
    source = iter(todo)
    total = length_hint(source)
    for pair in source:
        left = length_hint(source)
        step = part_of(progress, 1 - (left + 1) / total, 1 - left / total)
        step(0.0)
        yield work.do(pair, step)


def parallel(
    shared: Path, todo: Iterable[int], workers: Plan | str, progress: StepProgress
) -> Generator[Outcome, None, None]:
    """Do pairs in parallel, in any order; yield the outcome of each.

    Parameters
    ----------
    shared : Path
        Folder with everything that the workers need, from `worker.share`.
    todo : iterable of int
        Pairs to do; each is taken when a worker is free.
    workers : Plan or str
        Processes to start on this machine, or the address of a Dask scheduler whose workers see `shared`.
    progress : callable
        Called with the finished fraction of all pairs.

    Raises
    ------
    InputError
        If the scheduler does not answer, or a worker cannot use the task.
    StorageError
        If results cannot be written.
    ClusterError
        If the cluster is lost.
    RuntimeError
        If the workers cannot run the code that is sent to them.
    """
    found = (
        cluster_workers.workers(workers, shared) if isinstance(workers, str) else local_workers.workers(workers, shared)
    )
    with found as (client, capacity):
        yield from Dispatch(client, capacity, shared, todo).outcomes(progress)


class Dispatch:
    """Pairs of a run on their way to and from the workers of a Dask client."""

    def __init__(self, client: Any, capacity: Capacity, shared: Path, todo: Iterable[int]):
        self.client, self.capacity, self.shared = client, capacity, shared
        self.source = iter(todo)
        """Pairs that were not submitted yet."""
        self.total = max(length_hint(self.source), 1)
        self.waiting, self.again = deque[int](), deque[int]()
        """Pairs to submit once more: before those of `source`, and after all others."""
        self.running: dict[str, tuple[Any, int]] = {}
        """Key of Dask -> future and pair; futures that are not referenced are cancelled."""
        self.fractions: dict[int, float] = {}
        """Pair -> finished fraction, as its worker reports it."""
        self.tried: set[int] = set()
        """Pairs whose worker died once."""
        self.numbers = itertools.count()
        self.arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.topic = f"lfpiv-{shared.name}"

    def outcomes(self, progress: StepProgress) -> Generator[Outcome, None, None]:
        """Submit all pairs and yield their outcomes."""
        self.client.subscribe_topic(self.topic, lambda event: self.fractions.update([event[1]]))
        try:
            while True:
                self._submit()
                if not self.running and not self.waiting and not self.again and not length_hint(self.source):
                    return
                progress(self._fraction())
                try:
                    future = self.arrived.get(timeout=TICK_S)
                except queue.Empty:
                    continue
                outcome = self._outcome(future)
                if outcome is not None:
                    yield outcome
        finally:
            with contextlib.suppress(Exception):  # the cluster may be lost
                self.client.unsubscribe_topic(self.topic)

    def _submit(self) -> None:
        """Submit as many waiting pairs as the workers take."""
        room = self.capacity() - len(self.running)
        while room > 0 and (pair := self._next()) is not None:
            room -= 1
            name = f"{self.topic}-{pair}-{next(self.numbers)}"
            future = self.client.submit(_in_worker, str(self.shared), pair, self.topic, key=name, pure=False)
            self.running[name] = future, pair
            future.add_done_callback(self.arrived.put)

    def _next(self) -> int | None:
        """Return the next pair to submit; None if there is none at present."""
        if self.waiting:
            return self.waiting.popleft()
        if (pair := next(self.source, None)) is None and self.again and not self.running:
            self.waiting, self.again = self.again, self.waiting
            pair = self.waiting.popleft()
        return pair

    def _fraction(self) -> float:
        running = sum(self.fractions.get(pair, 0.0) for _, pair in list(self.running.values()))
        left = length_hint(self.source) + len(self.waiting) + len(self.again) + len(self.running)
        return 1 - (left - min(running, len(self.running))) / self.total

    def _outcome(self, future: Any) -> Outcome | None:
        """Return the outcome of a pair that came back; None if the pair is submitted once more."""
        from distributed import KilledWorker

        _, pair = self.running.pop(future.key)
        self.fractions.pop(pair, None)
        result = _fetched(future, pair) if future.status == "finished" else None
        if result is not None:
            return _checked(result)
        if future.status != "error":  # the scheduler forgot the pair when the connection to it broke
            self.waiting.append(pair)
            return None
        if not isinstance(future.exception(), KilledWorker):
            raise RuntimeError(f"the workers cannot do pair {pair}: {_first_line(future.exception())}")
        if pair not in self.tried:
            self.tried.add(pair)
            self.again.append(pair)
            log.info("pair %d: its worker died; it is tried once more in another one", pair)
            return None
        return Outcome(
            pair=pair, reason="its worker died, in each of two trials: killed, a crash, or too little memory"
        )


def _fetched(future: Any, pair: int) -> worker.Result | None:
    """Return the result of a finished future; None if the connection to the scheduler broke just now."""
    from distributed import CancelledError, TimeoutError

    try:
        found: worker.Result = future.result(timeout=FETCH_S)
    except TimeoutError:
        raise ClusterError(
            f"the scheduler does not deliver the result of pair {pair}. {cluster_workers.RESUME}"
        ) from None
    except (CancelledError, OSError):
        return None
    return found


def _checked(result: worker.Result) -> Outcome:
    """Log what the worker logged and return the outcome; raise the error that ends the run."""
    for name, level, text in result.records:
        logging.getLogger(name).log(level, "%s", text)
    if result.outcome is None:
        raise (StorageError if result.storage else InputError)(result.fatal)
    return result.outcome


def _in_worker(shared: str, pair: int, topic: str) -> worker.Result:
    """Do one pair in a worker of Dask."""
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
        return max(granted_cores() // max(places.count(_place()), 1), 1)

    return worker.work_on(Path(shared), pair, report, threads)


def _place() -> tuple[Any, ...]:
    """Return the queue's job and the allowed cores of this worker; workers with equal places share cores."""
    affinity = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    return os.environ.get("SLURM_JOB_ID"), *affinity


def granted_cores() -> int:
    """Return the number of cores of this job; SLURM may grant fewer than the system shows."""
    granted = os.environ.get("SLURM_CPUS_PER_TASK", "")
    return min(cores(), int(granted)) if granted.isdigit() else cores()


def _first_line(error: BaseException | None) -> str:
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[0]}"
