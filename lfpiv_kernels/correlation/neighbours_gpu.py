"""Predictions of vectors from their 26 neighbours on a GPU; host function and CPU form: ``neighbours``."""

import warp as wp

from lfpiv_kernels import native

wp.set_module_options(native.options("neighbours_gpu.h"))


@wp.func_native(
    "lfpiv::predict_vector(field.data, keep.data, points.data, shape, task, prediction_out.data, count_out.data);"
)
def _predict_one(
    field: wp.array(dtype=float),
    keep: wp.array(dtype=int),
    points: wp.array(dtype=int),
    shape: wp.vec3i,
    task: int,
    prediction_out: wp.array(dtype=float),
    count_out: wp.array(dtype=int),
): ...


@wp.kernel
def predict_vectors(
    # in
    field: wp.array(dtype=float),  # as in `_predict`; a thread per component of a vector
    keep: wp.array(dtype=int),
    points: wp.array(dtype=int),
    shape: wp.vec3i,
    first: int,
    # out
    prediction_out: wp.array(dtype=float),
    count_out: wp.array(dtype=int),
):
    """Predict one component of a vector from its neighbours."""
    _predict_one(field, keep, points, shape, first + wp.tid(), prediction_out, count_out)
