"""Kernels of the correlation against slow NumPy twins."""

import dataclasses

import numpy as np
import pytest
import scipy.ndimage
import warp as wp
from support.particle_volumes import TOLERANCE_PEAK, particle_pair, ring, uniform

from lfpiv_kernels import runtime
from lfpiv_kernels.correlation import (
    box_sum,
    carry,
    correlate,
    deform,
    neighbours,
    plan,
    transforms,
)
from lfpiv_kernels.transfer import to_device, to_host

pytestmark = pytest.mark.usefixtures("device")

TOLERANCE_SUM = 2e-5  # float32 sums of up to 4096 products and their square root: 4096 ** 0.5 * 1.2e-7, rounded up
TOLERANCE_PLACE = 1e-5  # places up to 20 voxels, float32
TOLERANCE_SPLINE = 1e-5  # 64 float32 products, coefficients up to 2.5 times the values
TOLERANCE_MEDIAN = 1e-6  # order statistics of float32 values near 1


def possible_plans(shape, window, step, search):
    """Plans that the device can follow by name; windows that share no blocks leave "whole" ones only."""
    names = ("whole", "shared", "whole-spectral", "shared-spectral")
    found = dict(zip(names, plan.possible_plans(shape, window, step, search), strict=False))
    return {name: way for name, way in found.items() if "shared" not in name or way.block != window}


def coefficients_twin(first, second, window, step, search):
    """Correlation coefficient of every window at every lag, from the definition, in float64."""
    origin, count = correlate.window_grid(first.shape, window, step)
    padded = np.pad(second.astype(float), [(r, r) for r in search])
    result = np.zeros((*count, *(2 * r + 1 for r in search)))
    for cell in np.ndindex(*count):
        corner = [o + k * s for o, k, s in zip(origin, cell, step, strict=True)]
        a = first[tuple(slice(c, c + w) for c, w in zip(corner, window, strict=True))].astype(float)
        a = a - a.mean()
        for lag in np.ndindex(*result.shape[3:]):
            begin = np.add(corner, lag)
            b = padded[tuple(slice(c, c + w) for c, w in zip(begin, window, strict=True))]
            b = b - b.mean()
            result[cell + lag] = (a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum())
    return result


def peaks_twin(score, search, reach=2):
    """Displacement of the two highest peaks of one window, NaN where there is none; highest value and its rival."""

    def refine(lag):
        place = []
        for axis in range(3):
            values = [score[tuple(np.add(lag, k * np.eye(3, dtype=int)[axis]))] for k in (-1, 0, 1)]
            if min(values) > 0:
                values = np.log(values)
            place.append(lag[axis] - search[axis] + 0.5 * (values[0] - values[2]) / np.dot(values, (1, -2, 1)))
        return place

    top = np.array(score.shape) - 1
    first = np.unravel_index(score.argmax(), score.shape)
    second, best, rival = None, 0.0, 0.0
    for lag in np.ndindex(*score.shape):
        if np.abs(np.subtract(lag, first)).max() > reach:
            rival = max(rival, score[lag])
        if (np.array(lag) == 0).any() or (lag == top).any() or np.abs(np.subtract(lag, first)).max() < reach:
            continue
        around = [score[tuple(np.add(lag, sign * unit))] for unit in np.eye(3, dtype=int) for sign in (-1, 1)]
        if score[lag] > best and score[lag] >= max(around):
            second, best = lag, score[lag]
    inside = not ((np.array(first) == 0).any() or (first == top).any())
    nothing = [np.nan] * 3
    return (refine(first) if inside else nothing), (refine(second) if second else nothing), score[first], rival


