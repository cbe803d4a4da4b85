"""A series in sequence: the guess is the moved volume before, volumes gain in fewer iterations, changes are noticed."""

import dataclasses

import numpy as np
import pytest
import xarray as xr
from scipy import ndimage
from support import plain_steps
from support.ideal_rig import optics, two_cameras

import lfpiv
from lfpiv import metrics
from lfpiv.reconstruction.settings import PLAIN, SmartSettings
from lfpiv.reconstruction.sieve import coefficients
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.sequence import solver as sequence
from lfpiv.sequence.solver import PreviousFrame, SequenceSolver, StartedFrom
from lfpiv.simulation.flows import Swirl, Uniform

GRID = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(2.4, 2.4, 2.0), voxel_mm=0.1)
VOXEL_MM = GRID.voxel_mm
BLOB = 0.7  # standard deviation of the particles [voxel]
FLOW = Swirl(peak_mm=0.15, core_mm=1.3, axial_mm=0.08)
INSTANTS = 8
ITERATIONS = 14
SETTINGS = PLAIN | {"subsets": "auto"}
CORRELATION = {"windows": (16, 12, 12), "smoothing_voxel": 0.5, "intensity_power": 0.5}

TOLERANCE_SPLINE = 0.1  # cubic splines flatten blobs of 0.7 voxel by 5 to 10 %; particles that rest are 0.6 off
TOLERANCE_F32 = 1e-4  # powers and sums of float32 volumes
UNBLURRED = 0.5  # error left of points by five steps of Richardson and Lucy, the hardest case; 0.40 here
GAIN = 0.85  # 1 - Q left by fewer than half of the iterations


def blobs(positions):
    return metrics.truth_volume(positions, None, GRID, BLOB)


def vectors_of(flow, valid=True):
    """What `correlate` would return for a flow it measures without error."""
    nodes = [GRID.axis_mm(axis)[2:-2:5] + VOXEL_MM / 2 for axis in range(3)]
    z, y, x = np.meshgrid(*nodes, indexing="ij")
    moved = flow(np.stack([x, y, z], -1).reshape(-1, 3)).reshape(*x.shape, 3) / VOXEL_MM
    dims = ("z", "y", "x")
    variables = {f"displacement_{axis}": (dims, moved[..., k]) for k, axis in enumerate("xyz")}
    variables["valid"] = (dims, np.full(x.shape, valid))
    shares = {"valid_fraction": 1.0, "measurable_fraction": 1.0, "voxel_mm": [VOXEL_MM] * 3}
    return xr.Dataset(variables, dict(zip(dims, nodes, strict=True)), shares)


def uniform(*displacement_voxel, valid=True):
    return vectors_of(Uniform(displacement_mm=tuple(VOXEL_MM * part for part in displacement_voxel)), valid)


@pytest.fixture(scope="module")
def weights(device):
    return lfpiv.build_weights(two_cameras(optics=optics(460, 640)), GRID)


def images_of(weights, positions, seed):
    """Images of blobs as the weights have them, with shot and read noise."""
    rng, images = np.random.default_rng(seed), {}
    for name, image in weights(blobs(positions).values * np.float32(3e5)).items():
        images[name] = (image + rng.standard_normal(image.shape) * np.sqrt(0.4 * image + 4)).astype(np.float32)
    return images


@pytest.fixture(scope="module")
def series(weights):
    """Positions and images of a densely seeded flow at several instants, and of other particles."""
    size = np.array([2.4, 2.4, 2.0])
    draw = np.random.default_rng(7).uniform(-0.5, 0.5, (2, 330, 3)) * (size + 0.4) + [0.1, -0.1, 0.2]
    positions = [draw[0]]
    for _ in range(INSTANTS - 1):
        halfway = positions[-1] + FLOW(positions[-1]) / 2
        positions.append(positions[-1] + FLOW(halfway))
    return positions, [images_of(weights, at, [7, k]) for k, at in enumerate(positions)], images_of(weights, draw[1], 8)


@pytest.fixture
def solver(weights):
    return SequenceSolver(SmartSolver(weights, SmartSettings(iterations=ITERATIONS, **SETTINGS)), CORRELATION)


def along(solver, images):
    """Solve instants one after the other; return all of them, and what follows from the last one."""
    previous, done = None, []
    for one in images:
        done.append(solver.solve(one, previous))
        previous = done[-1].as_previous(done[-1].found.to_dataarray(), previous)
    return done, previous


