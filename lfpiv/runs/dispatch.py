"""Distribute pairs: one after the other in this process, or in parallel to worker processes that Dask watches.

A worker gets a work unit: one image pair, or pairs of a series that share their instants (`lfpiv.runs.work_units`). If
a worker dies, its work unit is tried once more, in another worker and after all others. If that worker dies too, the
pairs of the work unit that were not finished before have failed.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import queue
from collections import Counter, deque
from collections.abc import Generator, Iterable, Sequence
from operator import length_hint
from pathlib import Path
from typing import Any

from lfpiv.errors import ClusterError, InputError, StorageError
from lfpiv.experiment.experiment import Experiment
from lfpiv.progress import StepProgress
from lfpiv.runs import cluster_workers, local_workers, worker
from lfpiv.runs.local_workers import Capacity
from lfpiv.runs.pair import PairWork
from lfpiv.runs.pair_outcome import Outcome
from lfpiv.runs.pending_pairs import PendingPairs
from lfpiv.runs.work_units import CLUSTER_WORKERS, WorkUnit, cut, cut_at_segments
from lfpiv.runs.worker_plan import Plan
from lfpiv.warn import name_pairs
from lfpiv_kernels.runtime import cores

log = logging.getLogger(__name__)

FETCH_S = 600.0
"""Longest time to wait for a finished result from the scheduler [s]."""
TICK_S = 0.5
"""Interval at which the state of the cluster is checked and progress is reported [s]."""


def sequential(work: PairWork, pending: Iterable[int], progress: StepProgress) -> Generator[Outcome, None, None]:
    """Do pairs one after the other in this process; yield the outcome of each.

    Pairs are taken from `pending` when their turn comes; pairs of a series come step by step. `length_hint`
    says how many may come.
    """
    source = iter(pending)
    total = max(length_hint(source), 1)
    before = _kept(pending)
    progress(0.0)
    yield from work.do(source, lambda number, fraction: progress((_kept(pending) - before + number + fraction) / total))


def _kept(pending: Iterable[int]) -> int:
    """Return the number of pairs that were passed over because they are finished."""
    return pending.finished[1] if isinstance(pending, PendingPairs) else 0


def _units(experiment: Experiment, pending: Iterable[int], workers: int) -> Iterable[WorkUnit]:
    recording = experiment.recording
    if experiment.in_sequence:
        return cut_at_segments(pending, recording.step)
    return cut(pending, recording.shared_step, workers)


def parallel(
    shared: Path, experiment: Experiment, pending: Iterable[int], workers: Plan | str, progress: StepProgress
) -> Generator[Outcome, None, None]:
    """Do pairs in parallel, in any order; yield the outcome of each.

    Parameters
    ----------
    shared : Path
        Folder with everything that the workers need, from `task.write_task`.
    pending : iterable of int
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
    total = max(length_hint(pending), 1)
    units = _units(experiment, pending, CLUSTER_WORKERS if isinstance(workers, str) else workers.workers)
    with found as (client, capacity):
        yield from Dispatch(client, capacity, shared, units, total, experiment.noun).outcomes(progress)


