"""Warp: how voxels are shared among the nodes of planes, for the loops on the CPU and on a GPU."""

import warp as wp


@wp.struct
class PlaneMap:
    """`PlaneShares` on the device."""

    plane: wp.array(dtype=int)
    share: wp.array(dtype=float)
    shift: wp.array(dtype=int)
    rows: int
    layers: int
    columns: int
    row_stride: int
    layer_stride: int
    node_rows: int
    planes: int
    node_columns: int
