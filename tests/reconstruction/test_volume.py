"""SMART: convergence to the minimum of its divergence, its invariants, and a particle that comes back in its place."""

import logging
import re
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy import ndimage
from scipy.optimize import minimize
from support import plain_steps
from support.ideal_rig import IdealCamera, IdealRig, optics, two_cameras
from support.noisy_blobs import NOISE as NOISE_OF_BLOBS
from support.noisy_blobs import noisy_blobs
from support.plain_rays import plain

import lfpiv
from lfpiv.calibration import coverage
from lfpiv.reconstruction import momentum, sieve, smart, steps
from lfpiv.results import netcdf
from lfpiv.weights.operator import Weights
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels import reference, runtime
from lfpiv_kernels.reconstruction import update as kernels
from lfpiv_kernels.reconstruction import voxels
from lfpiv_kernels.reconstruction.projector import Blocks, Projector
from lfpiv_kernels.reconstruction.sums import Totals
from lfpiv_kernels.transfer import to_device, to_host
from lfpiv_kernels.weights import ray_model

TOLERANCE_F32 = 2e-4  # 50 iterations of float32 steps whose sums have <= 60 terms: 50 * 60 * 6e-8
TOLERANCE_NEAR = 5e-3  # projections rounded by 6e-8 in differences of 1e-4 from the image, over 300 pixels
TOLERANCE_RATIO = 1e-6  # logarithms up to 6 in float32, relative to a voxel's weights
TOLERANCE_MISFIT = 1e-6  # a misfit is a float32 image's sum: rounding of 24 pixels relative to their light
TOLERANCE_NOISE = 0.1  # faint light adds to the noise of dark pixels, as in test_dark_noise
TOLERANCE_LIMIT = 2e-3  # SMART converges linearly: what is left after 2,000 iterations in float32, 400 with momentum


def random_system(seed, voxels=(3, 4, 5), rows=4, lit=0.4):
    """Operator of two cameras of `rows` x 8 pixels with random sparse weights: fewer pixels than voxels."""
    runtime.device()
    rng = np.random.default_rng(seed)
    grid = lfpiv.Grid(shape=voxels, voxel_mm=1.0, first_centre_mm=(0.0, 0.0, 0.0))
    cameras, projectors = {}, {}
    for name in ("one", "two"):
        value = rng.integers(1, 256, (grid.size * rows, 8)) * (rng.random((grid.size * rows, 8)) < lit)
        value[::rows, 0] = 100  # every voxel lights something
        blocks = Blocks(
            form="pixels",
            first_block=np.arange(grid.size + 1, dtype=np.int32),
            first_value=np.arange(grid.size + 1, dtype=np.int64) * rows * 8,
            ray=np.zeros(grid.size, np.int32),
            height=np.full(grid.size, rows, np.uint8),
            width=np.full(grid.size, 8, np.uint8),
            value=np.append(value, np.zeros(8)).astype(np.uint8),
            scale=rng.uniform(0.5, 1.5, grid.size).astype(np.float32) / ray_model.LEVELS,
            microimages=plain((rows, 8)),
        )
        optics = SimpleNamespace(sensor_shape=(rows, 8))
        cameras[name] = SimpleNamespace(optics=optics, gain=np.ones((rows, 8), np.float32))
        projectors[name] = Projector(blocks)
    return Weights(StoredGrid(grid, (1, 0, 2)), cameras, projectors, "footprint")


def matrix_of(weights):
    """Dense matrix of all cameras on voxels in (z, y, x) order, padding left out."""
    order = weights.stored.restore(np.arange(weights.grid.size)).ravel()
    return np.concatenate([reference.dense(weights.projector(name).blocks)[:, order] for name in weights.cameras])


def images_of(weights, stacked):
    size = stacked.size // len(weights.cameras)
    return {
        name: stacked[k * size : (k + 1) * size].reshape(camera.gain.shape).astype(np.float32)
        for k, (name, camera) in enumerate(weights.cameras.items())
    }


def divergence(matrix, image, volume, floor):
    """The misfit of the module's head, in double precision."""
    projected = matrix @ volume.astype(float) + floor
    return (projected * np.log(projected / (image + floor)) - projected + image + floor).sum()


