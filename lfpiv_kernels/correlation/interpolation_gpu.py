"""Matrices applied along the axes of a vector field on a GPU; host function and CPU form: ``interpolation``."""

import math

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.correlation.memory import empty_volume
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.transfer import to_device

wp.set_module_options(native.quiet_options() | {"max_unroll": 0})


@wp.kernel
def _multiply(
    # in
    matrix: wp.array2d(dtype=wp.float64),
    source: wp.array3d(dtype=wp.float64),  # the matrix applies to the middle axis; a thread per result
    begin: int,
    # out
    result_out: wp.array3d(dtype=wp.float64),
):
    layer, k, column = wp.tid()
    row = begin + layer
    total = wp.float64(0.0)
    for n in range(matrix.shape[1]):
        total += matrix[k, n] * source[row, n, column]
    result_out[row, k, column] = total


@wp.kernel
def _as_vectors(
    # in
    values: wp.array(dtype=wp.float64),  # flat, (vector, component)
    begin: int,
    # out
    vector_out: wp.array(dtype=wp.vec3),
):
    k = begin + wp.tid()
    vector_out[k] = wp.vec3(float(values[3 * k]), float(values[3 * k + 1]), float(values[3 * k + 2]))


@wp.kernel
def _as_numbers(
    # in
    vector: wp.array(dtype=wp.vec3),
    begin: int,
    # out
    value_out: wp.array(dtype=wp.float64),  # flat, (vector, component)
):
    k = begin + wp.tid()
    for component in range(3):
        value_out[3 * k + component] = wp.float64(vector[k][component])


def along_axes(matrices: list[np.ndarray], field: wp.array) -> wp.array:
    """Return a field (z, y, x, component) of float64 after a matrix was applied along each axis."""
    for axis, matrix in enumerate(matrices):
        shape = (*field.shape[:axis], len(matrix), *field.shape[axis + 1 :])
        before, behind = math.prod(shape[:axis]), math.prod(shape[axis + 1 :])
        result = empty_volume(shape, wp.float64)
        inputs = [to_device(matrix, wp.float64), field.reshape((before, field.shape[axis], behind))]
        launch(
            Call(
                _multiply, before, inputs, [result.reshape((before, len(matrix), behind))], inner=(len(matrix), behind)
            )
        )
        field = result
    return field


def vectors(field: wp.array) -> wp.array:
    """Return a field (z, y, x, 3) of float64 as vectors of float32."""
    found = empty_volume(field.shape[:3], wp.vec3)
    launch(Call(_as_vectors, found.size, [field.flatten()], [found.flatten()]))
    return found


def numbers(field: wp.array) -> wp.array:
    """Return a field of vectors as numbers (z, y, x, 3) of float64."""
    found = empty_volume((*field.shape, 3), wp.float64)
    launch(Call(_as_numbers, field.size, [field.flatten()], [found.flatten()]))
    return found
