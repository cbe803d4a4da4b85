"""The global state of Taichi and Warp: pick the device, start both once per process, run launches on threads.

Nothing else may call ``ti.init`` or ``wp.init``. A second ``ti.init`` would destroy every live Taichi field.
"""

import atexit
import contextlib
import io
import logging
import os
import platform
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from lfpiv_kernels import caches

log = logging.getLogger(__name__)

First = TypeVar("First")
Second = TypeVar("Second")

TAICHI = os.environ.get("LFPIV_TAICHI", "")
"""Where Taichi's kernels run if not on the device: "vulkan", by any driver. For tests: Warp has no such device."""
CHUNKS = 8
"""Parts of work that `run_chunks` cuts on the CPU. Fixed, so that results do not depend on the number of threads."""


@dataclass(frozen=True)
class Device:
    """Where kernels run."""

    kind: str
    """ "cpu" or "cuda"."""
    threads: int
    """Threads that run CPU launches."""
    form: str = "cpu"
    """Loops of the kernels: "cpu", a vector of lanes per step, or "gpu", a lane per thread. "gpu" on the CPU is for
    tests, see ``native.EMULATED``."""
    reason: str = ""
    """Why this device was picked; empty if it was the one requested."""
    name: str = ""
    """Name of the GPU, or of the processor; empty where the system does not say it."""
    memory_bytes: int | None = None
    """Memory of the GPU [byte]; None on the CPU."""
    driver: str = ""
    """Newest version of CUDA that the driver knows; empty on the CPU."""

    @property
    def sentence(self) -> str:
        """Kind, name, memory and driver, threads, and why it was picked, for people."""
        facts = [self.kind, *([self.name] if self.name else [])]
        if self.memory_bytes is not None:
            facts.append(f"{self.memory_bytes / 2**30:.1f} GiB")
        if self.driver:
            facts.append(f"driver for CUDA {self.driver}")
        facts.append(f"{self.threads} {'thread' if self.threads == 1 else 'threads'}")
        return ", ".join(facts) + (f" ({self.reason})" if self.reason else "")

    def figures(self) -> dict[str, Any]:
        """Return what a summary says of the device."""
        names = ("kind", "name", "memory_bytes", "driver", "threads", "reason")
        return {name: getattr(self, name) for name in names}

    @property
    def warp(self) -> str:
        """Name of the device in Warp."""
        return "cuda:0" if self.kind == "cuda" else "cpu"


TAICHI_SHARE = 512
"""Least number of a loop's turns that Taichi gives to a CPU thread. A shorter loop runs on one thread."""

_device: Device | None = None
_pool: ThreadPoolExecutor | None = None
_taichi_folder: Path | None = None  # for the kernels of Taichi, if it held none at the start
_starting = threading.Lock()
_forked = False


def start(request: str = "auto", *, threads: int | None = None) -> Device:
    """Start the runtime once per process and return its device.

    Parameters
    ----------
    request : {"auto", "cpu", "cuda"}
        "auto" takes a CUDA device if there is one, else it takes the CPU and logs why. "cuda" never takes the CPU.
    threads : int, optional
        CPU threads. Default: the cores that this process may use.

    Raises
    ------
    ValueError
        If `request` is none of the three.
    RuntimeError
        If "cuda" was requested and no device is visible, if the runtime already runs on another device, or if it ran
        when this process was forked: its threads are not in this process. If no folder for compiled kernels can be
        written, or the process may not take the address space that Taichi reserves.
    """
    if request not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device: expected 'auto', 'cpu' or 'cuda', got {request!r}.")
    with _starting:
        return _start(request, threads)


def _start(request: str, threads: int | None) -> Device:
    global _device, _pool, _taichi_folder
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

    caches.prepare()
    import warp as wp

    from lfpiv_kernels import native

    wp.config.log_level = wp.LOG_ERROR  # no banner, no notes on compilation
    with _quiet_stderr():  # without a CUDA driver, native code writes whatever the log level
        wp.init()
    caches.verify_warp(Path(wp.config.kernel_cache_dir))
    if request == "cuda" and not wp.is_cuda_available():
        raise RuntimeError("device: 'cuda' was requested but none is visible; use 'auto' to allow the CPU.")
    kind = "cuda" if request != "cpu" and wp.is_cuda_available() else "cpu"
    reason = "no CUDA device visible" if request == "auto" and kind == "cpu" else ""
    form = "gpu" if kind == "cuda" or native.EMULATED else "cpu"
    count = 1 if native.EMULATED else threads or cores()  # a GPU adds atomically, the CPU's threads do not

    compiled = caches.taichi_folder()
    _taichi_folder = None if caches.verify_taichi(compiled) else compiled
    _start_taichi(kind, count, compiled)
    _pool = ThreadPoolExecutor(count, thread_name_prefix="lfpiv")
    _device = Device(kind, count, form, reason, **_described(kind))
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_forget_threads)
    log.info("kernels run on %s", _device.sentence)
    return _device


