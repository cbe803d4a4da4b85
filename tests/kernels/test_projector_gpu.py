"""The loops for a GPU against those for the CPU and their twins: projection, pixels and rays, blur, depth planes."""

import numpy as np
import pytest
from support.plain_rays import plain
from support.random_blocks import VOXELS, matrix_of, random_blocks

from lfpiv_kernels import native, runtime
from lfpiv_kernels.filters import blur_gpu
from lfpiv_kernels.filters.blur import GaussianBlur
from lfpiv_kernels.reconstruction import depth_planes_gpu, line_shares_gpu, pixel_rays_gpu
from lfpiv_kernels.reconstruction.depth_planes import DepthPlanes, PlaneShares
from lfpiv_kernels.reconstruction.line_shares import Layers, LineShares
from lfpiv_kernels.reconstruction.pixel_rays import ALL, RayMap, RaySets
from lfpiv_kernels.reconstruction.projector import EVEN, ODD, Blocks, Projector
from lfpiv_kernels.reconstruction.projector_gpu import TiledProjector, device_bytes
from lfpiv_kernels.reconstruction.sums import Totals
from lfpiv_kernels.reconstruction.update import Comparison
from lfpiv_kernels.transfer import to_device, to_host
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH, ROW_GROUP

EDGES = {"small": 7, "usual": 20, "tile": 24, "two tiles": 31, "three tiles": 50}
"""Rays along a microimage. Above 24 rays a block has more than one sector, and a lens more than one tile."""
TOLERANCE_SUM = 2e-6
"""Sums of at most 2,000 positive float32 terms in another order, relative to the largest sum."""
TOLERANCE_ADJOINT = 1e-6
"""Relative difference of two sums of positive terms in float64 over float32 results."""
TOLERANCE_MISFIT = 1e-6
"""Float32 terms that differ by rounding, summed in float64."""


@pytest.fixture(params=["profiles", "pixels"])
def form(request):
    return request.param


@pytest.mark.slow(but="usual")
@pytest.mark.parametrize("edge", EDGES.values(), ids=EDGES)
def test_rays_and_voxels_get_the_light_of_the_weights(form, edge):
    blocks, rng = random_blocks(form, edge), np.random.default_rng(1)
    tiled = TiledProjector(blocks)
    volume = (rng.random(VOXELS) * (rng.random(VOXELS) < 0.8)).astype(np.float32)
    active = (rng.random(VOXELS) < 0.7).astype(np.float32)
    light = rng.random(blocks.microimages.size).astype(np.float32)
    for lenses in (ALL, EVEN, ODD, ALL):
        matrix = matrix_of(blocks, lenses)
        tiled.scatter(to_device(volume, float), lenses)
        rays = tiled.in_order(to_host(tiled.rays))[: len(light)]
        expected = matrix @ volume
        np.testing.assert_allclose(rays, expected, atol=TOLERANCE_SUM * expected.max())
        placed = np.zeros(len(tiled.rays), np.float32)
        placed[tiled.places(np.arange(len(light)))] = light
        tiled.rays.assign(placed)
        out = to_device(np.full(VOXELS, 2.0, np.float32), float)
        tiled.gather(out, to_device(active, float), lenses)
        expected = 2 + (active != 0) * (matrix.T @ light)
        np.testing.assert_allclose(to_host(out), expected, atol=TOLERANCE_SUM * expected.max())
        tiled.rays.zero_()  # rays that no voxel lights are never written


def test_sums_do_not_depend_on_the_run_and_lit_rays_are_counted(form):
    blocks = random_blocks(form, 20, seed=3)
    tiled, volume = TiledProjector(blocks), to_device(np.random.default_rng(3).random(VOXELS).astype(np.float32), float)
    tiled.scatter(volume, ALL)
    first = to_host(tiled.rays).copy()
    tiled.scatter(volume, ALL)
    assert (to_host(tiled.rays) == first).all()
    share = blocks.microimages.share
    entries = [blocks.entries(voxel) for voxel in range(VOXELS)]
    expected = [int(((weight > 0) & (share[ray] > 0)).sum()) for ray, weight in entries]
    np.testing.assert_array_equal(to_host(tiled.count_lit(share)), expected)


def test_memory_is_that_of_the_estimate(form):
    blocks = random_blocks(form, 20, seed=4)
    estimate = device_bytes(form, VOXELS, len(blocks.ray), len(blocks.value), edge=20)
    assert TiledProjector(blocks).nbytes == pytest.approx(estimate, rel=0.1)