def accelerated_twin(matrix, image, first, *, iterations, floor):
    """SMART with momentum, slow and in double precision; returns the volume and how often momentum was given up."""
    point = last = first.astype(float)
    time, restarts, misfit = 1.0, 0, divergence(matrix, image, point, floor)
    for _ in range(iterations):
        following = reference.smart(matrix, image, point, iterations=1, floor=floor)
        later = (1 + np.sqrt(1 + 4 * time**2)) / 2
        ratio = np.clip(following / last, 1 / kernels.LARGEST_LEAP, kernels.LARGEST_LEAP)
        ahead = following * ratio ** min((time - 1) / later, momentum.MOMENTUM)
        if divergence(matrix, image, ahead, floor) > misfit:
            point, time, restarts = following, 1.0, restarts + 1
        else:
            point, time = ahead, later
        last, misfit = following, divergence(matrix, image, point, floor)
    return point, restarts


@pytest.mark.slow(but="0-True")
@pytest.mark.parametrize(
    ("seed", "accelerate", "iterations"), [(0, False, 2_000), (0, True, 400), (1, True, 400), (2, True, 400)]
)
def test_smart_reaches_the_solution_of_least_divergence(seed, accelerate, iterations):
    """On a consistent underdetermined system SMART must end at argmin sum_j s_j KL(x_j, x0_j) with W x = I."""
    weights = random_system(seed, rows=1, lit=0.4)
    matrix = matrix_of(weights)
    assert np.linalg.matrix_rank(matrix) < weights.grid.size  # many solutions: the divergence picks one
    rng = np.random.default_rng(seed + 100)
    truth = rng.uniform(0.5, 2.0, weights.grid.size)
    first = rng.uniform(0.5, 2.0, weights.grid.size)
    image, column_sum = matrix @ truth, matrix.sum(0)

    def dual(multiplier):  # the solution is x0 exp(W' m / s) with the multipliers m that minimise this
        x = first * np.exp(matrix.T @ multiplier / column_sum)
        return (column_sum * x).sum() - image @ multiplier, matrix @ x - image

    best = minimize(dual, np.zeros(len(image)), jac=True, method="BFGS", options={"gtol": 1e-10, "maxiter": 5000}).x
    expected = first * np.exp(matrix.T @ best / column_sum)
    assert np.allclose(matrix @ expected, image, rtol=1e-5)
    volume = plain_steps.reconstruct(
        weights,
        images_of(weights, image),
        iterations=iterations,
        accelerate=accelerate,
        floor=0.0,
        floor_share=0.0,
        first=first.reshape(weights.grid.shape).astype(np.float32),
    )
    assert np.abs(volume.values.ravel() / expected - 1).max() <= TOLERANCE_LIMIT
    assert np.abs(expected / truth - 1).max() > 10 * TOLERANCE_LIMIT  # the test could have failed


@pytest.mark.parametrize("normalisation", ["column", "paper"])
@pytest.mark.parametrize("floor", [0.0, 0.3])
def test_smart_equals_its_dense_twin(normalisation, floor):
    weights = random_system(5)
    matrix = matrix_of(weights)
    rng = np.random.default_rng(6)
    image = rng.uniform(0.1, 3.0, len(matrix))
    first = rng.uniform(0.5, 2.0, weights.grid.size).astype(np.float32)
    volume = plain_steps.reconstruct(
        weights,
        images_of(weights, image),
        iterations=50,
        relaxation=0.9,
        floor=floor,
        floor_share=0.0,
        normalisation=normalisation,
        accelerate=False,
        first=first.reshape(weights.grid.shape),
    )
    twin = reference.smart(
        matrix, image, first, iterations=50, relaxation=0.9, floor=floor, paper=normalisation == "paper"
    )
    assert np.abs(volume.values.ravel() / twin - 1).max() <= TOLERANCE_F32


