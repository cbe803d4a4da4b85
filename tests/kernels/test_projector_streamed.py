"""Weights that pass through a GPU's memory in slabs against those that are there at once: equal bit by bit."""

import numpy as np
import pytest
from support.random_blocks import VOXELS, matrix_of, random_blocks

from lfpiv_kernels.reconstruction import projector_streamed
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.projector import EVEN, ODD
from lfpiv_kernels.reconstruction.projector_gpu import TiledProjector
from lfpiv_kernels.reconstruction.projector_streamed import StreamedProjector, fits_whole, least_bytes, slab_edges
from lfpiv_kernels.transfer import count_transfers, to_device, to_host

SLABS = 5
"""Slabs of the tests at least."""
TOLERANCE_ADJOINT = 1e-6
"""Relative difference of two sums of positive terms in float64 over float32 results."""


@pytest.fixture(params=["profiles", "pixels"])
def form(request):
    return request.param


@pytest.fixture
def small_slabs(monkeypatch):
    """Return a function that makes slabs so small that there are `SLABS` of some blocks."""

    def shrink(blocks):
        sizes = projector_streamed._most_bytes(blocks)
        size = int(sizes[-1]) // SLABS + projector_streamed._tile_bytes(blocks)
        monkeypatch.setattr(projector_streamed, "SLAB_BYTES", size)
        return size

    return shrink


@pytest.mark.parametrize("edge", [7, 20, 31, 50])
@pytest.mark.parametrize("resident", [0, 2])
def test_slabs_give_the_sums_of_the_whole_bit_by_bit(form, edge, resident, small_slabs):
    blocks, rng = random_blocks(form, edge), np.random.default_rng(1)
    limit = (2 + resident) * small_slabs(blocks)
    whole, slabs = TiledProjector(blocks), StreamedProjector(blocks, limit)
    assert slabs.count >= SLABS and slabs.resident >= resident and slabs.nbytes <= limit
    assert (slabs.resident == 0) == (resident == 0)
    volume = (rng.random(VOXELS) * (rng.random(VOXELS) < 0.8)).astype(np.float32)
    active = (rng.random(VOXELS) < 0.7).astype(np.float32)
    light = whole.placed(rng.random(blocks.microimages.size).astype(np.float32))
    for lenses in (ALL, EVEN, ODD, ALL):
        found = []
        for one in (whole, slabs):
            one.rays.zero_()
            one.scatter(to_device(volume, float), lenses)
            rays = to_host(one.rays).copy()
            one.rays.assign(light)
            out = to_device(np.full(VOXELS, 2.0, np.float32), float)
            one.gather(out, to_device(active, float), lenses)
            found.append((rays, to_host(out)))
        for expected, streamed in zip(*found, strict=True):
            np.testing.assert_array_equal(streamed, expected)
        assert found[0][0].any() and (found[0][1] != 2).any()
    share = blocks.microimages.share
    np.testing.assert_array_equal(to_host(slabs.count_lit(share)), to_host(whole.count_lit(share)))


def test_projection_and_back_projection_are_adjoint(form, small_slabs):
    blocks, rng = random_blocks(form, 20, seed=2), np.random.default_rng(2)
    slabs = StreamedProjector(blocks, 3 * small_slabs(blocks))
    volume, light = rng.random(VOXELS).astype(np.float32), rng.random(blocks.microimages.size).astype(np.float32)
    slabs.scatter(to_device(volume, float), ALL)
    forth = np.vdot(slabs.in_order(to_host(slabs.rays))[: len(light)].astype(float), light)
    slabs.rays.assign(slabs.placed(light))
    back = to_device(np.zeros(VOXELS, np.float32), float)
    slabs.gather(back, to_device(np.ones(VOXELS, np.float32), float), ALL)
    assert np.vdot(to_host(back).astype(float), volume) == pytest.approx(forth, rel=TOLERANCE_ADJOINT)
    assert forth == pytest.approx(float(light @ (matrix_of(blocks) @ volume)), rel=TOLERANCE_ADJOINT)


def test_a_pass_copies_what_it_reads_of_the_slabs_that_do_not_stay(form, small_slabs):
    blocks = random_blocks(form, 20, seed=3)
    slabs = StreamedProjector(blocks, 3 * small_slabs(blocks))
    ones = to_device(np.ones(VOXELS, np.float32), float)
    for expected, work in zip(slabs.pass_bytes, (slabs.scatter, lambda v, s: slabs.gather(v, ones, s)), strict=True):
        volume = to_device(np.ones(VOXELS, np.float32), float)
        with count_transfers() as counted:
            work(volume, ALL)
        assert len(counted.to_device) == slabs.count - slabs.resident
        assert sum(counted.to_device) == expected < slabs.host_bytes
        assert counted.to_host == []
    assert slabs.host_bytes + slabs.nbytes - least_bytes() >= TiledProjector(blocks).nbytes


@pytest.mark.parametrize("edge", [20, 50])
def test_slabs_are_no_larger_than_their_buffers_and_cover_all_voxels(form, edge, small_slabs):
    blocks = random_blocks(form, edge, seed=4)
    size = small_slabs(blocks)
    edges = list(slab_edges(blocks))
    assert [first for first, _ in edges] == [0, *(last for _, last in edges[:-1])] and edges[-1][1] == VOXELS
    assert all(TiledProjector(blocks.part(*some)).nbytes <= size for some in edges)
    whole = TiledProjector(blocks).nbytes
    assert not fits_whole(blocks, whole - 1)
    assert fits_whole(blocks, int(projector_streamed._most_bytes(blocks)[-1]) + size)


def test_a_part_of_the_blocks_has_the_entries_of_its_voxels(form):
    blocks = random_blocks(form, 20, seed=5)
    part = blocks.part(20, 45)
    for voxel in range(25):
        for found, expected in zip(part.entries(voxel), blocks.entries(20 + voxel), strict=True):
            np.testing.assert_array_equal(found, expected)


def test_too_little_memory_for_two_slabs_is_refused(form, small_slabs):
    blocks = random_blocks(form, 20, seed=6)
    size = small_slabs(blocks)
    with pytest.raises(MemoryError, match=r"weights that are streamed need .* MiB of the GPU's memory, .* are left"):
        StreamedProjector(blocks, 2 * size - 1)


def test_a_voxel_larger_than_a_slab_is_refused(form, monkeypatch):
    blocks = random_blocks(form, 20, seed=7)
    monkeypatch.setattr(projector_streamed, "SLAB_BYTES", 3000)
    with pytest.raises(MemoryError, match="the weights of voxel"):
        StreamedProjector(blocks, 10**6)
