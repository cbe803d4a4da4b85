"""Warp's struct of `depth_planes.PlaneShares`, for the kernels on the CPU and on a GPU."""

import warp as wp


@wp.struct
class PlaneMap:
    """`PlaneShares` on the device, except its shares among lines of sight."""

    plane: wp.array(dtype=int)  # first plane of each layer, (layer,)
    share: wp.array(dtype=float)  # of a layer on its planes, flat (layer, 4)
    shift: wp.array(dtype=int)  # rows and columns from a line of sight to its nodes, flat (layer, 4, 2)
    rows: int  # of lines of sight
    layers: int
    columns: int
    row_stride: int  # elements from a row of the volume to the next
    layer_stride: int
    node_rows: int
    planes: int
    node_columns: int
