"""Cases of `lfpiv reproduce`: trainers, dots in volumes, planar PIV, the injector, and each case on a tiny rig."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support import scenes

import lfpiv
from lfpiv.calibration.levenberg_marquardt import Samples, forward, levenberg_marquardt
from lfpiv.calibration.training import TrainingSettings, train
from lfpiv.errors import InputError
from lfpiv.reproduce import fig19, lsi, lsi_twin, planar_piv, table1, table3, trainers
from lfpiv.reproduce.rigs import Rig
from lfpiv.simulation.scene import Noise, true_mapping
from lfpiv.simulation.simulator import simulate

DIFFERENCE = 1e-6  # step of central differences in weights of order one
GRADIENT = 1e-7  # their error: step squared times third derivatives, and rounding 1e-16 / step
SMOOTH_FIT = 0.01  # rms of a five-node network on a smooth function that spans two units
DESCENT_GAIN = 1.4  # a hundred epochs of descent lower the error left by the fitted output layer by 1.5 to 1.6
OVERFIT = 0.9  # regularised over early-stopped error of twenty nodes on few noisy samples; 0.73 to 0.79 over seeds
CENTROID_VOXEL = 0.1  # Gaussian dots sampled at 1.2 voxels standard deviation, ghosts beside them
PLANAR_PX = 0.05  # mean of OpenPIV's vectors on clean linear flow; a wrong sign, axis or origin misses by pixels
ROUNDING = 1e-9
INTERPOLATION = 0.02  # linear interpolation over 0.8 mm in shear layers of 1.7 mm, relative
JET = 0.6  # the jet is slower on its axis and faster in its annulus than the bulk; a wrong unit or time misses tenfold
TINY_LABELS = 0.05  # pitch; a tiny board's dots on a coarse sensor, a wrong frame or axis misses by pitches
TINY_LATERAL_MM, TINY_DEPTH_MM = 0.02, 0.06  # a fifth and half of a dot's diameter


@pytest.fixture(scope="module")
def rig(tmp_path_factory, device):
    """Two small cameras, calibrated from a simulated board."""
    scene = scenes.scene(
        "tiny",
        [
            scenes.camera(name, angle, (440, 440), true_yaw_deg=angle + 0.4)
            for name, angle in (("camera1", 20.0), ("camera2", -20.0))
        ],
        planes_mm=(-0.8, -0.4, 0.0, 0.4, 0.8),
        particles={"count": 8},
        displacement_mm=(0.0, 0.0, 0.0),
        seed=5,
        dt_s=1.0,
    )
    path = simulate(scene, tmp_path_factory.mktemp("tiny") / "data")
    experiment = lfpiv.open_experiment(path)
    return Rig(scene, experiment, lfpiv.calibrate(experiment))


def quiet(step, fraction):
    assert 0 <= fraction <= 1


def smooth(points):
    return np.stack([np.sin(points[:, 0]) * points[:, 1], np.cos(points[:, 0] + points[:, 1])], axis=1)


def test_descent_follows_the_gradient():
    rng = np.random.default_rng(0)
    layers = [rng.standard_normal(shape) for shape in ((4, 5), (6, 4), (5, 2))]
    samples = Samples(
        inputs=rng.standard_normal((30, 3)),
        outputs=rng.standard_normal((30, 2)),
        weights=rng.uniform(0.5, 2, (30, 1)),
    )

    def error(parts):
        return np.mean((samples.weights * (samples.outputs - forward(parts, samples.inputs)[-1])) ** 2)

    for number, gradient in enumerate(trainers.error_gradient(layers, samples)):
        for place in ((0, 0), (-1, 1)):
            moved = [[layer.copy() for layer in layers] for _ in range(2)]
            moved[0][number][place] -= DIFFERENCE
            moved[1][number][place] += DIFFERENCE
            slope = (error(moved[1]) - error(moved[0])) / (2 * DIFFERENCE)
            assert slope == pytest.approx(gradient[place], abs=GRADIENT)


def test_both_trainers_fit_and_regularisation_withstands_noise():
    rng = np.random.default_rng(1)
    points = rng.uniform(-1.5, 1.5, (600, 2))
    settings = TrainingSettings(hidden=(8,), trainer=trainers.bayesian_regularisation, epochs=60)
    bayes = train(points, smooth(points), settings)
    assert np.sqrt(np.mean(bayes.test_errors**2)) < SMOOTH_FIT
    settings = TrainingSettings(hidden=(8,), trainer=trainers.gradient_descent, epochs=100)
    descent = train(points, smooth(points), settings)
    assert descent.validation_rms.min() < descent.validation_rms[0] / DESCENT_GAIN

    few, clean = points[:150], rng.uniform(-1.4, 1.4, (500, 2))
    noisy = smooth(few) + 0.2 * rng.standard_normal((150, 2))
    fitted = [
        train(few, noisy, TrainingSettings(trainer=trainer, epochs=60, patience=61))
        for trainer in (trainers.bayesian_regularisation, levenberg_marquardt)
    ]
    bayes_error, plain_error = (np.sqrt(np.mean((fit.network(clean) - smooth(clean)) ** 2)) for fit in fitted)
    assert fitted[0].training_rms[-1] > fitted[1].training_rms[-1]  # refuses the noise that the other one fits
    assert bayes_error < OVERFIT * plain_error


def test_dots_are_found_among_ghosts():
    """Dots with bright ghosts half a spacing away and before and behind the board; one dot is missing."""
    rng = np.random.default_rng(2)
    z, y, x = (np.arange(n) * 0.06 + first for n, first in ((41, -1.13), (50, -1.48), (50, -1.44)))
    volume = np.zeros((len(z), len(y), len(x)))

    def add(at, light):
        grids = (np.exp(-((axis - c) ** 2) / (2 * 0.07**2)) for axis, c in zip((x, y, z), at, strict=True))
        gx, gy, gz = grids
        volume[:] += light * gz[:, None, None] * gy[:, None] * gx

    truth = np.full((4, 5, 3), np.nan)
    for row, column in np.ndindex(4, 5):
        if (row, column) == (1, 2):
            continue
        place = np.array([(column - 2) * 0.5, (row - 1.5) * 0.5, 0.1])
        truth[row, column] = place + rng.uniform(-0.03, 0.03, 3)
        add(truth[row, column], rng.uniform(0.8, 1.2))
        if column < 4:
            add(place + [0.25, 0, 0.69], 3.0)
    found = fig19.locate_dots(xr.DataArray(volume, coords={"z": z, "y": y, "x": x}), (5, 4), 0.5, 0.1)
    assert np.isnan(found[1, 2]).all() and np.isfinite(np.delete(found.reshape(20, 3), 7, axis=0)).all()
    assert np.nanmax(np.abs(found - truth)) < CENTROID_VOXEL * 0.06


def test_planar_piv_measures_the_sheet():
    pytest.importorskip("openpiv")
    camera = planar_piv.SheetCamera(axis_mm=(5.0, 1.0))
    field = ((3.0, -2.0), (6.0, 2.5))
    gradient = np.array([[0.01, 0.02], [0.03, -0.01]])

    def flow(points):
        return np.column_stack([points[:, :2] @ gradient.T + [0.05, -0.08], 0.02 + 0 * points[:, 2]])

    frames = planar_piv.sheet_images(
        camera, flow, plane_mm=-5.0, field_mm=field, noise=Noise(), rng=np.random.default_rng(3)
    )
    vectors = planar_piv.correlate_frames(*frames, camera, field)
    assert (np.diff(vectors.y_mm) > 0).all() and vectors.y_mm[0] > -2 and vectors.y_mm[-1] < 2.5
    y, x = np.meshgrid(vectors.y_mm, vectors.x_mm, indexing="ij")
    truth = flow(np.stack([x, y, x], axis=-1).reshape(-1, 3))[:, :2].reshape(*x.shape, 2)
    error = (vectors.displacement_mm - truth)[2:-2, 2:-2] / camera.pixel_in_sheet_mm
    for part in (error, error[:, :4], error[:, -4:], error[:4], error[-4:]):  # the gradient's axes and signs too
        assert np.abs(np.nanmean(part, axis=(0, 1))).max() < PLANAR_PX


@pytest.mark.slow
def test_a_missing_openpiv_is_named(monkeypatch, rig, tmp_path):
    monkeypatch.setitem(sys.modules, "openpiv", None)
    with pytest.raises(InputError, match=r"OpenPIV.*piv2d"):
        lsi.compute(rig, lsi.SIZES["small"], tmp_path, seed=0, progress=quiet)


@pytest.mark.slow
def test_dense_labels_lie_on_the_same_rays(rig):
    camera = rig.calibration.cameras["camera1"]
    points, pupil, array, dot = table3.dense_labels(camera.dots, 50, camera.optics.pupil_radius_mm)
    assert len(points) == 50 * len(np.unique(camera.dots.dot)) and len(np.unique(dot)) * 50 == len(dot)
    truth = true_mapping(rig.scene.camera[0])(points, pupil)
    assert np.linalg.norm(array - truth, axis=1).mean() < TINY_LABELS * 0.1


@pytest.mark.parametrize("scale", ["small", "paper"])
def test_profiles_of_exact_fields_are_exact(scale):
    """Fields that hold the mean flow itself give its profiles: places, axes, units and time are right."""
    sizes = dataclasses.replace(lsi.SIZES[scale], pairs=2)
    twin = lsi_twin.Twin(sizes, seed=4)
    half = np.array(sizes.volume_mm) / 2
    axes = [np.arange(-edge + 0.8, edge - 0.79, 0.4) for edge in half[::-1]]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    field = twin.mean(np.stack([x, y, z], -1).reshape(-1, 3)).reshape(*z.shape, 3)
    planar = []
    for depth in twin.depths_mm:
        y, x = np.meshgrid(axes[1], axes[2], indexing="ij")
        points = np.stack([x, y, np.full_like(x, depth)], -1).reshape(-1, 3)
        planar.append(
            {"y_mm": axes[1], "x_mm": axes[2], "displacement_mm": twin.mean(points)[:, :2].reshape(*x.shape, 2)}
        )
    profiles = lsi.sample_profiles(twin, {"axes_mm": axes, "displacement_mm": field, "truth_mm": field}, planar)
    for number in range(2):
        reference = profiles["mean"][..., number]
        assert lsi.relative_error(profiles["light_field"][..., number], reference) < INTERPOLATION
        assert lsi.relative_error(profiles["planar"][..., number], reference) < INTERPOLATION
    assert twin.mean.swirl_number == 0.55
    assert profiles["mean"][..., 1].max() == pytest.approx(lsi_twin.BULK_M_S, rel=JET)
    assert (profiles["mean"][0, :, 0] < 0).all()  # leftward in the deepest plane, as in the paper
    assert lsi.relative_error(np.array([1.0, np.nan]), np.array([2.0, 1.0])) == pytest.approx(0.5, abs=ROUNDING)


@pytest.mark.slow
def test_table1_on_a_tiny_rig(rig, tmp_path):
    sizes = table1.Sizes(layers=(1, 2), samples=400, epochs=4, descent_epochs=4, shallow_epochs=12)
    result = table1.compute(rig, sizes, tmp_path, seed=0, progress=quiet)
    assert set(result["sigma_nor"]) == {"LM", "BR", "GDM"}
    assert all(len(errors) == 2 for rows in result["sigma_nor"].values() for errors in rows.values())
    assert result["best"] == min(result["best_deep"], result["best_shallow"]) < TINY_LABELS
    own = [entry for entry in result["shallow"] if entry["baseline"] == "thin_lens"]
    assert all(camera["true_ray_error"] < TINY_LABELS for camera in own[0]["cameras"])
    assert (tmp_path / "table1.png").stat().st_size > 0

    kept = {path: path.read_bytes() for path in (tmp_path / "networks").glob("*.json")}
    again = table1.compute(rig, sizes, tmp_path, seed=0, progress=quiet)
    assert again["sigma_nor"] == result["sigma_nor"]  # resumed, not computed twice
    assert kept == {path: path.read_bytes() for path in (tmp_path / "networks").glob("*.json")}


@pytest.mark.slow
def test_table3_on_a_tiny_rig(rig, monkeypatch):
    monkeypatch.setitem(table3.VOLUME_MM, "small", (0.8, 0.8, 0.4))
    result = table3.compute(rig, "small", seed=0, progress=quiet)
    assert result["voxels"] == 8 * 8 * 4 and result["samples"] == 37 * 125
    assert result["training_s"] > 0 and result["weights_s"] > 0
    assert all(row["goal"] is None for row in result["comparison"])  # goals are for the paper's size only


@pytest.mark.slow
def test_fig19_on_a_tiny_rig(rig, tmp_path):
    result = fig19.compute(rig, (1, 2, 3), tmp_path, seed=0, progress=quiet)
    assert result["dots_found"] == result["dots_expected"] == 75
    assert result["lateral_mm"] < TINY_LATERAL_MM and result["depth_mm"] < TINY_DEPTH_MM
    assert {Path(figure["file"]).name for figure in result["figures"]} == {"fig18.png", "fig19.png"}
