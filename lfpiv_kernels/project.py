"""Warp: forward projection and its adjoint on weights stored as 8-bit blocks of rays.

A block is at most LANES rays wide, so that its row is one vector, and some rows high. It holds one value per ray, or a
profile along the columns and one along the rows, whose products are the values. The backward pass gathers per voxel.
The forward pass scatters: on the CPU every chunk of voxels adds into rays of its own, which are summed in a fixed
order, so results do not depend on the number of threads; on CUDA it adds atomically. The innermost loops are C++: as
Warp's vectors they take two to three times as long on the CPU. Twin: ``reference.dense``.
"""

import sys
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.microimages import Microimages, RayMap
from lfpiv_kernels.raymodel import LANES

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


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
    """Rays in a row of each block, at most LANES, shape (block,), uint8."""
    value: np.ndarray
    """Weights in levels, shape (value + LANES,), uint8: a vector may be read past the last one."""
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


# A row of 8 floats or bytes in C++: a vector of the compiler on the CPU, a plain loop on a GPU. What lies in a row
# beyond its block is another block's: `within` puts 0 there.
_ROWS = """
#if defined(__CUDA_ARCH__)
    struct row { float x[8]; };
    auto zero = []() { row r; for (int i = 0; i < 8; ++i) r.x[i] = 0.0f; return r; };
    auto load = [](const float* p) { row r; for (int i = 0; i < 8; ++i) r.x[i] = p[i]; return r; };
    auto levels = [](const unsigned char* p) { row r; for (int i = 0; i < 8; ++i) r.x[i] = p[i]; return r; };
    auto within = [](row a, int width) { for (int i = width; i < 8; ++i) a.x[i] = 0.0f; return a; };
    auto add = [](row a, row b, float c) { for (int i = 0; i < 8; ++i) a.x[i] += b.x[i] * c; return a; };
    auto add_product = [](row a, row b, row c) { for (int i = 0; i < 8; ++i) a.x[i] += b.x[i] * c.x[i]; return a; };
    auto sum = [](row a) {
        return ((a.x[0] + a.x[4]) + (a.x[1] + a.x[5])) + ((a.x[2] + a.x[6]) + (a.x[3] + a.x[7]));
    };
#else
    typedef float row __attribute__((vector_size(32), aligned(4)));
    typedef unsigned char bytes __attribute__((vector_size(8), aligned(1)));
    typedef int lanes __attribute__((vector_size(32)));
    auto zero = []() { return row{0, 0, 0, 0, 0, 0, 0, 0}; };
    auto load = [](const float* p) { return *(const row*)p; };
    auto levels = [](const unsigned char* p) { return __builtin_convertvector(*(const bytes*)p, row); };
    auto within = [](row a, int width) { return (lanes{0, 1, 2, 3, 4, 5, 6, 7} < width) ? a : row{}; };
    auto add = [](row a, row b, float c) { return a + b * c; };
    auto add_product = [](row a, row b, row c) { return a + b * c; };
    auto sum = [](row a) { return ((a[0] + a[4]) + (a[1] + a[5])) + ((a[2] + a[6]) + (a[3] + a[7])); };
#endif
"""

_GATHER = (
    _ROWS
    + """
    const unsigned char* level = levels_in.data + first_value;
    row total = zero();
    for (int block = first; block < last; ++block) {
        const float* at = rays.data + ray.data[block];
        const int rows = height.data[block], columns = width.data[block];
        row even = zero(), odd = zero();
        int k = 0;
        if (profiles) {
            const row across = within(levels(level), columns);
            level += columns;
            for (; k < rows; ++k, at += stride) even = add(even, load(at), (float)level[k]);
            level += rows;
            total = add_product(total, even, across);
        } else {
            for (; k + 1 < rows; k += 2, at += 2 * stride, level += 2 * columns) {
                even = add_product(even, load(at), levels(level));
                odd = add_product(odd, load(at + stride), levels(level + columns));
            }
            if (k < rows) {
                even = add_product(even, load(at), levels(level));
                level += columns;
            }
            total = add(total, within(add(even, odd, 1.0f), columns), 1.0f);
        }
    }
    return sum(total);
"""
)

_SCATTER = (
    _ROWS
    + """
#if !defined(__CUDA_ARCH__)  // rays of its own: not for two threads at once
    const unsigned char* level = levels_in.data + first_value;
    for (int block = first; block < last; ++block) {
        float* at = rays_out.data + ray.data[block];
        const int rows = height.data[block], columns = width.data[block];
        const row light = within(zero() + intensity, columns);
        int k = 0;
        if (profiles) {
            const row across = levels(level) * light;
            level += columns;
            for (; k + 1 < rows; k += 2, at += 2 * stride) {  // load two rows, then store two
                const row even = add(load(at), across, (float)level[k]);
                const row odd = add(load(at + stride), across, (float)level[k + 1]);
                *(row*)at = even;
                *(row*)(at + stride) = odd;
            }
            if (k < rows) *(row*)at = add(load(at), across, (float)level[k]);
            level += rows;
        } else {
            for (; k + 1 < rows; k += 2, at += 2 * stride, level += 2 * columns) {
                const row even = add_product(load(at), levels(level), light);
                const row odd = add_product(load(at + stride), levels(level + columns), light);
                *(row*)at = even;
                *(row*)(at + stride) = odd;
            }
            if (k < rows) {
                *(row*)at = add_product(load(at), levels(level), light);
                level += columns;
            }
        }
    }
#endif
"""
)


