"""Warp: voxels on planes across a camera's line of sight, and back: the factor R of the weights W = V R.

A voxel is shared among the nodes of four planes, where its line of sight meets them. Where this line follows no lattice
direction of the voxels, they are shared first among the lines of sight on either side, see ``line_shares``. Each thread
writes a row of nodes or of voxels, so that results do not depend on the number of threads. The loops are C++, see
``depth_planes.h``; a GPU has ``depth_planes_gpu``. Twin: `PlaneShares.nodes_of`, voxel by voxel.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.reconstruction import depth_planes_gpu
from lfpiv_kernels.reconstruction.line_shares import Layers, LineShares
from lfpiv_kernels.reconstruction.plane_layout import PlaneMap
from lfpiv_kernels.transfer import Given, as_given, empty, to_device, to_host

wp.set_module_options(native.options("depth_planes.h", contract="fast"))

TAPS: int = native.constant("depth_planes.h", "TAPS")
"""Planes, rows and columns among which a voxel is shared."""


@dataclass(frozen=True, kw_only=True)
class PlaneShares:
    """Places and shares of voxels on planes of nodes.

    The voxel in row a, layer z and column b has the share ``row_share[z, j] column_share[z, k]`` on the line of sight
    in row ``a + j`` and column ``b + k`` of this layer. The line of sight in row a and column b has the share
    ``share[z, n]`` in plane ``plane[z] + n``, n from 0 to 3, at row ``a + shift[z, n, 0]`` and column
    ``b + shift[z, n, 1]``.
    """

    axes: tuple[int, int, int]
    """Axes of the volume in memory that count rows, layers and columns."""
    voxels: tuple[int, int, int]
    """Voxels along the axes of the volume in memory."""
    nodes: tuple[int, int, int]
    """Rows, planes and columns of nodes."""
    plane: np.ndarray
    """First plane of each layer, shape (layer,), int32."""
    share: np.ndarray
    """Share of a layer on its planes, shape (layer, 4), float32."""
    shift: np.ndarray
    """Rows and columns from a line of sight to its nodes, shape (layer, 4, 2), int32."""
    row_share: np.ndarray
    """Share of a layer's voxels on lines of sight along the rows, shape (layer, line), float32; one line: all of it."""
    column_share: np.ndarray
    """The same along the columns."""

    @property
    def size(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.nodes))

    def nodes_of(self, voxel: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes of a voxel and its shares, shapes (node,); shares of zero are left out."""
        place = np.unravel_index(voxel, self.voxels)
        row, layer, column = (int(place[axis]) for axis in self.axes)
        of_row, of_column = (share[layer].astype(np.float64) for share in (self.row_share, self.column_share))
        share = np.einsum("j,k,n->jkn", of_row, of_column, self.share[layer].astype(np.float64))
        j, k, n = np.indices(share.shape)
        rows, columns = row + j + self.shift[layer, n, 0], column + k + self.shift[layer, n, 1]
        node = (rows * self.nodes[1] + self.plane[layer] + n) * self.nodes[2] + columns
        return node[share != 0], share[share != 0]


@native.kernel("lfpiv::spread_row(lfpiv::plane_map(map), row, absolute, voxels.data, nodes_out.data);")
def _spread(
    # in
    map: PlaneMap,
    absolute: bool,
    voxels: wp.array(dtype=float),
    first_row: int,
    # out
    nodes_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::collect_row(lfpiv::plane_map(map), row, nodes.data, voxels_out.data);")
def _collect(
    # in
    map: PlaneMap,
    nodes: wp.array(dtype=float),
    first_row: int,
    # out
    voxels_out: wp.array(dtype=float),
): ...


class DepthPlanes:
    """The linear map R from voxels to the nodes of one camera, and its adjoint, on the running device."""

    def __init__(self, shares: PlaneShares):
        self.shares = shares
        rows, layers, columns = (shares.voxels[axis] for axis in shares.axes)
        strides = {0: shares.voxels[1] * shares.voxels[2], 1: shares.voxels[2], 2: 1}
        self._moved = shares.axes[2] != 2
        """Whether columns must be brought together in memory first."""
        self._map = PlaneMap()
        for name, array in (("plane", shares.plane), ("shift", shares.shift)):
            setattr(self._map, name, to_device(np.ascontiguousarray(array, np.int32).ravel()))
        self._map.share = to_device(np.ascontiguousarray(shares.share, np.float32).ravel())
        lattice = Layers(
            rows,
            columns,
            layers * columns if self._moved else strides[shares.axes[0]],
            columns if self._moved else strides[shares.axes[1]],
        )
        self._lines = []
        for share, along_rows in ((shares.row_share, True), (shares.column_share, False)):
            if share.shape[1] > 1:
                self._lines.append(LineShares(share, along_rows, lattice))
                lattice = self._lines[-1].shared
        self._map.rows, self._map.layers, self._map.columns = lattice.rows, layers, lattice.columns
        self._map.row_stride, self._map.layer_stride = lattice.row_stride, lattice.layer_stride
        self._map.node_rows, self._map.planes, self._map.node_columns = shares.nodes
        self._layers_of = to_device(depth_planes_gpu.layers_of_planes(shares.plane, shares.nodes[1]))

    def spread(self, volume: Given, *, absolute: bool = False) -> Given:
        """Return the nodes' light R volume, shape (node,), float32, on the device if `volume` is.

        With `absolute` the shares count as positive.
        """
        voxels, nodes = to_device(volume, float), empty(self.shares.size)
        if self._moved:
            voxels = _transposed(voxels, self.shares.voxels, self.shares.axes)
        for line in self._lines:
            voxels = line.spread(voxels, absolute=absolute)
        if runtime.device().form == "gpu":
            depth_planes_gpu.spread(self._map, self._layers_of, absolute, voxels, nodes)
        else:
            launch(Call(_spread, self.shares.nodes[0] * self.shares.nodes[1], [self._map, absolute, voxels], [nodes]))
        return as_given(nodes, volume)

    def collect(self, nodes: Given) -> Given:
        """Return the adjoint's sum R^T nodes, shape (voxel,), float32, on the device if `nodes` are."""
        found = empty(self._map.rows * self._map.layers * self._map.columns)
        light = to_device(nodes, float)
        if runtime.device().form == "gpu":
            depth_planes_gpu.collect(self._map, light, found)
        else:
            launch(Call(_collect, self._map.rows * self._map.layers, [self._map, light], [found]))
        for line in reversed(self._lines):
            found = line.collect(found)
        if self._moved:
            rows, layers, columns = (self.shares.voxels[axis] for axis in self.shares.axes)
            first, second, third = (self.shares.axes.index(axis) for axis in range(3))
            found = _transposed(found, (rows, layers, columns), (first, second, third))
        return as_given(found, nodes)


def _transposed(volume: wp.array, shape: tuple[int, int, int], axes: tuple[int, int, int]) -> wp.array:
    """Return a flat volume of a shape with its axes in another order in memory."""
    if runtime.device().form == "gpu":
        return volume.reshape(shape).transpose(axes).contiguous().flatten()
    # NumPy's loop takes a quarter of the time of Warp's on the CPU.
    return to_device(np.ascontiguousarray(to_host(volume).reshape(shape).transpose(axes)).ravel())
