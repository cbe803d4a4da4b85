"""SMART: convergence to the minimum of its divergence, its invariants, and a particle that comes back in its place."""

from types import SimpleNamespace

import numpy as np
import pytest
from ideal_rig import two_cameras
from scipy.optimize import minimize

import lfpiv
from lfpiv.microimages import plain
from lfpiv.weightblocks import StoredGrid
from lfpiv.weights import Weights
from lfpiv_kernels import raymodel, reference, runtime
from lfpiv_kernels.project import Blocks, Projector

TOLERANCE_F32 = 2e-4  # 50 iterations of float32 steps whose sums have <= 60 terms: 50 * 60 * 6e-8
TOLERANCE_MISFIT = 1e-6  # a misfit is a float32 image's sum: rounding of 24 pixels relative to their light
TOLERANCE_LIMIT = 2e-3  # SMART converges linearly: what is left after 2,000 iterations in float32


def random_system(seed, voxels=(3, 4, 5), rows=4, lit=0.4):
    """Operator of two cameras of `rows` x 8 pixels with random sparse weights: fewer pixels than voxels."""
    runtime.device()
    rng = np.random.default_rng(seed)
    grid = lfpiv.Grid(shape=voxels, voxel_mm=1.0, first_centre_mm=(0.0, 0.0, 0.0))
    weights = Weights.__new__(Weights)
    weights.grid, weights.method, weights._column_sum = grid, "footprint", None
    weights.stored, weights.cameras, weights._projectors = StoredGrid(grid, (1, 0, 2)), {}, {}
    for name in ("one", "two"):
        value = rng.integers(1, 256, (grid.size * rows, 8)) * (rng.random((grid.size * rows, 8)) < lit)
        value[::rows, 0] = 100  # every voxel lights something
        blocks = Blocks(
            form="pixels",
            first_block=np.arange(grid.size + 1, dtype=np.int32),
            first_row=np.arange(grid.size + 1, dtype=np.int64) * rows,
            ray=np.zeros(grid.size, np.int32),
            height=np.full(grid.size, rows, np.uint16),
            value=value.astype(np.uint8),
            scale=rng.uniform(0.5, 1.5, grid.size).astype(np.float32) / raymodel.LEVELS,
            microimages=plain((rows, 8)),
        )
        optics = SimpleNamespace(sensor_shape=(rows, 8))
        weights.cameras[name] = SimpleNamespace(optics=optics, gain=np.ones((rows, 8), np.float32))
        weights._projectors[name] = Projector(blocks)
    return weights


def matrix_of(weights):
    """Dense matrix of all cameras on voxels in (z, y, x) order, padding left out."""
    order = weights.stored.restore(np.arange(weights.grid.size)).ravel()
    parts = []
    for projector in weights._projectors.values():
        parts.append(reference.dense(projector.blocks)[:, order])
    return np.concatenate(parts)


def images_of(weights, stacked):
    size = stacked.size // len(weights.cameras)
    return {
        name: stacked[k * size : (k + 1) * size].reshape(camera.gain.shape).astype(np.float32)
        for k, (name, camera) in enumerate(weights.cameras.items())
    }