@pytest.mark.parametrize(("seed", "iterations"), [(4, 50), (5, 50), (6, 80)])
def test_momentum_equals_its_dense_twin(seed, iterations):
    """Restarts included, which these systems, of fewer pixels than voxels, call for before float32 ends."""
    weights = random_system(seed, rows=1)
    matrix = matrix_of(weights)
    rng = np.random.default_rng(seed)
    image = (matrix @ rng.random(weights.grid.size)).astype(np.float32)
    first = np.exp(rng.normal(0, 1, weights.grid.size)).astype(np.float32)
    twin, restarts = accelerated_twin(matrix, image, first, iterations=iterations, floor=0.1)
    assert restarts > 0
    volume = plain_steps.reconstruct(
        weights,
        images_of(weights, image),
        iterations=iterations,
        floor=0.1,
        floor_share=0.0,
        first=first.reshape(weights.grid.shape),
    )
    assert np.abs(volume.values.ravel() - twin).max() <= TOLERANCE_F32 * twin.max()
    assert (np.diff(volume.misfit) <= TOLERANCE_MISFIT * image.sum()).all()


def test_momentum_that_only_harms_leaves_plain_smart(monkeypatch):
    """Every iteration it spoils is done again without it, so what is recorded and returned is plain SMART's."""
    weights = random_system(6)
    images, _ = noisy_images(weights, 6)

    def spoil(*arguments, extrapolation, stepped, **keywords):
        kernels.update(*arguments, extrapolation=extrapolation, stepped=stepped, **keywords)
        if extrapolation is not None and extrapolation.exponent > 0:
            voxels.multiply(stepped, voxels.ones(stepped.size), extrapolation.ahead, factor=1e3)

    plain = plain_steps.reconstruct(weights, images, iterations=12, accelerate=False)
    monkeypatch.setattr(steps, "update", spoil)
    spoilt = plain_steps.reconstruct(weights, images, iterations=12)
    assert spoilt.values.tobytes() == plain.values.tobytes()
    assert spoilt.misfit == plain.misfit


def noisy_images(weights, seed):
    """Images that no volume explains: 30 % off pixel by pixel, one in ten dark; as a mapping and as one vector."""
    rng = np.random.default_rng(seed)
    matrix = matrix_of(weights)
    image = matrix @ rng.random(weights.grid.size) ** 4 * rng.uniform(0.7, 1.3, len(matrix))
    image[rng.random(image.size) < 0.1] = 0.0
    return images_of(weights, image), image.astype(np.float32)


@pytest.mark.parametrize("distance", [1.0, 1e-4])
def test_comparison_equals_its_twin_far_from_the_minimum_and_at_it(distance):
    """With gains, dead pixels and pixels no voxel lights; and so near the minimum that log(I / P) loses its digits."""
    weights, rng = random_system(7, rows=40, lit=0.03), np.random.default_rng(7)
    projector = weights.projector("one")
    matrix, floor = reference.dense(projector.blocks), 0.2
    volume = rng.uniform(0.5, 2.0, matrix.shape[1]).astype(np.float32)
    gain = rng.uniform(0.5, 1.5, len(matrix)).astype(np.float32) * (rng.random(len(matrix)) > 0.1)
    projected = gain * (matrix @ volume.astype(float))
    image = (projected * np.exp(distance * rng.normal(size=len(matrix)))).astype(np.float32)
    if distance == 1.0:
        image[(matrix.sum(1) == 0) & (gain > 0)] = 0.7  # light from elsewhere
        image[rng.random(len(image)) < 0.1] = 0.0
    comparison = kernels.Comparison(projector, image, gain, floor)
    image = image.astype(float)
    ratio = np.log((image + floor) / (projected + floor))
    terms = image - projected - (projected + floor) * ratio
    totals = Totals(2)
    comparison.compare(volume, totals)
    squares, misfit = totals.read()
    lit = matrix.sum(1) > 0  # what the others recorded is none of the voxels' business
    assert squares == pytest.approx(np.square(image - projected)[lit].sum(), rel=TOLERANCE_NEAR)
    assert misfit == pytest.approx(terms[lit].sum(), rel=TOLERANCE_NEAR)
    seen, added = rng.random(len(volume)) < 0.5, np.ones_like(volume)
    projector.gather(added, active=seen.astype(np.float32))
    expected = 1 + seen * (matrix.T @ (gain * ratio))
    assert np.abs(added - expected).max() <= TOLERANCE_RATIO * matrix.sum(0).max()