class Dispatch:
    """Work units of pairs of a run on their way to and from the workers of a Dask client."""

    def __init__(
        self,
        client: Any,
        capacity: Capacity,
        shared: Path,
        pending: Iterable[WorkUnit],
        total: int,
        noun: str = "pair",
    ):
        self.client, self.capacity, self.shared, self.noun = client, capacity, shared, noun
        self.total, self.done = total, 0
        """Largest number of pairs that may come, and the number of those that were done."""
        self.coming, self.all_came = iter(pending), False
        """Work units to submit after those that wait, and whether there are no more."""
        self.waiting, self.again = deque[WorkUnit](), deque[WorkUnit]()
        """Work units to submit now, and after all others."""
        self.running: dict[str, tuple[Any, WorkUnit]] = {}
        """Key of Dask -> future and work unit; futures that are not referenced are cancelled."""
        self.fractions: dict[str, float] = {}
        """Key of Dask -> number of finished pairs and parts of one, as its worker reports it."""
        self.tried: set[int] = set()
        """First pairs of work units whose worker died once."""
        self.beside: Counter[int] = Counter()
        """Boundary pair -> number of finished work units beside it."""
        self.ready: set[int] = set()
        """Boundary pairs that can be done; they go first, so that the volumes stored for them can be removed."""
        self.numbers = itertools.count()
        self.arrived: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.topic = f"lfpiv-{shared.name}"

    def outcomes(self, progress: StepProgress) -> Generator[Outcome, None, None]:
        """Submit all work units and yield the outcomes of their pairs."""
        self.client.subscribe_topic(self.topic, lambda event: self.fractions.update([event[1]]))
        try:
            while True:
                self._submit()
                if self.all_came and not (self.running or self.waiting or self.again):
                    return
                progress(self._fraction())
                try:
                    future = self.arrived.get(timeout=TICK_S)
                except queue.Empty:
                    continue
                for outcome in self._outcomes(future):
                    self.done += 1
                    yield outcome
        finally:
            with contextlib.suppress(Exception):  # the cluster may be lost
                self.client.unsubscribe_topic(self.topic)

    def _next(self) -> WorkUnit | None:
        """Return the work unit to submit next; None if all are submitted."""
        if not self.waiting:
            if (coming := next(self.coming, None)) is not None:
                return coming
            self.all_came = True
            if not self.running:
                self.waiting, self.again = self.again, self.waiting
        return self.waiting.popleft() if self.waiting else None

    def _submit(self) -> None:
        """Submit as many waiting work units as the workers take."""
        room = self.capacity() - len(self.running)
        while room > 0 and (unit := self._next()) is not None:
            room -= 1
            first = unit.pairs[0]
            name = f"{self.topic}-{first}-{next(self.numbers)}"
            options = {"priority": 1} if first in self.ready else {}
            work = str(self.shared), unit, self.topic, name
            future = self.client.submit(_in_worker, *work, key=name, pure=False, **options)
            self.running[name] = future, unit
            future.add_done_callback(self.arrived.put)

    def _fraction(self) -> float:
        running = ((self.fractions.get(key, 0.0), len(unit.pairs)) for key, (_, unit) in self.running.items())
        return (self.done + sum(min(counts) for counts in running)) / self.total

    def _outcomes(self, future: Any) -> Sequence[Outcome]:
        """Return the outcomes of a work unit that came back; none if it is submitted once more."""
        from distributed import KilledWorker

        _, unit = self.running.pop(future.key)
        self.fractions.pop(future.key, None)
        result = _fetched(future, self._name(unit)) if future.status == "finished" else None
        if result is not None:
            outcomes = _checked(result)
            self._finish(unit)
            return outcomes
        if future.status != "error":  # the scheduler forgot the work unit when the connection to it broke
            self.waiting.append(unit)
            return ()
        first = unit.pairs[0]
        if not isinstance(future.exception(), KilledWorker):
            raise RuntimeError(f"the workers cannot do {self._name(unit)}: {_first_line(future.exception())}")
        if first not in self.tried:
            self.tried.add(first)
            self.again.append(unit)
            log.info("%s: its worker died; it is tried once more in another one", self._name(unit))
            return ()
        self._finish(unit)
        reason = "its worker died, in each of two trials: killed, a crash, or too little memory"
        return [Outcome(pair=pair, reason=reason, died=True) for pair in unit.pairs]

    def _name(self, unit: WorkUnit) -> str:
        return name_pairs(unit.pairs, self.noun)

    def _finish(self, unit: WorkUnit) -> None:
        """Submit the boundary pairs of a finished work unit whose other work unit is finished, too."""
        self.beside.update(unit.boundary_pairs)
        for pair in unit.boundary_pairs:
            if self.beside[pair] == 2:
                del self.beside[pair]
                self.ready.add(pair)
                self.waiting.appendleft(WorkUnit((pair,)))


def _fetched(future: Any, name: str) -> worker.Result | None:
    """Return the result of a finished future; None if the connection to the scheduler broke just now."""
    from distributed import CancelledError, TimeoutError

    try:
        found: worker.Result = future.result(timeout=FETCH_S)
    except TimeoutError:
        raise ClusterError(f"the scheduler does not deliver the result of {name}. {cluster_workers.RESUME}") from None
    except (CancelledError, OSError):
        return None
    return found


def _checked(result: worker.Result) -> Sequence[Outcome]:
    """Log what the worker logged and return the outcomes; raise the error that ends the run."""
    for name, level, text in result.records:
        logging.getLogger(name).log(level, "%s", text)
    if result.outcomes is None:
        raise (StorageError if result.storage else InputError)(result.fatal)
    return result.outcomes


def _in_worker(shared: str, unit: WorkUnit, topic: str, key: str) -> worker.Result:
    """Do one work unit in a worker of Dask."""
    from distributed import get_client, get_worker
    from distributed.comm.addressing import get_address_host

    here = get_worker()

    def report(done: float) -> None:
        here.log_event(topic, (key, done))

    def threads() -> int:
        if here.state.nthreads > 1:
            return int(here.state.nthreads)
        client: Any = get_client()
        host = get_address_host(here.address)
        near = [address for address in client.nthreads() if get_address_host(address) == host]
        places = list(client.run(_place, workers=near, on_error="return").values())
        return max(granted_cores() // max(places.count(_place()), 1), 1)

    return worker.work_on(Path(shared), WorkUnit(*unit), report, threads)


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