@pytest.mark.parametrize("seed", [0, 1])
def test_smart_reaches_the_solution_of_least_divergence(seed):
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
    volume = lfpiv.reconstruct(
        weights,
        images_of(weights, image),
        iterations=2_000,
        floor=0.0,
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
    volume = lfpiv.reconstruct(
        weights,
        images_of(weights, image),
        iterations=50,
        relaxation=0.9,
        floor=floor,
        normalisation=normalisation,
        first=first.reshape(weights.grid.shape),
    )
    # "paper" scales the weights to a largest one of 1: the twin works on the scaled system
    unit = raymodel.LEVELS * max(float(p.blocks.scale.max()) for p in weights._projectors.values())
    scale = unit / matrix.max() if normalisation == "paper" else 1.0
    twin = reference.smart(
        matrix, image, first, iterations=50, relaxation=0.9 / scale, floor=floor, paper=normalisation == "paper"
    )
    assert np.abs(volume.values.ravel() / twin - 1).max() <= TOLERANCE_F32


@pytest.mark.parametrize("seed", range(8))
def test_misfit_never_rises_and_the_volume_stays_positive(seed):
    weights = random_system(seed)
    rng = np.random.default_rng(seed)
    truth = rng.random(weights.grid.size) ** 4
    image = matrix_of(weights) @ truth * rng.uniform(0.7, 1.3, 2 * 4 * 8)
    image[rng.random(image.size) < 0.1] = 0.0  # dark pixels
    volume = lfpiv.reconstruct(weights, images_of(weights, image), iterations=60, floor=0.05)
    misfit = np.array(volume.misfit)
    assert (np.diff(misfit) <= TOLERANCE_MISFIT * image.sum()).all()
    assert misfit[-1] < misfit[0]
    assert (volume.values > 0).all()
    assert len(volume.residual) == 61


def test_twelve_iterations_are_five_and_seven():
    weights = random_system(3)
    image = images_of(weights, matrix_of(weights) @ np.random.default_rng(3).random(weights.grid.size))
    twelve = lfpiv.reconstruct(weights, image, iterations=12)
    five = lfpiv.reconstruct(weights, image, iterations=5)
    seven = lfpiv.reconstruct(weights, image, iterations=7, first=five.values)
    assert seven.values.tobytes() == twelve.values.tobytes()


def test_truth_is_a_fixed_point():
    weights = random_system(4)
    truth = np.random.default_rng(4).uniform(0.5, 2, weights.grid.shape).astype(np.float32)
    volume = lfpiv.reconstruct(weights, weights(truth), iterations=20, first=truth)
    assert np.abs(volume.values / truth - 1).max() <= TOLERANCE_F32
    assert volume.residual[-1] <= TOLERANCE_F32


def test_the_floor_is_the_noise_of_the_background_by_default():
    weights = random_system(8)
    rng = np.random.default_rng(8)
    noise = {name: rng.normal(0, 0.2, (4, 8)) for name in weights.cameras}
    image = images_of(weights, matrix_of(weights) @ rng.random(weights.grid.size) ** 8)
    image = {name: np.where(np.arange(8) < 3, 0, image[name]) + noise[name] for name in image}  # three dark columns
    floor = {name: float(np.sqrt((image[name][image[name] < 0] ** 2).mean())) for name in image}
    given = lfpiv.reconstruct(weights, image, floor=floor)
    assert np.allclose(lfpiv.reconstruct(weights, image).values, given.values, rtol=TOLERANCE_F32)


def test_verdicts():
    weights = random_system(7)
    image = images_of(weights, matrix_of(weights) @ np.random.default_rng(7).random(weights.grid.size))
    assert "iteration limit" in lfpiv.reconstruct(weights, image, iterations=3).stop
    early = lfpiv.reconstruct(weights, image, iterations=500, tolerance=0.05)
    assert "no longer falls" in early.stop
    assert early.iterations < 500


def test_particles_come_back_in_their_places():
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.6, 1.4, 1.2), voxel_mm=0.1)
    weights = lfpiv.build_weights(two_cameras(), grid)
    truth = np.zeros(grid.shape, np.float32)
    places = [(3, 4, 5), (8, 9, 10), (5, 10, 3)]
    for place in places:
        truth[place] = 1000.0
    images = weights(truth)
    plain = lfpiv.reconstruct(weights, images, iterations=20, floor=1e-3)
    smooth = lfpiv.reconstruct(weights, images, iterations=20, floor=1e-3, smoothing_voxel=0.5)
    for volume in (plain, smooth):
        brightest = np.argsort(volume.values.ravel())[::-1]
        found = np.array(np.unravel_index(brightest[:3], grid.shape)).T
        assert sorted(map(tuple, found)) == sorted(places)
    assert np.abs(np.diff(smooth.values)).max() < np.abs(np.diff(plain.values)).max()


def test_light_outside_the_volume_and_dead_pixels_do_not_break_it():
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.8, 0.8, 0.8), voxel_mm=0.1)
    rig = two_cameras()
    for camera in rig.cameras.values():
        camera.gain[190:200] = 0.0  # dead rows
    weights = lfpiv.build_weights(rig, grid)
    truth = np.full(grid.shape, 0.01, np.float32)
    truth[4, 4, 4] = 1e5  # about 70 counts in its brightest pixels
    images = {name: image + 3.0 for name, image in weights(truth).items()}
    volume = lfpiv.reconstruct(weights, images, iterations=10, floor=1.0)
    assert np.isfinite(volume.values).all()
    assert np.unravel_index(volume.values.argmax(), grid.shape) == (4, 4, 4)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"iterations": -1}, "iterations: expected a whole number"),
        ({"relaxation": 0.0}, "relaxation: expected a number > 0"),
        ({"normalisation": "rows"}, "normalisation: expected one of"),
        ({"smoothing_voxel": -0.1}, "smoothing_voxel: expected"),
        ({"floor": float("nan")}, "floor: expected"),
        ({"floor": {"one": 1.0}}, "floor: camera 'two' is missing"),
        ({"first": np.zeros((3, 4, 5))}, "first: expected positive values"),
    ],
)
def test_wrong_arguments_are_named(keywords, message):
    weights = random_system(0)
    image = images_of(weights, matrix_of(weights) @ np.ones(weights.grid.size))
    with pytest.raises(ValueError, match=message):
        lfpiv.reconstruct(weights, image, **keywords)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda images: images.pop("two"), "camera 'two' is missing"),
        (lambda images: images.update(one=np.zeros((3, 3))), r"images\['one'\]: expected shape"),
        (lambda images: images.update(one=np.zeros((4, 8))), "expected some light"),
        (lambda images: images.update(one=np.full((4, 8), np.nan)), "expected finite counts"),
    ],
)
def test_wrong_images_are_named(change, message):
    weights = random_system(0)
    images = images_of(weights, matrix_of(weights) @ np.ones(weights.grid.size))
    change(images)
    with pytest.raises(ValueError, match=message):
        lfpiv.reconstruct(weights, images)
