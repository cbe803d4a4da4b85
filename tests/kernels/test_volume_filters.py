"""Filters, sums and masks of whole volumes against SciPy and NumPy: the loops of the running device."""

import numpy as np
import pytest
from scipy import ndimage

from lfpiv_kernels.correlation import deform, fluid, interpolation, light, sums, uncertainty, window_means
from lfpiv_kernels.transfer import to_device, to_host

SHAPE = (13, 18, 21)
TOLERANCE_F32 = 2e-6  # float32 sums of some 50 terms of order 1: 16 roundings of 1.2e-7
ROUNDED = 4e-6  # float32 sums of some 700 products along three axes: 30 roundings of 1.2e-7
TRUNCATED = 1e-6  # a spline's coefficients, whose filter is cut where its taps fall below 1e-8, and their rounding


@pytest.fixture
def volume():
    return np.random.default_rng(4).random(SHAPE, np.float32)


def both(volume):
    """The volume on the host, and the same on the device."""
    return volume, to_device(volume.copy(), float)


def test_results_lie_where_the_volume_was_given(volume):
    host, device = both(volume)
    for function, further in (
        (deform.spline_coefficients, ()),
        (light.smoothed, (0.7,)),
        (light.powered, (0.5,)),
        (light.fluctuation, ((4, 5, 6),)),
    ):
        on_host, on_device = function(host, *further), function(device, *further)
        assert isinstance(on_host, np.ndarray) and not isinstance(on_device, np.ndarray)
        np.testing.assert_array_equal(to_host(on_device), on_host)


def test_spline_coefficients_are_those_of_scipy(volume):
    """Those of a volume with zeros far around it, as the coefficients do not end with the volume."""
    far = 20
    wide = ndimage.spline_filter(np.pad(volume, far + deform.MARGIN).astype(float), order=3)
    expected = wide[far:-far, far:-far, far:-far]
    np.testing.assert_allclose(deform.spline_coefficients(volume), expected, atol=TRUNCATED * np.abs(expected).max())


def test_a_spline_passes_through_the_voxels(volume):
    padded = to_host(deform.spline_coefficients(volume))
    for axis in range(3):
        padded = ndimage.convolve1d(padded, [1 / 6, 4 / 6, 1 / 6], axis, mode="mirror")
    inner = (slice(deform.MARGIN, -deform.MARGIN),) * 3
    np.testing.assert_allclose(padded[inner], volume, atol=4 * TRUNCATED)


@pytest.mark.parametrize("sigma", (0.4, 1.0, 5.0))
def test_smoothing_is_that_of_scipy(volume, sigma):
    expected = ndimage.gaussian_filter(volume.astype(float), sigma, mode="constant")
    np.testing.assert_allclose(light.smoothed(volume, sigma), expected, atol=TOLERANCE_F32)


@pytest.mark.parametrize("window", ((4, 5, 6), (1, 18, 21), (13, 7, 2)))
def test_the_local_mean_is_that_of_scipy(volume, window):
    expected = volume - ndimage.uniform_filter(volume.astype(float), window)
    np.testing.assert_allclose(light.fluctuation(volume, window), expected, atol=TOLERANCE_F32)


@pytest.mark.parametrize("exponent", (0.5, 1.0, 2.0))
def test_powers_of_intensities(volume, exponent):
    signed = volume - np.float32(0.5)
    np.testing.assert_allclose(light.powered(signed, exponent), np.maximum(signed, 0.0) ** exponent, rtol=TOLERANCE_F32)


def test_light_that_two_volumes_share(volume):
    other = volume[::-1].copy() - np.float32(0.3)
    least, mean = light.shared_light(volume, other)
    relative = [np.maximum(one, 0) / np.maximum(one, 0).mean(dtype=float) for one in (volume, other)]
    np.testing.assert_allclose(least, np.minimum(*relative), atol=4 * TOLERANCE_F32)
    np.testing.assert_allclose(mean, np.mean(relative, 0), atol=4 * TOLERANCE_F32)
    dark = light.shared_light(volume, np.zeros_like(volume))
    assert not dark[0].any() and np.isfinite(dark[1]).all()


