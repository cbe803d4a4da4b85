"""Many pairs: how many processes work on them, with which threads and devices, and what comes of each pair."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace

from lfpiv import memory
from lfpiv.errors import InputError
from lfpiv.experiment import Experiment
from lfpiv.pair import Outcome, PairWork
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
    return Plan(workers, max(device.threads // workers, 1), devices)


def visible_gpus() -> tuple[str, ...]:
    """Return the names of the GPUs this process sees, as CUDA_VISIBLE_DEVICES has them; Warp must run."""
    import warp as wp

    count = len(wp.get_cuda_devices())
    names = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    return tuple((names or [str(number) for number in range(count)])[:count])


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
    """Take fewer workers where the weights came out larger than foreseen; says so."""
    fits = memory.fitting_workers(experiment, weights, planned.workers)
    if fits == planned.workers:
        return planned
    log.warning(
        "%d workers instead of %d: the weights take %.1f GiB, more than foreseen",
        fits,
        planned.workers,
        weights / memory.GIB,
    )
    return replace(planned, workers=fits, threads=max(device.threads // fits, 1), devices=planned.devices[:fits])


def alone(work: PairWork, todo: Sequence[int], progress: Callable[[float], None]) -> Generator[Outcome, None, None]:
    """Do pairs one after the other in this process."""
    for number, pair in enumerate(todo):

        def step(fraction: float, number: int = number) -> None:
            progress((number + fraction) / len(todo))

        step(0.0)
        yield work.do(pair, step)
