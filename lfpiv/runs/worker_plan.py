"""Plan the worker processes of a run: how many, with how many threads, on which GPUs, within the memory."""

from __future__ import annotations

import importlib.util
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.files import size_text
from lfpiv.runs import memory
from lfpiv.warn import Code, Warning, warn
from lfpiv_kernels.runtime import Device

log = logging.getLogger(__name__)

MAX_WORKERS = 1024
"""Largest accepted number of workers; more is a typing error."""


@dataclass(frozen=True)
class Plan:
    """Distribution of the pairs of a run over processes of this machine."""

    workers: int
    """Number of processes that work on pairs; 1 is the process of the run itself."""
    threads: int
    """CPU threads of each."""
    devices: tuple[str | None, ...]
    """CUDA_VISIBLE_DEVICES of each process; None leaves it as it is in this process."""
    kind: str = "cpu"
    """Where their kernels run: "cpu" or "cuda"."""


def plan(pairs: int, workers: int | None, device: Device, gpus: Sequence[str] = ()) -> Plan:
    """Distribute pairs over at most as many processes; on CUDA the processes take the GPUs in turn.

    Parameters
    ----------
    pairs : int
        Number of pairs.
    workers : int, optional
        Number of processes; default: one per GPU on CUDA, one otherwise.
    device : Device
        Device of this process; the workers share its threads.
    gpus : sequence of str
        Names of the GPUs as in CUDA_VISIBLE_DEVICES.

    Raises
    ------
    InputError
        If `workers` is no whole number from 1 to `MAX_WORKERS`.
    """
    if workers is not None and not (type(workers) is int and 1 <= workers <= MAX_WORKERS):
        raise InputError(f"--workers: expected a whole number from 1 to {MAX_WORKERS}, found {workers!r}.")
    several = device.kind == "cuda" and len(gpus) > 1
    if workers is None:
        workers = len(gpus) if several else 1
    workers = max(min(workers, pairs), 1)
    devices = tuple(gpus[number % len(gpus)] if several and workers > 1 else None for number in range(workers))
    if several and workers != len(gpus):
        using = f"each has one of {len(gpus)} GPUs" if workers < len(gpus) else f"they share {len(gpus)} GPUs"
        log.info("%d %s for %d pairs: %s", workers, "worker" if workers == 1 else "workers", pairs, using)
    return Plan(workers, max(device.threads // workers, 1), devices, device.kind)


def visible_gpus() -> tuple[str, ...]:
    """Return the names of the GPUs that worker processes can use. Warp must run."""
    import warp as wp

    return gpu_names(os.environ.get("CUDA_VISIBLE_DEVICES"), len(wp.get_cuda_devices()))


def gpu_names(listed: str | None, count: int) -> tuple[str, ...]:
    """Name the GPUs of this process as in CUDA_VISIBLE_DEVICES.

    Parameters
    ----------
    listed : str, optional
        CUDA_VISIBLE_DEVICES: numbers or UUIDs, as the user or the cluster set it; None if it is not set.
    count : int
        GPUs that this process sees. CUDA ignores the list from the first unknown name on. Of parts of GPUs (names with
        "MIG-") CUDA shows a process only one, so all listed parts count.
    """
    names = [name.strip() for name in (listed or "").split(",")]
    if count and all(name.startswith("MIG-") for name in names):
        return tuple(dict.fromkeys(names))
    return tuple(names[:count] if listed else map(str, range(count)))


def require_memory(experiment: Experiment, weights: int, workers: int) -> None:
    """Log the memory that the run needs with weights [byte] and a number of workers; refuse more workers than fit.

    Raises
    ------
    InputError
        With the need of all and of each, and with the number of workers that fits.
    """
    needed = memory.run_bytes(experiment, weights, workers)
    each = memory.worker_bytes(experiment)
    text = f"about {size_text(needed)} needed, {size_text(weights)} of it for weights"
    if workers > 1:
        text += f" that {workers} workers share, {size_text(each)} for each worker"
    log.info("memory: %s", text)
    fits = memory.fitting_workers(experiment, weights, workers)
    if fits < workers and memory.run_bytes(experiment, weights, 1) <= memory.allowed_bytes(experiment):
        raise InputError(
            f"--workers {workers}: {text}, {memory.allowed_bytes(experiment) / memory.GIB:.1f} GiB may be used. "
            f"Use --workers {fits}, or free memory."
        )
    memory.require(needed, experiment, "volumes and weights of")


def fit_memory(planned: Plan, experiment: Experiment, weights: int, device: Device) -> Plan:
    """Return a plan with as many workers as fit into the memory after the weights [byte]; warn if these are fewer."""
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


def fit_installation(planned: Plan, device: Device) -> Plan:
    """Return a plan with one worker, and warn, if several need the package `distributed` and it is not installed."""
    if planned.workers == 1 or importlib.util.find_spec("distributed") is not None:
        return planned
    warn(log, Warning(code=Code.ONE_GPU, figures={"gpus": len(set(planned.devices))}))
    return Plan(1, device.threads, (None,), device.kind)
