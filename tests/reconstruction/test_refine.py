"""`PreparedFrame.refine`: steps by a part of the rays from a first guess that shows where particles are."""

import numpy as np
import pytest
from support.noisy_blobs import noisy_blobs

from lfpiv.reconstruction.first_guess import FAINTEST, LEAST_FLOOR_SHARE
from lfpiv.reconstruction.normalisation import COMPARED, FOLLOWED_STEPS
from lfpiv.reconstruction.ordered_subsets import CORRECTING, FEWEST_ROWS, Subset, correcting_subset, joint_subsets
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.weights.forms import shared_profiles
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.transfer import to_device, to_host

SIEVES = (0.6, 0.0)
TOLERANCE_SAMPLE = 0.1  # misfits of some ray rows stand for those of all; rows differ by their noise and their pupil
TOLERANCE_ROW = 0.3  # of a single row at the edge of the pupil; without scaling it would be a fifteenth
TOLERANCE_F32 = 2e-5  # a truth in float32 against its own images, after some steps
TOLERANCE_LIGHT = 0.02  # light of projections of two guesses: voxels at the faces are seen by few rows
ALIKE = 0.95  # correlation of guesses by a quarter of the rays and by all
FADED = 0.7  # brightness of each other particle in a guess
GAIN = 0.5  # error of the particles' brightness that is left after the steps: 0.2 to 0.35 here