def test_volumes_gain_by_fewer_iterations_if_the_flow_is_known(solver, series):
    positions, images, _ = series
    exact = SequenceSolver(solver.smart, CORRELATION, lambda first, second, settings, known: vectors_of(FLOW))
    done, _ = along(exact, images)
    assert [one.started_from for one in done] == [StartedFrom.FIRST] * 2 + [StartedFrom.PREDICTED] * (INSTANTS - 2)
    most = np.ceil(sequence.ITERATION_SHARE * ITERATIONS)
    assert all(one.found.iterations <= most for one in done[2:])
    for number in (INSTANTS - 4, INSTANTS - 1):  # with three instants after it, and with none
        corrected, alone = exact.correct(done, number), solver.smart.solve(images[number])
        assert corrected.iterations < ITERATIONS / 2
        lost = [1 - metrics.reconstruction_quality(one.volume, blobs(positions[number])) for one in (alone, corrected)]
        assert lost[1] < GAIN * lost[0]


@pytest.mark.slow
def test_an_instant_with_nothing_beside_it_is_that_of_its_images(solver, series):
    _, images, _ = series
    alone = solver.smart.solve(images[0])
    done, _ = along(solver, images[:2])
    assert np.array_equal(solver.correct(done[:1], 0).volume, alone.volume)
    assert np.array_equal(solver.correct(done, 0).volume, alone.volume), "the flow is not known"


@pytest.mark.slow
def test_instants_state_how_much_their_cameras_ask_for_unlike_light(solver, series):
    """Light that changes over one camera's image by a factor of 0.7 to 1.3 stands for particles that it sees unlike."""
    _, images, _ = series
    name, image = next(iter(images[0].items()))
    uneven = images[0] | {name: image * np.linspace(0.7, 1.3, image.shape[1], dtype=np.float32)}
    asked = []
    for frame in (images[0], uneven):
        done, _ = along(solver, [frame])
        alone = solver.smart.prepare(frame)
        asked.append(solver.correct(done, 0).unlike)
        assert asked[-1] == pytest.approx(alone.with_unlike_light(alone.solve()).unlike, rel=TOLERANCE_F32)
    assert 0 < 3 * asked[0] < asked[1]


def rough_vectors():
    """Vectors of the flow that alternate along x by as much as no flow that is resolved does."""
    rough = vectors_of(FLOW)
    bumps = (-1.0) ** np.arange(rough.sizes["x"]) * sequence.ROUGHEST
    return rough.assign({f"displacement_{axis}": rough[f"displacement_{axis}"] + bumps for axis in "xyz"})


@pytest.mark.slow
def test_a_flow_that_is_not_resolved_moves_nothing(solver, series):
    _, images, _ = series
    rough = rough_vectors()
    unresolved = SequenceSolver(solver.smart, CORRELATION, lambda first, second, settings, known: rough)
    done, _ = along(unresolved, images[:3])
    assert done[2].started_from is StartedFrom.UNRESOLVED
    expected = solver.smart.solve(images[2]).volume
    assert np.array_equal(done[2].found.volume, expected)
    assert np.array_equal(unresolved.correct(done, 2).volume, expected)


@pytest.mark.slow
def test_after_some_flows_that_are_not_resolved_none_is_measured(solver, series):
    _, images, _ = series
    rough = rough_vectors()
    measured = []
    unresolved = SequenceSolver(solver.smart, CORRELATION, lambda *arguments: measured.append(arguments) or rough)
    done, previous = along(unresolved, images[:6])
    assert [one.started_from for one in done] == [StartedFrom.FIRST] * 2 + [StartedFrom.UNRESOLVED] * 4
    assert len(measured) == sequence.TRIES and previous.given_up
    assert np.array_equal(done[5].found.volume, solver.smart.solve(images[5]).volume)
    assert not along(solver, images[:3])[1].given_up


def test_tries_are_counted_one_after_the_other(solver, series):
    _, images, _ = series
    done, previous = along(solver, images[:3])
    assert done[2].started_from is StartedFrom.PREDICTED
    nearly = dataclasses.replace(previous, unresolved=sequence.TRIES - 1)
    assert done[2].as_previous(previous.measured, nearly).unresolved == 0


def test_a_change_of_the_scene_is_noticed_and_the_instant_starts_from_its_images(solver, series):
    _, images, others = series
    done, previous = along(solver, images[:3])
    changed = solver.solve(others, previous)
    assert changed.started_from is StartedFrom.MISSED and changed.misfit_ratio > sequence.LEAST_AGREEMENT
    alone = solver.smart.solve(others)
    assert np.array_equal(solver.correct([changed], 0).volume, alone.volume)
    after = changed.as_previous(changed.found.to_dataarray(), previous)
    assert after.earlier is None, "the flow is not measured between different particles"
    assert after.flow is not None, "the flow stays known"
    expected = solver.solve(images[3], previous)
    assert (
        expected.started_from is StartedFrom.PREDICTED and np.isnan(expected.misfit_ratio) and done[2].flow is not None
    )


