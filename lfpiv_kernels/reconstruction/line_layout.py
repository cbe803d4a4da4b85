"""Warp: how voxels are shared among neighbours on a line, for the loops on the CPU and on a GPU."""

import warp as wp


@wp.struct
class LineMap:
    """Shares of each layer, and the rows, columns and strides of what is read and written."""

    share: wp.array(dtype=float)
    taps: int
    layers: int
    along_rows: bool
    back: bool
    from_rows: int
    from_columns: int
    from_row_stride: int
    from_layer_stride: int
    to_rows: int
    to_columns: int
    to_row_stride: int
    to_layer_stride: int
