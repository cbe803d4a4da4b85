"""The model of memory traffic: sectors are counted as stated, and addresses are those of the kernels' own loops."""

import numpy as np
import pytest
from gpu_model import MODULES, SAMPLED, Passes
from gpu_trace import PLACE_BITS, Accesses, Tracer, loops_for_a_gpu
from gpu_traffic import LAUNCH_S, count_sectors
from support.ideal_rig import two_cameras

import lfpiv
from lfpiv_kernels.lanes import LANES
from lfpiv_kernels.reconstruction import voxels
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.projector import Projector
from lfpiv_kernels.reconstruction.projector_gpu import TiledProjector
from lfpiv_kernels.transfer import zeros

GRID = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.2, 1.0, 0.8), voxel_mm=0.1)
MOST_TOUCHED = 1.5
"""Sectors touched per sector needed: the goal."""


def accesses(*rows):
    """Return events of (warp, site, times, lane, address in the first array, bytes, kind)."""
    return np.array(
        [
            (w << 40 | site << 28 | times << 8 | lane, ((1 << PLACE_BITS) + a) << 8 | b << 2 | kind)
            for w, site, times, lane, a, b, kind in rows
        ],
        np.uint64,
    )


def test_sectors_of_instructions_and_of_thread_blocks():
    row = [(0, 1, 0, lane, 4096 + 4 * lane, 4, 0) for lane in range(32)]  # aligned: four sectors
    again = [(1, 1, 0, lane, 4096 + 4 * lane, 4, 0) for lane in range(32)]  # another warp of the same block
    askew = [(8, 1, 0, lane, 8208 + 4 * lane, 4, 0) for lane in range(32)]  # half a sector on: five
    apart = [(8, 2, 0, lane, 65536 + 64 * lane, 4, 1) for lane in range(3)]  # three, far apart
    events = accesses(*row, *again, *askew, *apart)
    found = count_sectors("kernel", Accesses(events, 7, 2.0, 18, 8, np.array([1 << 20])))
    assert (found.touched, found.needed) == (2 * (4 + 4 + 5 + 3), 2 * (4 + 4 + 4 + 3))
    assert found.packed == 2 * (4 + 4 + 4 + 1)
    assert (found.by_block, found.used) == (2 * (4 + 5 + 3), 2 * (4 + 4))  # 12 bytes of those far apart fill no sector
    assert (found.exchanges, found.memory) == (14, 32 * found.by_block)
    small = count_sectors("kernel", Accesses(events, 7, 2.0, 18, 8, np.array([100])))
    assert small.memory == 100  # the second cache holds what is read again


@pytest.fixture(scope="module", params=["profiles", "pixels"])
def projector(request, device):
    weights = lfpiv.build_weights(two_cameras(), GRID, form=request.param)
    return weights.projector(next(iter(weights.cameras)))


@pytest.mark.slow(but="pixels")
@pytest.mark.parametrize("sampled", [(), SAMPLED])
def test_a_traced_gather_reads_the_rays_of_its_blocks(projector, sampled):
    """The rule, by NumPy: lane l reads column l % 8 of rows l // 8, l // 8 + 4, ... of each block."""
    blocks, found = projector.blocks, {}
    with loops_for_a_gpu():
        tiled = TiledProjector(blocks)
    tracer = Tracer(MODULES, lambda name, accesses: found.setdefault(name, accesses), sampled)
    with tracer.running():
        tiled.gather(zeros(GRID.size), voxels.ones(GRID.size), ALL)
    events = found["projector_gpu._gather"].events
    place, warp = (events[:, 1] >> np.uint64(8)).astype(np.int64), (events[:, 0] >> np.uint64(40)).astype(np.int64)
    (of_rays,) = np.flatnonzero(found["projector_gpu._gather"].nbytes == 4 * tiled.rays.size) + 1
    first = place.min() >> PLACE_BITS
    assert first >= 1
    read = (place >> PLACE_BITS == of_rays) & (events[:, 1] >> np.uint64(2) & np.uint64(63) == 4)
    noted = np.unique(warp)
    assert LANES <= len(noted) < GRID.size  # a warp is a voxel
    rule = []
    for voxel in noted:
        for block in range(blocks.first_block[voxel], blocks.first_block[voxel + 1]):
            begin, width = int(tiled.places(blocks.ray[block])), int(blocks.width[block])
            for row in range(int(blocks.height[block])):
                rule += [begin + row * tiled.matrix.pitch + column for column in range(width)]
    np.testing.assert_array_equal(np.sort((place[read] & (1 << PLACE_BITS) - 1) // 4), np.sort(rule))


@pytest.mark.slow(but="pixels")
def test_no_projection_touches_much_more_than_it_needs(projector):
    with loops_for_a_gpu():
        passes = Passes(Projector(projector.blocks), GRID.shape, cameras=1)
    for work in (passes.projection(forward=True), passes.projection(forward=False), passes.comparison(0.0)):
        assert {one.kernel for one in work.launches} & {"projector_gpu._gather", "projector_gpu._scatter"}
        for one in work.launches:
            assert one.ratio <= MOST_TOUCHED, one
            assert 0 < one.by_block <= one.touched and one.used <= one.by_block, one
            assert one.seconds > LAUNCH_S


@pytest.mark.slow
def test_an_epoch_takes_every_subset_and_an_iteration_every_camera(projector):
    with loops_for_a_gpu():
        passes = Passes(Projector(projector.blocks), GRID.shape, cameras=2)

    def launches(work):
        kernels = [one.kernel for one in work.launches]
        return [kernels.count(f"projector_gpu.{name}") for name in ("_scatter", "_gather")]

    assert launches(passes.guess()) == [0, 2]
    assert launches(passes.comparison()) == [2, 0]
    assert launches(passes.iteration()) == [2, 2]
    assert launches(passes.epoch()) == [4, 4]
