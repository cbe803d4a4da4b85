"""Sets of rays: how rays are divided, which pixels see one set only, and projection by one set at a time."""

from types import SimpleNamespace

import numpy as np
import pytest
from support.random_blocks import LENSES, random_blocks

from lfpiv_kernels.reconstruction.pixel_rays import ALL, MOST_SETS, RayMap, RaySets
from lfpiv_kernels.reconstruction.ray_projector import RayProjector
from lfpiv_kernels.reconstruction.sums import Totals
from lfpiv_kernels.reconstruction.update import Comparison
from lfpiv_kernels.transfer import to_device, to_host, zeros
from lfpiv_kernels.weights.microimages import LAYERS

TOLERANCE_SUM = 2e-6
"""Sums of at most 100 positive float32 terms in another order, relative to the largest sum."""
TOLERANCE_ADJOINT = 1e-6
"""Relative difference of two sums of positive terms in float64 over float32 results."""
TOLERANCE_MISFIT = 1e-5
"""Float32 terms of differences of a tenth of the light and more, summed in float64."""
SHAPE = 12, 17
"""Rows and columns of the sensor [pixel]."""
GROUP, GROUPS = 9, 60
"""Rays of a group, and groups."""
SETS = [1, 2, 5, MOST_SETS]
VOXELS = 40


def random_rays(sets, seed):
    """Rays at random pixels, a tenth of them at none, and their sets; most pixels see several rays."""
    rng, size = np.random.default_rng(seed), GROUP * GROUPS
    pixel = rng.integers(0, np.prod(SHAPE), size).astype(np.int32)
    share = rng.uniform(0.1, 1, size).astype(np.float32)
    outside = rng.random(size) < 0.1
    pixel[outside], share[outside] = -1, 0
    rays = SimpleNamespace(pixel=pixel, share=share, sensor_shape=SHAPE)
    return rays, RaySets((np.arange(GROUPS) % sets).astype(np.uint8), GROUP, sets)


def set_of_rays(sets):
    return np.repeat(sets.of_group, sets.group)


def sets_of_pixels(rays, sets, light):
    """The sets that each pixel sees light of, a `set` for each pixel."""
    seen = [set() for _ in range(int(np.prod(SHAPE)))]
    for ray in np.flatnonzero((light > 0) & (rays.share > 0)):
        seen[rays.pixel[ray]].add(int(set_of_rays(sets)[ray]))
    return seen


@pytest.mark.parametrize("sets", SETS)
def test_pixels_that_see_one_set_are_those_of_its_map_and_others_of_none(sets):
    rays, divided = random_rays(sets, 1)
    light = (np.random.default_rng(2).random(rays.pixel.size) < 0.7).astype(np.float32)
    map_ = RayMap(rays, light, [0, light.size], [0], sets=divided)
    seen = sets_of_pixels(rays, divided, light)
    first, place = to_host(map_.rays.first), to_host(map_.rays.place)
    taken = []
    for number in range(sets):
        one = map_.rays_of(number)
        pixels = map_.pixel[one.start : one.end].tolist()
        assert sorted(pixels) == [pixel for pixel, of in enumerate(seen) if of == {number}]
        assert (set_of_rays(divided)[place[first[one.start] : first[one.end]]] == number).all()
        taken += pixels
    several = [pixel for pixel, of in enumerate(seen) if len(of) > 1]
    assert (len(several) > 0) == (sets > 1) and len(taken) > 0
    assert len(set(taken)) == len(taken) and not set(taken) & set(several)
    whole = map_.rays_of(ALL)
    assert sorted(map_.pixel[whole.start : whole.end]) == sorted(taken + several)
    np.testing.assert_array_equal(np.sort(place), np.flatnonzero((light > 0) & (rays.share > 0)))  # each ray once
    np.testing.assert_array_equal(to_host(map_.rays.dark), np.flatnonzero((light > 0) & (rays.share == 0)))


def test_lenses_beside_each_other_are_of_different_sets_and_all_layers_of_a_lens_of_one():
    microimages = random_blocks("profiles", 7).microimages
    sets = RaySets.of_lenses(microimages)
    assert sets.count == 2 and sets.group == microimages.edge**2
    assert sets.group * len(sets.of_group) >= microimages.size  # every ray has a set
    lens = sets.of_group[: LENSES * LAYERS * LENSES].reshape(LENSES, LAYERS, LENSES)
    assert (lens == lens[:, :1]).all()
    assert (np.abs(np.diff(lens[:, 0].astype(int), axis=0)) == 1).all()
    assert (np.abs(np.diff(lens[:, 0].astype(int), axis=1)) == 1).all()
    assert lens[0, 0, 0] == 0


@pytest.mark.parametrize("size", [0, 1, 1000])
def test_a_single_set_holds_every_ray(size):
    sets = RaySets.single(size)
    assert sets.count == 1 and not sets.of_group.any() and len(sets.of_group) * sets.group >= size