def test_sums_over_volumes(volume):
    other = 2 * volume[:, ::-1].copy() - 1
    exact = [one.astype(float) for one in (volume, other)]
    for (mean, square), one in zip(sums.means_and_squares([volume, other]), exact, strict=True):
        assert mean == pytest.approx(one.mean(), abs=TOLERANCE_F32)
        assert square == pytest.approx((one**2).sum(), rel=TOLERANCE_F32)
    assert sums.power([volume, other]) == pytest.approx(sum((one**2).sum() for one in exact), rel=TOLERANCE_F32)
    for lag in (1, 3):
        found = sums.lag_products([volume, other], lag, (0, 1, 2))
        for axis in range(3):
            moved = [np.moveaxis(one, axis, 0) for one in exact]
            assert found[axis] == pytest.approx(sum((one[lag:] * one[:-lag]).sum() for one in moved), rel=TOLERANCE_F32)
    assert sums.lag_products([volume], 2, (1,)) == sums.lag_products([volume], 2, (0, 1, 2))[1:2]


def test_fluid_of_two_volumes_ends_beside_what_only_one_of_them_calls_solid():
    first, second = (np.random.default_rng(seed).random(SHAPE, np.float32) ** 3 for seed in (0, 1))
    solid = [one > 0.5 for one in (first, second)]
    expected = ~(solid[0] | solid[1] | ndimage.binary_dilation(solid[0] ^ solid[1]))
    assert 0 < expected.sum() < expected.size
    np.testing.assert_array_equal(fluid.common_fluid(first, second), expected)
    np.testing.assert_array_equal(fluid.common_fluid(first, first), ~solid[0])
    np.testing.assert_array_equal(fluid.inverted(solid[0]), ~solid[0])
    np.testing.assert_array_equal(fluid.as_numbers(solid[0]), solid[0].astype(np.float32))


def test_levelled_volumes_have_no_local_mean_in_their_fluid(volume):
    inside = np.random.default_rng(2).random(SHAPE) < 0.7
    inside[:4] = False
    window = (5, 4, 6)

    def mean(values):
        return ndimage.uniform_filter(values, window, mode="constant")

    share = mean(inside.astype(float))
    for found, of in zip(fluid.levelled(volume, volume[::-1], inside, window), (volume, volume[::-1]), strict=True):
        exact = of.astype(float)
        expected = np.where(inside, exact - mean(np.where(inside, exact, 0)) / np.maximum(share, 1e-30), 0)
        np.testing.assert_allclose(found, expected, atol=4 * TOLERANCE_F32)  # the share of fluid is some 1/4 or more


WINDOWS = {"window": (4, 6, 5), "origin": (0, 0, 2), "step": (3, 4, 2), "count": (4, 4, 8)}


def corners():
    """Slices of every window, with its index."""
    for index in np.ndindex(WINDOWS["count"]):
        at = zip(index, WINDOWS["origin"], WINDOWS["step"], WINDOWS["window"], strict=True)
        yield index, tuple(slice(o + k * s, o + k * s + w) for k, o, s, w in at)


def test_means_over_windows(volume):
    flags = volume < 0.3
    means, shares = (window_means.window_means(values, **WINDOWS) for values in (volume, flags))
    for index, part in corners():
        assert means[index] == pytest.approx(volume[part].mean(dtype=float), abs=TOLERANCE_F32)
        assert shares[index] == pytest.approx(flags[part].mean(), abs=1e-12)
    whole = window_means.window_means(np.ones(SHAPE, bool), **WINDOWS)
    assert (whole == 1).all()  # exactly, as callers expect


def test_middles_of_what_windows_hold():
    flags = np.random.default_rng(1).random(SHAPE) < 0.02
    middles = window_means.window_middles(flags, **WINDOWS)
    empty = 0
    for index, part in corners():
        places = np.argwhere(flags[part]) + [at.start for at in part]
        empty += not len(places)
        expected = places.mean(0) if len(places) else np.full(3, np.nan)
        np.testing.assert_allclose(middles[index], expected, atol=1e-9)
    assert 0 < empty < middles.size / 3


def test_a_matrix_along_each_axis_takes_a_field_to_another_grid_and_back():
    rng = np.random.default_rng(0)
    field = rng.random((3, 4, 5, 3))
    matrices = [rng.random((6, 3)), rng.random((7, 4)), rng.random((8, 5))]
    control = interpolation.to_control_points(matrices, field)
    expected = np.einsum("az,by,cx,zyxk->abck", *matrices, field)
    np.testing.assert_allclose(to_host(control), expected, rtol=1e-6)  # float32
    back = interpolation.from_control_points([np.linalg.pinv(matrix) for matrix in matrices], control)
    np.testing.assert_allclose(back, field, atol=1e-4)  # float32, times the condition of random matrices


