"""Predictions of vectors from their 26 neighbours on a GPU; host function and CPU form: ``neighbours``."""

import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.lanes import lanes_of_warp
from lfpiv_kernels.launch import Call

wp.set_module_options(native.options("neighbours_gpu.h"))


@native.kernel(
    "lfpiv::predict_vector(field.data, keep.data, points.data, shape, task, prediction_out.data, count_out.data);",
    "task",
    "_lane",
    registers=64,
)
def _predict_vectors(
    # in
    field: wp.array(dtype=float),  # as in `_predict`; a warp per component of a vector
    keep: wp.array(dtype=int),
    points: wp.array(dtype=int),
    shape: wp.vec3i,
    first_task: int,
    # out
    prediction_out: wp.array(dtype=float),
    count_out: wp.array(dtype=int),
): ...


def prediction_call(inputs: list[object], outputs: list[wp.array]) -> Call:
    """Return the call that predicts vectors: a warp per component of each."""
    _, count = outputs
    return Call(_predict_vectors, 3 * len(count), inputs, outputs, inner=lanes_of_warp())
