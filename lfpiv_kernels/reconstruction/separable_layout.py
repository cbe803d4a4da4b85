"""Warp: how profiles that planes of voxels share lie in memory, for the loops on the CPU and on a GPU."""

import warp as wp

from lfpiv_kernels.reconstruction.separable_weights import SeparableWeights
from lfpiv_kernels.transfer import to_device


@wp.struct
class Separable:
    """The arrays of `SeparableWeights` on the device, see ``SeparableArrays`` in ``separable_layout.h``."""

    rows: int
    planes: int
    columns: int
    row_stride: int
    plane_stride: int
    column_stride: int
    strips: int
    lenses: int
    pixels: int
    ray_rows: int
    blocks: int
    down_first: wp.array(dtype=wp.int16)
    down: wp.array(dtype=wp.uint8)
    down_start: wp.array(dtype=wp.int64)
    down_taps: wp.array(dtype=int)
    down_scale: wp.array(dtype=float)
    lens: wp.array(dtype=int)
    lens_count: wp.array(dtype=int)
    taps: wp.array(dtype=int)
    first_start: wp.array(dtype=wp.int64)
    level_start: wp.array(dtype=wp.int64)
    first: wp.array(dtype=wp.int16)
    level: wp.array(dtype=wp.uint8)
    turn: wp.array(dtype=float)
    middle: wp.array(dtype=float)
    rim: wp.array(dtype=wp.int8)
    reach: wp.array(dtype=wp.int16)
    seen_start: wp.array(dtype=wp.int64)
    seen_by: wp.array(dtype=int)
    seen_level: wp.array(dtype=wp.uint8)


def on_device(weights: SeparableWeights, strides: tuple[int, int, int]) -> Separable:
    """Return the arrays of weights on the device, without those that are for a GPU only.

    `strides` are the voxels in memory from one row, plane and column to the next.
    """
    arrays = Separable()
    arrays.rows, arrays.planes, arrays.columns = weights.shape
    arrays.row_stride, arrays.plane_stride, arrays.column_stride = strides
    for name in ("strips", "lenses", "pixels", "ray_rows", "blocks"):
        setattr(arrays, name, getattr(weights, name))
    for name in (
        *("down_first", "down", "down_start", "down_taps", "down_scale", "lens", "lens_count", "taps"),
        *("first_start", "level_start", "first", "level", "turn", "middle", "rim"),
    ):
        setattr(arrays, name, to_device(getattr(weights, name).ravel()))
    return arrays
