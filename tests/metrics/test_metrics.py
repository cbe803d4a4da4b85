"""Figures of merit against analytic cases, brute force and invariances."""

import itertools

import numpy as np
import pytest
import xarray as xr
from scipy.stats import norm

import lfpiv
from lfpiv import metrics

ROUNDING = 1e-12  # float64 sums of at most 1e4 terms
FLOAT32 = 1e-6  # volumes are float32: a sum over a blob's 9 x 9 x 9 voxels is this exact
CUT = 3e-6  # light of a blob beyond 5 standard deviations: 3 axes x 6e-7, and rounding
FIT_VOXEL = 0.02  # a 3-point Gaussian fit of a blob that was integrated over voxels: 0.015 voxel at the worst phase


def box(shape=(12, 14, 16), voxel_mm=0.1, first=(-0.3, 0.2, 1.0)):
    return lfpiv.Grid(shape=shape, voxel_mm=voxel_mm, first_centre_mm=first)


def points_in(grid, count, rng, margin=0.0):
    """Return random points (x, y, z) [mm] at least `margin` voxels inside the faces of the grid."""
    place = rng.uniform(margin - 0.5, np.array(grid.shape) - 0.5 - margin, (count, 3))
    return (np.asarray(grid.first_centre_mm) + place * grid.voxel_mm)[:, ::-1]


# -- true particles ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0, 0.3, 0.7, 1.5])
def test_light_of_a_blob_does_not_depend_on_its_place_between_voxels(sigma):
    grid, rng = box((40, 42, 44)), np.random.default_rng(1)
    for point in points_in(grid, 5, rng, margin=5 * 1.5 + 2):
        blob = metrics.truth_volume(point[None], 3.0, grid, sigma).astype(float)
        assert float(blob.sum()) == pytest.approx(3.0, rel=CUT)
        moments = {a: (float((blob * blob[a]).sum()) / 3, float((blob * blob[a] ** 2).sum()) / 3) for a in "xyz"}
        for axis, true in zip("xyz", point, strict=True):
            mean, square = moments[axis]
            if sigma >= 0.7:  # a voxel samples the Gaussian well enough for its moments to be exact
                assert mean == pytest.approx(true, abs=1e-4 * grid.voxel_mm)
                variance = (square - mean**2) / grid.voxel_mm**2
                assert variance == pytest.approx(sigma**2 + 1 / 12, rel=2e-3)
            assert abs(mean - true) <= 0.5 * grid.voxel_mm + 1e-9


def test_blobs_equal_a_voxel_by_voxel_integral_and_add_up():
    grid, rng = box((6, 7, 8)), np.random.default_rng(2)
    points, light = points_in(grid, 9, rng, margin=-2.0), rng.uniform(0.1, 2.0, 9)  # some lie outside
    expected = np.zeros(grid.shape)
    for (x, y, z), brightness in zip(points, light, strict=True):
        for index in np.ndindex(grid.shape):
            part = brightness
            for axis, place in enumerate((z, y, x)):
                middle = grid.axis_mm(axis)[index[axis]]
                edges = np.array([middle - 0.05, middle + 0.05])
                part *= np.diff(norm.cdf(edges, place, 0.7 * grid.voxel_mm))[0]
            expected[index] += part
    volume = metrics.truth_volume(points, light, grid)
    assert np.allclose(volume, expected, atol=CUT)
    parts = [metrics.truth_volume(points[k : k + 1], light[k], grid) for k in range(9)]
    assert np.allclose(sum(part.values for part in parts), volume, atol=FLOAT32)


def test_particles_of_a_truth_volume_are_found_where_they_are():
    grid, rng = box((30, 30, 30)), np.random.default_rng(3)
    cells = rng.permutation(list(np.ndindex(3, 3, 3)))[:20]  # one particle per cell of 9 voxels: no overlap
    place = 5.5 + 9 * cells + rng.uniform(-1, 1, (20, 3))
    points = (np.asarray(grid.first_centre_mm) + place * grid.voxel_mm)[:, ::-1]
    light = rng.uniform(0.5, 2.0, 20)
    volume = metrics.truth_volume(points, light, grid)
    quality = metrics.particle_quality(volume, points)
    assert (quality.true_count, quality.found_count, quality.matched_count) == (20, 20, 20)
    assert quality.accuracy == quality.ghost_ratio == quality.precision == quality.recall == 1.0
    assert max(quality.rms_mm) < FIT_VOXEL * grid.voxel_mm
    assert quality.elongation == pytest.approx(1.0, abs=0.02)  # the fit's width depends a little on the phase
    found = metrics.find_particles(volume, 0.0)
    assert (np.diff(found.peaks) <= 0).all()
    same = metrics.find_particles(volume.values, 0.0, grid=grid)
    assert np.allclose(same.positions_mm, found.positions_mm, atol=1e-9)
    stretched = metrics.find_particles(volume.rename(z="x", x="z").transpose("z", "y", "x"), 0.0)
    assert np.allclose(stretched.positions_mm[:, ::-1], found.positions_mm, atol=1e-9)  # axes are alike


