"""Sums over all voxels of volumes, brought to the host as numbers."""

from collections.abc import Sequence

import numpy as np

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation import sums_gpu
from lfpiv_kernels.correlation.memory import on_device
from lfpiv_kernels.transfer import Values, to_host


def means_and_squares(volumes: Sequence[Values]) -> list[tuple[float, float]]:
    """Return the mean and the sum of squares of each volume, shape (z, y, x), float32."""
    if runtime.device().form == "gpu":
        given = [on_device(volume) for volume in volumes]
        found = zip(given, sums_gpu.moments(given), strict=True)
        return [(float(total / volume.size), float(np.float32(square))) for volume, (total, square) in found]
    flat = [to_host(volume).ravel() for volume in volumes]
    return [(float(values.mean()), float(np.dot(values, values))) for values in flat]


def power(volumes: Sequence[Values]) -> float:
    """Return the sum of the squares of all volumes."""
    if runtime.device().form == "gpu":
        return float(sums_gpu.moments([on_device(volume) for volume in volumes])[:, 1].sum())
    return sum(float(np.square(to_host(volume), dtype=np.float64).sum()) for volume in volumes)


def lag_products(volumes: Sequence[Values], lag: int, axes: Sequence[int]) -> list[float]:
    """Return the sum over all volumes of products of voxels `lag` [voxel] apart along each of some axes."""
    if runtime.device().form == "gpu":
        return sums_gpu.lag_products([on_device(volume) for volume in volumes], lag, axes).sum(0).tolist()
    return [sum(_product(to_host(volume), axis, lag) for volume in volumes) for axis in axes]


def _product(values: np.ndarray, axis: int, lag: int) -> float:
    """Return the sum of products of voxels `lag` [voxel] apart along an axis."""
    moved = np.moveaxis(values, axis, 0)
    return float((moved[lag:] * moved[:-lag]).sum(dtype=np.float64))
