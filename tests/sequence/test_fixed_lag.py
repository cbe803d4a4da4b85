"""Correction by the instants beside one: particles stay where they are, light that does not move with them fades."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy import ndimage

import lfpiv
from lfpiv import metrics
from lfpiv.reconstruction.result import SMOOTHING_VOXEL
from lfpiv.sequence import fixed_lag
from lfpiv_kernels.correlation import deform

GRID = lfpiv.Grid.from_extent(centre_mm=(0.0, 0.0, 0.0), size_mm=(2.4, 2.0, 1.6), voxel_mm=0.1)
BLOB = 0.8  # standard deviation of particles [voxel]
STEP = np.array([0.13, -0.06, 0.04])  # displacement from one instant to the next, x y z [mm]
PARTICLES = np.array([[-0.5, 0.3, 0.1], [0.4, -0.2, -0.2], [0.1, 0.5, 0.2], [-0.2, -0.5, 0.0]])
GHOST = np.array([[0.6, 0.4, 0.3]])

TOLERANCE_F32 = 1e-4  # sums of float32 volumes
KEPT = 0.15  # brightness of particles that all instants show; splines flatten them by 5 to 10 %
FADED = 0.5  # a ghost of one instant out of five: 0.02^(4/5) = 0.04 and its tails
NEAR_VOXEL = 0.1  # centroids of particles, whose brightness alone changes


def blobs(positions):
    return metrics.truth_volume(positions, None, GRID, BLOB).values.astype(np.float32)


def reconstruction(volume, sieve_voxel=0.0):
    blurred = ndimage.gaussian_filter(volume, SMOOTHING_VOXEL, mode="constant")
    spline = deform.spline_coefficients(blurred)
    return SimpleNamespace(grid=GRID, volume=volume, blurred=blurred, spline=spline, sieve_voxel=sieve_voxel)


def flow_of(displacement_voxel, valid=True):
    """The same displacement (x, y, z) in all of 3 x 4 x 4 windows."""
    dims, nodes = ("z", "y", "x"), [np.linspace(-0.6, 0.6, count) for count in (3, 4, 4)]
    shape = tuple(len(at) for at in nodes)
    variables = {
        f"displacement_{axis}": (dims, np.full(shape, float(part)))
        for axis, part in zip("xyz", displacement_voxel, strict=True)
    }
    variables["valid"] = (dims, np.full(shape, valid))
    return xr.Dataset(variables, dict(zip(dims, nodes, strict=True)), {"voxel_mm": [GRID.voxel_mm] * 3})


def light_at(volume, position):
    """Light within two voxels of a point, and its centroid [voxel]."""
    z, y, x = np.meshgrid(*GRID.axes_mm, indexing="ij")
    near = np.where((x - position[0]) ** 2 + (y - position[1]) ** 2 + (z - position[2]) ** 2 < 0.25**2, volume, 0)
    return near.sum(), np.array([(near * at).sum() / near.sum() for at in (x, y, z)]) / GRID.voxel_mm


def beside(steps):
    return {step: reconstruction(blobs(PARTICLES - step * STEP)) for step in steps}


def test_a_ghost_of_one_instant_fades_and_the_particles_stay():
    volume = blobs(np.vstack([PARTICLES, GHOST]))
    flow = flow_of(STEP / GRID.voxel_mm)
    guess = fixed_lag.agreed_guess(reconstruction(volume), beside((-2, -1, 1, 2)), flow)
    assert guess.sum(dtype=np.float64) == pytest.approx(volume.sum(dtype=np.float64), rel=TOLERANCE_F32)
    left = [light_at(guess, at)[0] / light_at(volume, at)[0] for at in PARTICLES]
    assert np.ptp(left) < KEPT * np.mean(left)
    assert light_at(guess, GHOST[0])[0] / light_at(volume, GHOST[0])[0] < FADED * np.mean(left)


def test_a_wrong_flow_moves_no_particle():
    volume = blobs(PARTICLES)
    wrong = flow_of(STEP / GRID.voxel_mm + [0.4, 0.0, 0.0])
    guess = fixed_lag.agreed_guess(reconstruction(volume), beside((-1, 1)), wrong)
    for at in PARTICLES:
        assert np.abs(light_at(guess, at)[1] - light_at(volume, at)[1]).max() < NEAR_VOXEL


def test_where_the_flow_is_not_valid_nothing_changes():
    volume = blobs(np.vstack([PARTICLES, GHOST]))
    guess = fixed_lag.agreed_guess(reconstruction(volume), beside((-1, 1)), flow_of(STEP / GRID.voxel_mm, valid=False))
    bright, light = guess > 0, volume.sum(dtype=np.float64)
    scale = light / volume[bright].sum(dtype=np.float64)
    assert 1 < scale < 1 / (1 - fixed_lag.FAINT) + TOLERANCE_F32, "the faintest voxels are left out"
    assert volume[~bright].max() <= volume[bright].min()
    assert np.abs(guess - np.where(bright, scale * volume, 0)).max() < TOLERANCE_F32 * volume.max()


def test_with_a_sieve_no_voxel_is_left_out():
    volume = blobs(np.vstack([PARTICLES, GHOST]))
    still = reconstruction(volume, sieve_voxel=0.6)
    guess = fixed_lag.agreed_guess(still, beside((-1, 1)), flow_of(STEP / GRID.voxel_mm))
    assert ((guess > 0) == (volume > 0)).all()


def test_a_dark_volume_stays_dark():
    dark = np.zeros(GRID.shape, np.float32)
    assert np.array_equal(fixed_lag.agreed_guess(reconstruction(dark), beside((1,)), flow_of((1, 0, 0))), dark)


def test_the_mean_flow_is_that_of_valid_vectors():
    first, second = flow_of((1.0, 2.0, 3.0)), flow_of((3.0, 2.0, 1.0))
    first["valid"][0, 0, 0] = second["valid"][1, 1, 1] = False
    first["displacement_x"][0, 0, 0] = np.nan
    first["valid"][2, 2, 2] = second["valid"][2, 2, 2] = False
    mean = fixed_lag.mean_flow([first, second])
    assert mean["displacement_x"].values[0, 0, 0] == 3.0
    assert mean["displacement_x"].values[1, 1, 1] == 1.0
    assert mean["displacement_z"].values[2, 2, 2] == 2.0 and not mean["valid"].values[2, 2, 2]
    assert np.delete(mean["displacement_x"].values.ravel(), [0]).max() == 2.0
    assert mean["valid"].values.sum() == mean["valid"].size - 1


def test_roughness_is_zero_for_a_linear_flow_and_grows_with_curvature():
    flow = flow_of((1.0, 2.0, 3.0))
    index = np.arange(4.0)
    linear = flow.assign(displacement_x=flow["displacement_x"] + index)  # along x
    assert fixed_lag.roughness(linear) == pytest.approx(0.0, abs=1e-12)
    curved = flow.assign(displacement_x=flow["displacement_x"] + 0.5 * index**2)
    assert fixed_lag.roughness(curved) == pytest.approx(np.sqrt(1 / 9))  # second difference 1 in x of x, of 3 x 3 terms
    single = flow.isel(z=[0], y=[0, 1], x=[0])
    assert fixed_lag.roughness(single) == 0.0
