"""Warp: forward projection and its adjoint on weights stored as 8-bit blocks of rays.

A block is at most BLOCK_WIDTH rays wide, so that its row is one vector, and some rows high. It holds one value per ray, or a
profile along the columns and one along the rows, whose products are the values. The backward pass gathers per voxel.
The forward pass scatters: on the CPU every part of the voxels adds into rays of its own, which each pixel sums in a
fixed order; on CUDA it adds atomically. The innermost loops are C++: as Warp's vectors they take two to three times as
long on the CPU. Twin: ``reference.dense``.
"""

import contextlib
import itertools
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.reconstruction.pixel_rays import RayMap
from lfpiv_kernels.weights.microimages import Microimages
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH

wp.set_module_options(native.options("projector.h"))


@dataclass(frozen=True, kw_only=True)
class Blocks:
    """Weights of all voxels for one camera; twin of a sparse matrix with 8-bit values and a scale per column.

    A block is `width` rays wide and `height` rows high. In the form "pixels" its values are those of its rays, row by
    row. In the form "profiles" they are `width` column values A, then `height` row values B; the value of column c and
    row k is A[c] B[k].
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
    """Rays in a row of each block, at most BLOCK_WIDTH, shape (block,), uint8."""
    value: np.ndarray
    """Weights in levels, shape (value + BLOCK_WIDTH,), uint8: a vector may be read past the last one."""
    scale: np.ndarray
    """Weight of one level, shape (voxel,), float32."""
    microimages: Microimages
    """How the rays lie in memory."""

    @property
    def nbytes(self) -> int:
        """Memory of all arrays [byte]."""
        return sum(
            getattr(self, name).nbytes
            for name in ("first_block", "first_value", "ray", "height", "width", "value", "scale")
        )

    def entries(self, voxel: int) -> tuple[np.ndarray, np.ndarray]:
        """Rays of one voxel and their weights, shapes (entry,): a ray may occur twice."""
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
    stride: int
    profiles: bool


@wp.func_native("return lfpiv::gather(lfpiv::blocks_of(matrix, voxel), rays.data);")
def _gather(matrix: Matrix, voxel: int, rays: wp.array(dtype=float)) -> float: ...


@wp.func_native("lfpiv::scatter(lfpiv::blocks_of(matrix, voxel), intensity, rays_out.data);")
def _scatter(matrix: Matrix, voxel: int, intensity: float, rays_out: wp.array(dtype=float)): ...


@wp.kernel
def _back_project(
    # in
    first_voxel: int,
    matrix: Matrix,
    rays: wp.array(dtype=float),
    active: wp.array(dtype=float),
    # out
    volume_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    if active[voxel] == 0.0:
        return
    volume_out[voxel] = volume_out[voxel] + matrix.scale[voxel] * _gather(matrix, voxel, rays)


@wp.kernel
def _project(
    # in
    first_voxel: int,
    matrix: Matrix,
    volume: wp.array(dtype=float),
    # out
    rays_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    intensity = volume[voxel] * matrix.scale[voxel]
    if intensity != 0.0:
        _scatter(matrix, voxel, intensity, rays_out)


@wp.func
def _level(matrix: Matrix, value: wp.int64, width: int, row: int, column: int):
    """Level of a block's ray; its values begin at `value`."""
    if matrix.profiles:
        return float(matrix.level[value + wp.int64(column)]) * float(matrix.level[value + wp.int64(width + row)])
    return float(matrix.level[value + wp.int64(row * width + column)])


@wp.func
def _values(matrix: Matrix, width: int, height: int):
    """Values of a block."""
    if matrix.profiles:
        return wp.int64(width + height)
    return wp.int64(width * height)