def test_threads_that_share_weights_take_turns():
    """Each camera holds the light of one volume at a time: of two threads one waits, and a callback is refused."""
    weights = lfpiv.build_weights(
        two_cameras(), lfpiv.Grid.from_extent(centre_mm=(0,) * 3, size_mm=(1.5,) * 3, voxel_mm=0.1)
    )
    volumes = np.random.default_rng(0).random((8, *weights.grid.shape)).astype(np.float32)
    alone = [weights(volume) for volume in volumes]
    with ThreadPoolExecutor(4) as threads:
        together = list(threads.map(weights, volumes))
    assert all((a[name] == b[name]).all() for a, b in zip(alone, together, strict=True) for name in a)
    one, other = (plain_steps.reconstruct(weights, images, 5).values for images in alone[:2])
    with ThreadPoolExecutor(2) as threads:
        both = list(threads.map(lambda images: plain_steps.reconstruct(weights, images, 5).values, alone[:2]))
    assert both[0].tobytes() == one.tobytes() and both[1].tobytes() == other.tobytes()
    for meddle in (
        lambda _: weights(volumes[0]),
        lambda _: plain_steps.reconstruct(weights, alone[0], 1, first=volumes[0]),
    ):
        with pytest.raises(RuntimeError, match="in use by a reconstruction of the same thread"):
            plain_steps.reconstruct(weights, alone[0], 5, progress=meddle)
    assert (
        plain_steps.reconstruct(weights, alone[0], 5).values.tobytes() == one.tobytes()
    )  # the refusal left nothing behind


@pytest.mark.parametrize("seed", range(4))
def test_momentum_needs_at_most_half_the_iterations(seed):
    weights = random_system(seed)
    images, _ = noisy_images(weights, seed)
    plain, fast = (
        plain_steps.reconstruct(
            weights, images, iterations=40, floor=0.05, floor_share=0.0, accelerate=accelerate
        ).misfit
        for accelerate in (False, True)
    )
    assert fast[20] < plain[40]
    assert fast[:2] == plain[:2]  # the first iteration has nothing to repeat


def test_twelve_iterations_are_five_and_seven():
    weights = random_system(3)
    image = images_of(weights, matrix_of(weights) @ np.random.default_rng(3).random(weights.grid.size))
    twelve = plain_steps.reconstruct(weights, image, iterations=12, accelerate=False)
    five = plain_steps.reconstruct(weights, image, iterations=5, accelerate=False)
    seven = plain_steps.reconstruct(weights, image, iterations=7, first=five.values, accelerate=False)
    assert seven.values.tobytes() == twelve.values.tobytes()
    five = plain_steps.reconstruct(weights, image, iterations=5)
    seven = plain_steps.reconstruct(weights, image, iterations=7, first=five.values)
    assert (
        seven.misfit[0] == five.misfit[-1] > seven.misfit[-1]
    )  # momentum starts anew, from where the first ones ended


@pytest.mark.parametrize("accelerate", [False, True])
def test_zeros_of_the_first_guess_stay_and_change_nothing_else(accelerate):
    """Dark voxels are as if the operator had no such columns."""
    weights = random_system(9)
    matrix = matrix_of(weights)
    images, image = noisy_images(weights, 9)
    first = np.random.default_rng(9).uniform(0.5, 2.0, weights.grid.shape).astype(np.float32)
    first[np.random.default_rng(10).random(first.shape) < 0.5] = 0.0
    lit = first.ravel() > 0
    volume = plain_steps.reconstruct(
        weights, images, iterations=20, floor=0.2, floor_share=0.0, first=first, accelerate=accelerate
    )
    assert (volume.values[first == 0] == 0).all()
    arguments = (matrix[:, lit], image, first.ravel()[lit])
    if accelerate:
        twin, _ = accelerated_twin(*arguments, iterations=20, floor=0.2)
    else:
        twin = reference.smart(*arguments, iterations=20, floor=0.2)
    assert np.abs(volume.values.ravel()[lit] - twin).max() <= TOLERANCE_F32 * twin.max()


