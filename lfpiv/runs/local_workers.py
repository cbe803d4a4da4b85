"""Worker processes of this machine. Dask starts and watches them. All of them end with the run."""

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
"""Longest time that worker processes may take to start [s]."""
CLOSE_S = 10.0
"""Time that Dask is given to close [s]."""

Capacity = Callable[[], float]
"""Return how many pairs may be submitted at once; raise ClusterError if the scheduler is lost."""

SETTINGS = {
    "distributed.worker.profile.enabled": False,  # would look at the workers' stacks 100 times a second
    "distributed.admin.tick.interval": "1s",  # default: 20 ms, in every process
    "distributed.admin.system-monitor.interval": "10s",
}
"""Settings of Dask that reduce its own load on the processes."""


def import_distributed(key: str) -> Any:
    """Import Dask's package `distributed`.

    Raises
    ------
    InputError
        If it is not installed; `key` is the option that needs it.
    """
    try:
        import distributed
    except ImportError:
        raise InputError(
            f"{key}: expected the package `distributed`, which several processes need, found none. "
            "Install it: pip install 'lfpiv[distributed]'."
        ) from None

    return distributed


def start_preloading(kind: str) -> None:
    """Start the process that workers are forked from, and let it import their modules; return at once.

    It imports while this process works, on the calibration for example. It serves all later runs of this process and
    ends with it. CUDA drivers do not survive a fork, so on CUDA this does nothing.

    Raises
    ------
    InputError
        If `distributed` is not installed.
    """
    dask = import_distributed("--workers")
    if not _forks(kind):
        return
    from multiprocessing import forkserver, resource_tracker

    with _settings(kind):
        dask.utils.get_mp_context().set_forkserver_preload(["lfpiv.runs.worker_preload"])  # after Dask's own
    resource_tracker.ensure_running()  # must start first: it unblocks Ctrl-C
    path = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))  # the same modules as here
    try:
        with interrupts_blocked():
            forkserver.ensure_running()
    finally:
        if path is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = path


def _forks(kind: str) -> bool:
    """Return whether workers are forked. Libraries of other systems than Linux may not survive a fork."""
    return kind == "cpu" and sys.platform == "linux"


def _settings(kind: str) -> Any:
    """Return a context with the settings of Dask for processes of this machine."""
    import dask

    method = "forkserver" if _forks(kind) else "spawn"
    return dask.config.set(SETTINGS | {"distributed.worker.multiprocessing-method": method})


@contextlib.contextmanager
def workers(planned: Plan, shared: Path) -> Iterator[tuple[Any, Capacity]]:
    """Start worker processes on this machine; yield Dask's client and their capacity. End them in any case."""
    start_preloading(planned.kind)
    with _settings(planned.kind):
        cluster = _start_scheduler()
        finished = False
        try:
            with import_distributed("--workers").Client(cluster, set_as_default=False) as client:
                cluster.worker_spec.update(_specifications(planned, shared))
                cluster.scale(planned.workers)  # starts them
                yield client, _capacity(client, cluster)
                finished = True
        finally:
            if not finished:
                _kill(cluster)
            with contextlib.suppress(Exception):  # processes that do not close end with this one
                cluster.close(timeout=CLOSE_S)


def _start_scheduler() -> Any:
    dask = import_distributed("--workers")
    with interrupts_blocked():
        return dask.SpecCluster(
            scheduler={
                "cls": dask.Scheduler,
                # Dask must not repeat a pair whose worker died: `dispatch` decides that
                "options": {"host": "127.0.0.1", "dashboard": False, "allowed_failures": 0, "worker_ttl": None},
            },
            silence_logs=logging.CRITICAL,
        )


def _specifications(planned: Plan, shared: Path) -> dict[int, dict[str, Any]]:
    """Return Dask's specification of every worker by its number."""
    options = {
        "nthreads": 1,
        "memory_limit": 0,
        "host": "127.0.0.1",
        "local_directory": str(shared / "dask"),
        "silence_logs": logging.CRITICAL,
        "dashboard": False,
    }
    nanny = import_distributed("--workers").Nanny
    envs = [{} if device is None else {"CUDA_VISIBLE_DEVICES": device} for device in planned.devices]
    return {number: {"cls": nanny, "options": {**options, "env": env}} for number, env in enumerate(envs)}


def _capacity(client: Any, cluster: Any) -> Capacity:
    """Return a function that counts the workers; it raises if the scheduler ended or no worker starts."""
    last_seen_s = time.monotonic()

    def capacity() -> float:
        nonlocal last_seen_s
        if client.status != "running":
            raise ClusterError("the scheduler of the workers ended. The same command goes on where it stopped.")
        count = len(cluster.scheduler.workers)
        if count:
            last_seen_s = time.monotonic()
        elif time.monotonic() - last_seen_s > START_S:
            raise RuntimeError(
                "no worker process starts. A script that calls lfpiv.run with workers must do so below "
                '`if __name__ == "__main__":`'
            )
        return count

    return capacity


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C in threads and processes started in this block: only the main process answers it and ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _kill(cluster: Any) -> None:
    """Kill the workers at once. They write files atomically, so no file is damaged."""
    for nanny in list(cluster.workers.values()):
        with contextlib.suppress(Exception):
            nanny.auto_restart = False
            if nanny.pid is not None:
                os.kill(nanny.pid, signal.SIGKILL)