def test_nothing_is_predicted_before_the_flow_is_known(solver, series):
    _, images, others = series
    first = solver.solve(images[0], None)
    second = solver.solve(images[1], first.as_previous(first.found.to_dataarray(), None))
    assert first.started_from is second.started_from is StartedFrom.FIRST
    strange = solver.solve(others, second.as_previous(second.found.to_dataarray(), None))
    assert strange.started_from is StartedFrom.FIRST, "no earlier volume"


def plain_guess(solver, images):
    return solver.smart.solve(images, iterations=0)


def test_the_guess_is_the_moved_volume_times_the_guess_from_the_images(solver, series):
    positions, images, _ = series
    plain, moved = plain_guess(solver, images[0]), np.array([1.3, -0.7, 0.4])
    inner = positions[0][np.all(np.abs(positions[0] - [0.1, -0.1, 0.2]) < 0.7, axis=1)]
    volume, there = blobs(inner).values, blobs(inner + moved * VOXEL_MM).values
    guess = sequence.predicted_guess(volume, plain, uniform(*moved))
    light = plain.volume.sum(dtype=np.float64)
    assert guess.sum(dtype=np.float64) == pytest.approx(light, rel=TOLERANCE_F32)
    lifted = np.maximum(there * light / there.sum(), sequence.DIMMEST * plain.volume.mean())
    core = (slice(3, -3),) * 3  # light comes in through the faces
    expected = (lifted**sequence.PERSISTENCE * plain.volume ** (1 - sequence.PERSISTENCE))[core]
    gap = guess[core] / np.linalg.norm(guess[core]) - expected / np.linalg.norm(expected)
    assert np.linalg.norm(gap) < TOLERANCE_SPLINE


def test_where_the_flow_is_not_known_or_comes_from_outside_the_images_alone_count(solver, series):
    positions, images, _ = series
    plain, volume = plain_guess(solver, images[0]), blobs(positions[0]).values
    unknown = sequence.predicted_guess(volume, plain, uniform(1.0, 0.0, 0.0, valid=False))
    assert np.abs(unknown - plain.volume).max() < TOLERANCE_F32 * plain.volume.max()
    guess = sequence.predicted_guess(volume, plain, uniform(6.0, 0.0, 0.0))
    ratio = guess[:, :, :5] / plain.volume[:, :, :5]  # particles that were outside the volume before
    assert np.ptp(ratio) < TOLERANCE_F32 * ratio.max()
    assert guess[plain.volume > 0].min() > 0, "SMART could not raise it"
    dark = sequence.predicted_guess(np.zeros_like(volume), plain, uniform(1.0, 0.0, 0.0))
    assert np.array_equal(dark, plain.volume)


def test_the_sieve_is_undone():
    rng = np.random.default_rng(3)
    sharp = np.zeros((16, 16, 16), np.float32)
    sharp[tuple(rng.integers(3, 13, (3, 20)))] = 1.0
    blurred = ndimage.gaussian_filter(sharp, 0.6, mode="constant", truncate=3.5)
    again = ndimage.gaussian_filter(coefficients(blurred, 0.6), 0.6, mode="constant", truncate=3.5)
    twice = ndimage.gaussian_filter(blurred, 0.6, mode="constant", truncate=3.5)
    assert np.linalg.norm(again - blurred) < UNBLURRED * np.linalg.norm(twice - blurred)
    assert np.array_equal(coefficients(blurred, 0.0), blurred)


def test_the_flow_is_a_mean_over_time(solver, series):
    positions, _, _ = series
    volumes = [blobs(at) for at in positions[:2]]
    found = plain_steps.correlate(*volumes, dt_s=1.0, **CORRELATION)
    known = found.assign({f"displacement_{axis}": found[f"displacement_{axis}"] + 1 for axis in "zyx"})
    given = []

    def measure(*arguments):
        given.append(arguments)
        return found

    averaging = SequenceSolver(solver.smart, CORRELATION, measure)
    images = series[1][2]
    previous = PreviousFrame(volume=volumes[1].values, measured=volumes[1], earlier=volumes[0], flow=known)
    solved = averaging.solve(images, previous)
    shift = solved.flow["displacement_x"] - found["displacement_x"]
    assert np.allclose(shift, sequence.FLOW_MEMORY, atol=1e-5)
    assert given[0][0] is volumes[0] and given[0][1] is volumes[1]
    assert given[0][2] == CORRELATION and given[0][3] is known