def test_a_sieve_is_smart_on_blurred_voxels():
    """With E = G c it must equal SMART for c with the operator W G."""
    weights = random_system(12)
    _, image = noisy_images(weights, 12)
    first = np.random.default_rng(12).uniform(0.5, 2.0, weights.grid.shape).astype(np.float32)
    size = weights.grid.size
    blur = np.array(
        [
            ndimage.gaussian_filter(row.reshape(first.shape), 0.6, mode="constant", truncate=sieve.TRUNCATE).ravel()
            for row in np.eye(size)
        ]
    )
    assert np.allclose(blur, blur.T)
    twin = reference.smart(matrix_of(weights) @ blur, image, first.ravel(), iterations=30, floor=0.2)
    volume = plain_steps.reconstruct(
        weights,
        images_of(weights, image),
        iterations=30,
        floor=0.2,
        floor_share=0.0,
        first=first,
        sieve_voxel=0.6,
        accelerate=False,
    )
    assert np.abs(volume.values.ravel() / (blur @ twin) - 1).max() <= TOLERANCE_F32


@pytest.mark.parametrize("seed", range(4))
def test_sharp_steps_reach_the_images_in_half_the_iterations(seed):
    """With a sieve, plain momentum and sharp steps solve W G c = I; sharp ones are faster and leave solutions alone."""
    weights = random_system(seed, voxels=(6, 6, 6))
    shape, (truth, start) = weights.grid.shape, np.random.default_rng(seed).uniform(0.5, 2.0, (2, 216))
    blur = sieve.Sieve(0.6, weights.stored.shape)
    order = weights.stored.store(truth.reshape(shape).astype(np.float32))
    volume = weights.stored.restore(blur(order))
    keywords = {"floor": 1e-3, "floor_share": 0.0, "sieve_voxel": 0.6}
    stays = plain_steps.reconstruct(weights, weights(volume), iterations=20, first=truth.reshape(shape), **keywords)
    assert np.abs(stays.values / volume - 1).max() <= TOLERANCE_F32
    sharp, plain = (_misfits(weights, weights(volume), start.reshape(shape), sharp) for sharp in (True, False))
    assert sharp[30] < plain[60] < plain[0]


def _misfits(weights, images, first, sharp):
    """Misfits of 60 iterations with a sieve and momentum, with sharp steps or without."""
    blur, total = sieve.Sieve(0.6, weights.stored.shape), weights.stored.store(weights.column_sum)
    sharpened = (steps.SharpenedStep(to_device(1 / total), blur),) if sharp else ()
    guess = to_device(weights.stored.store(first.astype(np.float32)))
    plain = steps.SmartStep(to_device(1 / blur(total)), blur)
    state = smart.State(guess, momentum.Momentum(guess), (*sharpened, plain))
    states = smart.iterate(equations_of(weights, images, 1e-3), state, blur, iterations=60)
    return [misfit.divergence for _, misfit in states]


def equations_of(weights, images, floor):
    return smart.ImageEquations(
        [
            smart.CameraEquation(
                image=images[name].reshape(-1),
                gain=weights.gain(name),
                floor=floor,
                projector=weights.projector(name),
            )
            for name in weights.cameras
        ]
    )


@pytest.mark.parametrize("gain", [-1.0, 30.0])
def test_a_sharp_step_that_raises_the_misfit_is_taken_back(gain):
    weights = random_system(12)
    images, image = noisy_images(weights, 12)
    blur, total = sieve.Sieve(0.6, weights.stored.shape), weights.stored.store(weights.column_sum)

    def sharp(coefficients, exponent, memory):
        change = np.clip(gain * to_host(exponent) / total, -3, 3)
        stepped = to_device((to_host(coefficients) * np.exp(change)).astype(np.float32))
        return stepped, None if memory is None else memory.after(stepped)

    first = to_device(np.ones_like(total))
    plain = steps.SmartStep(to_device(1 / blur(total)), blur)
    state = smart.State(first, momentum.Momentum(first), (sharp, plain))
    states = smart.iterate(equations_of(weights, images, 0.2), state, blur, iterations=40)
    misfits = [misfit.divergence for _, misfit in states]
    assert (np.diff(misfits) <= TOLERANCE_MISFIT * image.sum()).all()
    assert misfits[-1] < 0.7 * misfits[0]


