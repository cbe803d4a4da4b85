"""Sweeps over voxels, sums, quantiles and the first guess against NumPy, and their independence of the threads."""

import numpy as np
import pytest
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction import first_guess, sums, update, voxels
from lfpiv_kernels.transfer import duplicate, empty, to_device, to_host, zeros

TOLERANCE_SUM = 1e-12  # float64 sums of the same terms in another order, relative
TOLERANCE_F32 = 1e-6  # a few roundings of float32, relative
TOLERANCE_POWER = 1e-6  # a power as a polynomial in float32, relative; of momentum times its exponent, at least 1
TOLERANCE_GUESS = 2e-4  # exp(x) - 1 from x = 1e-3 on, where the difference loses three of seven digits, relative
SIZES = [1, 7, 1025, 20_011]


@pytest.fixture(params=SIZES)
def volumes(request, monkeypatch):
    """Four volumes: positive, with zeros, of 0 and 1, and of any sign. Sweeps of the largest are cut."""
    monkeypatch.setattr(voxels, "FEWEST_VOXELS", 8192)
    rng = np.random.default_rng(request.param)
    lit = (rng.random(request.param) > 0.3).astype(np.float32)
    positive, signed = rng.lognormal(0, 2, request.param).astype(np.float32), rng.normal(size=request.param)
    return positive, positive[::-1] * lit, lit, signed.astype(np.float32)


def test_sweeps_are_the_operators_of_numpy(volumes):
    positive, dark, lit, signed = volumes
    on = [to_device(one.copy()) for one in volumes]
    np.testing.assert_array_equal(
        to_host(voxels.multiply(on[0], on[3], factor=0.7)), positive * np.float32(0.7) * signed
    )
    np.testing.assert_array_equal(to_host(voxels.divide(on[3], on[1], 0.5)), signed / np.maximum(dark, np.float32(0.5)))
    np.testing.assert_array_equal(to_host(voxels.indicator(on[1])), dark != 0)
    np.testing.assert_array_equal(to_host(voxels.ones(len(lit))), np.ones_like(lit))
    for mask, expected in ((None, positive + signed), (on[2], np.where(lit > 0, positive + signed, positive))):
        total = duplicate(on[0])
        voxels.add(on[3], total, mask)
        np.testing.assert_array_equal(to_host(total), expected)
    darkened = duplicate(on[0])
    voxels.darken(darkened, on[2])
    np.testing.assert_array_equal(to_host(darkened), np.where(lit > 0, positive, 0))


def test_a_sweep_may_overwrite_what_it_reads(volumes):
    positive, dark, _, signed = volumes
    one, other = (to_device(array.copy()) for array in (positive, dark))
    np.testing.assert_array_equal(to_host(voxels.multiply(one, to_device(signed), one)), positive * signed)
    np.testing.assert_array_equal(to_host(voxels.divide(to_device(signed), other, 0.1, other)), signed / dark.clip(0.1))


def test_the_largest_voxel_is_found_on_the_device(volumes):
    positive = volumes[0]
    assert to_host(sums.largest(to_device(positive)))[0] == positive.max()