@pytest.fixture(scope="module", params=["voxels", "planes"])
def recorded(request, device):
    """Weights of voxels or of planes of voxels, a true volume and its images."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "planes":
            patch.setattr(shared_profiles, "FEWEST_VOXELS", 0)
        return noisy_blobs(40)


def prepared_from(recorded, sieve_voxel, images=None):
    settings = SmartSettings(iterations=10, sieve_voxel=sieve_voxel, intensity_cap=0.0)
    return SmartSolver(recorded[0], settings).prepare(recorded[2] if images is None else images)


def partitions_of(prepared):
    """Partitions of both uses: from the instant before, and from those beside it."""
    return [*prepared.normalisation.followed, prepared.normalisation.correcting]


@pytest.mark.slow(but="voxels")
@pytest.mark.parametrize("sieve_voxel", SIEVES)
def test_misfits_of_some_rays_stand_for_those_of_all(recorded, sieve_voxel):
    prepared, guess = prepared_from(recorded, sieve_voxel), recorded[1].astype(np.float32)
    normal, equations = prepared.normalisation, prepared.equations

    def misfit(coefficients):
        with equations.locked():
            return equations.compare(to_device(coefficients, float))

    def norm(found):
        images = (one.image.astype(float) for one in prepared.images.values())
        return np.sqrt(found.squares / sum((image**2).sum() for image in images))

    sieved = normal.sieve(to_device(prepared.stored.store(guess), float))
    before = misfit(sieved)
    for partition in partitions_of(prepared):
        first = partition.part(slice(1))  # the guess is not changed before its misfit is taken
        found = prepared.refine(guess, [first], epochs=1)
        after = misfit(prepared.stored.store(found.volume))
        assert found.misfit[0] == pytest.approx(before.divergence, rel=TOLERANCE_ROW)
        assert found.residual[0] == pytest.approx(norm(before), rel=TOLERANCE_ROW)
        assert found.misfit[1] == pytest.approx(after.divergence, rel=TOLERANCE_SAMPLE)
        assert found.residual[1] == pytest.approx(norm(after), rel=TOLERANCE_SAMPLE)


@pytest.mark.slow(but="voxels")
@pytest.mark.parametrize("sieve_voxel", SIEVES)
def test_the_truth_is_a_fixed_point(recorded, sieve_voxel):
    weights, truth, _ = recorded
    prepared = prepared_from(recorded, sieve_voxel)
    coefficients = np.where(truth > 0.01 * truth.max(), truth, 0).astype(np.float32)
    sieved = prepared.normalisation.sieve(to_device(prepared.stored.store(coefficients), float))
    volume = prepared.stored.restore(sieved.numpy())
    exact = prepared_from(recorded, sieve_voxel, weights(volume))
    for partition in partitions_of(exact):
        for time in (1.0, 8.0):
            found = exact.refine(coefficients, [partition], epochs=1, time=time)
            assert np.abs(found.volume - volume).max() < TOLERANCE_F32 * volume.max()


@pytest.mark.parametrize("sieve_voxel", SIEVES)
def test_steps_by_some_rays_correct_the_brightness_of_particles(recorded, sieve_voxel):
    weights, truth, _ = recorded
    prepared = prepared_from(recorded, sieve_voxel)
    x = weights.grid.axis_mm(2)
    wrong = np.where(np.sin(12 * x) > 0, FADED, 2 - FADED).astype(np.float32) * truth.astype(np.float32)
    light = truth.sum(dtype=np.float64)

    def error(volume):
        """Of the light of slices of the volume, which noise and the size of particles do not change."""
        slices = (volume.sum((0, 1), dtype=np.float64), truth.sum((0, 1), dtype=np.float64))
        return np.abs(slices[0] / volume.sum(dtype=np.float64) - slices[1] / light).sum()

    for partition in prepared.normalisation.followed:
        found = prepared.refine(wrong, [partition], epochs=1, time=8.0)
        assert error(found.volume) < GAIN * error(wrong)
    assert np.isnan(prepared.refine(wrong, [partition], epochs=1, brief=True).misfit[-1])


def test_a_momentum_that_begins_later_makes_longer_first_steps(recorded):
    prepared, guess = prepared_from(recorded, 0.0), recorded[1].astype(np.float32) + np.float32(1e-3)
    step = [prepared.normalisation.correcting]
    plain, longer = (prepared.refine(guess, step, epochs=1, time=time).volume for time in (1.0, 2.0))
    lit = (plain > 0) & (np.abs(np.log(plain / guess, where=plain > 0)) > 1e-3)
    exponent = 1 / ((1 + np.sqrt(17)) / 2)  # (t - 1) / t' for t = 2
    ratio = np.log(longer[lit] / guess[lit]) / np.log(plain[lit] / guess[lit])
    assert np.median(ratio) == pytest.approx(1 + exponent, rel=1e-3)


@pytest.mark.parametrize("sieve_voxel", SIEVES)
def test_a_guess_by_a_part_of_the_rays_equals_its_twin(recorded, sieve_voxel):
    """expm1 of the mean logarithm of the pixels that these rays see, brightened to the light of all images."""
    weights = recorded[0]
    prepared = prepared_from(recorded, sieve_voxel)
    normal, whole, found = prepared.normalisation, prepared.solve(iterations=0), prepared.guess()
    if weights.rows == 1:
        np.testing.assert_array_equal(found.volume, whole.volume)
        return
    names, (subset,) = list(weights.cameras), normal.correcting.subsets
    logarithm, total = (np.zeros(weights.grid.size, np.float32) for _ in range(2))
    for camera, ray_set in subset.parts:
        one, projector = prepared.images[names[camera]], weights.projector(names[camera])
        gain = weights.gain(names[camera]) * np.float32(one.camera_gain)
        floor = max(one.floor, LEAST_FLOOR_SHARE * one.peak)
        projector.back_project(gain * np.log1p(one.image / np.float32(floor)), logarithm, ray_set)
        projector.back_project(gain, total, ray_set)
    lit = to_host(normal.lit) > 0
    assert 0.1 < total.sum() / to_host(normal.column_sum).sum() < 0.5 and (total[lit] > 0).all()
    expected = np.expm1(np.divide(logarithm, total, out=np.zeros_like(total), where=lit))
    expected = np.where(lit, np.maximum(expected, FAINTEST * expected.max()), 0)
    expected = prepared.stored.restore(to_host(normal.sieve(to_device(expected.astype(np.float32), float))))
    light = whole.volume.sum(dtype=float)
    assert found.volume.sum(dtype=float) == pytest.approx(light, rel=TOLERANCE_LIGHT)
    expected *= found.volume.sum(dtype=float) / expected.sum(dtype=float)
    np.testing.assert_allclose(found.volume, expected, atol=TOLERANCE_F32 * expected.max())
    assert np.corrcoef(found.volume.ravel(), whole.volume.ravel())[0, 1] > ALIKE
    if sieve_voxel == 0:  # it would be blurred once more
        assert prepared.sampled_misfit() == pytest.approx(prepared.sampled_misfit(found.volume), rel=TOLERANCE_F32)


@pytest.mark.parametrize("rows", [1, 2, 3, 5, 7, 9, 11, 12, 15, 30])
def test_a_correction_takes_rows_that_lie_apart_and_were_not_sampled(rows):
    parts, chosen = correcting_subset(2, rows)
    taken = sorted({row for _, row in parts[chosen].parts})
    assert len(parts[chosen].parts) == 2 * len(taken) and {camera for camera, _ in parts[chosen].parts} == {0, 1}
    assert len(taken) >= min(rows, FEWEST_ROWS) and len(set(np.diff(taken))) <= 1
    assert len(parts) == CORRECTING or len(taken) < 2 * FEWEST_ROWS
    sampled = {row for one in joint_subsets(2, rows, rows)[: -(-rows // COMPARED)] for _, row in one.parts}
    assert len(taken) == rows or not sampled & set(taken)


def test_without_subsets_all_rays_of_all_cameras_follow_an_instant(recorded):
    solver = SmartSolver(recorded[0], SmartSettings(subsets=1))
    assert solver.subsets == (Subset(((0, ALL), (1, ALL))),)
    assert not solver.prepare(recorded[2]).normalisation.followed  # whole passes follow


@pytest.mark.parametrize("sieve_voxel", SIEVES)
def test_rows_of_pixels_where_there_are_some(recorded, sieve_voxel):
    normal = prepared_from(recorded, sieve_voxel).normalisation
    (correcting,) = normal.correcting.subsets
    if recorded[0].rows == 1:
        assert correcting == Subset(((0, ALL), (1, ALL))) and normal.followed == normal.partitions
        return
    rows = min(recorded[0].projector(name).ray_sets for name in recorded[0].cameras)
    parts, chosen = correcting_subset(2, rows)
    assert correcting == parts[chosen] and len(correcting.parts) < 2 * rows
    (whole,), (followed,) = normal.partitions, normal.followed
    assert followed.subsets == whole.subsets[: FOLLOWED_STEPS if sieve_voxel == 0 else None]
