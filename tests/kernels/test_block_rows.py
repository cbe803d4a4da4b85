"""Blocks cut into rows of rays: projection by sets of rows of pixels against the matrix of the blocks."""

from dataclasses import replace

import numpy as np
import pytest
from support.random_blocks import VOXELS, matrix_of, random_blocks

from lfpiv_kernels.reconstruction.block_rows import ROW_BYTES, with_rows
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.projector import Projector
from lfpiv_kernels.transfer import to_device, to_host

TOLERANCE_SUM = 2e-6
"""Sums of at most 2,000 positive float32 terms in another order, relative to the largest sum."""
EDGES = [7, 20, 31]
SETS = [2, 5, 7]
ROUNDED = {"pixels": 0.0, "profiles": 0.5}
"""Largest difference of a row's weights from its block's [level]: products of profiles are rounded."""
TOLERANCE_LEVEL = {"pixels": 1e-12, "profiles": 1e-6}
"""Rounding of sums in double precision; of a profile's level in single precision as well. Relative."""


@pytest.fixture(params=[(form, edge, sets) for form in ROUNDED for edge in EDGES for sets in SETS], ids=str)
def rig(request, device):
    if device.form == "gpu":
        pytest.skip("a GPU takes halves of the lenses")
    form, edge, sets = request.param
    blocks = random_blocks(form, edge)
    return blocks, with_rows(blocks, sets), np.arange(blocks.microimages.size) // edge % edge % sets


def matrix_of_set(cut, number):
    """Return the weights of the rows of a set as a matrix, shape (ray, voxel), float64: the slow twin."""
    rows, found = cut.rows, np.zeros((cut.microimages.size + 8, VOXELS))
    for voxel in range(VOXELS):
        place = number * VOXELS + voxel
        for row in range(rows.first[place], rows.first[place + 1]):
            levels = rows.level[8 * row : 8 * row + 8]
            found[rows.ray[row] : rows.ray[row] + 8, voxel] += levels * np.float64(cut.row_scale[voxel])
    return found[: cut.microimages.size]


@pytest.mark.slow(but=", 20, 5")
def test_rows_of_a_set_have_the_weights_of_their_rays(rig):
    blocks, cut, set_of = rig
    matrix, rows = matrix_of(blocks), cut.rows
    assert rows.level.size == 8 * rows.ray.size <= 8 * int(blocks.height.sum())
    assert cut.nbytes - blocks.nbytes == ROW_BYTES * rows.ray.size + rows.first.nbytes
    blocks_over = matrix_of(replace(blocks, value=np.ones_like(blocks.value))) / blocks.scale
    rounded = ROUNDED[blocks.form] * cut.row_scale * blocks_over
    for number in range(rows.sets):
        own = matrix * (set_of == number)[:, None]
        apart = np.abs(matrix_of_set(cut, number) - own)
        assert (apart <= rounded + TOLERANCE_LEVEL[blocks.form] * (own + rounded)).all()


def test_rows_of_profiles_without_light_are_left_out(rig):
    blocks, cut, _ = rig
    lit = cut.rows.level.reshape(-1, 8).any(axis=1)
    if blocks.form == "profiles":
        assert lit.all() and len(lit) < int(blocks.height.sum())
    else:
        assert len(lit) == int(blocks.height.sum())


@pytest.mark.slow(but=", 20, 5")
def test_rays_and_voxels_get_the_light_of_a_set(rig):
    blocks, cut, _ = rig
    rng, projector = np.random.default_rng(1), Projector(cut)
    of_set = {number: matrix_of_set(cut, number) for number in range(cut.rows.sets)} | {ALL: matrix_of(blocks)}
    assert projector.ray_sets == projector.rows == cut.rows.sets
    volume = (rng.random(VOXELS) * (rng.random(VOXELS) < 0.8)).astype(np.float32)
    active = (rng.random(VOXELS) < 0.7).astype(np.float32)
    share, pixel = blocks.microimages.share, blocks.microimages.pixel
    image = rng.random(int(np.prod(blocks.microimages.sensor_shape))).astype(np.float32)
    for number in (*range(cut.rows.sets), ALL, 0):
        matrix = of_set[number]
        light = np.bincount(pixel[share > 0], (matrix @ volume * share)[share > 0], image.size)
        found = projector.project(volume, np.zeros_like(image), number)
        np.testing.assert_allclose(found, light, atol=TOLERANCE_SUM * light.max())
        back = matrix.T @ np.where(share > 0, image[pixel] * share, 0)
        found = projector.back_project(image, np.zeros(VOXELS, np.float32), number)
        np.testing.assert_allclose(found, back, atol=TOLERANCE_SUM * back.max())
        with projector.reserved():
            projector.map.spread(to_device(image[projector.map.pixel], float), projector.returned)
            some = to_device(np.zeros(VOXELS, np.float32), float)
            projector.gather(some, to_device(active, float), number)
        assert not to_host(some)[active == 0].any()


def test_all_rays_together_are_those_of_the_blocks_to_the_last_bit(rig):
    blocks, cut, _ = rig
    plain, split = Projector(blocks), Projector(cut)
    rng = np.random.default_rng(2)
    volume = rng.random(VOXELS).astype(np.float32)
    image = rng.random(int(np.prod(blocks.microimages.sensor_shape))).astype(np.float32)
    for _ in range(2):
        first, second = (one.project(volume, np.zeros_like(image)) for one in (plain, split))
        np.testing.assert_array_equal(first, second)
        first, second = (one.back_project(image, np.zeros_like(volume)) for one in (plain, split))
        np.testing.assert_array_equal(first, second)
        _ = split.project(volume[::-1].copy(), np.zeros_like(image), 1)  # leaves light on some rays


def test_sets_share_out_the_pixels(rig):
    _, cut, set_of = rig
    projector, microimages = Projector(cut), cut.microimages
    lit = (matrix_of(replace(cut, rows=None)).max(1) > 0) & (microimages.share > 0)
    for number in range(cut.rows.sets):
        others = np.unique(microimages.pixel[lit & (set_of != number)])
        own = np.setdiff1d(microimages.pixel[lit & (set_of == number)], others)
        np.testing.assert_array_equal(np.sort(projector.exclusive_pixels(number)), own)