def test_elongation_is_the_ratio_of_the_widths():
    grid = box((25, 21, 21), first=(0.0, 0.0, 0.0))
    z, y, x = np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij")
    volume = np.exp(-((z - 12.3) ** 2) / (2 * 2.0**2) - ((y - 10.2) ** 2 + (x - 9.6) ** 2) / (2 * 0.8**2))
    (found,) = [metrics.find_particles(volume, 0.5, grid=grid)]
    assert np.allclose(found.positions_mm, [[0.96, 1.02, 1.23]], atol=1e-9)  # sampled Gaussians are fitted exactly
    assert np.allclose(found.sigma_voxel, [[0.8, 0.8, 2.0]])
    assert metrics.elongation(found.sigma_voxel) == pytest.approx(2.5)


def test_peaks_equal_a_search_voxel_by_voxel_and_plateaus_count_once():
    rng = np.random.default_rng(4)
    grid = box((9, 8, 7), first=(0.0, 0.0, 0.0))
    volume = rng.permutation(504).reshape(grid.shape).astype(float)
    expected = []
    for index in np.ndindex(volume.shape):
        around = tuple(slice(max(i - 1, 0), i + 2) for i in index)
        if volume[index] == volume[around].max() and volume[index] > 300:
            expected.append(volume[index])
    found = metrics.find_particles(volume, 300.0, grid=grid)
    assert sorted(expected) == sorted(found.peaks) and len(expected) > 5
    nearest = np.rint(found.positions_mm[:, ::-1] / grid.voxel_mm).astype(int)
    assert (np.abs(found.positions_mm[:, ::-1] / grid.voxel_mm - nearest) <= 0.5 + 1e-9).all()

    flat = np.zeros(grid.shape)
    flat[3:5, 4, 2:4] = 1.0
    assert len(metrics.find_particles(flat, 0.5, grid=grid)) == 1
    flat = np.zeros(grid.shape)
    flat[4, 4, 3:5] = 1.0  # a particle midway between two voxels
    assert np.allclose(metrics.find_particles(flat, 0.5, grid=grid).positions_mm, [[0.35, 0.4, 0.4]], atol=1e-9)
    flat[0, 0, 0] = 2.0  # in the corner nothing can be fitted
    corner = metrics.find_particles(flat, 0.5, grid=grid)
    assert np.allclose(corner.positions_mm[0], 0, atol=1e-9) and np.isnan(corner.sigma_voxel[0]).all()
    assert len(metrics.find_particles(np.zeros(grid.shape), 0.0, grid=grid)) == 0


# -- matching ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_matching_equals_the_best_of_all_assignments(seed):
    rng = np.random.default_rng(seed)
    true, found = rng.uniform(0, 2, (5, 3)), rng.uniform(0, 2, (rng.integers(3, 7), 3))
    found[0] = true[2]  # a distance of exactly zero is a pair too
    distance = np.linalg.norm(found[:, None] - true[None], axis=2)
    best = (0, 0.0)
    padded = [*range(len(found)), *[None] * len(true)]
    for choice in set(itertools.permutations(padded, len(true))):
        length = [distance[f, t] for t, f in enumerate(choice) if f is not None]
        if all(d <= 1.0 for d in length):
            best = min(best, (-len(length), sum(length)))
    pairs = metrics.match_particles(found, true, 1.0)
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs) == -best[0] > 0
    assert distance[pairs[:, 0], pairs[:, 1]].sum() == pytest.approx(best[1], rel=1e-9)


def test_matching_of_many_particles_is_undone_by_a_shuffle():
    rng = np.random.default_rng(5)
    true = rng.uniform(0, 40, (4000, 3))
    order = rng.permutation(4000)
    found = np.concatenate([(true + rng.normal(0, 1e-3, true.shape))[order], rng.uniform(0, 40, (4000, 3))])
    pairs = metrics.match_particles(found, true, 1.0)
    assert len(pairs) == 4000
    assert (order[pairs[:, 0][pairs[:, 0] < 4000]] == pairs[:, 1][pairs[:, 0] < 4000]).all()
    assert len(metrics.match_particles(np.empty((0, 3)), true, 1.0)) == 0


