"""Warp: projection of voxels to pixels and its adjoint, with weights stored as 8-bit blocks of rays.

A block is at most `BLOCK_WIDTH` rays wide, so that its row is one vector. It holds one value per ray, or a profile
along the columns and one along the rows, whose products are the values. Blocks under even lenses come before those
under odd ones, so that either half of them can be taken alone. The adjoint gathers per voxel. The projection
scatters: on the CPU every part of the voxels adds to rays of its own, which each pixel sums in a fixed order; on CUDA
it adds atomically. The innermost loops are C++, see ``projector.h``. Twin: ``reference.dense``.
"""

import contextlib
import itertools
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch, load, to_device
from lfpiv_kernels.reconstruction.depth_planes import DepthPlanes, PlaneShares
from lfpiv_kernels.reconstruction.pixel_rays import RayMap
from lfpiv_kernels.weights.microimages import Microimages
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH

wp.set_module_options(native.options("projector.h"))


EVEN, ODD, ALL = 0, 1, 2
"""Lenses whose rays take part: i + j is even, odd, or either. Neighbours in a row or column of lenses differ."""


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Weights of all voxels for one camera: a sparse matrix with 8-bit values and a scale per column.

    A block is `width` rays wide and `height` rows high. In the form "pixels" it has one value per ray, row by row. In
    the form "profiles" it has `width` values A, then `height` values B; the value of column c and row k is A[c] B[k].
    There `width` is `BLOCK_WIDTH` and `height` a multiple of `ROW_GROUP`, and blocks are sorted by it.
    """

    form: str
    """"profiles" or "pixels"."""
    first_block: np.ndarray
    """Index of each voxel's first block, shape (voxel + 1,), int32."""
    first_value: np.ndarray
    """Index of each voxel's first value, shape (voxel + 1,), int64."""
    ray: np.ndarray
    """Index of each block's first ray, shape (block,), int32."""
    height: np.ndarray
    """Rows of rays of each block, shape (block,), uint8."""
    width: np.ndarray
    """Rays in a row of each block, at most `BLOCK_WIDTH`, shape (block,), uint8."""
    value: np.ndarray
    """Weights in levels, shape (value + BLOCK_WIDTH,), uint8. A vector may be read past the last one."""
    scale: np.ndarray
    """Weight of one level, shape (voxel,), float32."""
    microimages: Microimages
    """Where the rays lie in memory."""
    even_blocks: np.ndarray | None = None
    """Number of each voxel's blocks under even lenses, which come first, shape (voxel,), int32; None for all."""
    even_values: np.ndarray | None = None
    """Number of their values, shape (voxel,), int32."""

    @property
    def nbytes(self) -> int:
        """Memory of all arrays [byte]."""
        names = ("first_block", "first_value", "ray", "height", "width", "value", "scale", "even_blocks", "even_values")
        return sum(array.nbytes for array in (getattr(self, name) for name in names) if array is not None)

    def entries(self, voxel: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays of one voxel and their weights, shapes (entry,). A ray may occur twice."""
        value, rays, weights = int(self.first_value[voxel]), [], []
        for block in range(self.first_block[voxel], self.first_block[voxel + 1]):
            width, height = int(self.width[block]), int(self.height[block])
            rays.append(self.ray[block] + np.arange(height)[:, None] * self.microimages.edge + np.arange(width))
            if self.form == "profiles":
                across, down = np.split(self.value[value : value + width + height].astype(np.float64), [width])
                weights.append(down[:, None] * across)
                value += width + height
            else:
                weights.append(self.value[value : value + width * height].astype(np.float64))
                value += width * height
        if not rays:
            return np.zeros(0, np.int64), np.zeros(0)
        return np.concatenate(rays, axis=None), np.concatenate(weights, axis=None) * float(self.scale[voxel])


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
def _project_atomic(
    # in
    matrix: Matrix,
    volume: wp.array(dtype=float),
    lenses: int,
    first_voxel: int,
    # out
    rays_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    intensity = volume[voxel] * matrix.scale[voxel]
    if intensity == 0.0:
        return
    value = wp.int64(matrix.first_value[voxel])
    first, last = int(matrix.first_block[voxel]), int(matrix.first_block[voxel + 1])
    if lenses == wp.static(EVEN):
        last = first + matrix.even_blocks[voxel]
    if lenses == wp.static(ODD):
        first += matrix.even_blocks[voxel]
        value += wp.int64(matrix.even_values[voxel])
    for block in range(first, last):
        width, height = int(matrix.width[block]), int(matrix.height[block])
        for row in range(height):
            for column in range(width):
                level = _level(matrix, value, width, row, column)
                if level > 0.0:
                    wp.atomic_add(rays_out, matrix.ray[block] + row * matrix.stride + column, intensity * level)
        value += _values(matrix, width, height)


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


class Projector:
    """The linear map of one camera's weights on the running device: voxels to sensor pixels, and back.

    Light goes from voxels to rays (`scatter`) and from rays to pixels; back from pixels to rays and from rays to voxels
    (`gather`). Each part of the voxels that a CPU launch takes has memory of its own for its rays. So no two threads
    write the same ray, and results do not depend on the number of threads. The light of a ray that voxels of two parts
    light lies in both parts and is added up.

    With `planes` the blocks are those of nodes on planes across the line of sight: voxels -> nodes -> rays, and back.

    `project` and `back_project` may be called from several threads, which take turns. A caller of `scatter` and
    `gather` that needs the light on the rays in between calls them inside `reserved`.

    Arrays in and out are float32, C-contiguous and flat. On the CPU they are used in place.
    """

    def __init__(self, blocks: Blocks, planes: PlaneShares | None = None):
        self._turn, self._reserved = threading.RLock(), False
        self.blocks = blocks
        self.planes = planes
        """How voxels are shared among the nodes whose weights `blocks` are; None if these are the voxels."""
        self._planes = None if planes is None else DepthPlanes(planes)
        self._on_cpu = runtime.device().form == "cpu"
        self._matrix = Matrix()
        for name in ("first_block", "first_value", "ray", "height", "width", "scale"):
            setattr(self._matrix, name, to_device(getattr(blocks, name)))
        self._matrix.level = to_device(blocks.value)
        self.lens_sets = 1 if blocks.even_blocks is None else 2
        """Sets of lenses that can be taken alone."""
        for name, ends in (("even_blocks", blocks.first_block), ("even_values", blocks.first_value)):
            array = getattr(blocks, name)
            setattr(self._matrix, name, to_device(np.diff(ends).astype(np.int32) if array is None else array))
        self._matrix.stride = blocks.microimages.edge
        self._matrix.profiles = blocks.form == "profiles"
        load(_project, runtime.device().warp)  # before threads start
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

    def _find_spans(self) -> list[tuple[int, int]]:
        """Return the first ray that each part of the voxels can touch, and the end of its rays."""
        voxels, rays = len(self.blocks.scale), self.blocks.microimages
        if not self._on_cpu:
            return [(0, rays.size)]
        edges = [self.blocks.first_block[voxels * part // runtime.CHUNKS] for part in range(runtime.CHUNKS + 1)]
        spans = []
        for a, b in itertools.pairwise(edges):
            if a == b:
                spans.append((0, 0))
                continue
            first, last, tall = self.blocks.ray[a:b].min(), self.blocks.ray[a:b].max(), self.blocks.height[a:b].max()
            spans.append((int(first), min(int(last) + max(int(tall) - 1, 0) * rays.edge + BLOCK_WIDTH, rays.size)))
        return spans

    def _map_rays(self) -> RayMap:
        """Return the map between pixels and the rays that voxels light."""
        self._scatter(np.ones(len(self.blocks.scale), np.float32), ALL)
        starts, two = [start for start, _ in self._spans], self.lens_sets == 2
        return RayMap(self.blocks.microimages, self.rays.numpy(), self._places, starts, two_sets=two)

    @contextlib.contextmanager
    def reserved(self) -> Iterator[None]:
        """Reserve the rays for this thread. Other threads wait.

        Raises
        ------
        RuntimeError
            If this thread has reserved them already: it would overwrite the light on them.
        """
        with self._turn:
            if self._reserved:
                raise RuntimeError(
                    "weights: these are in use by a reconstruction of the same thread, whose `progress` cannot project "
                    "with them. Do so before or after it, or build weights of its own."
                )
            self._reserved = True
            try:
                yield
            finally:
                self._reserved = False

    def scatter(self, volume: np.ndarray, lenses: int = ALL) -> None:
        """Send the light of `volume`, shape (voxel,), to the rays of some lenses. The other rays become dark."""
        self._scatter(volume if self._planes is None else self._planes.spread(volume), lenses)

    def _scatter(self, volume: np.ndarray, lenses: int) -> None:
        """Do as `scatter` with the light of what `blocks` are of."""
        voxels = to_device(volume, float)
        if not self._on_cpu:
            self.rays.zero_()
            launch(Call(_project_atomic, len(volume), [self._matrix, voxels, lenses], [self.rays]))
            return
        rays = self.rays.numpy()

        def scatter_part(part, first, last):
            rays[self._places[part] : self._places[part + 1]] = 0.0
            inputs, outputs = [self._matrix, voxels, lenses, first], [self._parts[part]]
            wp.launch(_project, dim=last - first, inputs=inputs, outputs=outputs, device="cpu")

        runtime.run_chunks(len(volume), scatter_part)

    def gather(self, out: np.ndarray, active: np.ndarray | None = None, lenses: int = ALL) -> np.ndarray:
        """Add the weighted sum of the light on each voxel's rays of some lenses to `out`, shape (voxel,). Return `out`.

        Voxels whose `active`, shape (voxel,), float32, is zero do not change.
        """
        if self._planes is None:
            return self._gather(out, active, lenses)
        every = active is None or bool(active.all())
        lit = None if every else self._planes.spread((active != 0).astype(np.float32), absolute=True)
        found = self._planes.collect(self._gather(np.zeros(self._planes.shares.size, np.float32), lit, lenses))
        return np.add(out, found, out=out, where=True if every else active != 0)

    def _gather(self, out: np.ndarray, active: np.ndarray | None, lenses: int) -> np.ndarray:
        """Do as `gather` for what `blocks` are of."""
        volume, device = to_device(out, float), runtime.device().warp
        mask = to_device(np.ones_like(out) if active is None else active, float)

        def gather_part(part, first, last):
            inputs = [self._matrix, self._parts[part], mask, lenses, first]
            wp.launch(_back_project, dim=last - first, inputs=inputs, outputs=[volume], device=device)

        runtime.run_chunks(len(out), gather_part)
        if not self._on_cpu:
            out[:] = volume.numpy()
        return out

    def project(self, volume: np.ndarray, out: np.ndarray, lenses: int = ALL) -> np.ndarray:
        """Write the image of `volume`, shape (voxel,), through some lenses into `out`, shape (pixel,). Return `out`."""
        with self.reserved():
            self.scatter(volume, lenses)
            out.fill(0.0)  # pixels that no voxel lights
            image = to_device(out, float)
            self.map.collect(self.rays, image)
        if not self._on_cpu:
            out[:] = image.numpy()
        return out

    def back_project(self, image: np.ndarray, out: np.ndarray, lenses: int = ALL) -> np.ndarray:
        """Add the weighted sum of `image`, shape (pixel,), over each voxel's pixels to `out`, shape (voxel,).

        Rays of other lenses than `lenses` do not count. Return `out`.
        """
        with self.reserved():
            self.map.spread(to_device(image, float), self.rays)
            return self.gather(out, lenses=lenses)

    def see_only(self, lenses: int) -> np.ndarray:
        """Return the sensor pixels that see light through some lenses and through no others, shape (pixel,), int32."""
        rays = self.map.rays if lenses == ALL else self.map.of_lenses[lenses]
        return self.map.pixel[rays.start : rays.end]

    def entries(self, voxel: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays of one voxel and their weights, shapes (entry,). A ray may occur several times."""
        if self.planes is None:
            return self.blocks.entries(voxel)
        nodes, shares = self.planes.nodes_of(voxel)
        rays, weights = zip(*(self.blocks.entries(int(node)) for node in nodes), strict=True)
        return np.concatenate(rays), np.concatenate([own * share for own, share in zip(weights, shares, strict=True)])

    def count_lit(self) -> np.ndarray:
        """Count the rays that each voxel lights, shape (voxel,), int32. With planes: a weighted mean of its nodes'."""
        count = wp.zeros(len(self.blocks.scale), dtype=int, device=runtime.device().warp)
        share = to_device(self.blocks.microimages.share, float)
        launch(Call(_count_lit, len(count), [self._matrix, share], [count]))
        if self._planes is None:
            return count.numpy()
        return np.rint(np.maximum(self._planes.collect(count.numpy().astype(np.float32)), 0)).astype(np.int32)
