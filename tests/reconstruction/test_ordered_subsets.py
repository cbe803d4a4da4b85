"""Ordered subsets: the rays' halves, an epoch against its twin, the limit, the last passes, and what is refused."""

import logging

import numpy as np
import pytest
from support import plain_steps
from support.ideal_rig import optics, two_cameras
from support.noisy_blobs import noisy_blobs

import lfpiv
from lfpiv.reconstruction import momentum, ordered_subsets
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.sieve import Sieve
from lfpiv.reconstruction.smart import CameraEquation, ImageEquations, State
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.reconstruction.steps import SmartStep
from lfpiv.weights.operator import Weights
from lfpiv_kernels import reference
from lfpiv_kernels.reconstruction import update as kernels
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.projector import EVEN, ODD
from lfpiv_kernels.transfer import to_device, to_host

TOLERANCE_TWIN = 2e-4  # three epochs of float32 sums against float64, of the brightest voxel
FORMS = ["profiles", "pixels"]


@pytest.fixture(scope="module", params=FORMS)
def weights(request):
    """A 3 x 4 x 5 grid seen by two cameras."""
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0.3), size_mm=(0.5, 0.4, 0.3), voxel_mm=0.1)
    return lfpiv.build_weights(two_cameras(optics=optics(rows=200, columns=240)), grid, form=request.param)


@pytest.fixture(scope="module")
def volume_of_blobs():
    """Weights of a small volume, blobs in it, and their noisy images."""
    return noisy_blobs(120)


@pytest.mark.parametrize("cameras", [1, 3])
@pytest.mark.parametrize(
    ("sets", "count"), [(1, 1), (2, 2), (3, 3), (5, 5), (8, 8), (13, 13), (64, 64), (16, 4), (13, 5), (7, 1)]
)
def test_joint_subsets_are_each_set_of_all_cameras_once_in_bit_reversed_order(cameras, sets, count):
    order = [0]
    while len(order) < count:  # even numbers before odd ones, and so on within each: the halves of half as many
        order = [2 * number for number in order] + [2 * number + 1 for number in order]
    expected = [number for number in order if number < count]
    subsets = ordered_subsets.joint_subsets(cameras, sets, count)
    assert [one.parts[0] for one in subsets] == [(0, number) for number in expected]
    for subset, first in zip(subsets, expected, strict=True):
        assert subset.parts == tuple((n, number) for n in range(cameras) for number in range(first, sets, count))
    parts = [part for one in subsets for part in one.parts]
    assert sorted(parts) == [(camera, number) for camera in range(cameras) for number in range(sets)]


def test_subsets_are_each_set_of_each_camera_once_or_whole_cameras():
    assert [one.parts for one in ordered_subsets.subsets_of(2, 2)] == [((n, half),) for n in (0, 1) for half in (0, 1)]
    assert [one.parts for one in ordered_subsets.subsets_of(3)] == [((n, ALL),) for n in range(3)]


@pytest.mark.parametrize(
    "subsets",
    [ordered_subsets.subsets_of(2, 2), ordered_subsets.subsets_of(2), ordered_subsets.joint_subsets(2, 2, 2)],
    ids=["halves", "cameras", "joint"],
)
def test_epochs_equal_their_dense_twin(weights, subsets):
    rng, floor = np.random.default_rng(4), 0.5
    first = rng.uniform(50, 200, weights.grid.size).astype(np.float32)
    names = list(weights.cameras)
    images = {name: rng.uniform(0, 20, camera.gain.size).astype(np.float32) for name, camera in weights.cameras.items()}
    dense = [reference.dense(weights.projector(name).blocks) for name in names]
    pixels = [[(n, weights.projector(names[n]).exclusive_pixels(part)) for n, part in one.parts] for one in subsets]
    rows = [np.concatenate([dense[n][seen] for n, seen in each]) for each in pixels]
    twin = reference.ordered_subsets(
        rows,
        [np.concatenate([images[names[n]][seen] for n, seen in each]) for each in pixels],
        first.astype(float),
        column_sum=sum(matrix.sum(0) for matrix in dense),
        epochs=3,
        floor=floor,
        shortening=ordered_subsets.SHORTENING,
        momentum=ordered_subsets.SUBSET_MOMENTUM,
        extrapolation=kernels.LARGEST_LEAP,
    )
    even_gain = {name: np.ones(camera.gain.size, np.float32) for name, camera in weights.cameras.items()}
    equations = ImageEquations(
        [
            CameraEquation(image=images[name], gain=even_gain[name], floor=floor, projector=weights.projector(name))
            for name in names
        ]
    )
    sieve, column_sum = Sieve(0.0, weights.stored.shape), sum(matrix.sum(0) for matrix in dense).astype(np.float32)
    sums = [matrix.sum(0).astype(np.float32) for matrix in rows]
    sizes = ordered_subsets.step_sizes(column_sum, sums, np.ones(len(first), bool))
    state = State(to_device(first), momentum.Momentum(to_device(first)), ())
    partition = ordered_subsets.Partition(subsets, tuple(SmartStep(to_device(size), sieve) for size in sizes))
    with equations.locked():
        epochs = ordered_subsets.iterate_epochs(equations, state, sieve, partitions=[partition], epochs=3)
        found = to_host([epoch.state.coefficients for epoch in epochs][-1])
    np.testing.assert_allclose(found, twin, atol=TOLERANCE_TWIN * twin.max())


