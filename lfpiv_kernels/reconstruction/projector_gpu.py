"""Warp: projection of voxels to rays and its adjoint on a GPU; host functions and CPU form: ``projector``.

A warp gathers a voxel: a lane for each ray of four rows of a block. A warp scatters to a tile of a microimage: it goes
through a list of the blocks that light the tile, sums in shared memory, and writes the tile once. No sum is atomic, and
all are in a fixed order. Each block's values begin a sector of `SECTOR` bytes, what the memory moves at once, and so do
rows of rays. The loops are C++, see ``projector_gpu.h``; without a GPU they run lane after lane. Twin:
``reference.dense``.
"""

import numpy as np
import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.lanes import lanes_of_warp
from lfpiv_kernels.launch import Call, launch
from lfpiv_kernels.reconstruction.weight_blocks import Blocks
from lfpiv_kernels.transfer import bytes_on_device, to_device

wp.set_module_options(native.options("projector_gpu.h"))

SECTOR: int = native.constant("projector_gpu.h", "SECTOR")
"""Bytes that the memory of a GPU moves at once."""
TILE: int = native.constant("projector_gpu.h", "TILE")
"""Rays along each side of a tile at most."""
ALIGNED_RAYS = SECTOR // 4
"""Rays of a sector."""
MOST_BYTES = SECTOR * np.iinfo(np.int32).max
"""Most memory of a camera's weights on a GPU [byte]: indices of sectors have 32 bits."""
ENTRY_BYTES, HEAD_BYTES = 12, 6
"""Memory of a block in the list of its tile, and of its ray, height and width [byte]."""


@wp.struct
class TiledMatrix:
    """The arrays of `Blocks` on a GPU, and the blocks of each tile."""

    first_block: wp.array(dtype=int)
    even_blocks: wp.array(dtype=int)
    scale: wp.array(dtype=float)
    ray: wp.array(dtype=int)
    """First ray of each block, rows `pitch` apart."""
    height: wp.array(dtype=wp.uint8)
    width: wp.array(dtype=wp.uint8)
    start: wp.array(dtype=int)
    """Sector of each block's values; empty for profiles, which all have `sectors`."""
    word: wp.array(dtype=wp.uint32)
    """Values, four in a word."""
    tile_entry: wp.array(dtype=wp.int64)
    """First entry of each tile; one element more than there are tiles."""
    tile_ray: wp.array(dtype=int)
    """First ray of each tile."""
    tile_size: wp.array(dtype=int)
    """Rows, columns and set of lenses of each tile, see ``scatter_tile``."""
    entry_voxel: wp.array(dtype=int)
    entry_start: wp.array(dtype=int)
    entry_place: wp.array(dtype=int)
    sectors: int
    pitch: int
    profiles: bool