@pytest.mark.slow
def test_volumes_made_of_gaussians_are_smoothed_less_before_they_are_correlated():
    positions, grid = (
        np.random.default_rng(4).uniform(0, 1.6, (150, 3)),
        lfpiv.Grid(shape=(16, 16, 16), voxel_mm=0.1, first_centre_mm=(0.0, 0.0, 0.0)),
    )
    pair = [lfpiv.metrics.truth_volume(positions + shift, None, grid) for shift in (0.0, 0.07)]
    made = [volume.assign_attrs(sieve_voxel=sieve) for volume, sieve in zip(pair, (0.4, 0.3), strict=True)]
    less, same = (
        plain_steps.correlate(*volumes, dt_s=1.0, windows=(16, 8), smoothing_voxel=smoothing)
        for volumes, smoothing in ((made, 0.5), (pair, 0.4))
    )
    assert less["valid"].any() and "0.5" in less.attrs["settings"]  # what was asked for, the same for all pairs
    for name in ("displacement_x", "displacement_y", "displacement_z"):
        assert np.allclose(less[name], same[name], atol=TOLERANCE_F32)


def test_the_floor_is_the_noise_of_dark_pixels_by_default():
    weights, _, images = noisy_blobs(120)
    measured = plain_steps.reconstruct(weights, images, 2, floor_share=0.0)
    assert measured.floor == pytest.approx([NOISE_OF_BLOBS] * 2, rel=TOLERANCE_NOISE)
    floor = dict(zip(images, measured.floor, strict=True))
    given = plain_steps.reconstruct(weights, images, 2, floor=floor, floor_share=0.0)
    assert np.allclose(measured.values, given.values, rtol=TOLERANCE_F32)


def test_the_floor_is_at_least_a_share_of_the_brightness():
    weights = random_system(8)
    images, _ = noisy_images(weights, 8)
    brightness = {name: (image**2).sum() / image.sum() for name, image in images.items()}
    given = plain_steps.reconstruct(weights, images, floor={name: 0.2 * value for name, value in brightness.items()})
    shared = plain_steps.reconstruct(weights, images, floor=0.0, floor_share=0.2)
    assert np.allclose(shared.values, given.values, rtol=TOLERANCE_F32)
    assert np.allclose(shared.floor, [0.2 * value for value in brightness.values()])
    doubled = plain_steps.reconstruct(weights, {name: 2 * image for name, image in images.items()}, floor=0.0)
    once = plain_steps.reconstruct(weights, images, floor=0.0)
    assert np.allclose(doubled.values, 2 * once.values, rtol=TOLERANCE_F32)  # no count is special


def test_verdicts():
    weights = random_system(7)
    image = images_of(weights, matrix_of(weights) @ np.random.default_rng(7).random(weights.grid.size))
    assert plain_steps.reconstruct(weights, image, iterations=3).stop == "all iterations asked for were done"
    assert "iteration limit" in plain_steps.reconstruct(weights, image, iterations=3, tolerance=1e-6).stop
    early = plain_steps.reconstruct(weights, image, iterations=500, tolerance=0.05)
    assert "no longer falls" in early.stop
    assert early.iterations < 500


@pytest.mark.parametrize("iterations", [1, 5])
def test_a_misfit_beyond_all_numbers_is_divergence(iterations):
    weights = random_system(7)
    images, _ = noisy_images(weights, 7)
    keywords = {"relaxation": 1e4, "accelerate": False}
    assert "misfit rises" in plain_steps.reconstruct(weights, images, iterations, **keywords).stop


def test_dark_pixels_without_a_floor_do_not_end_it():
    """One dark pixel among many that shine has an infinite misfit without a floor: the least one keeps it finite."""
    weights = random_system(10)
    images, _ = noisy_images(weights, 10)
    volume = plain_steps.reconstruct(weights, images, 40, floor=0.0, floor_share=0.0)
    assert np.isfinite(volume.misfit).all() and volume.misfit[-1] < 0.5 * volume.misfit[0]
    assert np.isfinite(volume.values).all() and (volume.values > 0).any()