def test_a_sensor_without_lenses_is_one_microimage_of_many_tiles():
    runtime.device()
    rng, shape = np.random.default_rng(5), (30, 61)
    microimages = plain(shape)
    height, width = rng.integers(1, 29, VOXELS), rng.integers(1, 9, VOXELS)
    row, column = (rng.integers(0, n - of + 1) for n, of in zip(shape, (height, width), strict=True))
    sizes = height * width
    blocks = Blocks(
        form="pixels",
        first_block=np.arange(VOXELS + 1, dtype=np.int32),
        first_value=np.append(0, sizes.cumsum()),
        ray=(row * microimages.edge + column).astype(np.int32),
        height=height.astype(np.uint8),
        width=width.astype(np.uint8),
        value=rng.integers(1, 256, sizes.sum() + BLOCK_WIDTH).astype(np.uint8),
        scale=np.full(VOXELS, 1 / 255, np.float32),
        microimages=microimages,
    )
    tiled, volume = TiledProjector(blocks), rng.random(VOXELS).astype(np.float32)
    tiled.scatter(to_device(volume, float), ALL)
    matrix = np.zeros((microimages.size, VOXELS))
    for voxel in range(VOXELS):
        ray, weight = blocks.entries(voxel)
        matrix[ray, voxel] = weight
    found = tiled.in_order(to_host(tiled.rays))[: microimages.size]
    np.testing.assert_allclose(found, matrix @ volume, atol=TOLERANCE_SUM * (matrix @ volume).max())


@pytest.mark.parametrize("lenses", [ALL, EVEN, ODD])
def test_pixels_of_a_gpu_are_those_of_the_cpu(lenses):
    """Collected, spread and compared; on a GPU rays lie in rows of whole sectors."""
    if runtime.device().form == "gpu":
        pytest.skip("the CPU's loops are not compiled")
    blocks, rng = random_blocks("profiles", 20, seed=6), np.random.default_rng(6)
    projector, tiled = Projector(blocks), TiledProjector(blocks)
    volume = rng.random(VOXELS).astype(np.float32)
    microimages = blocks.microimages
    tiled.scatter(to_device(np.ones(VOXELS, np.float32), float), ALL)
    light = tiled.in_order(to_host(tiled.rays))
    sets = RaySets.of_lenses(microimages)
    map_ = RayMap(microimages, light, [0, microimages.size], [0], sets=sets, places=tiled.places)
    assert sorted(map_.pixel) == sorted(projector.map.pixel)
    rays = map_.rays_of(lenses)
    size = int(np.prod(microimages.sensor_shape))
    expected = projector.project(volume, np.empty(size, np.float32), lenses)
    tiled.scatter(to_device(volume, float), lenses)
    found = np.zeros(size, np.float32)
    pixel_rays_gpu.collect(map_.rays, tiled.rays, to_device(found, float))
    np.testing.assert_allclose(found, expected, atol=TOLERANCE_SUM * expected.max())
    image = rng.random(size).astype(np.float32) * expected.max() + 0.1
    gain = rng.random(size).astype(np.float32)
    comparison = Comparison(projector, image, gain, 0.3)
    totals = Totals(2)
    comparison.compare(to_device(volume, float), totals, lenses)
    of_map = [to_device(values[map_.pixel], float) for values in (image, gain)]
    tiled.scatter(to_device(volume, float), lenses)
    of_warps = [to_device(np.zeros(pixel_rays_gpu.WARPS)) for _ in range(2)]
    apart = to_device(np.zeros(len(tiled.rays), np.float32), float)
    for out in (apart, tiled.rays):  # corrections may lie where the light lies
        pixel_rays_gpu.compare([rays, *of_map, 0.3, tiled.rays], [out, *of_warps])
        sums = [to_host(one).sum() for one in of_warps]
        assert sums == pytest.approx(totals.read(), rel=TOLERANCE_MISFIT)
    np.testing.assert_array_equal(to_host(apart), to_host(tiled.rays))
    back = to_device(np.zeros(VOXELS, np.float32), float)
    tiled.gather(back, to_device(np.ones(VOXELS, np.float32), float), lenses)
    with projector.reserved():
        expected = projector.gather(np.zeros(VOXELS, np.float32), ray_set=lenses)
    np.testing.assert_allclose(to_host(back), expected, atol=TOLERANCE_SUM * np.abs(expected).max())
    if lenses == ALL:
        pixel_rays_gpu.spread(map_.rays, to_device(image, float), tiled.rays)
        back = to_device(np.zeros(VOXELS, np.float32), float)
        tiled.gather(back, to_device(np.ones(VOXELS, np.float32), float), ALL)
        expected = projector.back_project(image, np.zeros(VOXELS, np.float32))
        np.testing.assert_allclose(to_host(back), expected, atol=TOLERANCE_SUM * expected.max())


