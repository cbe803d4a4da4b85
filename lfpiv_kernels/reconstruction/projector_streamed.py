"""Projection on a GPU whose memory does not hold a camera's weights: slabs of voxels pass through two buffers.

The weights are cut into slabs of contiguous voxels. The first ones stay on the GPU, as many as fit. The others lie in
the host's memory, page-locked where CUDA allows. In each pass a copy stream fills one buffer while the kernels work on
the other. A projection goes through the slabs in the order of the voxels and adds to the light on the rays, and a voxel
gathers by itself. So sums are those of `projector_gpu.TiledProjector` bit by bit.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.projector_gpu import (
    ENTRY_BYTES,
    HEAD_BYTES,
    SECTOR,
    TILE,
    TiledMatrix,
    TiledRays,
    align_on_host,
    profile_sectors,
    tiles_per_edge,
)
from lfpiv_kernels.reconstruction.weight_blocks import Blocks
from lfpiv_kernels.transfer import copy_bytes, empty, host_bytes, view

SLAB_BYTES = 64 << 20
"""Most memory of a slab [byte]. At 25 GB/s its copy takes 2.7 ms, and a pass over a slab four calls of the driver."""
MOST_SECTORS = np.iinfo(np.int32).max
"""Largest number of sectors of a matrix: their indices have 32 bits."""
ALIGNMENT = 256
"""Each array of a slab begins at a multiple of these bytes, as CUDA's own allocations do."""
GATHERED = ("first_block", "even_blocks", "ray", "height", "width", "start")
BOTH = ("scale", "word")
SCATTERED = ("tile_entry", "tile_ray", "tile_size", "entry_voxel", "entry_start", "entry_place")
"""Arrays in their order in a slab: what only a gather reads, what both passes read, what only a scatter reads."""
VOXEL_BYTES, TILE_BYTES = 12, 16
"""Memory of a voxel without its blocks, and of a tile without its entries [byte]."""


@dataclass(frozen=True)
class Slab:
    """Contiguous voxels and their weights."""

    first: int
    last: int
    """The first voxel, and the one behind the last."""
    matrix: TiledMatrix
    """The weights where they lie on the device while the slab is worked on."""
    memory: wp.array
    """All arrays, one behind the other [byte]: on the device if the slab stays there, else on the host."""
    gathered: tuple[int, int]
    scattered: tuple[int, int]
    """The bytes that each pass reads: begin and end."""


class Buffers:
    """Two buffers on the device. One is filled while work on the other goes on.

    On a GPU copies have a stream of their own: a copy waits until the work on its buffer is done, and work waits for
    its copy. The host waits for neither. Without a GPU all is done in order.
    """

    def __init__(self, size: int):
        device = runtime.device()
        self.arrays = [empty(size, wp.uint8) for _ in range(2)]
        self._done: list[wp.Event | None] = [None, None]
        self._copying = None
        if device.kind == "cuda":
            self._copying = wp.Stream(device.warp)
            self._copying.wait_stream(wp.get_stream(device.warp))  # which allocates the buffers

    def fill(self, number: int, source: wp.array, begin: int, end: int) -> None:
        """Copy some bytes of a slab to their places in a buffer. Kernels that are launched next wait for them."""
        done = self._done[number]
        if self._copying is not None and done is not None:
            self._copying.wait_event(done)
        copy_bytes(self.arrays[number], source, begin, end, self._copying)
        if self._copying is not None:
            wp.get_stream(runtime.device().warp).wait_event(self._copying.record_event())

    def release(self, number: int) -> None:
        """Allow that a buffer is filled again after what has been launched."""
        if self._copying is not None:
            self._done[number] = wp.get_stream(runtime.device().warp).record_event()