class Dense(RayProjector):
    """Dense weights (ray, voxel), whose corrections lie apart from the light."""

    def __init__(self, matrix, rays, sets):
        super().__init__()
        self.matrix, self.ray_sets, self._set_of = matrix, sets.count, set_of_rays(sets)
        self.rays, self.returned = zeros(len(matrix)), zeros(len(matrix))
        light = matrix.sum(1).astype(np.float32)
        self.map = RayMap(rays, light, [0, light.size], [0], sets=sets, darken=False)

    def _of(self, ray_set):
        return np.full(len(self.matrix), True) if ray_set == ALL else self._set_of == ray_set

    def scatter(self, volume, ray_set=ALL):
        light, own = to_host(self.rays).copy(), self._of(ray_set)
        light[own] = self.matrix[own] @ to_host(volume)
        self.rays.assign(light)

    def gather(self, out, active=None, ray_set=ALL):
        own = self._of(ray_set)
        found = self.matrix[own].T @ to_host(self.returned)[own]
        sums = to_host(out) + found * (1 if active is None else to_host(active) != 0)
        if isinstance(out, np.ndarray):
            out[:] = sums
        else:
            out.assign(sums.astype(np.float32))
        return out

    def darken(self, ray_set=ALL):
        light = to_host(self.returned).copy()
        light[self._of(ray_set)] = 0
        self.returned.assign(light)


@pytest.fixture(params=[2, 5])
def dense(request):
    """Weights of which some rays reach no pixel, their sets, and their images' matrix (pixel, voxel) of each set."""
    rng, (rays, sets) = np.random.default_rng(3), random_rays(request.param, 4)
    matrix = (rng.random((rays.pixel.size, VOXELS)) * (rng.random((rays.pixel.size, VOXELS)) < 0.05)).astype(np.float32)
    images = np.zeros((sets.count, int(np.prod(SHAPE)), VOXELS))
    for ray in np.flatnonzero(rays.share > 0):
        images[set_of_rays(sets)[ray], rays.pixel[ray]] += rays.share[ray] * matrix[ray].astype(float)
    return Dense(matrix, rays, sets), images


def test_sets_project_by_themselves_and_add_up(dense):
    projector, images = dense
    volume, size = np.random.default_rng(5).random(VOXELS).astype(np.float32), images.shape[1]
    whole = projector.project(volume, np.full(size, 7, np.float32))
    np.testing.assert_allclose(whole, images.sum(0) @ volume, atol=TOLERANCE_SUM * whole.max())
    for number, matrix in enumerate(images):  # nothing is left of the light of the others
        found = projector.project(volume, np.full(size, 7, np.float32), number)
        np.testing.assert_allclose(found, matrix @ volume, atol=TOLERANCE_SUM * whole.max())


def test_the_back_projection_of_each_set_is_adjoint(dense):
    projector, images = dense
    image = np.random.default_rng(6).random(images.shape[1]).astype(np.float32)
    projector.returned.assign(np.full(len(projector.matrix), 1e3, np.float32))  # of other work before
    for number, matrix in zip((ALL, *range(len(images))), (images.sum(0), *images), strict=True):
        found = projector.back_project(image, np.full(VOXELS, 2, np.float32), number)
        expected = 2 + matrix.T @ image
        np.testing.assert_allclose(found, expected, rtol=TOLERANCE_ADJOINT)


def test_a_comparison_takes_the_pixels_of_a_set_and_writes_apart_from_the_light(dense):
    projector, images = dense
    rng, floor = np.random.default_rng(7), 0.3
    volume = rng.uniform(1, 2, VOXELS).astype(np.float32)
    image, gain = rng.uniform(0, 20, images.shape[1]).astype(np.float32), rng.uniform(0.5, 1.5, images.shape[1])
    gain = gain.astype(np.float32)
    comparison = Comparison(projector, image, gain, floor)
    for number, matrix in zip((ALL, *range(len(images))), (images.sum(0), *images), strict=True):
        projector.returned.assign(np.full(len(projector.matrix), 1e3, np.float32))
        totals = Totals(2)
        comparison.compare(to_device(volume, float), totals, number)
        light = np.where(projector._of(number), projector.matrix @ volume, to_host(projector.rays))
        np.testing.assert_allclose(to_host(projector.rays), light, rtol=TOLERANCE_SUM)
        pixels = projector.exclusive_pixels(number)
        expected, counts = gain[pixels] * (matrix[pixels] @ volume) + floor, image[pixels] + floor
        squares, divergence = np.square(counts - expected), expected * np.log(expected / counts) - expected + counts
        assert len(pixels) and totals.read() == pytest.approx((squares.sum(), divergence.sum()), rel=TOLERANCE_MISFIT)
        back = to_host(projector.gather(np.zeros(VOXELS, np.float32), ray_set=number))
        terms = matrix[pixels].T * (gain[pixels] * np.log(counts / expected))
        np.testing.assert_allclose(back, terms.sum(1), atol=TOLERANCE_MISFIT * np.abs(terms).sum(1).max())


def test_rays_without_a_pixel_become_dark_only_where_they_are_asked_to():
    rays, sets = random_rays(2, 8)
    light = np.ones(rays.pixel.size, np.float32)
    image = np.random.default_rng(9).random(int(np.prod(SHAPE))).astype(np.float32)
    for darken in (True, False):
        map_ = RayMap(rays, light, [0, light.size], [0], sets=sets, darken=darken)
        spread = to_device(np.full(light.size, 3, np.float32), float)
        map_.spread(to_device(image, float), spread)
        expected = np.where(rays.share > 0, rays.share * image[rays.pixel], 0.0 if darken else 3.0)
        np.testing.assert_array_equal(to_host(spread), expected.astype(np.float32))