@wp.func_native(_GATHER)
def _gather(
    first: int,
    last: int,
    first_value: wp.int64,
    ray: wp.array(dtype=int),
    height: wp.array(dtype=wp.uint8),
    width: wp.array(dtype=wp.uint8),
    levels_in: wp.array(dtype=wp.uint8),
    stride: int,
    profiles: bool,
    rays: wp.array(dtype=float),
) -> float: ...


@wp.func_native(_SCATTER)
def _scatter(
    first: int,
    last: int,
    first_value: wp.int64,
    ray: wp.array(dtype=int),
    height: wp.array(dtype=wp.uint8),
    width: wp.array(dtype=wp.uint8),
    levels_in: wp.array(dtype=wp.uint8),
    stride: int,
    profiles: bool,
    intensity: float,
    rays_out: wp.array(dtype=float),
): ...


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
    total = _gather(
        matrix.first_block[voxel], matrix.first_block[voxel + 1], matrix.first_value[voxel],
        matrix.ray, matrix.height, matrix.width, matrix.level, matrix.stride, matrix.profiles, rays,
    )  # fmt: skip
    volume_out[voxel] = volume_out[voxel] + matrix.scale[voxel] * total


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
        _scatter(
            matrix.first_block[voxel], matrix.first_block[voxel + 1], matrix.first_value[voxel],
            matrix.ray, matrix.height, matrix.width, matrix.level, matrix.stride, matrix.profiles, intensity, rays_out,
        )  # fmt: skip


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

    Arrays in and out are float32, C-contiguous and flat; on the CPU they are used in place.
    """

    def __init__(self, blocks: Blocks):
        self.blocks = blocks
        self._device = runtime.device()
        self._map = RayMap(blocks.microimages)
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
        self._rays = wp.zeros(blocks.microimages.size, dtype=float, device=self._device.warp)
        wp.load_module(sys.modules[__name__], device=self._device.warp)  # before threads use it
        self._spans = [self._span(part) for part in range(runtime.CHUNKS)] if self._device.kind == "cpu" else []
        self._parts: list[np.ndarray] = []

    def _put(self, array, dtype):
        return wp.array(array, dtype=dtype, device=self._device.warp, copy=False)

    def _span(self, part):
        """First and last ray that a chunk of voxels can touch."""
        voxels, rays = len(self.blocks.scale), self.blocks.microimages
        a, b = (self.blocks.first_block[voxels * k // runtime.CHUNKS] for k in (part, part + 1))
        if a == b:
            return 0, 0
        first, last, tall = self.blocks.ray[a:b].min(), self.blocks.ray[a:b].max(), self.blocks.height[a:b].max()
        return int(first), min(int(last) + max(int(tall) - 1, 0) * rays.edge + LANES, rays.size)

    def back_project(self, image: np.ndarray, out: np.ndarray, active: np.ndarray | None = None) -> np.ndarray:
        """Add the weighted sum of `image`, shape (pixel,), over each voxel's pixels to `out`, shape (voxel,).

        Voxels whose `active` is zero are left out. Returns `out`.
        """
        volume = self._put(out, float)
        mask = self._put(np.ones_like(out) if active is None else active, float)
        self._map.spread(self._put(image, float), self._rays)

        def launch(_, first, last):
            wp.launch(
                _back_project,
                dim=last - first,
                inputs=[first, self._matrix, self._rays, mask],
                outputs=[volume],
                device=self._device.warp,
            )

        runtime.run_chunks(len(out), launch)
        if self._device.kind == "cuda":
            out[:] = volume.numpy()
        return out

    def project(self, volume: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Write the image of `volume`, shape (voxel,), into `out`, shape (pixel,); returns `out`."""
        voxels, image = self._put(volume, float), self._put(out, float)
        self._rays.zero_()
        if self._device.kind == "cuda":
            wp.launch(
                _project_atomic,
                dim=len(volume),
                inputs=[self._matrix, voxels],
                outputs=[self._rays],
                device=self._device.warp,
            )
            self._map.collect(self._rays, image)
            out[:] = image.numpy()
            return out
        if not self._parts:
            self._parts = [np.empty(last - first, np.float32) for first, last in self._spans]

        def launch(part, first, last):
            start, stop = self._spans[part]
            if start == stop:
                return
            scratch = self._parts[part]
            scratch[:] = 0.0
            rays = wp.array(ptr=scratch.ctypes.data - 4 * start, dtype=float, shape=(stop,), device="cpu", copy=False)
            wp.launch(_project, dim=last - first, inputs=[first, self._matrix, voxels], outputs=[rays], device="cpu")

        runtime.run_chunks(len(volume), launch)
        rays = self._rays.numpy()
        for (start, stop), scratch in zip(self._spans, self._parts, strict=True):
            rays[start:stop] += scratch
        self._map.collect(self._rays, image)
        return out

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