@native.kernel("lfpiv::gather_voxel(matrix, voxel, lenses, rays.data, active.data, volume_out.data);", "voxel", "_lane")
def _gather(
    # in
    matrix: TiledMatrix,  # a warp per voxel
    rays: wp.array(dtype=float),
    active: wp.array(dtype=float),
    lenses: int,
    first_voxel: int,
    # out
    volume_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::scatter_tile(matrix, tile, lenses, volume.data, rays_out.data);", "tile", "_lane")
def _scatter(
    # in
    matrix: TiledMatrix,  # a warp per tile
    volume: wp.array(dtype=float),
    lenses: int,
    first_tile: int,
    # out
    rays_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::count_voxel(matrix, voxel, share.data, count_out.data);", "voxel", "_lane")
def _count_lit(
    # in
    matrix: TiledMatrix,  # a warp per voxel
    share: wp.array(dtype=float),
    first_voxel: int,
    # out
    count_out: wp.array(dtype=int),
): ...


@native.kernel("lfpiv::align_values(matrix, first_value, level.data, voxel, word_out.data);")
def _align(
    # in
    matrix: TiledMatrix,
    first_value: wp.array(dtype=wp.int64),
    level: wp.array(dtype=wp.uint8),
    first_voxel: int,
    # out
    word_out: wp.array(dtype=wp.uint32),
): ...


@native.kernel("lfpiv::count_entries(matrix, level.data, {edge, side}, count_out.data, set_out.data);")
def _count_entries(
    # in
    matrix: TiledMatrix,
    level: wp.array(dtype=wp.uint8),
    edge: int,
    side: int,
    # out
    count_out: wp.array(dtype=wp.int64),  # per tile
    set_out: wp.array(dtype=wp.uint8),
): ...


@native.kernel("""
    lfpiv::write_entries(matrix, level.data, {edge, side}, next_out.data, voxel_out.data, start_out.data,
                         place_out.data);
""")
def _write_entries(
    # in
    matrix: TiledMatrix,
    level: wp.array(dtype=wp.uint8),
    edge: int,
    side: int,
    # out
    next_out: wp.array(dtype=wp.int64),  # in: where each tile's entries begin; out: where they end
    voxel_out: wp.array(dtype=int),
    start_out: wp.array(dtype=int),
    place_out: wp.array(dtype=int),
): ...


class TiledProjector:
    """The weights of one camera as a GPU reads them, and the light on its rays. Rows of rays begin sectors."""

    def __init__(self, blocks: Blocks):
        self._edge = blocks.microimages.edge
        self._rows = -(-blocks.microimages.size // self._edge)
        self._pitch = -(-self._edge // ALIGNED_RAYS) * ALIGNED_RAYS
        beyond = int(blocks.height.max(initial=0)) + 1  # rows of zero levels are read as well
        size = (self._rows + beyond) * self._pitch
        self.rays = wp.zeros(size, dtype=float, device=runtime.device().warp)
        """The light on the rays. Those that no voxel lights stay dark."""
        self.matrix = self._matrix_of(blocks)
        """The weights on the device."""

    @property
    def nbytes(self) -> int:
        """Memory of the weights on the device [byte]."""
        values = (getattr(self.matrix, name) for name in TiledMatrix.vars)
        arrays = (value for value in values if isinstance(value, wp.array))
        return sum(value.size * wp.types.type_size_in_bytes(value.dtype) for value in arrays)

    def places(self, ray: np.ndarray) -> np.ndarray:
        """Return where rays lie in memory, int32."""
        row, column = np.divmod(ray, self._edge)
        return (row * self._pitch + column).astype(np.int32)

    def in_order(self, rays: np.ndarray) -> np.ndarray:
        """Return values of rays as they lie in memory in the order of the rays, shape (ray,)."""
        return rays[: self._rows * self._pitch].reshape(self._rows, self._pitch)[:, : self._edge].ravel()

    def _matrix_of(self, blocks: Blocks) -> TiledMatrix:
        """Return the matrix of the camera's blocks. One thread of the host makes its arrays: bound by memory."""
        matrix = TiledMatrix()
        matrix.profiles = blocks.form == "profiles"
        matrix.pitch = self._pitch
        if matrix.profiles:
            highest = int(blocks.height.max(initial=0)) + int(blocks.width.max(initial=0))
            matrix.sectors = -(-highest // SECTOR)  # of each block
            starts, sectors = np.zeros(0, np.int64), matrix.sectors * len(blocks.ray)
        else:
            sizes = -(-blocks.height.astype(np.int64) * blocks.width // SECTOR)
            starts, sectors = np.append(0, sizes.cumsum())[:-1], int(sizes.sum())
        even = np.diff(blocks.first_block) if blocks.even_blocks is None else blocks.even_blocks
        arrays = {
            "first_block": blocks.first_block,
            "even_blocks": even.astype(np.int32),
            "height": blocks.height,
            "width": blocks.width,
            "start": starts.astype(np.int32),
            "scale": blocks.scale,
        }
        tiles = self._tiles(blocks, matrix, arrays)
        for name, array in {**arrays, "ray": self.places(blocks.ray), **tiles}.items():
            setattr(matrix, name, to_device(array))
        matrix.word = wp.zeros(max(sectors, 1) * SECTOR // 4, dtype=wp.uint32, device=runtime.device().warp)
        values = [to_device(blocks.first_value), bytes_on_device(blocks.value)]
        launch(Call(_align, len(blocks.scale), [matrix, *values], [matrix.word]))
        return matrix

    def _tiles(self, blocks: Blocks, matrix: TiledMatrix, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the arrays of the tiles that are lit and of their entries."""
        per_edge = -(-self._edge // TILE)  # tiles along a microimage
        side = -(-self._edge // per_edge)
        count = np.zeros(-(-self._rows // self._edge) * per_edge**2, np.int64)
        tile_set = np.zeros(len(count), np.uint8)
        work = TiledMatrix()
        work.profiles, work.sectors = matrix.profiles, matrix.sectors
        for name, array in (arrays | {"ray": blocks.ray}).items():
            setattr(work, name, to_device(array, device="cpu"))
        inputs = [work, bytes_on_device(blocks.value, "cpu"), self._edge, side]
        _run_on_host(_count_entries, inputs, [count, tile_set])
        (lit,) = np.nonzero(count)
        first = np.append(0, count[lit].cumsum())
        following = np.zeros_like(count)
        following[lit] = first[:-1]
        entries = [np.empty(first[-1], np.int32) for _ in range(3)]
        _run_on_host(_write_entries, inputs, [following, *entries])
        band, column = np.divmod(lit, per_edge)
        lens, band = np.divmod(band, per_edge)
        first_row = lens * self._edge + band * side
        rows, columns = (np.minimum(self._edge - side * at, side) for at in (band, column))
        rows = np.minimum(rows, self._rows - first_row)
        ray = first_row * self._pitch + column * side
        return {
            "tile_entry": first,
            "tile_ray": ray.astype(np.int32),
            "tile_size": (rows | columns << 8 | tile_set[lit].astype(np.int64) << 16).astype(np.int32),
            **dict(zip(("entry_voxel", "entry_start", "entry_place"), entries, strict=True)),
        }

    def scatter(self, volume: wp.array, lenses: int) -> None:
        """Send the light of `volume`, shape (voxel,), to the rays of some lenses. The other rays become dark."""
        tiles = len(self.matrix.tile_ray)
        launch(Call(_scatter, tiles, [self.matrix, volume, lenses], [self.rays], inner=lanes_of_warp()))

    def gather(self, volume_out: wp.array, active: wp.array, lenses: int) -> None:
        """Add the weighted sum of the light on each active voxel's rays of some lenses to `volume_out`."""
        inputs = [self.matrix, self.rays, active, lenses]
        launch(Call(_gather, len(volume_out), inputs, [volume_out], inner=lanes_of_warp()))

    def count_lit(self, share: np.ndarray) -> wp.array:
        """Count the rays that each voxel lights, shape (voxel,), int32. Those whose `share` is zero do not count."""
        placed = np.zeros(len(self.rays), np.float32)
        placed[self.places(np.arange(len(share)))] = share
        count = wp.zeros(len(self.matrix.scale), dtype=int, device=runtime.device().warp)
        inputs = [self.matrix, to_device(placed)]
        launch(Call(_count_lit, len(count), inputs, [count], inner=lanes_of_warp()))
        return count


def device_bytes(form: str, voxels: int, blocks: int, values: int, *, edge: int) -> int:
    """Return the memory of one camera's weights on a GPU [byte], from the numbers of voxels, blocks and values."""
    aligned = SECTOR * -(-(ALIGNED_RAYS + edge) // SECTOR) * blocks
    if form != "profiles":
        aligned = values + (SECTOR // 2 + 4) * blocks
    return aligned + (ENTRY_BYTES + HEAD_BYTES) * blocks + 12 * voxels


def _run_on_host(kernel: wp.Kernel, inputs: list[object], outputs: list[np.ndarray]) -> None:
    """Run a kernel on arrays in the host's memory by one thread."""
    runtime.device()
    arrays = [to_device(array, device="cpu") for array in outputs]
    wp.launch(kernel, dim=1, inputs=inputs, outputs=arrays, device="cpu")