class StreamedProjector(TiledRays):
    """The weights of one camera, of which a GPU holds a part at a time, and the light on its rays.

    Parameters
    ----------
    blocks : Blocks
        The weights.
    limit_bytes : int
        Memory that the weights may take on the GPU [byte].

    Raises
    ------
    MemoryError
        If the limit does not hold two slabs, or the weights of one voxel are larger than a slab.
    """

    def __init__(self, blocks: Blocks, limit_bytes: int):
        super().__init__(blocks)
        if limit_bytes < least_bytes():
            raise MemoryError(
                f"device: weights that are streamed need {least_bytes() / 2**20:,.0f} MiB of the GPU's memory, "
                f"{max(limit_bytes, 0) / 2**20:,.0f} MiB are left for them. Reconstruct fewer voxels, or use the CPU."
            )
        self._voxels = len(blocks.scale)
        self._buffers = Buffers(SLAB_BYTES)
        self._slabs: list[Slab] = []
        self.resident = 0
        """Number of slabs that stay on the device."""
        self.nbytes = least_bytes()
        """Memory of the weights on the device: of both buffers and the slabs that stay [byte]."""
        for first, last in slab_edges(blocks):
            self._add(blocks.part(first, last), first, last, limit_bytes - self.nbytes)

    def _add(self, part: Blocks, first: int, last: int, left: int) -> None:
        """Add a slab. It stays on the device if all before it do and it takes no more than `left` [byte]."""
        matrix, arrays = self.matrix_of(part)
        matrix.adds = True
        arrays["word"] = align_on_host(matrix, arrays, part)
        names = (*GATHERED, *BOTH, *SCATTERED)
        sizes = [-(-arrays[name].nbytes // ALIGNMENT) * ALIGNMENT for name in names]
        begins = dict(zip(names, itertools.accumulate(sizes, initial=0), strict=False))
        size, number = sum(sizes), len(self._slabs)
        if size > SLAB_BYTES:
            raise MemoryError(
                f"device: the weights of voxel {first} take {size / 2**20:,.0f} MiB, more than the {SLAB_BYTES >> 20} "
                "of a slab. Reconstruct smaller voxels, or use the CPU."
            )
        stays = self.resident == number and size <= left
        memory = host_bytes(size, locked=not stays)
        packed = memory.numpy()  # a view: it is on the host
        for name, begin in begins.items():
            packed[begin : begin + arrays[name].nbytes] = arrays[name].view(np.uint8)
        place = self._buffers.arrays[number % 2]
        if stays:
            place = empty(size, wp.uint8)
            copy_bytes(place, memory, 0, size)
            self.resident, self.nbytes, memory = number + 1, self.nbytes + size, place
        for name, begin in begins.items():
            setattr(matrix, name, view(place, begin, arrays[name]))
        gathered, scattered = (0, begins[SCATTERED[0]]), (begins[BOTH[0]], size)
        self._slabs.append(Slab(first, last, matrix, memory, gathered, scattered))

    @property
    def count(self) -> int:
        """Number of slabs."""
        return len(self._slabs)

    @property
    def host_bytes(self) -> int:
        """Memory of the slabs on the host [byte]."""
        return sum(slab.memory.size for slab in self._slabs[self.resident :])

    @property
    def pass_bytes(self) -> tuple[int, int]:
        """What a projection and a back projection copy to the device [byte]."""
        streamed = self._slabs[self.resident :]
        scattered, gathered = ([getattr(slab, name) for slab in streamed] for name in ("scattered", "gathered"))
        return sum(end - begin for begin, end in scattered), sum(end - begin for begin, end in gathered)

    def scatter(self, volume: wp.array, lenses: int) -> None:
        """Send the light of `volume`, shape (voxel,), to the rays of some lenses. The other rays become dark."""
        self.rays.zero_()
        for slab in self._in_turn("scattered"):
            self.scatter_of(slab.matrix, volume[slab.first : slab.last], lenses)

    def gather(self, volume_out: wp.array, active: wp.array, lenses: int) -> None:
        """Add the weighted sum of the light on each active voxel's rays of some lenses to `volume_out`."""
        for slab in self._in_turn("gathered"):
            some = slice(slab.first, slab.last)
            self.gather_of(slab.matrix, volume_out[some], active[some], lenses)

    def count_lit(self, share: np.ndarray) -> wp.array:
        """Count the rays that each voxel lights, shape (voxel,), int32. Those whose `share` is zero do not count."""
        placed, count = self.placed(share), wp.zeros(self._voxels, dtype=int, device=runtime.device().warp)
        for slab in self._in_turn("gathered"):
            self.count_of(slab.matrix, placed, count[slab.first : slab.last])
        return count

    def _in_turn(self, read: str) -> Iterator[Slab]:
        """Yield the slabs in order, each when what a pass reads of it is on the device, or on its way there."""
        for number, slab in enumerate(self._slabs):
            if number < self.resident:
                yield slab
                continue
            self._buffers.fill(number % 2, slab.memory, *getattr(slab, read))
            yield slab
            self._buffers.release(number % 2)


def least_bytes() -> int:
    """Return the least memory that streamed weights of a camera take on the device: both buffers [byte]."""
    return 2 * SLAB_BYTES


def fits_whole(blocks: Blocks, limit_bytes: int) -> bool:
    """Return whether a limit holds all weights of a camera at once [byte], and 32 bits number their sectors."""
    size = int(_most_bytes(blocks)[-1]) + _tile_bytes(blocks)
    return size <= min(limit_bytes, SECTOR * MOST_SECTORS)


def slab_edges(blocks: Blocks) -> Iterator[tuple[int, int]]:
    """Yield the first voxel of each slab and the one behind its last: as many as `SLAB_BYTES` surely hold."""
    sizes, first = _most_bytes(blocks), 0
    room = SLAB_BYTES - _tile_bytes(blocks)
    while first < len(blocks.scale):
        last = int(np.searchsorted(sizes, sizes[first] + room, side="right")) - 1
        last = max(last, first + 1)
        yield first, last
        first = last


def _most_bytes(blocks: Blocks) -> np.ndarray:
    """Return the most memory that the voxels before each voxel take on the device [byte], shape (voxel + 1,), int64."""
    per_edge, entries = tiles_per_edge(blocks.microimages.edge), 1
    if per_edge > 1:  # a block may light several tiles of a lens; it is no wider than a tile
        rows = 1 + -(-int(blocks.height.max(initial=1)) // (TILE // 2))
        entries = 2 * min(per_edge, rows)
    each = HEAD_BYTES + entries * ENTRY_BYTES
    sizes: np.ndarray = VOXEL_BYTES * np.arange(len(blocks.first_block), dtype=np.int64)
    if blocks.form == "profiles":
        each += SECTOR * profile_sectors(blocks)
    else:
        each += 4 + SECTOR - 1  # `start`, and where the last sector is not full
        sizes += blocks.first_value
    sizes += each * blocks.first_block.astype(np.int64)
    return sizes


def _tile_bytes(blocks: Blocks) -> int:
    """Return the memory of a slab beside its voxels: of all tiles, and of what alignment leaves empty [byte]."""
    edge = blocks.microimages.edge
    tiles = -(-blocks.microimages.size // edge**2) * tiles_per_edge(edge) ** 2
    return TILE_BYTES * (tiles + 1) + (len(GATHERED) + len(BOTH) + len(SCATTERED)) * ALIGNMENT