def test_light_outside_the_volume_and_dead_pixels_do_not_break_it():
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.8, 0.8, 0.8), voxel_mm=0.1)
    rig = two_cameras()
    for camera in rig.cameras.values():
        camera.gain[190:200] = 0.0  # dead rows
    weights = lfpiv.build_weights(rig, grid)
    truth = np.full(grid.shape, 0.01, np.float32)
    truth[4, 4, 4] = 1e5  # about 70 counts in its brightest pixels
    images = {name: image + 3.0 for name, image in weights(truth).items()}
    volume = plain_steps.reconstruct(weights, images, iterations=10, floor=1.0, floor_share=0.0)
    assert np.isfinite(volume.values).all()
    assert np.unravel_index(volume.values.argmax(), grid.shape) == (4, 4, 4)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"iterations": -1}, "iterations: expected a whole number"),
        ({"iterations": float("nan")}, "iterations: expected a whole number"),
        ({"relaxation": 0.0}, "relaxation: expected a number > 0"),
        ({"normalisation": "rows"}, "normalisation: expected one of"),
        ({"relaxation": float("nan")}, "relaxation: expected a number > 0"),
        ({"relaxation": "1"}, "relaxation: expected a number > 0"),
        ({"sieve_voxel": float("nan")}, "sieve_voxel: expected"),
        ({"sieve_voxel": "0.6"}, 'sieve_voxel: expected a number >= 0 or "auto"'),
        ({"sieve_voxel": None}, 'sieve_voxel: expected a number >= 0 or "auto"'),
        ({"tolerance": -0.1}, "tolerance: expected"),
        ({"floor_share": float("nan")}, "floor_share: expected"),
        ({"floor": float("nan")}, "floor: expected"),
        ({"floor": "auto"}, "floor: expected a number >= 0, or one for each camera"),
        ({"floor": {"one": 1.0}}, "floor: camera 'two' is missing"),
        ({"first": np.zeros((3, 4, 5))}, "first: expected finite values >= 0"),
        ({"first": np.full((3, 4, 5), np.nan)}, "first: expected finite values >= 0"),
        ({"first": np.ones((4, 4, 5))}, "first: expected shape"),
        ({"first": xr.DataArray(np.ones((5, 4, 3)), dims=("x", "y", "z"))}, r"first: expected dims \(z, y, x\)"),
    ],
)
def test_wrong_arguments_are_named(keywords, message):
    weights = random_system(0)
    image = images_of(weights, matrix_of(weights) @ np.ones(weights.grid.size))
    with pytest.raises(ValueError, match=message):
        plain_steps.reconstruct(weights, image, **keywords)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda images: images.pop("two"), "camera 'two' is missing"),
        (lambda images: images.update(one=np.zeros((3, 3))), r"images\['one'\]: expected shape"),
        (lambda images: images.update(one=np.zeros((4, 8))), "expected some light"),
        (lambda images: images.update(one=np.full((4, 8), np.nan)), "expected finite counts"),
        (lambda images: images.update(one=images["one"] * 1j), "expected an array of counts"),
    ],
)
def test_wrong_images_are_named(change, message):
    weights = random_system(0)
    images = images_of(weights, matrix_of(weights) @ np.ones(weights.grid.size))
    change(images)
    with pytest.raises(ValueError, match=message):
        plain_steps.reconstruct(weights, images)


FEW_RAYS, MANY_RAYS = 0.05, 0.2
"""Parts of a voxel's rays by which a camera surely does not see it, or does: the threshold between is a tenth, and 27
points in the voxel, whose rays meet the sensor through 69 points of the pupil or do not, tell the part to 0.05."""


def half_seen_rig():
    """Two cameras of which the second sees the middle of a tall volume only."""
    wide = two_cameras(optics=optics(400, 260)).cameras
    return IdealRig({"cam1": wide["cam1"], "cam2": IdealCamera("cam2", wide["cam2"].pose, optics=optics(200, 260))})


