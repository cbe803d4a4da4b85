"""Warp: projection of voxels to pixels and its adjoint, with weights stored as 8-bit blocks of rays.

A block is at most `BLOCK_WIDTH` rays wide, so that its row is one vector. It holds one value per ray, or a profile
along the columns and one along the rows, whose products are the values. Blocks under even lenses come before those
under odd ones, so that either half of them can be taken alone. Blocks may have rows, see ``block_rows``: then sets of
rows of pixels under every lens can be taken alone in place of lenses. The adjoint gathers per voxel. The projection
scatters: every part of the voxels adds to rays of its own, which each pixel sums in a fixed order. The innermost loops
are C++, see ``projector.h``. A GPU has ``projector_gpu`` instead. Twin: ``reference.dense``.
"""

import itertools

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch, load
from lfpiv_kernels.reconstruction import voxels
from lfpiv_kernels.reconstruction.block_rows import RowLoops
from lfpiv_kernels.reconstruction.pixel_rays import ALL, RayMap, RaySets
from lfpiv_kernels.reconstruction.projector_gpu import TiledProjector
from lfpiv_kernels.reconstruction.ray_projector import RayProjector
from lfpiv_kernels.reconstruction.weight_blocks import Blocks
from lfpiv_kernels.transfer import Given, Values, bytes_on_device, overwrite, to_device, to_host
from lfpiv_kernels.weights.microimages import Microimages
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH

wp.set_module_options(native.options("projector.h"))


EVEN, ODD = 0, 1
"""Lenses whose rays take part: i + j is even or odd. Neighbours in a row or column of lenses differ."""


@wp.struct
class Matrix:
    """The arrays of `Blocks` on the device."""

    first_block: wp.array(dtype=int)
    first_value: wp.array(dtype=wp.int64)
    ray: wp.array(dtype=int)
    height: wp.array(dtype=wp.uint8)
    width: wp.array(dtype=wp.uint8)
    level: wp.array(dtype=wp.uint8)
    scale: wp.array(dtype=float)
    even_blocks: wp.array(dtype=int)
    even_values: wp.array(dtype=int)
    stride: int
    profiles: bool


@wp.func_native("return lfpiv::gather(lfpiv::blocks_of(matrix, voxel, lenses), rays.data);")
def _gather(matrix: Matrix, voxel: int, lenses: int, rays: wp.array(dtype=float)) -> float: ...


@wp.func_native("lfpiv::scatter(lfpiv::blocks_of(matrix, voxel, lenses), intensity, rays_out.data);")
def _scatter(matrix: Matrix, voxel: int, lenses: int, intensity: float, rays_out: wp.array(dtype=float)): ...


@wp.func_native("lfpiv::prefetch_next(matrix, active.data, voxel, lenses);")
def _prefetch_next(matrix: Matrix, active: wp.array(dtype=float), voxel: int, lenses: int): ...


