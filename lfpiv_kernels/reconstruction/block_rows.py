"""Warp: blocks of weights cut into rows of rays, so that a set of rows of pixels under every lens can be taken alone.

A row has the levels of `BLOCK_WIDTH` rays side by side; zeros fill it up. The rows of a set lie one after the other,
voxel by voxel, so that a projection by one set reads no memory of the others. They take about twice the
memory of blocks of pixels, and three to five times the memory of profiles. The blocks are kept as well. The loops are
C++, see ``projector.h``. A GPU has no rows. Twin: ``reference.dense``.
"""

from dataclasses import replace

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch, load
from lfpiv_kernels.reconstruction.weight_blocks import BlockRows, Blocks
from lfpiv_kernels.transfer import bytes_on_device, to_device
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH, LEVELS

wp.set_module_options(native.options("projector.h"))

ROW_BYTES = 4 + BLOCK_WIDTH
"""Memory of a row: the index of its first ray, and its levels [byte]."""


@wp.struct
class SplitBlocks:
    """The arrays of `Blocks` that are cut into rows."""

    first_block: wp.array(dtype=int)
    first_value: wp.array(dtype=wp.int64)
    ray: wp.array(dtype=int)
    height: wp.array(dtype=wp.uint8)
    width: wp.array(dtype=wp.uint8)
    value: wp.array(dtype=wp.uint8)
    edge: int
    sets: int
    voxels: int
    profile_levels: int


@wp.struct
class Rows:
    """The arrays of `BlockRows` and the weight of a level of each voxel."""

    first: wp.array(dtype=int)
    ray: wp.array(dtype=int)
    level: wp.array(dtype=wp.uint8)
    scale: wp.array(dtype=float)
    voxels: int


@native.kernel("lfpiv::count_rows(lfpiv::split_blocks(blocks), voxel, count_out.data);")
def _count(
    # in
    blocks: SplitBlocks,
    first_voxel: int,
    # out
    count_out: wp.array(dtype=int),
): ...


@native.kernel("lfpiv::write_rows(lfpiv::split_blocks(blocks), voxel, next_out.data, ray_out.data, level_out.data);")
def _write(
    # in
    blocks: SplitBlocks,
    first_voxel: int,
    # out
    next_out: wp.array(dtype=int),  # in: where each set's rows of each voxel begin; out: where they end
    ray_out: wp.array(dtype=int),
    level_out: wp.array(dtype=wp.uint8),
): ...


@wp.func_native("return lfpiv::gather_rows(lfpiv::rows_of(rows, voxel, ray_set), rays.data);")
def _gather(rows: Rows, voxel: int, ray_set: int, rays: wp.array(dtype=float)) -> float: ...


@wp.func_native("lfpiv::scatter_rows(lfpiv::rows_of(rows, voxel, ray_set), intensity, rays_out.data);")
def _scatter(rows: Rows, voxel: int, ray_set: int, intensity: float, rays_out: wp.array(dtype=float)): ...


@wp.kernel
def _back_project(
    # in
    rows: Rows,
    rays: wp.array(dtype=float),
    active: wp.array(dtype=float),
    ray_set: int,
    first_voxel: int,
    # out
    volume_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    if active[voxel] != 0.0:
        volume_out[voxel] = volume_out[voxel] + rows.scale[voxel] * _gather(rows, voxel, ray_set, rays)


@wp.kernel
def _project(
    # in
    rows: Rows,
    volume: wp.array(dtype=float),
    ray_set: int,
    first_voxel: int,
    # out
    rays_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    intensity = volume[voxel] * rows.scale[voxel]
    if intensity != 0.0:
        _scatter(rows, voxel, ray_set, intensity, rays_out)


def have_loops() -> bool:
    """Return whether the running device has loops over rows; a GPU has none."""
    return runtime.device().form == "cpu"


def with_rows(blocks: Blocks, sets: int) -> Blocks:
    """Return blocks with their rows of rays: every `sets`-th row under each lens makes a set.

    Rows of profiles have the products rounded to levels, and rows whose products are all below half a level are left
    out.

    The arrays on the device "cpu" are views of the NumPy arrays. So the kernels fill `first`, `ray` and `level`.
    """
    voxels = len(blocks.scale)
    split = SplitBlocks()
    for name in ("first_block", "first_value", "ray", "height", "width"):
        setattr(split, name, to_device(getattr(blocks, name), device="cpu"))
    split.value = bytes_on_device(blocks.value, "cpu")
    split.edge, split.sets, split.voxels = blocks.microimages.edge, sets, voxels
    split.profile_levels = int(LEVELS) if blocks.form == "profiles" else 0
    first = np.zeros(sets * voxels + 1, np.int32)
    launch(Call(_count, voxels, [split], [to_device(first[1:], device="cpu")]), device="cpu")
    np.cumsum(first, out=first)  # from numbers of rows to the index of the first row
    ray, level = np.empty(first[-1], np.int32), np.zeros(BLOCK_WIDTH * first[-1], np.uint8)
    outputs = [to_device(array, device="cpu") for array in (first[:-1].copy(), ray, level)]
    launch(Call(_write, voxels, [split], outputs), device="cpu")
    return replace(blocks, rows=BlockRows(sets=sets, first=first, ray=ray, level=level))


class RowLoops:
    """Projection and back projection by the rows of one set, for the voxels first <= voxel < last, on the CPU."""

    def __init__(self, blocks: Blocks):
        rows, scale = blocks.rows, blocks.row_scale
        assert rows is not None
        self._rows = Rows()
        for name in ("first", "ray"):
            setattr(self._rows, name, to_device(getattr(rows, name)))
        self._rows.level, self._rows.scale = bytes_on_device(rows.level), to_device(scale)
        self._rows.voxels = len(scale)
        load(_project, "cpu")  # with the whole module, before threads start

    def project(self, volume: wp.array, ray_set: int, first: int, last: int, rays_out: wp.array) -> None:
        """Add the weighted intensities of the voxels to their rays of a set."""
        inputs = [self._rows, volume, ray_set, first]
        wp.launch(_project, dim=last - first, inputs=inputs, outputs=[rays_out], device="cpu")

    def back_project(
        self, rays: wp.array, active: wp.array, ray_set: int, first: int, last: int, volume_out: wp.array
    ) -> None:
        """Add the weighted sum of their rays of a set to the voxels where `active` is not 0."""
        inputs = [self._rows, rays, active, ray_set, first]
        wp.launch(_back_project, dim=last - first, inputs=inputs, outputs=[volume_out], device="cpu")