def test_accuracy_counts_single_peaks_within_a_voxel_and_ghosts_raise_the_ratio():
    true = np.array([[1, 1, 1], [3, 3, 3], [5, 5, 5], [7, 7, 7], [9, 9, 9]]) * 0.1
    found = true[[0, 0, 1, 2, 4]] + 0.1 * np.array(
        [[0.9, 0.9, -0.9], [0, 0, 0], [1.0, -1.0, 1.0], [0, 0, 1.01], [0.2, 0, 0]]
    )  # two at the first, one just within at the second, one just beyond at the third, none at the fourth
    assert metrics.reconstruction_accuracy(found, true, 0.1) == pytest.approx(2 / 5)
    assert metrics.reconstruction_accuracy(np.empty((0, 3)), true, 0.1) == 0.0

    grid = box((11, 11, 11), first=(0.0, 0.0, 0.0))
    rng = np.random.default_rng(6)
    particles, ghosts = np.array([[3.2, 3, 3], [7, 7.1, 7]]) * 0.1, np.array([[3, 7, 3], [7, 3, 6.9], [2, 8, 8]]) * 0.1
    light = metrics.truth_volume(np.concatenate([particles, ghosts]), [1, 1, 0.5, 0.5, 0.05], grid)
    order = rng.permutation(2)
    quality = metrics.particle_quality(7 * light, particles[order])
    assert (quality.found_count, quality.ghost_ratio, quality.precision, quality.recall) == (4, 2.0, 0.5, 1.0)
    assert metrics.particle_quality(7 * light, particles, threshold=0.0).found_count == 5
    outside = np.concatenate([particles, [[5.0, 5.0, 5.0]]])
    assert metrics.particle_quality(light, outside).true_count == 2


def test_poisson_neighbours_lower_the_accuracy_of_perfect_positions_as_stated():
    density, rng = 0.02, np.random.default_rng(7)
    true = rng.uniform(0, 100, (20_000, 3))
    inside = (np.abs(true - 50) < 49).all(1)
    around = metrics.reconstruction_accuracy(true, true[inside], 1.0)
    assert around == pytest.approx(np.exp(-8 * density), abs=4 * np.sqrt(0.25 / 18_000))  # four standard deviations


# -- volumes and images ------------------------------------------------------------------------------------------------


def test_quality_factor():
    grid, rng = box(), np.random.default_rng(8)
    truth = metrics.truth_volume(points_in(grid, 15, rng), None, grid)
    other = metrics.truth_volume(points_in(grid, 15, rng), None, grid)
    assert metrics.reconstruction_quality(truth, truth) == pytest.approx(1.0, abs=ROUNDING)
    q = metrics.reconstruction_quality(other, truth)
    assert 0 < q < 1 and q == pytest.approx(metrics.reconstruction_quality(5 * truth.values, other.values), rel=FLOAT32)
    a, b = other.values.ravel().astype(float), truth.values.ravel().astype(float)
    assert q == pytest.approx((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()), abs=ROUNDING)
    haze = metrics.reconstruction_quality(other.values + 0.3, truth.values, zero_mean=True)
    assert haze == pytest.approx(np.corrcoef(a, b)[0, 1], rel=1e-5)
    # blobs of standard deviations s and t around one place: (2 s t / (s^2 + t^2))^(3/2), far from every border
    wide = box((41, 41, 41))
    blobs = [
        metrics.truth_volume(points_in(wide, 1, np.random.default_rng(0), margin=18), 1.0, wide, s) for s in (2, 3)
    ]
    expected = (12 / 13) ** 1.5
    assert metrics.reconstruction_quality(*blobs) == pytest.approx(expected, rel=0.01)  # a voxel adds 1/12 to s^2


def test_relative_l2():
    reference = np.array([[3.0, 4.0]])
    assert metrics.relative_l2(reference * 1.1, reference) == pytest.approx(0.1, rel=1e-9)
    assert metrics.relative_l2(np.array([[3.0, 4.5]]), reference) == pytest.approx(0.1, rel=1e-9)


def slow_ssim(a, b):
    """Compute the structural similarity of Wang et al. 2004 window by window."""
    place = np.arange(-5, 6)
    window = np.exp(-(place[:, None] ** 2 + place**2) / (2 * 1.5**2))
    window /= window.sum()
    c1, c2 = (0.01 * max(a.max(), b.max())) ** 2, (0.03 * max(a.max(), b.max())) ** 2
    values = []
    for i, j in np.ndindex(a.shape[0] - 10, a.shape[1] - 10):
        p, q = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
        mean_p, mean_q = (window * p).sum(), (window * q).sum()
        var_p, var_q = (window * p**2).sum() - mean_p**2, (window * q**2).sum() - mean_q**2
        joint = (window * p * q).sum() - mean_p * mean_q
        values.append(
            (2 * mean_p * mean_q + c1) * (2 * joint + c2) / (mean_p**2 + mean_q**2 + c1) / (var_p + var_q + c2)
        )
    return np.mean(values)