@pytest.mark.slow
def test_a_volume_tells_what_fewer_than_two_cameras_see(tmp_path, caplog):
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.8, 1.8, 0.8), voxel_mm=0.1)
    weights = lfpiv.build_weights(half_seen_rig(), grid)
    with caplog.at_level(logging.WARNING):
        views = weights.views
    z, y, x = (grid.axis_mm(axis)[:, None] + 0.1 * np.array([-1, 0, 1]) / 3 for axis in range(3))
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)
    u, v = np.meshgrid(*[np.linspace(-0.9, 0.9, 9)] * 2)
    pupil = 12.5 * np.stack([u, v], -1)[np.hypot(u, v) < 1]  # f = 100 mm, f/4
    share = np.zeros((2, *grid.shape))
    for number, camera in enumerate(weights.cameras.values()):
        half = np.array(camera.optics.sensor_shape[::-1]) * camera.optics.pixel_mm / 2
        met = (np.abs(camera.map_fan(points, pupil)) < half).all(-1).mean(1)
        nz, ny, nx = grid.shape
        share[number] = met.reshape(nx, 3, ny, 3, nz, 3).mean((1, 3, 5)).T
    assert np.ptp(share[1]) == 1  # all, and nothing
    sure = ((share < FEW_RAYS) | (share > MANY_RAYS)).all(0)
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(views[sure], (share > MANY_RAYS).sum(0)[sure])
    ones = {name: np.ones(camera.optics.sensor_shape, np.float32) for name, camera in weights.cameras.items()}
    np.testing.assert_array_equal(weights.column_sum, weights.T(ones))
    alone = round(100 * (views < 2).mean())
    assert 30 < alone < 70 and f"{alone} % of the volume is seen by fewer than two cameras" in caplog.text
    (warned,) = coverage.sight_warnings(half_seen_rig(), grid)
    said = warned.sentence  # of a sample of eight planes each way, before any weights
    assert re.match(r"about \d\d % of the volume is seen by fewer than two cameras; vectors there are not valid", said)
    assert abs(int(said.split()[1]) - alone) <= 2 * 100 / coverage.SAMPLES  # a plane at either end

    positions = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3)) * (0.8, 1.8, 0.8)
    images = weights(lfpiv.metrics.truth_volume(positions, None, grid, 0.07))
    volume = plain_steps.reconstruct(weights, images, iterations=2)
    np.testing.assert_array_equal(volume["views"], views)
    netcdf.write_volume(volume, tmp_path / "volume.nc", attributes={})
    read = netcdf.read_volume(tmp_path / "volume.nc")
    vectors = plain_steps.correlate(read, read, dt_s=1.0, windows=((8, 8, 8), (8, 6, 8)))
    assert 0 < vectors.attrs["seen_fraction"] < 1
    middle = np.abs(vectors["y"].values)
    assert vectors["valid"].values[:, middle < 0.2].all() and not vectors["valid"].values[:, middle > 0.5].any()
    pair = plain_steps.reconstruct_pair(weights, [images, images], iterations=2, correlation={"windows": ((8, 8, 8),)})
    assert all("views" in frame.coords for frame in pair)


def test_a_volume_that_all_see_tells_nothing_and_neither_does_one_camera(caplog):
    rig = half_seen_rig()
    for cameras, height in ((rig.cameras, 0.4), ({"cam2": rig.cameras["cam2"]}, 1.8)):
        grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.4, height, 0.4), voxel_mm=0.1)
        weights = lfpiv.build_weights(IdealRig(cameras), grid)
        with caplog.at_level(logging.WARNING):
            volume = plain_steps.reconstruct(weights, weights(np.ones(grid.shape, np.float32)), iterations=0)
        assert "views" not in volume.coords and "fewer than two" not in caplog.text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size_mm": (0.04, 1, 1)}, r"size_mm: expected \(x, y, z\) of at least a voxel"),
        ({"size_mm": (1, -1, 1)}, "size_mm: expected"),
        ({"size_mm": (1, 1, float("inf"))}, "size_mm: expected"),
        ({"voxel_mm": 0.0}, "voxel_mm: expected a length > 0"),
        ({"voxel_mm": float("nan")}, "voxel_mm: expected a length > 0"),
        ({"centre_mm": (0, 0, float("nan"))}, "first_centre_mm: expected three finite lengths"),
    ],
)
def test_grids_without_voxels_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        lfpiv.Grid.from_extent(**{"centre_mm": (0, 0, 0), "size_mm": (1, 1, 1), "voxel_mm": 0.1} | change)
    with pytest.raises(ValueError, match="shape: expected three whole numbers"):
        lfpiv.Grid(shape=(0, 3, 4), voxel_mm=0.1, first_centre_mm=(0.0, 0.0, 0.0))


def test_a_volume_with_its_axes_in_another_order_is_not_projected():
    weights = random_system(0, voxels=(4, 4, 4))
    volume = xr.DataArray(np.random.default_rng(0).random((4, 4, 4)), dims=("z", "y", "x"))
    assert (weights(volume)["one"] == weights(volume.values)["one"]).all()
    with pytest.raises(ValueError, match="volume: expected dims"):
        weights(volume.transpose("x", "y", "z"))
