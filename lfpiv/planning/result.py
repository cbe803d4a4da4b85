"""`Plan`: what a campaign takes, as figures and for people."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lfpiv.files import size_text
from lfpiv.prompt import Card, Shown, count, times
from lfpiv.quantities import duration
from lfpiv_kernels.runtime import Device


@dataclass(frozen=True)
class Cost:
    """Time of some work."""

    wall_s: float = 0.0
    """Time that passes [s]."""
    cpu_s: float = 0.0
    """Time of all threads on their cores [s]. Other programs on the machine change it little."""

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)

    def __sub__(self, other: Cost) -> Cost:
        """Subtract, to no less than nothing: small times scatter."""
        return Cost(max(self.wall_s - other.wall_s, 0.0), max(self.cpu_s - other.cpu_s, 0.0))

    def __mul__(self, factor: float) -> Cost:
        return Cost(self.wall_s * factor, self.cpu_s * factor)


@dataclass(frozen=True, kw_only=True)
class Time:
    """Time of the parts of a campaign."""

    preparation: Mapping[str, Cost]
    """Done once: "weights", and "cameras" where these could be compared."""
    first: Cost
    """What only the first pair of each worker needs."""
    pair: Cost
    """One pair in one worker."""
    steps: Mapping[str, Cost]
    """Of a pair: "images", "reconstruction", "correlation", "tracking" where particles are tracked, "writing"."""
    simulated: Cost
    """Pairs that are simulated at the end to measure the damping by ghosts."""
    total_s: float
    """The campaign with all workers, without its report [s]."""


@dataclass(frozen=True, kw_only=True)
class Memory:
    """Memory of a campaign [byte]."""

    needed: int
    """Of all workers of this machine."""
    weights: int
    """Of the weights, which the workers share."""
    worker: int
    """Of each worker beside them."""
    allowed: int
    """What a run may take here now."""
    device_needed: int | None
    """On each GPU, all weights included; None on the CPU."""
    device_free: int | None
    """Free memory of the GPU; None on the CPU."""


@dataclass(frozen=True, kw_only=True)
class Disk:
    """Files of a campaign [byte]."""

    pair: int
    """Vectors and linked particles of a pair."""
    results: int
    """Vectors and linked particles of all pairs."""
    volumes: int
    """Both volumes of a pair, if they are kept, before compression."""
    weights: int
    """Weights that several workers share while they work; 0 for one."""
    free: int
    """Free space where the results go."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Plan(Shown):
    """What a campaign takes. Made by `plan`."""

    name: str
    file: Path
    noun: str
    """What results are numbered by: "pair" or "instant"."""
    pairs: int
    workers: int
    device: Device
    """Where the calibration ran; `threads` are those of each worker."""
    shape: tuple[int, int, int]
    """Voxels of the volume (z, y, x)."""
    voxel_mm: float
    reconstructed: tuple[int, int, int]
    """Voxels that are reconstructed, with guard layers and refined (z, y, x)."""
    reconstructed_mm: float
    """Their edge [mm]."""
    vectors: tuple[int, int, int]
    """Vectors of a pair (z, y, x)."""
    time: Time
    memory: Memory
    disk: Disk
    limits: tuple[str, ...]
    """What limits the campaign."""
    assumptions: tuple[str, ...]
    """What the plan takes for granted."""

    @property
    def fits(self) -> bool:
        """Whether memory and disk suffice."""
        return self.memory.needed <= self.memory.allowed and self.disk.results + self.disk.weights <= self.disk.free

    def to_json(self) -> dict[str, Any]:
        """Return the form of ``lfpiv plan --json``."""

        def voxels(shape: tuple[int, int, int], edge_mm: float) -> dict[str, Any]:
            return {"shape": list(shape), "voxels": math.prod(shape), "voxel_mm": edge_mm}

        return {
            "experiment": {"name": self.name, "file": str(self.file)},
            f"{self.noun}s": self.pairs,
            "workers": self.workers,
            "threads": self.device.threads,
            "device": self.device.figures(),
            "volume": voxels(self.shape, self.voxel_mm),
            "reconstructed": voxels(self.reconstructed, self.reconstructed_mm),
            "vectors": {"shape": list(self.vectors), "count": math.prod(self.vectors)},
            "time": asdict(self.time),
            "memory_bytes": asdict(self.memory),
            "disk_bytes": asdict(self.disk),
            "fits": self.fits,
            "limits": list(self.limits),
            "assumptions": list(self.assumptions),
        }

    def card(self) -> Card:
        """Return the plan for people."""
        when, need, disk = self.time, self.memory, self.disk
        all_of = f"{count(self.pairs, self.noun)} with {count(self.workers, 'worker')}"
        several = f", {size_text(need.worker)} for each worker" if self.workers > 1 else ""
        finest = f"{times(self.reconstructed)} of {self.reconstructed_mm:.4g} mm: {math.prod(self.reconstructed):,}"
        facts = [
            ("device", self.device.sentence),
            ("volume", f"{times(self.shape)} voxels (z, y, x) of {self.voxel_mm:.4g} mm"),
            ("reconstructed", finest),
            ("vectors", f"{times(self.vectors[::-1])} (x, y, z), {math.prod(self.vectors):,} per {self.noun}"),
            ("preparation", _parts(when.preparation)),
            (f"a {self.noun}", _parts(when.steps)),
            ("in all", f"{duration(when.total_s)} for {all_of}, without the report"),
            ("memory", f"{size_text(need.needed)}, {size_text(need.weights)} of it for weights{several}"),
            ("disk", f"{size_text(disk.results)}, {size_text(disk.pair)} per {self.noun}"),
        ]
        if need.device_needed is not None and need.device_free is not None:
            text = f"{size_text(need.device_needed)} needed, {size_text(need.device_free)} free"
            facts.insert(-1, ("memory of the GPU", text))
        if disk.weights:
            facts.append(("while it runs", f"{size_text(disk.weights)} of disk for the weights that workers share"))
        facts += [("limit", text) for text in self.limits] + [("taken for granted", text) for text in self.assumptions]
        return Card(f"Plan of {self.name!r}: {all_of}", tuple(facts))


def _parts(costs: Mapping[str, Cost]) -> str:
    """Return the time of all parts, and of each."""
    each = ", ".join(f"{name} {duration(one.wall_s)}" for name, one in costs.items())
    return f"{duration(sum(one.wall_s for one in costs.values()))}: {each}"
