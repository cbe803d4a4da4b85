"""Worker processes of this machine: Dask starts and watches them, and nothing is left of them afterwards."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from lfpiv.errors import ClusterError, InputError
from lfpiv.runs.worker_plan import Plan

START_S = 300.0
"""Worker processes that are not up after this time never will be [s]."""
CLOSE_S = 10.0
"""Time that a cluster is given to close [s]."""

Width = Callable[[], float]
"""How many pairs may be under way now; raises where the cluster is lost."""

SETTINGS = {
    "distributed.worker.profile.enabled": False,  # looks at the workers' stacks 100 times a second
    "distributed.admin.tick.interval": "1s",  # 20 ms, in every process
    "distributed.admin.system-monitor.interval": "10s",
}
"""What Dask does beside the work, which took 4 % of a core for each process."""


def engine(key: str) -> Any:
    """Import Dask's engine, which does not say its types.

    Raises
    ------
    InputError
        If it is not installed; names `key` as what asked for it.
    """
    try:
        import distributed
    except ImportError:
        raise InputError(
            f"{key}: expected the package `distributed`, which several processes need, found none. "
            "Install it: pip install 'lfpiv[distributed]'."
        ) from None

    return distributed


def warm_up(kind: str) -> None:
    """Start to read what workers need, in a process of its own that they are forked from, and return at once.

    What this process does first, the calibration for example, goes on meanwhile. That process serves all later runs
    too, and ends with this one. On CUDA, whose drivers no fork survives, nothing is done: workers start afresh.

    Raises
    ------
    InputError
        If Dask's engine is not installed.
    """
    dask = engine("--workers")
    if not _forks(kind):
        return
    from multiprocessing import forkserver, resource_tracker

    with _settings(kind):
        dask.utils.get_mp_context().set_forkserver_preload(["lfpiv.runs.worker_preload"])  # after Dask's own
    resource_tracker.ensure_running()  # it lets Ctrl-C through again
    path = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))  # the same modules as here
    try:
        with unheard_by_children():
            forkserver.ensure_running()
    finally:
        if path is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = path


def _forks(kind: str) -> bool:
    """Elsewhere than on Linux libraries of the system may not survive a fork, either."""
    return kind == "cpu" and sys.platform == "linux"


def _settings(kind: str) -> Any:
    """Hold Dask to what is right for a few processes of this machine; a context."""
    import dask

    method = "forkserver" if _forks(kind) else "spawn"
    return dask.config.set(SETTINGS | {"distributed.worker.multiprocessing-method": method})


@contextlib.contextmanager
def workers(planned: Plan, shared: Path) -> Iterator[tuple[Any, Width]]:
    """Start worker processes on this machine; nothing is left of them afterwards, however that comes."""
    warm_up(planned.kind)
    with _settings(planned.kind):
        yield from _workers(planned, shared)


def _workers(planned: Plan, shared: Path) -> Iterator[tuple[Any, Width]]:
    dask = engine("--workers")
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
    with unheard_by_children():
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
                if client.status != "running":
                    raise ClusterError("the scheduler of the workers ended. The same command goes on where it stopped.")
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
def unheard_by_children() -> Iterator[None]:
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
