"""Voxels on planes across a camera's line of sight on a GPU; host functions and CPU form: ``depth_planes``."""

import numpy as np
import warp as wp

from lfpiv_kernels import native
from lfpiv_kernels.lanes import LANES, lanes_of_warp
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.reconstruction.plane_layout import PlaneMap

wp.set_module_options(native.options("depth_planes_gpu.h", contract="fast"))

TAPS: int = native.constant("depth_planes.h", "TAPS")


@native.kernel(
    """
    lfpiv::spread_nodes(
        lfpiv::plane_map(map), layers_of.data, warp, absolute, voxels.data, nodes_out.data
    );
    """,
    "warp",
    "_lane",
)
def _spread(
    # in
    map: PlaneMap,
    layers_of: wp.array(dtype=int),
    absolute: bool,
    voxels: wp.array(dtype=float),
    first_warp: int,
    # out
    nodes_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::collect_voxels(lfpiv::plane_map(map), warp, nodes.data, voxels_out.data);", "warp", "_lane")
def _collect(
    # in
    map: PlaneMap,
    nodes: wp.array(dtype=float),
    first_warp: int,
    # out
    voxels_out: wp.array(dtype=float),
): ...


def layers_of_planes(plane: np.ndarray, planes: int) -> np.ndarray:
    """Return the first layer that meets each plane and the end of those that do, shape (2 * plane,), int32."""
    meets = np.abs(2 * (np.arange(planes)[:, None] - plane) - (TAPS - 1)) <= TAPS - 1
    first, end = meets.argmax(axis=1), len(plane) - meets[:, ::-1].argmax(axis=1)
    return np.where(meets.any(axis=1), (first, end), 0).T.astype(np.int32).ravel()


def spread(map: PlaneMap, layers_of: wp.array, absolute: bool, voxels: wp.array, nodes_out: wp.array) -> None:
    """Write the nodes' light; with `absolute` all shares count as positive."""
    inputs = [map, layers_of, absolute, voxels]
    launch(Call(_spread, -(-nodes_out.size // LANES), inputs, [nodes_out], inner=lanes_of_warp()))


def collect(map: PlaneMap, nodes: wp.array, voxels_out: wp.array) -> None:
    """Write the sum of each voxel's nodes."""
    launch(Call(_collect, -(-voxels_out.size // LANES), [map, nodes], [voxels_out], inner=lanes_of_warp()))