def _start_taichi(kind: str, threads: int, compiled: Path) -> None:
    """Start Taichi with a folder of compiled kernels, which is sealed when the process ends."""
    from lfpiv_kernels.libraries import ti

    named = {} if "TI_OFFLINE_CACHE_FILE_PATH" in os.environ else {"offline_cache_file_path": str(compiled)}
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # Taichi prints a line that log_level does not silence
            ti.init(
                arch=getattr(ti, TAICHI or kind),
                cpu_max_num_threads=threads,
                log_level=ti.ERROR,
                offline_cache=True,
                fast_math=True,
                **named,
            )
    except RuntimeError as error:
        if "memory allocation" not in str(error):
            raise
        raise RuntimeError(
            "device: the kernels need more address space than this process may take: Taichi reserves 1 GiB at its "
            "start. Raise the limit (`ulimit -v`, in KiB; `ulimit -v unlimited`)."
        ) from None
    if TAICHI and ti.cfg.arch != getattr(ti, TAICHI):  # Taichi takes the CPU without a word
        raise RuntimeError(f"LFPIV_TAICHI: Taichi finds no driver for {TAICHI!r}.")
    atexit.register(caches.seal_taichi, compiled, ti.reset)


def _described(kind: str) -> dict[str, Any]:
    """Return name, memory and driver of the device."""
    if kind == "cpu":
        return {"name": _processor()}
    import warp as wp

    found, version = wp.get_device("cuda:0"), wp.get_cuda_driver_version()
    return {"name": found.name, "memory_bytes": found.total_memory, "driver": ".".join(map(str, version or ()))}


def _processor() -> str:
    """Return the name of the processor; empty where the system does not say it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")


def free_bytes() -> int | None:
    """Return the free memory of the running GPU [byte]; None on the CPU."""
    if device().kind == "cpu":
        return None
    import warp as wp

    return int(wp.get_device(device().warp).free_memory)


def _forget_threads() -> None:
    """Refuse work in a forked process: it has neither the pool's threads nor Taichi's, so jobs would never end."""
    global _device, _pool, _forked
    _device, _pool, _forked = None, None, True


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Discard what native code writes to standard error. Do nothing where standard error is closed."""
    try:
        saved = os.dup(2)
    except OSError:
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(nowhere)


def device() -> Device:
    """Return the running device. Start it with "auto" if nothing runs yet."""
    return _device or start("auto")


def device_of_taichi() -> Device:
    """Return the running device for a kernel of Taichi. Log that kernels are compiled if the cache held none."""
    where = device()
    if _taichi_folder is not None:
        caches.log_compilation(_taichi_folder)
    return replace(where, form="gpu") if TAICHI else where


def on_threads(warp_device: str) -> bool:
    """Return whether work on a device runs in parts on the CPU's threads: not on a GPU, nor where one is emulated."""
    return warp_device == "cpu" and (device().form == "cpu" or device().kind == "cuda")


def run_chunks(
    size: int, job: Callable[[int, int, int], None], *, chunks: int = CHUNKS, warp_device: str | None = None
) -> None:
    """Call ``job(chunk, first, last)`` for contiguous parts of ``range(size)``: on threads on the CPU, once on CUDA.

    A Warp launch on the CPU runs on one thread and releases the GIL, so Python threads scale. Jobs must write disjoint
    memory. Exceptions of a job are raised here. Kernels whose parts need nothing else are launched by ``launch``.
    `warp_device` is Warp's name of the device that the job uses; default: the running one.
    """
    where = device()
    if not on_threads(warp_device or where.warp) or size == chunks == 1:
        job(0, 0, size)
        return
    edges = [size * part // chunks for part in range(chunks + 1)]
    chosen = [part for part in range(chunks) if edges[part + 1] > edges[part]]
    parts = [partial(job, part, edges[part], edges[part + 1]) for part in chosen]
    waiting = iter(parts)  # a thread that is late still holds it: empty, it keeps none of the job's arrays

    def work() -> None:
        for part in waiting:
            part()

    # The calling thread works, too. It wakes one thread for each other core: to hand over each part costs more time.
    helpers = [_pool.submit(work) for _ in range(min(where.threads, len(parts)) - 1)]
    try:
        work()
    finally:
        begun = [helper for helper in helpers if not helper.cancel()]
        for helper in begun:
            helper.exception()  # waits for its end; `wait` takes as long as a short kernel
    for helper in begun:
        helper.result()


def side_by_side(first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Call two functions that use nothing in common, on two threads on the CPU, in turn on CUDA.

    Each may launch kernels on all threads. An exception of one of them is raised here, after both have ended.
    """
    found: list[Any] = [None, None]

    def call(_: int, begin: int, end: int) -> None:
        for number in range(begin, end):
            found[number] = (first, second)[number]()

    run_chunks(2, call, chunks=2)
    return found[0], found[1]