def deviation_twin(first, second):
    """Standard deviation of each window's displacement as Wieneke (2015) defines it, with sums over cubes, float64.

    The slope of the peak is limited by the median autocorrelation of the windows. Also the largest relative error per
    relative error of the sums: the mean's product, which is subtracted, may be much larger than what remains, and so
    may the peak be than what it exceeds its sides by.
    """

    def total(values):
        return np.array([values[part].sum() for _, part in corners()]).reshape(WINDOWS["count"])

    voxels, reach = np.prod(WINDOWS["window"]), uncertainty.REACH
    mean_product = total(first) * total(second) / voxels
    mean_squares = (total(first) ** 2 + total(second) ** 2) / voxels
    peak, own = total(first * second) - mean_product, total(first**2 + second**2) - mean_squares
    widest = np.median(total(first**2 + second**2) / own)
    result, amplified = [], []
    for axis in range(3):
        ahead = [np.roll(np.pad(one, [(0, int(k == axis)) for k in range(3)]), -1, axis) for one in (first, second)]
        ahead = [one[tuple(slice(n) for n in SHAPE)] for one in ahead]  # 0 behind the volume
        plus, minus = first * ahead[1], ahead[0] * second
        padded = np.pad(plus - minus, (reach // 2, reach - 1 - reach // 2))
        cubes = np.lib.stride_tricks.sliding_window_view(padded, (reach,) * 3).sum((-1, -2, -3))
        about_zero = total(cubes**2) / reach**3
        variance = np.maximum(about_zero - total(plus - minus) ** 2 * reach**3 / voxels, about_zero / 2)
        side = (total(plus) + total(minus)) / 2 - mean_product
        own_side = total(first * ahead[0] + second * ahead[1]) - mean_squares
        typical = np.log(np.median((own / own_side)[(own > own_side) & (own_side > 0)]))
        with np.errstate(divide="ignore", invalid="ignore"):
            above = np.where(side > 0, np.log(peak / side), np.inf)
            limited = np.clip(above, uncertainty.FLATTEST * typical, typical)
            result.append(np.where(peak > 0, np.sqrt(variance) / (4 * peak * np.exp(-limited) * limited), np.nan))
            largest = np.maximum(total(first * second), (total(plus) + total(minus)) / 2)
            sides = np.where(limited == above, largest / side, 0.0)  # no matter where the slope is limited
            amplified.append(1 + largest / peak + (sides + largest / peak + widest) / limited)
    return np.stack(result, -1), np.stack(amplified, -1)


def test_the_deviation_of_displacements_is_as_defined():
    rng = np.random.default_rng(0)
    light = ndimage.gaussian_filter(rng.random(SHAPE) ** 8, 0.9)
    pair = [(light + rng.normal(0, 0.01, SHAPE)).astype(np.float32) for _ in range(2)]
    found = uncertainty.displacement_deviation(*pair, **WINDOWS)
    expected, amplified = deviation_twin(*(one.astype(float) for one in pair))
    known = np.isfinite(expected)
    assert known.mean() > 0.5  # small windows: some have no peak at lag 0
    assert (np.isfinite(found) == known).all()
    assert (np.abs(found - expected) <= ROUNDED * amplified * expected)[known].all()


@pytest.fixture
def blobs():
    """Two volumes of the same particles with noise of their own, and windows that touch all faces."""
    rng = np.random.default_rng(1)
    light = 1000 * ndimage.gaussian_filter(rng.random((24, 24, 24)) ** 40, 0.8)
    pair = [(light + rng.normal(0, 1.0, light.shape)).astype(np.float32) for _ in range(2)]
    return pair, {"window": (12, 12, 12), "step": (6, 6, 6), "count": (3, 3, 3)}


def test_noise_beside_a_face_counts_in_full(blobs):
    pair, windows = blobs
    alone = uncertainty.displacement_deviation(*pair, origin=(0, 0, 0), **windows)
    within = [np.pad(one, uncertainty.REACH) for one in pair]  # the same windows, away from the faces
    inside = uncertainty.displacement_deviation(*within, origin=(uncertainty.REACH,) * 3, **windows)
    np.testing.assert_allclose(alone, inside, rtol=ROUNDED)


def test_a_flat_peak_is_not_all_noise(blobs):
    pair, windows = blobs
    pair[1][:12, :12, :12] = ndimage.shift(pair[1], (0, 0, 1.0))[:12, :12, :12]  # the peak lies at the next lag
    found = uncertainty.displacement_deviation(*pair, origin=(0, 0, 0), **windows)
    assert 0.1 < found[0, 0, 0, 2] < 0.5  # a displacement of 1 that is left; 1.7 by the slope of this peak