def test_ssim_equals_its_definition():
    rng = np.random.default_rng(9)
    first = np.zeros((60, 70))
    first[20:33, 30:47] = rng.uniform(1e-3, 0.1, (13, 17))
    second = first * rng.uniform(0.7, 1.3, first.shape)
    score = metrics.weight_ssim(first, second)
    assert score == pytest.approx(slow_ssim(first[15:38, 25:52], second[15:38, 25:52]), abs=1e-9)
    assert metrics.weight_ssim(first, first) == pytest.approx(1.0, abs=ROUNDING)
    assert metrics.weight_ssim(second, first) == pytest.approx(score, abs=ROUNDING)
    assert metrics.weight_ssim(1e-3 * first, 1e-3 * second) == pytest.approx(score, rel=1e-9)
    big = [np.pad(image, ((7, 200), (300, 0))) for image in (first, second)]
    assert metrics.weight_ssim(*big) == pytest.approx(score, abs=ROUNDING)
    assert metrics.weight_ssim(*big, crop=False) > score  # a dark sensor looks alike
    at_the_border = [image[20:, 30:] for image in (first, second)]
    assert metrics.weight_ssim(*at_the_border) == pytest.approx(score, abs=ROUNDING)


# -- dots --------------------------------------------------------------------------------------------------------------


def test_dot_errors_are_spacings_and_miss_no_pair():
    planes = np.array([-1.0, 0.0, 1.5])
    y, x = np.meshgrid(np.arange(4) * 0.5, np.arange(3) * 0.5)
    true = np.stack([np.stack([x, y, np.full_like(x, z)], -1) for z in planes])
    exact = metrics.dot_error(true + [7.0, -3.0, 2.0], 0.5, planes)  # a shift of all dots is not seen
    assert np.allclose(exact.lateral_mm, 0, atol=ROUNDING) and np.allclose(exact.depth_mm, 0, atol=ROUNDING)
    assert exact.found == 36
    grown = metrics.dot_error(true * [1.1, 1.1, 0.8], 0.5, planes)
    assert np.allclose(grown.lateral_mm, 0.05) and np.allclose(grown.depth_mm, [0.2, 0.3])
    noisy = true + np.random.default_rng(10).normal(0, 0.02, true.shape)
    noisy[1, 2, 3] = np.nan
    error = metrics.dot_error(noisy, 0.5, planes)
    gaps = []
    for i, j in np.ndindex(3, 4):
        gaps += [np.linalg.norm((noisy[1, i + 1, j] - noisy[1, i, j])[:2]) - 0.5] if i < 2 else []
        gaps += [np.linalg.norm((noisy[1, i, j + 1] - noisy[1, i, j])[:2]) - 0.5] if j < 3 else []
    gaps = np.abs(gaps)
    assert np.isnan(gaps).sum() == 2 and error.lateral_mm[1] == pytest.approx(np.nanmean(gaps), rel=1e-9)
    assert error.depth_mm[0] == pytest.approx(np.nanmean(np.abs(noisy[1, ..., 2] - noisy[0, ..., 2] - 1)), rel=1e-9)
    assert error.found == 35 and error.depth_mean_mm == pytest.approx(error.depth_mm.mean(), rel=0.2)


# -- vectors -----------------------------------------------------------------------------------------------------------


