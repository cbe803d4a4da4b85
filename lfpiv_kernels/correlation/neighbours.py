"""Predictions of vectors from their 26 neighbours, for outlier detection and filling.

In: a vector field and which of its vectors are valid. Out: medians of the neighbours, as they are and moved to the
middle along the local gradient, and their scatter.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.correlation import neighbours_gpu
from lfpiv_kernels.correlation.memory import on_device
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import Values, to_device, to_host

wp.set_module_options(native.options("neighbours.h"))

VECTORS = native.constant("neighbours.h", "VECTORS")
"""Vectors that a CPU task predicts at once; a GPU's warp predicts one component of one."""


@dataclass(frozen=True)
class Prediction:
    """Predictions of vectors from their neighbours, shape (vector, 3); NaN where there are none."""

    median: np.ndarray
    """Median of the neighbours."""
    scatter: np.ndarray
    """Median distance of the neighbours from `median`."""
    level: np.ndarray
    """Median of the neighbours after each was moved to the middle along the local gradient."""
    level_scatter: np.ndarray
    """Median distance of the moved neighbours from `level`."""
    lowest: np.ndarray
    """Least of the neighbours."""
    highest: np.ndarray
    """Greatest of the neighbours."""
    count: np.ndarray
    """Number of neighbours, shape (vector,)."""


@native.kernel("""
    const int64_t first = (int64_t)task * group;
    lfpiv::predict_points(field.data, keep.data, points.data + first, shape, points.shape[0] - first,
        prediction_out.data + 18 * first, count_out.data + first);
""")
def _predict(
    # in
    field: wp.array(dtype=float),  # flat, (z, y, x, component)
    keep: wp.array(dtype=int),  # flat, (z, y, x): 1 where a vector counts as neighbour
    points: wp.array(dtype=int),  # linear index of the vectors wanted
    shape: wp.vec3i,  # of the grid
    group: int,  # vectors per task
    first_task: int,
    # out
    prediction_out: wp.array(dtype=float),  # flat, (vector, component, 6): as in `Prediction`
    count_out: wp.array(dtype=int),  # neighbours, (vector,)
): ...


def predict(field: Values, keep: np.ndarray, wanted: np.ndarray) -> Prediction:
    """Predict vectors of a field from their neighbours, without the vectors themselves.

    Parameters
    ----------
    field : array, shape (z, y, x, 3)
        Vectors; any values where `keep` is false.
    keep : ndarray of bool, shape (z, y, x)
        Vectors that count as neighbours.
    wanted : ndarray of bool, shape (z, y, x)
        Vectors to predict.

    Returns
    -------
    Prediction
        Of the wanted vectors, in C order.

    Raises
    ------
    ValueError
        If the shapes do not match.
    """
    if field.ndim != 4 or field.shape[3] != 3:
        raise ValueError(f"field: expected shape (z, y, x, 3), got {field.shape}.")
    for name, flags in (("keep", keep), ("wanted", wanted)):
        if flags.shape != field.shape[:3]:
            raise ValueError(f"{name}: expected the shape of the field's grid, {field.shape[:3]}, got {flags.shape}.")
    where = runtime.device()
    points = np.flatnonzero(wanted).astype(np.int32)
    flags = np.ascontiguousarray(keep, np.int32).ravel()
    inputs = [on_device(field).flatten(), to_device(flags, int), to_device(points, int)]
    prediction = wp.empty((len(points), 3, 6), dtype=float, device=where.warp)
    count = wp.empty(len(points), dtype=int, device=where.warp)
    inputs, outputs = [*inputs, wp.vec3i(*keep.shape)], [prediction.flatten(), count]
    if where.form == "gpu":
        launch(neighbours_gpu.prediction_call(inputs, outputs))
    else:
        launch(Call(_predict, -(-len(points) // VECTORS), [*inputs, VECTORS], outputs))
    return Prediction(*np.moveaxis(to_host(prediction), -1, 0), to_host(count))