@wp.kernel
def _project_atomic(
    # in
    matrix: Matrix,
    volume: wp.array(dtype=float),
    # out
    rays_out: wp.array(dtype=float),
):
    voxel = wp.tid()
    intensity = volume[voxel] * matrix.scale[voxel]
    if intensity == 0.0:
        return
    value = matrix.first_value[voxel]
    for block in range(matrix.first_block[voxel], matrix.first_block[voxel + 1]):
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
    first_voxel: int,
    matrix: Matrix,
    share: wp.array(dtype=float),
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

    Light goes from voxels to rays (`scatter`) and from rays to pixels, and the same way back (`gather`). On the way the
    rays keep it, in memory of their own for every part of the voxels that a CPU launch takes: so no two threads write
    one ray, and results do not depend on their number. A ray that voxels of two parts light lies in both.

    `project` and `back_project` may be called from several threads, which take turns. Whoever calls `scatter` and
    `gather`, and counts on the light on the rays in between, does so inside `kept`.

    Arrays in and out are float32, C-contiguous and flat; on the CPU they are used in place.
    """

    def __init__(self, blocks: Blocks):
        self._turn, self._kept = threading.RLock(), False
        self.blocks = blocks
        self._device = runtime.device()
        self._matrix = Matrix()
        self._matrix.first_block = self._put(blocks.first_block, int)
        self._matrix.first_value = self._put(blocks.first_value, wp.int64)
        self._matrix.ray = self._put(blocks.ray, int)
        self._matrix.height = self._put(blocks.height, wp.uint8)
        self._matrix.width = self._put(blocks.width, wp.uint8)
        self._matrix.level = self._put(blocks.value, wp.uint8)
        self._matrix.scale = self._put(blocks.scale, float)
        self._matrix.stride = blocks.microimages.edge
        self._matrix.profiles = blocks.form == "profiles"
        wp.load_module(sys.modules[__name__], device=self._device.warp)  # before threads use it
        self._spans = self._find_spans()
        self._places = np.cumsum([0] + [stop - start for start, stop in self._spans])
        self.rays = self._put(np.empty(max(int(self._places[-1]), 1), np.float32), float)  # `scatter` writes it first
        """The light on the rays, part after part."""
        self._parts = [  # each as if it began with the camera's first ray, where the blocks count from
            wp.array(ptr=self.rays.ptr + 4 * (int(place) - start), dtype=float, shape=(stop,), device=self.rays.device)
            for place, (start, stop) in zip(self._places, self._spans, strict=False)
        ]
        self.map = self._map_rays()

    def _put(self, array, dtype):
        return wp.array(array, dtype=dtype, device=self._device.warp, copy=False)

    def _find_spans(self):
        """First and last ray that each part of the voxels can touch."""
        voxels, rays = len(self.blocks.scale), self.blocks.microimages
        if self._device.kind == "cuda":
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

    def _map_rays(self):
        """Map of the rays that voxels light to pixels."""
        self.scatter(np.ones(len(self.blocks.scale), np.float32))
        return RayMap(self.blocks.microimages, self.rays.numpy(), self._places, [start for start, _ in self._spans])

    @contextlib.contextmanager
    def kept(self) -> Iterator[None]:
        """Keep the light on the rays: other threads wait meanwhile.

        Raises
        ------
        RuntimeError
            If this thread is inside `kept` already: it would overwrite the light on the rays.
        """
        with self._turn:
            if self._kept:
                raise RuntimeError(
                    "weights: these are in use by a reconstruction of the same thread, whose `progress` cannot project "
                    "with them. Do so before or after it, or build weights of its own."
                )
            self._kept = True
            try:
                yield
            finally:
                self._kept = False

    def scatter(self, volume: np.ndarray) -> None:
        """Send the light of `volume`, shape (voxel,), to the rays."""
        voxels = self._put(volume, float)
        if self._device.kind == "cuda":
            self.rays.zero_()
            wp.launch(
                _project_atomic,
                dim=len(volume),
                inputs=[self._matrix, voxels],
                outputs=[self.rays],
                device=self._device.warp,
            )
            return
        rays = self.rays.numpy()

        def launch(part, first, last):
            rays[self._places[part] : self._places[part + 1]] = 0.0
            wp.launch(
                _project,
                dim=last - first,
                inputs=[first, self._matrix, voxels],
                outputs=[self._parts[part]],
                device="cpu",
            )

        runtime.run_chunks(len(volume), launch)

    def gather(self, out: np.ndarray, active: np.ndarray | None = None) -> np.ndarray:
        """Add the weighted sum of the light on each voxel's rays to `out`, shape (voxel,).

        Voxels whose `active` is zero are left out. Returns `out`.
        """
        volume = self._put(out, float)
        mask = self._put(np.ones_like(out) if active is None else active, float)

        def launch(part, first, last):
            wp.launch(
                _back_project,
                dim=last - first,
                inputs=[first, self._matrix, self._parts[part], mask],
                outputs=[volume],
                device=self._device.warp,
            )

        runtime.run_chunks(len(out), launch)
        if self._device.kind == "cuda":
            out[:] = volume.numpy()
        return out

    def project(self, volume: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Write the image of `volume`, shape (voxel,), into `out`, shape (pixel,); returns `out`."""
        with self.kept():
            self.scatter(volume)
            out.fill(0.0)  # pixels that no voxel lights
            image = self._put(out, float)
            self.map.collect(self.rays, image)
        if self._device.kind == "cuda":
            out[:] = image.numpy()
        return out

    def back_project(self, image: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Add the weighted sum of `image`, shape (pixel,), over each voxel's pixels to `out`, shape (voxel,).

        Returns `out`.
        """
        with self.kept():
            self.map.spread(self._put(image, float), self.rays)
            return self.gather(out)

    def count_lit(self) -> np.ndarray:
        """Count the rays that each voxel lights, shape (voxel,), int32."""
        count = wp.zeros(len(self.blocks.scale), dtype=int, device=self._device.warp)
        share = self._put(self.blocks.microimages.share, float)

        def launch(_, first, last):
            wp.launch(
                _count_lit,
                dim=last - first,
                inputs=[first, self._matrix, share],
                outputs=[count],
                device=self._device.warp,
            )

        runtime.run_chunks(len(count), launch)
        return count.numpy()