def test_displacement_errors_per_axis_and_their_distribution():
    rng = np.random.default_rng(11)
    truth = rng.normal(0, 2, (3, 4, 5, 3))
    sigma, bias = np.array([0.1, 0.2, 0.6]), np.array([0.0, -0.3, 0.1])
    measured = truth + bias + sigma * rng.standard_normal(truth.shape)
    error = metrics.displacement_error(measured, truth)
    difference = (measured - truth).reshape(-1, 3)
    length = np.sqrt((difference**2).sum(1))
    assert error.count == 60 and error.mean == pytest.approx(length.sum() / 60)
    assert np.allclose(error.bias, difference.mean(0)) and np.allclose(error.mean_absolute, np.abs(difference).mean(0))
    assert error.rms**2 == pytest.approx(sum(r**2 for r in error.rms_component))
    assert error.below == np.mean([d < 0.43 for d in length]) and error.median == error.percentiles[50]
    at, part = metrics.empirical_cdf(length)
    assert (
        part[-1] == 1
        and (np.diff(part) >= 0).all()
        and np.interp(error.median, at, part) == pytest.approx(0.5, abs=0.01)
    )
    assert metrics.empirical_cdf([1.0, 2.0, 2.0, 3.0], [0.5, 2.0, 3.0])[1].tolist() == [0.0, 0.75, 1.0]

    names = [f"displacement_{axis}" for axis in "xyz"]
    places = {axis: np.arange(n, dtype=float) for axis, n in zip("zyx", truth.shape, strict=False)}
    sets = [
        xr.Dataset({n: (("z", "y", "x"), field[..., k]) for k, n in enumerate(names)}, places)
        for field in (measured, truth)
    ]
    assert metrics.displacement_error(*sets) == error
    inner = np.zeros((3, 4, 5), bool)
    inner[1:-1, 1:-1, 1:-1] = True
    part = metrics.displacement_error(sets[0], truth, where=inner)
    assert part.count == 6 and part.mean == pytest.approx(length.reshape(3, 4, 5)[1:-1, 1:-1, 1:-1].mean())
    with pytest.raises(ValueError, match="window centres"):
        metrics.displacement_error(sets[0], sets[1].assign_coords(x=places["x"] + 1))
    truth[0, 0, 0] = np.nan
    with pytest.raises(ValueError, match=r"1 that are not.*where"):
        metrics.displacement_error(measured, truth)
    assert metrics.displacement_error(measured, truth, where=np.isfinite(truth).all(-1)).count == 59


# -- refusals ----------------------------------------------------------------------------------------------------------

_GRID = box((4, 4, 4))
_VOLUME = np.ones((4, 4, 4))
_POINT = np.array([[1.1, 0.3, -0.2]])


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: metrics.truth_volume(_POINT[:, :2], None, _GRID), "positions_mm.*shape"),
        (lambda: metrics.truth_volume(_POINT, [1.0, 2.0], _GRID), "intensities.*one or one per position"),
        (lambda: metrics.truth_volume(_POINT, 1.0, _GRID, -0.1), "sigma_voxel"),
        (lambda: metrics.find_particles(_VOLUME, 0.0), "volume.*needs the grid"),
        (lambda: metrics.find_particles(_VOLUME * np.nan, 0.0, grid=_GRID), "volume.*finite.*64"),
        (lambda: metrics.find_particles(_VOLUME, -1.0, grid=_GRID), "threshold"),
        (lambda: metrics.find_particles(xr.DataArray(_VOLUME), 0.0), "dims"),
        (lambda: metrics.match_particles(_POINT * np.inf, _POINT, 1.0), "found_mm.*NaN or infinity"),
        (lambda: metrics.match_particles(_POINT, _POINT, 0.0), "radius_mm"),
        (lambda: metrics.particle_quality(_VOLUME, _POINT + 9, grid=_GRID), "true_mm.*inside the grid"),
        (lambda: metrics.reconstruction_accuracy(_POINT, _POINT[:0], 0.1), "true_mm.*at least one"),
        (lambda: metrics.reconstruction_quality(_VOLUME, _VOLUME[:3]), "truth.*shape"),
        (lambda: metrics.reconstruction_quality(_VOLUME, 0 * _VOLUME), "truth.*empty"),
        (lambda: metrics.reconstruction_quality(_VOLUME, _VOLUME, zero_mean=True), "volume.*uniform"),
        (lambda: metrics.relative_l2(_VOLUME, 0 * _VOLUME), "reference"),
        (lambda: metrics.weight_ssim(np.zeros((20, 20)), np.zeros((20, 20))), "light"),
        (lambda: metrics.weight_ssim(np.ones((20, 20)), -np.ones((20, 20))), ">= 0"),
        (lambda: metrics.dot_error(np.zeros((2, 3, 3, 3)), 1.0, [0.0]), "planes_mm"),
        (lambda: metrics.dot_error(np.full((1, 2, 2, 3), np.nan), 1.0, [0.0]), "none that were found"),
        (lambda: metrics.displacement_error(np.zeros((2, 2, 2)), np.zeros((2, 2, 2, 3))), "vectors.*shape"),
        (lambda: metrics.displacement_error(xr.Dataset(), xr.Dataset()), "displacement_x"),
        (lambda: metrics.empirical_cdf([]), "values"),
    ],
)
def test_bad_input_is_refused_by_name(call, words):
    with pytest.raises(ValueError, match=f"(?s){words}"):
        call()


def test_the_module_is_reached_from_the_package():
    assert lfpiv.metrics is metrics and "metrics" in dir(lfpiv)
    for name in metrics.__all__:
        assert getattr(metrics, name).__doc__