@pytest.mark.slow(but="window1")
@pytest.mark.parametrize("symmetric", [False, True], ids=["one-sided", "symmetric"])
@pytest.mark.parametrize(
    ("window", "step", "search"),
    [
        ((8, 8, 8), (4, 4, 4), (3, 3, 3)),
        ((7, 9, 10), (7, 3, 5), (2, 5, 3)),
        ((16, 16, 16), (16, 8, 8), (4, 4, 4)),
        ((8, 8, 8), (12, 4, 4), (3, 3, 3)),  # layers of blocks that no window needs, between those of two slabs
        ((12, 12, 8), (6, 4, 2), (3, 2, 6)),  # several blocks along y and x, two parts of the lags along x
        (
            (9, 10, 5),
            (3, 5, 7),
            (2, 4, 3),
        ),  # odd blocks, whose transforms are longer than needed; windows that leave gaps
        ((12, 12, 8), (12, 12, 8), (11, 2, 3)),  # lags along z in two parts; blocks longer than half a transform
    ],
)
def test_peaks_equal_the_definition(monkeypatch, window, step, search, symmetric):
    monkeypatch.setattr(correlate, "SLAB_BYTES", 1)  # every layer of windows is a slab
    first, second = particle_pair((21, 26, 28), uniform(0.4, -1.2, 0.8), seed=1, ghosts=0.5, noise=0.05)
    score = coefficients_twin(first, second, window, step, search)
    if symmetric:
        score = 0.5 * (score + coefficients_twin(second, first, window, step, search)[..., ::-1, ::-1, ::-1])
    expected = {cell: peaks_twin(score[cell], search) for cell in np.ndindex(*score.shape[:3])}
    for name, way in possible_plans(first.shape, window, step, search).items():
        found = correlate.correlate_by_plan(way, first, second, symmetric=symmetric)
        assert found.correlation.shape == score.shape[:3], name
        for cell, (displacement, second_displacement, highest, rival) in expected.items():
            np.testing.assert_allclose(found.correlation[cell], highest, atol=TOLERANCE_SUM)
            np.testing.assert_allclose(found.rival[cell], rival, atol=TOLERANCE_SUM)
            np.testing.assert_allclose(found.displacement[cell], displacement, atol=TOLERANCE_PEAK)
            np.testing.assert_allclose(found.second_displacement[cell], second_displacement, atol=TOLERANCE_PEAK)
            assert found.measured[cell] == np.isfinite(displacement).all()


@pytest.mark.parametrize("reach", [1, 3])
def test_the_reach_of_a_peak_holds_no_rival_and_no_second_peak(reach):
    window, step, search = (10, 10, 10), (6, 6, 6), (5, 5, 5)
    first, second = particle_pair((20, 24, 28), uniform(0.4, -1.2, 0.8), seed=1, ghosts=0.5, noise=0.05)
    score = coefficients_twin(first, second, window, step, search)
    found = correlate.correlate_windows(first, second, window=window, step=step, search=search, reach=reach)
    for cell in np.ndindex(*score.shape[:3]):
        _, second_displacement, _, rival = peaks_twin(score[cell], search, reach)
        np.testing.assert_allclose(found.rival[cell], rival, atol=TOLERANCE_SUM)
        np.testing.assert_allclose(found.second_displacement[cell], second_displacement, atol=TOLERANCE_PEAK)
    with pytest.raises(ValueError, match="reach"):
        correlate.correlate_windows(first, second, window=window, step=step, search=search, reach=0)


def planes_twin(transform, values):
    """Rows that `_transform_planes` makes of one column of planes."""
    folds = transform.quads.reshape(-1, 4)
    up, down, far_up, far_down = np.append(values, 0)[folds].T  # the place -1 holds nothing
    classes = [up + down + far_up + far_down, up - down - far_up + far_down]
    classes += [up + down - far_up - far_down, up - down + far_up - far_down]
    parts = np.split(transform.matrix, len(folds) * np.cumsum(transform.counts)[:-1])
    rows = np.empty(len(transform.rows))
    rows[transform.rows] = np.concatenate([c @ m.reshape(len(folds), -1) for c, m in zip(classes, parts, strict=True)])
    return rows


@pytest.mark.parametrize(("edge", "search"), [(1, 2), (4, 4), (8, 8), (7, 3), (12, 2), (9, 2)])
def test_spectra_of_blocks_and_surroundings_give_their_correlation(edge, search):
    rng = np.random.default_rng(7)
    block, around = rng.normal(size=edge), rng.normal(size=edge + 2 * search)
    spectrum = transforms.Spectrum.for_block((edge,) * 3, (search,) * 3)
    rows = [planes_twin(*of) for of in zip(spectrum.planes, (block, around), strict=True)]
    half = spectrum.size[0] // 2
    taps, near = (row[: half + 1] + 1j * np.pad(row[half + 1 :], 1) for row in rows)
    found = np.fft.irfft(taps.conj() * near, spectrum.size[0])[np.arange(-search, search + 1)]
    np.testing.assert_allclose(found, np.correlate(around, block, "valid"), atol=TOLERANCE_SUM)


@pytest.mark.parametrize("symmetric", [False, True], ids=["one-sided", "symmetric"])
def test_peaks_do_not_depend_on_how_they_are_computed(monkeypatch, device, symmetric):
    pair = particle_pair((30, 34, 38), uniform(0.4, -1.2, 0.8), seed=8, ghosts=0.5, noise=0.05)
    ways = possible_plans(pair[0].shape, (12,) * 3, (6,) * 3, (4,) * 3)

    def values(way):
        found = correlate.correlate_by_plan(way, *pair, symmetric=symmetric)
        return {name: getattr(found, name) for name in ("displacement", "second_displacement", "correlation", "rival")}

    expected = values(ways["whole"])
    for name, way in ways.items():
        for field, found in values(way).items():
            np.testing.assert_allclose(found, expected[field], atol=TOLERANCE_PEAK, err_msg=f"{field}, {name}")
    before = {name: values(way) for name, way in ways.items()}
    monkeypatch.setattr(runtime, "device", lambda: dataclasses.replace(device, threads=1))
    for name, way in ways.items():
        for field, found in values(way).items():
            np.testing.assert_array_equal(found, before[name][field], err_msg=f"{field} depends on the threads")


