"""Warp: voxels shared among neighbours on their row or column, and back.

All voxels of a layer have the same shares. Each thread writes a row of a layer, so that results do not depend on the
number of threads. The loops are C++, see ``line_shares.h``; a GPU has ``line_shares_gpu``. Twin:
``PlaneShares.nodes_of``, voxel by voxel.
"""

from dataclasses import astuple, dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.reconstruction import line_shares_gpu
from lfpiv_kernels.reconstruction.line_layout import LineMap
from lfpiv_kernels.transfer import empty, to_device

wp.set_module_options(native.options("line_shares.h", contract="fast"))


@dataclass(frozen=True)
class Layers:
    """Rows and columns of every layer, and how far apart rows and layers lie in memory."""

    rows: int
    columns: int
    row_stride: int
    layer_stride: int


@native.kernel("lfpiv::share_row(lfpiv::line_map(map), row, absolute, values.data, shared_out.data);")
def _share(
    # in
    map: LineMap,
    absolute: bool,
    values: wp.array(dtype=float),
    first_row: int,
    # out
    shared_out: wp.array(dtype=float),
): ...


class LineShares:
    """The linear map from the voxels of all layers to the elements of longer lines, and its adjoint.

    A voxel at place a of its line in layer z has the share ``share[z, k]`` at place a + k.

    Parameters
    ----------
    share : ndarray, shape (layer, tap)
        The shares.
    along_rows : bool
        Whether places on a line are rows; else columns.
    """

    def __init__(self, share: np.ndarray, along_rows: bool, voxels: Layers):
        layers, taps = share.shape
        rows, columns = voxels.rows + (taps - 1) * along_rows, voxels.columns + (taps - 1) * (not along_rows)
        self.shared = Layers(rows, columns, layers * columns, columns)
        """The elements, those of a row and of a layer side by side."""
        on_device = to_device(np.ascontiguousarray(share, np.float32).ravel())
        self._size = layers * voxels.rows * voxels.columns
        self._forth = _map(on_device, taps, layers, along_rows, False, voxels, self.shared)
        self._back = _map(on_device, taps, layers, along_rows, True, self.shared, voxels)

    def spread(self, voxels: wp.array, *, absolute: bool = False) -> wp.array:
        """Return the elements' light, shape (element,), float32. With `absolute` the shares count as positive."""
        return _shared(self._forth, absolute, voxels, self._forth.layers * self.shared.rows * self.shared.columns)

    def collect(self, elements: wp.array) -> wp.array:
        """Return the adjoint's sums, shape (voxel,), float32."""
        return _shared(self._back, False, elements, self._size)


def _map(
    share: wp.array, taps: int, layers: int, along_rows: bool, back: bool, before: Layers, after: Layers
) -> LineMap:
    map = LineMap()
    map.share, map.taps, map.layers, map.along_rows, map.back = share, taps, layers, along_rows, back
    map.from_rows, map.from_columns, map.from_row_stride, map.from_layer_stride = astuple(before)
    map.to_rows, map.to_columns, map.to_row_stride, map.to_layer_stride = astuple(after)
    return map


def _shared(map: LineMap, absolute: bool, values: wp.array, size: int) -> wp.array:
    found = empty(size)
    if runtime.device().form == "gpu":
        line_shares_gpu.share(map, absolute, values, found)
    else:
        launch(Call(_share, map.to_rows * map.layers, [map, absolute, values], [found]))
    return found
