"""Many pairs: how many processes work on them, with which threads and devices, and what comes of each pair."""

from __future__ import annotations

import importlib.util
import logging
import os
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.runs import memory
from lfpiv.runs.pair import Outcome, PairWork
from lfpiv.warn import Code, Warning, warn
from lfpiv_kernels.runtime import Device

log = logging.getLogger(__name__)

MOST_WORKERS = 1024
"""More are a slip."""


@dataclass(frozen=True)
class Plan:
    """How the pairs of a run are shared out on this machine."""

    workers: int
    """Processes that work on pairs; one: this process itself."""
    threads: int
    """CPU threads of each."""
    devices: tuple[str | None, ...]
    """What each process sees as CUDA_VISIBLE_DEVICES; None: what this one sees."""
    kind: str = "cpu"
    """Where their kernels run: "cpu" or "cuda"."""


def plan(pairs: int, workers: int | None, device: Device, gpus: Sequence[str] = ()) -> Plan:
    """Share pairs out to processes: never more of them than pairs, on CUDA in turn over the GPUs.

    Parameters
    ----------
    pairs : int
        Pairs to do.
    workers : int, optional
        Processes asked for; default: one per GPU on CUDA, one otherwise.
    device : Device
        Where this process runs its kernels; its threads are shared out.
    gpus : sequence of str
        Names of the GPUs, as CUDA_VISIBLE_DEVICES has them.

    Raises
    ------
    InputError
        If `workers` is not a whole number from 1 on.
    """
    if workers is not None and not (type(workers) is int and 1 <= workers <= MOST_WORKERS):
        raise InputError(f"--workers: expected a whole number from 1 to {MOST_WORKERS}, found {workers!r}.")
    spread = device.kind == "cuda" and len(gpus) > 1
    if workers is None:
        workers = len(gpus) if spread else 1
    workers = max(min(workers, pairs), 1)
    devices = tuple(gpus[number % len(gpus)] if spread and workers > 1 else None for number in range(workers))
    if spread and workers != len(gpus):
        using = f"each has one of {len(gpus)} GPUs" if workers < len(gpus) else f"they share {len(gpus)} GPUs"
        log.info("%d %s for %d pairs: %s", workers, "worker" if workers == 1 else "workers", pairs, using)
    return Plan(workers, max(device.threads // workers, 1), devices, device.kind)


def visible_gpus() -> tuple[str, ...]:
    """Return the names of the GPUs that processes of this one can have, as CUDA_VISIBLE_DEVICES has them.

    Warp must run.
    """
    import warp as wp

    return gpu_names(os.environ.get("CUDA_VISIBLE_DEVICES"), len(wp.get_cuda_devices()))


def gpu_names(listed: str | None, count: int) -> tuple[str, ...]:
    """Name the GPUs that a process may hand on to others.

    Parameters
    ----------
    listed : str, optional
        CUDA_VISIBLE_DEVICES: numbers or UUIDs, as the user or the cluster set it; None where it is not set.
    count : int
        GPUs that this process sees. Of a list CUDA takes what stands before the first name it does not know. Of parts
        of GPUs (names with "MIG-") it shows every process a single one, whatever the list says.
    """
    names = [name.strip() for name in (listed or "").split(",")]
    if count and all(name.startswith("MIG-") for name in names):
        return tuple(dict.fromkeys(names))
    return tuple(names[:count] if listed else map(str, range(count)))


def require_memory(experiment: Experiment, weights: int, workers: int) -> None:
    """Log what the run will take; refuse workers that do not fit into the memory, before any work.

    Raises
    ------
    InputError
        With the need of all and of each, and with the number of workers that fits.
    """
    needed = memory.run_bytes(experiment, weights, workers)
    each = memory.worker_bytes(experiment)
    text = f"about {needed / memory.GIB:.1f} GiB needed, {weights / memory.GIB:.1f} GiB of it for weights"
    if workers > 1:
        text += f" that {workers} workers share, {each / memory.GIB:.1f} GiB for each worker"
    log.info("memory: %s", text)
    fits = memory.fitting_workers(experiment, weights, workers)
    if fits < workers and memory.run_bytes(experiment, weights, 1) <= memory.allowed_bytes(experiment):
        raise InputError(
            f"--workers {workers}: {text}, {memory.allowed_bytes(experiment) / memory.GIB:.1f} GiB may be used. "
            f"Use --workers {fits}, or free memory."
        )
    memory.require(needed, experiment, "volumes and weights of")


def lowered(planned: Plan, experiment: Experiment, weights: int, device: Device) -> Plan:
    """Take fewer workers where so many do not fit into the memory beside the weights; says so."""
    fits = memory.fitting_workers(experiment, weights, planned.workers)
    if fits == planned.workers:
        return planned
    figures = {
        "fits": fits,
        "noun": "worker" if fits == 1 else "workers",
        "planned": planned.workers,
        "weights_gib": weights / memory.GIB,
        "each_gib": memory.worker_bytes(experiment) / memory.GIB,
    }
    warn(log, Warning(code=Code.FEWER_WORKERS, figures=figures))
    return replace(planned, workers=fits, threads=max(device.threads // fits, 1), devices=planned.devices[:fits])


def unasked(planned: Plan, device: Device) -> Plan:
    """Several workers that nobody asked for need a package that nobody need have installed; without it, take one."""
    if planned.workers == 1 or importlib.util.find_spec("distributed") is not None:
        return planned
    warn(log, Warning(code=Code.ONE_GPU, figures={"gpus": len(set(planned.devices))}))
    return Plan(1, device.threads, (None,), device.kind)


def alone(work: PairWork, todo: Sequence[int], progress: Callable[[float], None]) -> Generator[Outcome, None, None]:
    """Do pairs one after the other in this process."""
    for number, pair in enumerate(todo):

        def step(fraction: float, number: int = number) -> None:
            progress((number + fraction) / len(todo))

        step(0.0)
        yield work.do(pair, step)