@pytest.mark.parametrize(
    ("window", "step", "search", "way"),
    [
        (5, 4, 3, "whole"),
        (12, 6, 3, "shared"),
        (13, 5, 6, "whole-spectral"),
        (16, 8, 8, "shared-spectral"),
    ],
)
def test_the_cheapest_plan_is_chosen(device, window, step, search, way):
    arguments = (70, 140, 140), (window,) * 3, (step,) * 3, (search,) * 3
    plans, chosen = possible_plans(*arguments), plan.make_plan(*arguments)
    assert chosen == min(plans.values(), key=plan.Plan.seconds)
    assert device.form == "gpu" or chosen == plans[way]


def test_windows_without_signal_are_not_measured():
    first, second = particle_pair((16, 24, 40), uniform(0, 0, 0), seed=2)
    first[:, :, :20], second[:, :, :20] = 0, 0
    measured = correlate.correlate_windows(first, second, window=(8,) * 3, step=(8,) * 3, search=(3,) * 3).measured
    assert not measured[:, :, :2].any() and measured[:, :, 3:].all()


@pytest.mark.parametrize("window", [(1, 5, 16), (7, 12, 9)])
def test_box_sums(window):
    volume = np.random.default_rng(3).random((19, 21, 23), dtype=np.float32)
    expected = np.lib.stride_tricks.sliding_window_view(volume.astype(float), window).sum((-1, -2, -3))
    result = box_sum.box_sum(volume, window)
    inside = tuple(slice(n) for n in expected.shape)
    np.testing.assert_allclose(result[inside], expected, rtol=TOLERANCE_SUM)
    assert result.sum(dtype=float) == pytest.approx(result[inside].sum(dtype=float))
    keep = (slice(0, 12, 3), slice(2, 9, 2), slice(0, 6, 5))
    np.testing.assert_array_equal(box_sum.box_sum(volume, window, keep), result[keep])


def test_deformation_samples_the_spline():
    rng = np.random.default_rng(4)
    volumes = rng.random((2, 14, 17, 19), dtype=np.float32)
    field = rng.normal(0, 2, (3, 4, 5, 3)).astype(np.float32)
    spacing = (13 / 2, 16 / 3, 18 / 4)
    deformed = deform.deform_pair(*map(deform.spline_coefficients, volumes), field, spacing)
    place = np.stack(np.meshgrid(*(np.arange(n) + deform.OFFSET for n in volumes.shape[1:]), indexing="ij"))
    cell = place / np.reshape(spacing, (3, 1, 1, 1))
    inside = (cell <= np.reshape(field.shape[:3], (3, 1, 1, 1)) - 1.0).all(0)  # beyond it the field is continued
    shift = np.stack([scipy.ndimage.map_coordinates(field[..., k], cell, order=1) for k in range(3)])
    for volume, result, sign in zip(volumes, deformed, (-0.5, 0.5), strict=True):
        wide = np.pad(volume.astype(float), 20)  # zero outside
        expected = scipy.ndimage.map_coordinates(wide, place + sign * shift + 20, order=3)
        np.testing.assert_allclose(result[inside], expected[inside], atol=TOLERANCE_SPLINE)


def test_a_carried_volume_is_the_spline_at_the_displaced_places():
    rng = np.random.default_rng(5)
    volume = rng.random((14, 17, 19), dtype=np.float32)
    field = rng.normal(0, 1, (3, 4, 5, 3)).astype(np.float32)
    spacing = (13 / 2, 16 / 3, 18 / 4)  # the last control points lie on the last voxels
    carried, inside = carry.carry(deform.spline_coefficients(volume), field, spacing)
    voxels = np.stack(np.meshgrid(*map(np.arange, volume.shape), indexing="ij")).astype(float)
    cell = voxels / np.reshape(spacing, (3, 1, 1, 1))
    place = voxels + [scipy.ndimage.map_coordinates(field[..., k], cell, order=1) for k in range(3)]
    wide = np.pad(volume.astype(float), 20)  # zero outside
    np.testing.assert_allclose(carried, scipy.ndimage.map_coordinates(wide, place + 20, order=3), atol=TOLERANCE_SPLINE)
    beyond = np.maximum(-place, place - np.reshape(volume.shape, (3, 1, 1, 1)) + 1)
    expected = np.prod(1 - np.clip(beyond, 0, 1), axis=0)
    assert 0 < (expected == 0).mean() < 0.5 and (expected == 1).any()
    np.testing.assert_allclose(inside, expected, atol=TOLERANCE_PLACE)
    wanted = np.flatnonzero(rng.random(volume.shape) < 0.3)
    there = carry.carry(deform.spline_coefficients(volume), field, spacing, wanted)
    np.testing.assert_array_equal(there[0], carried.ravel()[wanted])
    np.testing.assert_array_equal(there[1], inside.ravel()[wanted])