def test_agreement_is_the_number_of_subsets_for_one_will_and_nothing_for_opposite_ones():
    rng = np.random.default_rng(7)
    weight = rng.uniform(0, 2, 10_000).astype(np.float32)
    exponents = rng.normal(size=(4, weight.size)).astype(np.float32)

    def agreement(*each):
        found = ordered_subsets.Agreement(to_device(weight))
        for exponent in each:
            found.add(to_device(exponent))
        return found.measured()

    assert agreement(*[exponents[0]] * 4) == pytest.approx(4, rel=1e-6)
    assert agreement(exponents[0], -exponents[0]) == 0
    assert agreement(*exponents) == pytest.approx(1, abs=0.05)  # independent: 3 standard deviations are 0.03
    assert agreement(*np.zeros_like(exponents)) == 1
    dark = np.where(np.arange(weight.size) < 10, np.float32(1e3), 0)  # where the volume is dark, nothing counts
    weight[:10] = 0
    assert agreement(exponents[0] + dark, exponents[0] - dark) == pytest.approx(2, rel=1e-6)


def epochs_of(weights, images, partitions, epochs, last_conflict=0.0):
    """Numbers of subsets of the epochs, from an even volume on; `partitions` are tuples of subsets.

    All but the last are left where they conflict, and the last one where it agrees less than `last_conflict`.
    """
    names, even_gain = list(weights.cameras), {name: weights.gain(name) for name in weights.cameras}
    equations = ImageEquations(
        [
            CameraEquation(image=images[name], gain=even_gain[name], floor=0.5, projector=weights.projector(name))
            for name in names
        ]
    )
    sieve, lit = Sieve(0.0, weights.stored.shape), np.ones(weights.grid.size, bool)
    made = []
    for number, subsets in enumerate(partitions):
        sums = [sum(weights.sums_of_set(names[camera], part) for camera, part in one.parts) for one in subsets]
        sizes = ordered_subsets.step_sizes(weights.camera_sums.sum(0), sums, lit)
        conflict = ordered_subsets.CONFLICT if number + 1 < len(partitions) else last_conflict
        in_turn = tuple(SmartStep(to_device(size), sieve) for size in sizes)
        made.append(ordered_subsets.Partition(subsets, in_turn, conflict=conflict))
    first = to_device(np.full(weights.grid.size, 1e3, np.float32))
    state = State(first, momentum.Momentum(first), ())
    with equations.locked():
        found = list(ordered_subsets.iterate_epochs(equations, state, sieve, partitions=made, epochs=epochs))
    return [epoch.subsets for epoch in found]


def test_subsets_that_conflict_are_followed_by_larger_ones(weights):
    """Images of a volume are explained by all subsets, images of noise by none."""
    rng = np.random.default_rng(8)
    halves, cameras, one = (
        ordered_subsets.subsets_of(2, 2), ordered_subsets.subsets_of(2), ordered_subsets.subsets_of(1)
    )  # fmt: skip
    truth = rng.uniform(500, 2e3, weights.grid.shape).astype(np.float32)
    explained = {name: image.reshape(-1) for name, image in weights(truth).items()}
    noise = {name: rng.exponential(20, image.size).astype(np.float32) for name, image in explained.items()}
    assert epochs_of(weights, explained, [halves, cameras], 4) == [4, 4, 4, 4]
    found = epochs_of(weights, noise, [halves, cameras], 6)
    assert len(found) == 6 and found[0] == 4 and found[-1] == 2 and found == sorted(found, reverse=True)
    assert epochs_of(weights, noise, [halves], 6) == [4] * 6
    assert epochs_of(weights, noise, [halves, one], 6) == [4] * found.count(4)
    left = {"last_conflict": ordered_subsets.CONFLICT}
    assert epochs_of(weights, noise, [halves], 6, **left) == [4] * found.count(4)
    assert epochs_of(weights, explained, [halves], 4, **left) == [4] * 4


def unlike_bright(weights, truth, deviation):
    """Images of voxels whose brightness differs from camera to camera, by a log-normal factor."""
    rng = np.random.default_rng(9)
    return {
        name: weights(truth * rng.lognormal(0, deviation, truth.shape).astype("f4"))[name] for name in weights.cameras
    }