@wp.kernel
def _back_project(
    # in
    matrix: Matrix,
    rays: wp.array(dtype=float),
    active: wp.array(dtype=float),
    lenses: int,
    first_voxel: int,
    # out
    volume_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    _prefetch_next(matrix, active, voxel, lenses)
    if active[voxel] == 0.0:
        return
    volume_out[voxel] = volume_out[voxel] + matrix.scale[voxel] * _gather(matrix, voxel, lenses, rays)


@wp.kernel
def _project(
    # in
    matrix: Matrix,
    volume: wp.array(dtype=float),
    lenses: int,
    first_voxel: int,
    # out
    rays_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    _prefetch_next(matrix, volume, voxel, lenses)
    intensity = volume[voxel] * matrix.scale[voxel]
    if intensity != 0.0:
        _scatter(matrix, voxel, lenses, intensity, rays_out)


@wp.func
def _level(matrix: Matrix, value: wp.int64, width: int, row: int, column: int):
    """Return the level of a block's ray. The block's values begin at `value`."""
    if matrix.profiles:
        return float(matrix.level[value + wp.int64(column)]) * float(matrix.level[value + wp.int64(width + row)])
    return float(matrix.level[value + wp.int64(row * width + column)])


@wp.func
def _values(matrix: Matrix, width: int, height: int):
    """Return the number of a block's values."""
    if matrix.profiles:
        return wp.int64(width + height)
    return wp.int64(width * height)


@wp.kernel
def _count_lit(
    # in
    matrix: Matrix,
    share: wp.array(dtype=float),
    first_voxel: int,
    # out
    count_out: wp.array(dtype=int),
):
    voxel = first_voxel + wp.tid()
    value = matrix.first_value[voxel]
    for block in range(matrix.first_block[voxel], matrix.first_block[voxel + 1]):
        width, height = int(matrix.width[block]), int(matrix.height[block])
        for row in range(height):
            for column in range(width):
                ray = matrix.ray[block] + row * matrix.stride + column
                if share[ray] > 0.0 and _level(matrix, value, width, row, column) > 0.0:
                    count_out[voxel] = count_out[voxel] + 1
        value += _values(matrix, width, height)


class Projector(RayProjector):
    """The map of weights stored as blocks. Its sets of rays belong to even and to odd lenses, or to rows of pixels.

    Each part of the voxels that a CPU launch takes has memory of its own for its rays. So no two threads write the same
    ray, and results do not depend on the number of threads. The light of a ray that voxels of two parts light lies in
    both parts and is added up.
    """

    def __init__(self, blocks: Blocks):
        super().__init__()
        self.blocks, self.form, self.nbytes = blocks, blocks.form, blocks.nbytes
        self.parts = (blocks,)
        self.ray_sets = 1 if blocks.even_blocks is None else 2
        """Sets of rays that can be taken alone: by even and odd lenses, or by rows of pixels."""
        self._tiled = TiledProjector(blocks) if runtime.device().form == "gpu" else None
        self._row_loops = None
        if self._tiled is not None:
            self.rays = self._tiled.rays
            self.map = self._map_rays()
            return
        self._matrix = Matrix()
        for name in ("first_block", "first_value", "ray", "height", "width", "scale"):
            setattr(self._matrix, name, to_device(getattr(blocks, name)))
        self._matrix.level = bytes_on_device(blocks.value)
        for name, ends in (("even_blocks", blocks.first_block), ("even_values", blocks.first_value)):
            array = getattr(blocks, name)
            setattr(self._matrix, name, to_device(np.diff(ends).astype(np.int32) if array is None else array))
        self._matrix.stride = blocks.microimages.edge
        self._matrix.profiles = blocks.form == "profiles"
        load(_project, runtime.device().warp)  # before threads start
        if blocks.rows is not None:
            self.ray_sets = self.rows = blocks.rows.sets
            self._row_loops = RowLoops(blocks)
        self._spans = self._find_spans()
        self._places = np.cumsum([0] + [stop - start for start, stop in self._spans])
        self.rays = to_device(np.empty(max(int(self._places[-1]), 1), np.float32))  # `scatter` writes it first
        """The light on the rays, part after part."""
        self._parts = [  # each as if it began with the camera's first ray, from which the blocks count
            wp.array(ptr=self.rays.ptr + 4 * (int(place) - start), dtype=float, shape=(stop,), device=self.rays.device)
            for place, (start, stop) in zip(self._places, self._spans, strict=False)
        ]
        self.map = self._map_rays()

    @property
    def microimages(self) -> Microimages:
        """Where the rays lie in memory."""
        return self.blocks.microimages

    @property
    def device_bytes(self) -> int:
        """Memory of the weights on a GPU [byte]; 0 on the CPU, where they are those of the host."""
        return 0 if self._tiled is None else self._tiled.nbytes

    def _find_spans(self) -> list[tuple[int, int]]:
        """Return the first ray that each part of the voxels can touch, and the end of its rays.

        Where rows of pixels are taken alone, these are rays of whole lenses.
        """
        size, rays = len(self.blocks.scale), self.blocks.microimages
        whole = rays.edge**2 if self.rows > 1 else 1
        edges = [self.blocks.first_block[size * part // runtime.CHUNKS] for part in range(runtime.CHUNKS + 1)]
        spans = []
        for a, b in itertools.pairwise(edges):
            if a == b:
                spans.append((0, 0))
                continue
            first, last, tall = self.blocks.ray[a:b].min(), self.blocks.ray[a:b].max(), self.blocks.height[a:b].max()
            start, stop = int(first), min(int(last) + max(int(tall) - 1, 0) * rays.edge + BLOCK_WIDTH, rays.size)
            spans.append((start // whole * whole, -(-stop // whole) * whole))
        return spans

    def _map_rays(self) -> RayMap:
        """Return the map between pixels and the rays that voxels light."""
        Projector.scatter(self, voxels.ones(len(self.blocks.scale)))
        rays = self.blocks.microimages
        if self.rows > 1:
            sets = RaySets.of_rows(rays, self.rows)
        else:
            sets = RaySets.of_lenses(rays) if self.ray_sets == 2 else RaySets.single(rays.size)
        if self._tiled is not None:
            light = self._tiled.in_order(to_host(self.rays))
            return RayMap(rays, light, [0, rays.size], [0], sets=sets, places=self._tiled.places)
        starts = [start for start, _ in self._spans]
        return RayMap(rays, to_host(self.rays), self._places, starts, sets=sets)

    @property
    def returned(self) -> wp.array:
        """The light on the rays that `gather` reads: the memory of `rays`."""
        return self.rays

    def scatter(self, volume: Values, ray_set: int = ALL) -> None:
        """Send the light of `volume`, shape (voxel,), to the rays of some lenses, or of some rows of pixels.

        The rays of other lenses become dark, other rows of pixels stay as they are.
        """
        light = to_device(volume, float)
        if self._tiled is not None:
            self._tiled.scatter(light, ray_set)
            return
        rays, loops, edge = to_host(self.rays), self._row_loops, self.microimages.edge

        def scatter_part(part, first, last):
            own = rays[self._places[part] : self._places[part + 1]]
            if loops is not None and ray_set != ALL:
                own.reshape(-1, edge, edge)[:, ray_set :: self.rows] = 0.0
                loops.project(light, ray_set, first, last, self._parts[part])
                return
            own[:] = 0.0
            inputs, outputs = [self._matrix, light, ray_set, first], [self._parts[part]]
            wp.launch(_project, dim=last - first, inputs=inputs, outputs=outputs, device="cpu")

        runtime.run_chunks(light.size, scatter_part)

    def gather(self, out: Given, active: Values | None = None, ray_set: int = ALL) -> Given:
        """Add the weighted sum of the light on each voxel's rays of a set to `out`, shape (voxel,). Return `out`.

        Voxels whose `active`, shape (voxel,), float32, is zero stay as they are.
        """
        volume, device = to_device(out, float), runtime.device().warp
        mask = voxels.ones(volume.size) if active is None else to_device(active, float)
        if self._tiled is not None:
            self._tiled.gather(volume, mask, ray_set)
        else:
            loops = self._row_loops

            def gather_part(part, first, last):
                if loops is not None and ray_set != ALL:
                    loops.back_project(self._parts[part], mask, ray_set, first, last, volume)
                    return
                inputs = [self._matrix, self._parts[part], mask, ray_set, first]
                wp.launch(_back_project, dim=last - first, inputs=inputs, outputs=[volume], device=device)

            runtime.run_chunks(volume.size, gather_part)
        overwrite(out, volume)
        return out

    def entries(self, voxel: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays of one voxel and their weights, shapes (entry,). A ray may occur several times."""
        return self.blocks.entries(voxel)

    def largest_weight(self) -> float:
        """Return the largest weight of a ray."""
        return self.blocks.largest_weight()

    def count_lit(self) -> np.ndarray:
        """Count the rays that each voxel lights, shape (voxel,), int32."""
        share = self.blocks.microimages.share
        if self._tiled is not None:
            return to_host(self._tiled.count_lit(share))
        count = wp.zeros(len(self.blocks.scale), dtype=int, device="cpu")
        launch(Call(_count_lit, len(count), [self._matrix, to_device(share, float)], [count]))
        return to_host(count)