def test_displacements_midway_in_time_become_those_of_a_frame_s_particles():
    """At u(x) = steps * d(x + u / 2), the field continued by its outermost control points."""
    rng, spacing = np.random.default_rng(6), (4.0, 3.5, 3.0)
    midway = scipy.ndimage.gaussian_filter(rng.normal(0, 30, (7, 6, 8, 3)), (1, 1, 1, 0)).astype(np.float32)
    points = np.stack(np.meshgrid(*map(np.arange, midway.shape[:3]), indexing="ij")).astype(float)
    control = to_device(midway, wp.vec3)
    for steps in (1, -2):
        moved = to_host(carry.followed(control, spacing, steps)).astype(float)
        expected = steps * np.moveaxis(midway.astype(float), -1, 0)
        for _ in range(carry.ROUNDS):
            cell = points + expected / 2 / np.reshape(spacing, (3, 1, 1, 1))
            sampled = [scipy.ndimage.map_coordinates(midway[..., k], cell, order=1, mode="nearest") for k in range(3)]
            expected = steps * np.array(sampled, float)
        assert np.abs(expected - steps * np.moveaxis(midway, -1, 0)).max() > 0.5
        np.testing.assert_allclose(np.moveaxis(moved, -1, 0), expected, atol=10 * TOLERANCE_PLACE)


def predictions_twin(field, keep):
    """Median and scatter of the neighbours, as they are and with their gradient removed, for every vector."""
    padded = np.pad(np.where(keep[..., None], field, np.nan), [(1, 1)] * 3 + [(0, 0)], constant_values=np.nan)
    result = np.full((4, *field.shape), np.nan)
    offset = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"))
    for point in np.ndindex(*keep.shape):
        for component in range(3):
            cube = padded[tuple(slice(p, p + 3) for p in point) + (component,)].copy()
            cube[1, 1, 1] = np.nan
            if np.isnan(cube).all():
                continue
            differences = [np.diff(cube, axis=axis) for axis in range(3)]
            slope = [0 if np.isnan(d).all() else np.nanmedian(d) for d in differences]
            moved = cube - np.tensordot(slope, offset, 1)
            for k, values in ((0, cube), (2, moved)):
                median = np.nanmedian(values)
                result[(k, *point, component)] = median
                result[(k + 1, *point, component)] = np.nanmedian(np.abs(values - median))
    return result


def test_predictions_from_neighbours():
    rng = np.random.default_rng(5)
    field = rng.normal(size=(4, 5, 6, 3))
    keep = rng.random(field.shape[:3]) < 0.6
    keep[:, :, 4:] = False  # vectors without any neighbour
    keep[0, 0, 0] = True
    field[~keep] = np.nan
    expected = predictions_twin(field, keep)
    result = neighbours.predict(field, keep, np.ones_like(keep))
    for k, name in enumerate(("median", "scatter", "level", "level_scatter")):
        values = getattr(result, name).reshape(field.shape)
        np.testing.assert_allclose(values, expected[k], atol=TOLERANCE_MEDIAN * 10, err_msg=name)
    some = rng.random(keep.shape) < 0.3
    np.testing.assert_array_equal(neighbours.predict(field, keep, some).level, result.level[some.ravel()])


def test_the_kernel_refuses_what_is_not_finite():
    pair = particle_pair((16, 16, 16), uniform(0, 0, 0), seed=42)
    pair[1][3, 4, 5] = np.nan
    with pytest.raises(ValueError, match="second: expected finite values"):
        correlate.correlate_windows(*pair, window=(8, 8, 8), step=(4, 4, 4), search=(3, 3, 3))


def test_moving_both_volumes_moves_the_field():
    pair = particle_pair((36, 48, 48), ring((36, 48, 48)), seed=33)
    options = {"window": (12, 12, 12), "step": (6, 6, 6), "search": (3, 3, 3), "symmetric": True}
    still = correlate.correlate_windows(*pair, **options).displacement
    moved = correlate.correlate_windows(*(np.roll(v, (6, -6, 6), (0, 1, 2)) for v in pair), **options).displacement
    # by one step of the grid; windows at the edge see what was rolled in
    np.testing.assert_allclose(moved[2:-1, 1:-2, 2:-1], still[1:-2, 2:-1, 1:-2], atol=TOLERANCE_PEAK)