@pytest.mark.slow
def test_auto_takes_larger_subsets_where_cameras_contradict_each_other(volume_of_blobs, caplog):
    weights, truth, images = volume_of_blobs
    unlike = unlike_bright(weights, truth, 1.2)
    keywords = {"iterations": 14, "sieve_voxel": 0.6}
    auto, four = (plain_steps.reconstruct(weights, images, subsets=number, **keywords) for number in ("auto", 4))
    np.testing.assert_array_equal(auto, four)
    with caplog.at_level(logging.DEBUG, ordered_subsets.__name__):
        auto, four = (plain_steps.reconstruct(weights, unlike, subsets=number, **keywords) for number in ("auto", 4))
    assert sum("larger subsets follow" in record.message for record in caplog.records) == 1
    assert not np.array_equal(auto, four)


def test_a_change_of_the_subsets_is_no_stop_by_tolerance(volume_of_blobs):
    """The sum of the misfits hardly falls from the last epoch of halves to the first one of whole cameras."""
    weights, truth, _ = volume_of_blobs
    images, keywords = unlike_bright(weights, truth, 0.7), {"iterations": 12, "sieve_voxel": 0.6, "subsets": "auto"}
    found, never = (plain_steps.reconstruct(weights, images, tolerance=value, **keywords) for value in (0.01, 0.0))
    assert found.attrs["misfit"] == never.attrs["misfit"]


def test_sums_of_sets_are_those_of_the_dense_weights(weights):
    for name, camera in weights.cameras.items():
        for half in (EVEN, ODD):
            pixels = weights.projector(name).exclusive_pixels(half)
            expected = camera.gain.ravel()[pixels] @ reference.dense(weights.projector(name).blocks)[pixels]
            np.testing.assert_allclose(weights.sums_of_set(name, half), expected, rtol=1e-4, atol=1e-6)


def test_fourteen_passes_over_subsets_reach_the_misfit_and_truth_of_forty_iterations(volume_of_blobs):
    weights, truth, images = volume_of_blobs
    plain = plain_steps.reconstruct(weights, images, 40, sieve_voxel=0.6)
    fast = plain_steps.reconstruct(weights, images, 14, sieve_voxel=0.6, subsets="auto")
    assert fast.attrs["misfit"][-1] <= plain.attrs["misfit"][-1]
    assert (
        lfpiv.metrics.reconstruction_quality(fast, truth) >= lfpiv.metrics.reconstruction_quality(plain, truth) - 2e-3
    )


@pytest.mark.parametrize("iterations", [0, 1, 2, 5])
def test_the_first_misfit_is_that_of_the_first_guess(volume_of_blobs, iterations):
    weights, _, images = volume_of_blobs
    guess = plain_steps.reconstruct(weights, images, 0, sieve_voxel=0.6)
    volume = plain_steps.reconstruct(weights, images, iterations, sieve_voxel=0.6, subsets=4)
    assert volume.attrs["misfit"][0] == pytest.approx(guess.attrs["misfit"][0], rel=1e-9)
    assert volume.attrs["iterations"] == iterations and len(volume.attrs["residual"]) == iterations + 1


def test_a_stop_by_tolerance_is_one_of_whole_passes(volume_of_blobs):
    weights, _, images = volume_of_blobs
    volume = plain_steps.reconstruct(weights, images, 60, sieve_voxel=0.6, subsets=4, tolerance=3e-3)
    misfit = volume.attrs["misfit"]
    assert volume.attrs["iterations"] < 60 and volume.attrs["stop"].startswith("misfit no longer falls")
    assert 0 <= misfit[-2] - misfit[-1] < 3e-3 * misfit[-2]


@pytest.mark.parametrize(
    ("settings", "cameras", "expected"),
    [
        ({"subsets": "auto"}, 2, 4),
        ({"subsets": "auto"}, 1, 2),
        ({"subsets": 2}, 2, 2),
        ({"subsets": 1}, 2, 1),
        ({"subsets": "auto", "accelerate": False}, 2, 1),
        ({"subsets": "auto", "normalisation": "paper"}, 2, 1),
    ],
)
def test_the_number_of_subsets(weights, settings, cameras, expected):
    some = weights if cameras == 2 else weights.of_camera(next(iter(weights.cameras)))
    assert isinstance(some, Weights) and len(SmartSolver(some, SmartSettings(**settings)).subsets) == expected


def test_subsets_that_cannot_be_made_are_refused(weights):
    with pytest.raises(ValueError, match="subsets: with these cameras expected one of 1, 2, 4, got 3"):
        plain_steps.reconstruct(weights, weights(np.ones(weights.grid.shape)), 2, subsets=3)
    for wrong in (0, -1, 2.5, "many", True):
        with pytest.raises(ValueError, match="subsets: expected"):
            SmartSettings(subsets=wrong)
    with pytest.raises(ValueError, match="subsets: ordered subsets need momentum"):
        SmartSettings(subsets=4, accelerate=False)