def test_totals_are_sums_in_float64(volumes):
    positive, _, lit, signed = volumes
    totals, added = sums.Totals(3), to_device(lit.copy())
    numbers = signed.astype(np.float64)
    for _ in range(2):
        totals.add(0, to_device(numbers))
    totals.add(1, to_device(numbers), len(numbers) // 2)
    totals.add_squares(2, to_device(positive), to_device(signed), added)
    squares = (positive * signed * signed).sum(dtype=np.float64)
    expected = [2 * numbers.sum(), numbers[: len(numbers) // 2].sum(), squares]
    np.testing.assert_allclose(totals.read(), expected, atol=TOLERANCE_SUM * np.abs(numbers).sum(), rtol=TOLERANCE_SUM)
    np.testing.assert_array_equal(to_host(added), lit + signed)
    totals.clear()
    assert totals.read() == [0, 0, 0]


@pytest.mark.parametrize("momentum", [False, True])
@pytest.mark.parametrize("in_place", [False, True])
def test_steps_with_momentum_equal_their_twin(volumes, momentum, in_place):
    positive, dark, _, signed = volumes
    last = np.where(dark > 0, positive * 1.1, 0).astype(np.float32)
    share, largest, beta, length = 0.5, 3.0, 0.8, 0.9
    smart = dark * np.exp(0.3 * signed.astype(float) * length)
    logarithm = signed.astype(float)
    sharp = dark * np.exp(np.clip(logarithm + share * (logarithm - 0.5 * logarithm), -largest, largest))
    for expected, is_sharp in ((smart, False), (sharp, True)):
        volume, memory = to_device(dark.copy()), to_device(last.copy())
        stepped = memory if in_place and momentum else volume if in_place else empty(dark.size)
        extrapolation = (
            update.Extrapolation(memory, beta, volume if in_place else empty(dark.size)) if momentum else None
        )
        keywords = {"extrapolation": extrapolation, "stepped": stepped}
        if is_sharp:
            update.sharpen(volume, to_device(signed), to_device(0.5 * signed), share, largest, **keywords)
        else:
            step = to_device(np.full_like(dark, 0.3))
            update.update(volume, to_device(signed), step, length=length, **keywords)
        np.testing.assert_allclose(to_host(stepped), expected, rtol=10 * TOLERANCE_F32)
        if extrapolation is not None:
            ratio = np.divide(expected, last, out=np.ones_like(expected), where=last > 0)
            ahead = expected * np.clip(ratio, 1 / update.LARGEST_LEAP, update.LARGEST_LEAP) ** beta
            np.testing.assert_allclose(
                to_host(extrapolation.ahead), np.where(last > 0, ahead, 0), rtol=20 * TOLERANCE_F32
            )


FLOAT32 = np.finfo(np.float32)
LIGHT = np.float32([0, FLOAT32.tiny, 1e-30, 1e-3, 1, 70_000, 1e29])
"""Light of which powers are tried: all that counts can be."""


def assert_light(found, expected, tolerance=TOLERANCE_POWER):
    """Compare float32 with its twin in float64, beyond the range of float32 as well.

    Where a library made the processor take subnormal numbers for zeros, they are.
    """
    found = to_host(found)
    inside = np.abs(expected) < (1 - tolerance) * FLOAT32.max
    np.testing.assert_allclose(found[inside], expected[inside], rtol=tolerance, atol=FLOAT32.tiny)
    assert (found[~inside] >= (1 - 2 * tolerance) * FLOAT32.max).all() and not np.isnan(found).any()


@pytest.mark.parametrize("momentum", [False, True])
def test_light_times_exponentials_of_all_sizes(momentum):
    ends = [-np.inf, -1e30, -1e4, -172, 172, 1e4, 1e30, np.inf]
    exponent = np.float32([*np.linspace(-170, 170, 4001), *np.linspace(-1, 1, 4000), *ends])
    light, exponent = (part.ravel() for part in np.meshgrid(LIGHT, exponent))
    limit = 2 * update.LARGEST_EXPONENT
    expected = light * np.exp(np.clip(exponent.astype(float), -limit, limit))
    stepped, volume = empty(light.size), to_device(light)
    extrapolation = update.Extrapolation(volume, 0.0, empty(light.size)) if momentum else None
    update.update(volume, to_device(exponent), voxels.ones(light.size), extrapolation=extrapolation, stepped=stepped)
    least = FLOAT32.tiny if momentum else 0
    assert_light(stepped, np.where(light > 0, np.maximum(expected, least), 0))
    assert (to_host(stepped)[light > 0] >= least).all() and not to_host(stepped)[light == 0].any()


def test_light_vanishes_where_the_exponent_is_next_to_minus_infinity():
    light, stepped = np.float32([0, 1, 1e29]), empty(3)
    update.update(to_device(light), voxels.ones(3), to_device(np.full(3, -1e30, np.float32)), stepped=stepped)
    assert not to_host(stepped).any()


def test_an_exponent_that_is_not_a_number_shows_in_the_light():
    light, stepped = np.ones(20, np.float32), empty(20)
    update.update(to_device(light), voxels.ones(20), to_device(np.full(20, np.nan, np.float32)), stepped=stepped)
    assert np.isnan(to_host(stepped)).all()


@pytest.mark.parametrize("largest", [3.0, 86.0, 1e30])
def test_sharpened_steps_are_limited(largest):
    logarithm = np.float32([*np.linspace(-100, 100, 4001), -1e30, 1e30, np.nan])
    light, logarithm = (part.ravel() for part in np.meshgrid(LIGHT, logarithm))
    limit, stepped, dark = min(largest, update.LARGEST_EXPONENT), empty(light.size), zeros(light.size)
    expected = light * np.exp(np.fmin(np.fmax(logarithm.astype(float), -limit), limit))
    update.sharpen(to_device(light), to_device(logarithm), dark, 0.0, largest, stepped=stepped)
    assert_light(stepped, expected)
    assert not to_host(stepped)[light == 0].any()


@pytest.mark.parametrize("exponent", [0.0, 0.3, 0.94, 1.0, -2.5, 20.0, -20.0, 300.0])
def test_momentum_of_all_ratios(exponent):
    assert np.float32(update.SMALLEST) == FLOAT32.tiny
    ratio = np.float32([*np.geomspace(0.019, 51, 4001), 0, 1e-37, 1e-4, 1, 1e4, 1e38])
    last, ratio = (part.ravel() for part in np.meshgrid(np.float32([*LIGHT, -1, np.inf]), ratio))
    with np.errstate(all="ignore"):
        light = np.nan_to_num(last * ratio, nan=0, posinf=np.inf)
        lifted = np.where(last > 0, np.maximum(light, FLOAT32.tiny), light)
        repeated = np.divide(lifted, last, out=np.ones_like(light), where=last > 0).astype(float)
        repeated = np.fmin(np.fmax(repeated, 1 / update.LARGEST_LEAP), update.LARGEST_LEAP)
        power = repeated ** np.clip(exponent, -update.LARGEST_MOMENTUM, update.LARGEST_MOMENTUM)
        expected = np.where(last > 0, np.maximum(lifted * power, FLOAT32.tiny), last)
    volume, extrapolation = to_device(light.copy()), update.Extrapolation(to_device(last), exponent, empty(last.size))
    nothing = zeros(last.size)
    update.update(volume, nothing, nothing, extrapolation=extrapolation, stepped=volume)
    np.testing.assert_array_equal(to_host(volume), lifted)
    assert_light(extrapolation.ahead, expected, TOLERANCE_POWER * max(1, min(abs(exponent), update.LARGEST_MOMENTUM)))
    np.testing.assert_array_equal(to_host(extrapolation.ahead)[last <= 0], last[last <= 0])
    assert (to_host(extrapolation.ahead)[last > 0] >= FLOAT32.tiny).all()


def test_subnormal_light_is_lifted_or_taken_for_zero():
    """By a step with momentum; which of them, processors decide."""
    light = np.arange(1, 2**23, 9973, dtype=np.uint32).view(np.float32)
    light = np.concatenate([light, light, np.float32(np.linspace(0, 1e-30, 100))])
    for beta in (0.0, 0.5, 0.94):
        volume, memory = to_device(light.copy()), to_device(light[::-1].copy())
        stepped, extrapolation = empty(light.size), update.Extrapolation(memory, beta, empty(light.size))
        signed = to_device(np.float32(np.linspace(-3, 3, light.size)))
        update.sharpen(volume, signed, zeros(light.size), 0.5, 3.0, extrapolation=extrapolation, stepped=stepped)
        for found in (to_host(stepped), to_host(extrapolation.ahead)):
            assert ((found >= 0) & (found < 1e-27)).all()


def test_the_first_guess_equals_its_twin(volumes):
    positive, _, lit, _ = volumes
    total = np.linspace(0.5, 2, lit.size).astype(np.float32)
    logarithm = np.log1p(positive.astype(float) * 1e-2)
    guess = np.expm1(logarithm / total) * lit
    expected = np.where(lit > 0, np.maximum(guess, 1e-3 * guess.max()), 0)
    arrays = (to_device(one.astype(np.float32)) for one in (logarithm, total, lit))
    found = to_host(first_guess.exponentiate(*arrays, 1e-3))
    np.testing.assert_allclose(found, expected, rtol=TOLERANCE_GUESS)


def test_arrays_made_on_the_device_are_of_its_memory(device):
    for made in (empty(3), zeros(3), duplicate(zeros(3))):
        assert made.shape == (3,) and made.dtype == wp.float32 and str(made.device) == runtime.device().warp
    assert not to_host(zeros(3)).any()