def test_blur_of_a_gpu_is_that_of_the_cpu():
    rng, shape = np.random.default_rng(7), (9, 14, 37)
    blur, volume = GaussianBlur(1.3, shape, truncate=3.5, border="nearest"), rng.random(9 * 14 * 37, np.float32)
    work, out = np.empty_like(volume), np.empty_like(volume)
    arrays = [to_device(array, float) for array in (volume, work, out)]
    blur_gpu.blur(blur._axes, *arrays)
    np.testing.assert_allclose(to_host(arrays[2]), blur(volume), atol=TOLERANCE_SUM)


def test_planes_of_a_gpu_are_those_of_the_cpu():
    rng = np.random.default_rng(8)
    share = rng.uniform(-0.2, 1, (7, 4)).astype(np.float32) * (rng.random((7, 4)) < 0.8)
    shares = PlaneShares(
        axes=(0, 1, 2),
        voxels=(5, 7, 40),
        nodes=(11, 9, 50),
        plane=np.array([5, 4, 3, 3, 2, 1, 0], np.int32),
        share=share.astype(np.float32),
        shift=np.stack([rng.integers(0, 6, (7, 4)), rng.integers(0, 10, (7, 4))], axis=-1).astype(np.int32),
        row_share=np.ones((7, 1), np.float32),
        column_share=np.ones((7, 1), np.float32),
    )
    matrix = np.zeros((shares.size, 5 * 7 * 40))
    for voxel in range(matrix.shape[1]):
        node, of = shares.nodes_of(voxel)
        np.add.at(matrix[:, voxel], node, of)
    planes, volume = DepthPlanes(shares), rng.random(matrix.shape[1]).astype(np.float32)
    layers_of = to_device(depth_planes_gpu.layers_of_planes(shares.plane, 9))
    for absolute in (False, True):
        nodes = to_device(np.empty(shares.size, np.float32), float)
        depth_planes_gpu.spread(planes._map, layers_of, absolute, to_device(volume, float), nodes)
        expected = (np.abs(matrix) if absolute else matrix) @ volume
        np.testing.assert_allclose(to_host(nodes), expected, atol=TOLERANCE_SUM * np.abs(expected).max())
    light, found = rng.random(shares.size).astype(np.float32), to_device(np.empty_like(volume), float)
    depth_planes_gpu.collect(planes._map, to_device(light, float), found)
    expected = matrix.T @ light
    np.testing.assert_allclose(to_host(found), expected, atol=TOLERANCE_SUM * np.abs(expected).max())


@pytest.mark.parametrize("along_rows", [False, True])
def test_lines_of_a_gpu_are_those_of_the_cpu(along_rows):
    if runtime.device().form == "gpu":
        pytest.skip("the CPU's loops are not compiled")
    rng = np.random.default_rng(9)
    rows, layers, columns, taps = 5, 7, 40, 6
    share = rng.uniform(-0.2, 1, (layers, taps)).astype(np.float32)
    lines = LineShares(share, along_rows, Layers(rows, columns, layers * columns, columns))
    size = lines.shared.rows * layers * lines.shared.columns
    volume, light = rng.random(rows * layers * columns, np.float32), rng.random(size, np.float32)
    for absolute in (False, True):
        found, expected = (
            to_device(np.empty(size, np.float32), float),
            lines.spread(to_device(volume), absolute=absolute),
        )
        line_shares_gpu.share(lines._forth, absolute, to_device(volume), found)
        np.testing.assert_allclose(to_host(found), to_host(expected), atol=TOLERANCE_SUM * to_host(expected).max())
    found = to_device(np.empty_like(volume), float)
    line_shares_gpu.share(lines._back, False, to_device(light), found)
    expected = to_host(lines.collect(to_device(light)))
    np.testing.assert_allclose(to_host(found), expected, atol=TOLERANCE_SUM * expected.max())
    forth = np.vdot(to_host(lines.spread(to_device(volume))).astype(float), light)
    assert np.vdot(to_host(found).astype(float), volume) == pytest.approx(forth, rel=TOLERANCE_ADJOINT)


def test_constants_of_both_forms_agree():
    assert native.constant("projector_gpu.h", "COLUMNS") == BLOCK_WIDTH
    assert native.constant("projector_gpu.h", "ROWS") == ROW_GROUP
