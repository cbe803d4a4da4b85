"""The only owner of Taichi's and Warp's global state: picks the device, starts both, runs Warp launches on threads.

A second ``ti.init`` would kill every live Taichi field, so the runtime starts once per process.
"""

import contextlib
import io
import logging
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

log = logging.getLogger(__name__)


CHUNKS = 8
"""Parts into which a CPU launch is cut. Fixed, so that results do not depend on the number of threads."""


@dataclass(frozen=True)
class Device:
    """Where kernels run."""

    kind: str
    """ "cpu" or "cuda"."""
    threads: int
    """Threads used by CPU launches."""
    reason: str = ""
    """Why this device was picked, where the request left a choice."""

    @property
    def warp(self) -> str:
        """Warp's name of the device."""
        return "cuda:0" if self.kind == "cuda" else "cpu"


_device: Device | None = None
_pool: ThreadPoolExecutor | None = None
_starting = threading.Lock()
_forked = False


def start(request: str = "auto", *, threads: int | None = None) -> Device:
    """Start the kernels' runtime once per process and return its device.

    Parameters
    ----------
    request : {"auto", "cpu", "cuda"}
        "auto" takes a CUDA device where there is one and says once why not; "cuda" never falls back.
    threads : int, optional
        CPU threads; default: the cores this process may use.

    Raises
    ------
    ValueError
        If `request` is none of the three.
    RuntimeError
        If "cuda" was requested and none is visible, the runtime already runs on another device, or it ran when this
        process was forked: its threads stayed behind.
    """
    if request not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device: expected 'auto', 'cpu' or 'cuda', got {request!r}.")
    with _starting:
        return _start(request, threads)


def _start(request: str, threads: int | None) -> Device:
    global _device, _pool
    if _forked:
        raise RuntimeError(
            "device: kernels ran before this process was forked, and cannot run in it. Start processes by 'spawn' or "
            "'forkserver', as in multiprocessing.get_context('spawn'), or fork before kernels run."
        )
    if _device is not None:
        if request not in ("auto", _device.kind):
            raise RuntimeError(
                f"device: the runtime already runs on {_device.kind!r}; {request!r} needs a new process."
            )
        return _device

    import warp as wp

    wp.config.log_level = wp.LOG_ERROR  # no banner, no compilation notes on the user's terminal
    with _quiet_stderr():  # where there is no CUDA driver, Warp's native code says so whatever the log level
        wp.init()
    if request == "cuda" and not wp.is_cuda_available():
        raise RuntimeError("device: 'cuda' was requested but none is visible; use 'auto' to allow the CPU.")
    kind = "cuda" if request != "cpu" and wp.is_cuda_available() else "cpu"
    reason = "no CUDA device visible" if request == "auto" and kind == "cpu" else ""
    count = threads or cores()

    import taichi as ti

    with contextlib.redirect_stdout(io.StringIO()):  # Taichi prints a line that log_level does not silence
        ti.init(
            arch=ti.cuda if kind == "cuda" else ti.cpu,
            cpu_max_num_threads=count,
            log_level=ti.ERROR,
            offline_cache=True,
            fast_math=True,
        )
    _pool = ThreadPoolExecutor(count, thread_name_prefix="lfpiv")
    _device = Device(kind, count, reason)
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_leave_behind)
    if reason:
        log.info("kernels run on the CPU (%d %s): %s", count, "thread" if count == 1 else "threads", reason)
    return _device


def _leave_behind() -> None:
    """In a process forked from this one: neither the pool's threads nor Taichi's are there, so jobs would never end."""
    global _device, _pool, _forked
    _device, _pool, _forked = None, None, True


def cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Send what native code writes to standard error to nowhere; where that is closed, it goes there anyway."""
    try:
        kept = os.dup(2)
    except OSError:
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def device() -> Device:
    """Return the running device; starts it with "auto" where nothing ran yet."""
    return _device or start("auto")


def run_chunks(size: int, job: Callable[[int, int, int], None], *, chunks: int = CHUNKS) -> None:
    """Call ``job(chunk, first, last)`` for contiguous parts of ``range(size)``: threaded on the CPU, once on CUDA.

    A Warp launch on the CPU runs on one thread and releases the GIL, so Python threads scale. Jobs must write disjoint
    memory. Exceptions of a job are raised here.
    """
    where = device()
    if where.kind == "cuda":
        job(0, 0, size)
        return
    edges = [size * part // chunks for part in range(chunks + 1)]
    parts = [(part, edges[part], edges[part + 1]) for part in range(chunks) if edges[part + 1] > edges[part]]
    if where.threads == 1:  # handing chunks to another thread took a tenth of the time of small volumes
        for part in parts:
            job(*part)
        return
    futures = [_pool.submit(job, *part) for part in parts]
    for future in futures:
        future.result()
