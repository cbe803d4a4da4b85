"""The model of memory traffic: sectors are counted as stated, and addresses are those of the kernels' own loops."""

import gpu_model
import numpy as np
import pytest
from support.ideal_rig import two_cameras

import lfpiv
from lfpiv_kernels.reconstruction.projector import ALL
from lfpiv_kernels.reconstruction.projector_gpu import TiledProjector
from lfpiv_kernels.transfer import to_device, to_host

GRID = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.2, 1.0, 0.8), voxel_mm=0.1)
MOST_TOUCHED = 1.5
"""Sectors touched per sector needed: the goal."""


def accesses(*rows):
    """Return events of (warp, phase, number, lane, address, bytes, kind)."""
    return np.array(
        [(w << 40 | p << 20 | n << 8 | lane, a << 8 | b << 2 | kind) for w, p, n, lane, a, b, kind in rows], np.uint64
    )


def test_sectors_of_instructions_and_of_thread_blocks():
    row = [(0, 1, 0, lane, 4096 + 4 * lane, 4, 0) for lane in range(32)]  # aligned: four sectors
    again = [(1, 1, 0, lane, 4096 + 4 * lane, 4, 0) for lane in range(32)]  # another warp of the same block
    askew = [(8, 1, 0, lane, 8208 + 4 * lane, 4, 0) for lane in range(32)]  # half a sector on: five
    apart = [(8, 2, 0, lane, 65536 + 64 * lane, 4, 2) for lane in range(3)]  # three atomics, far apart
    found = gpu_model.count_sectors("kernel", accesses(*row, *again, *askew, *apart), 7, 2.0, 100.0, 18, 8)
    assert (found.touched, found.needed) == (2 * (4 + 4 + 5 + 3), 2 * (4 + 4 + 4 + 3))
    assert found.packed == 2 * (4 + 4 + 4 + 1)
    assert (found.by_block, found.used) == (2 * (4 + 5 + 3), 2 * (4 + 4))  # 12 bytes of the atomics fill no sector
    assert (found.atomics, found.exchanges, found.memory) == (6, 14, 100.0)


@pytest.fixture(scope="module", params=["profiles", "pixels"])
def projector(request, device):
    weights = lfpiv.build_weights(two_cameras(), GRID, form=request.param)
    return weights.projector("cam1") if "cam1" in weights.cameras else weights.projector(next(iter(weights.cameras)))


def test_a_traced_gather_reads_the_rays_of_its_blocks_and_gives_the_same(projector):
    """The rule, by NumPy: lane l reads column l % 8 of rows l // 8, l // 8 + 4, ... of each block."""
    tiled, blocks = TiledProjector(projector.blocks), projector.blocks
    rng = np.random.default_rng(0)
    tiled.rays.assign(rng.random(len(tiled.rays)).astype(np.float32))
    voxel, expected = GRID.size // 2, to_device(np.zeros(GRID.size, np.float32), float)
    tiled.gather(expected, to_device(np.ones(GRID.size, np.float32), float), ALL)
    events, light = gpu_model.trace_gather(tiled, voxel)
    assert light == to_host(expected)[voxel]
    address = (events[:, 1] >> np.uint64(8)).astype(np.int64) - tiled.rays.ptr
    read = address[
        (address >= 0) & (address < 4 * len(tiled.rays)) & (events[:, 1] >> np.uint64(2) & np.uint64(63) == 4)
    ]
    rule = []
    for block in range(blocks.first_block[voxel], blocks.first_block[voxel + 1]):
        first, width = int(tiled.places(blocks.ray[block])), int(blocks.width[block])
        for row in range(int(blocks.height[block])):
            rule += [first + row * tiled.matrix.pitch + column for column in range(width)]
    np.testing.assert_array_equal(np.sort(read) // 4, np.sort(rule))


def test_no_kernel_of_a_pass_touches_much_more_than_it_needs_or_adds_atomically(projector):
    for one in gpu_model.model_projector(gpu_model.Tracer(blocks=8), projector):
        assert one.ratio <= MOST_TOUCHED, one
        assert one.atomics == 0
        assert 0 < one.used <= one.by_block <= one.touched
        assert one.seconds > gpu_model.LAUNCH_S
