"""`Work`, a prepared case of the benchmarks, and particle volumes. Nothing here imports the package."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

SHIFT = np.array([0.7, -0.4, 0.3])
"""Displacement of the particles (z, y, x) [voxel]."""
BARE_CORRELATION = {"smoothing_voxel": 0.0, "intensity_power": 1.0}
"""The correlation as peers do it, whatever the defaults are."""


class WrongResult(Exception):
    """The result is wrong, so its time means nothing."""


@dataclass
class Work:
    """A prepared case. One sample is one call of `run`."""

    run: Callable[[], object]
    check: Callable[[object], dict[str, float]]  # raises WrongResult, or returns figures of quality
    amounts: dict[str, float]  # units of work in one run
    read_bytes: float = 0  # memory that a run must stream at least: its hardware limit is this over the bandwidth,
    flops: float = 0  # or this over the floating-point rate, whichever takes longer
    peers: dict[str, Callable[[], object]] = field(default_factory=dict)  # the same work by other software
    peer_check: Callable[[object], dict[str, float]] | None = None  # default: check
    peer_share: float = 1.0  # part of the work that a run of a peer does


def require(good: bool, message: str) -> None:
    """Raise `WrongResult` with a message unless the result is right."""
    if not good:
        raise WrongResult(message)


def particles(
    shape: tuple[int, int, int], shift=0.0, seed: int = 0, *, per_voxel: float = 0.012, sd: float = 0.7
) -> np.ndarray:
    """Draw Gaussian particles with a standard deviation `sd` [voxel], moved by `shift`."""
    rng = np.random.default_rng(seed)
    at = rng.random((int(per_voxel * np.prod(shape)), 3)) * shape + shift
    stencil = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    voxel = np.rint(at).astype(int)[:, None] + stencil
    light = np.exp(-((voxel - at[:, None]) ** 2).sum(-1) / (2 * sd**2))
    inside = ((voxel >= 0) & (voxel < shape)).all(-1)
    flat = np.ravel_multi_index(tuple(voxel[inside].T), shape)
    return np.bincount(flat, light[inside], np.prod(shape)).reshape(shape).astype(np.float32)
