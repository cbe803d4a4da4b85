"""Vector fields between grids: a matrix along each axis takes a field from one grid to another."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation import interpolation_gpu
from lfpiv_kernels.transfer import Values, to_device, to_host


def to_control_points(matrices: Sequence[np.ndarray], field: np.ndarray) -> wp.array:
    """Return a field at control points, on the device, shape (z, y, x), float32 vectors.

    Parameters
    ----------
    matrices : three ndarray, shape (control point, node), float64
        From values at the nodes of an axis to values at its control points, order (z, y, x).
    field : ndarray, shape (z, y, x, 3)
        Vectors at the nodes.
    """
    if runtime.device().form == "gpu":
        values = to_device(np.ascontiguousarray(field, np.float64), wp.float64)
        return interpolation_gpu.vectors(interpolation_gpu.along_axes(_contiguous(matrices), values))
    return to_device(np.ascontiguousarray(_along_axes(matrices, field), np.float32), wp.vec3)


def from_control_points(matrices: Sequence[np.ndarray], field: Values) -> np.ndarray:
    """Return a field that was given at control points, shape (z, y, x, 3), float64.

    Parameters
    ----------
    matrices : three ndarray, shape (result, control point), float64
    field : array of vectors
        From `to_control_points`.
    """
    if runtime.device().form == "gpu":
        values = interpolation_gpu.numbers(field)
        return to_host(interpolation_gpu.along_axes(_contiguous(matrices), values))
    return _along_axes(matrices, to_host(field).astype(float))


def _contiguous(matrices: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [np.ascontiguousarray(matrix, np.float64) for matrix in matrices]


def _along_axes(matrices: Sequence[np.ndarray], field: np.ndarray) -> np.ndarray:
    for axis, matrix in enumerate(matrices):
        field = np.moveaxis(np.tensordot(matrix, field, (1, axis)), 0, axis)
    return field
