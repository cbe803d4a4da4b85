"""A run from images to vectors, tracks and exports, killed and resumed, by the command line."""

import json
import shutil
import signal

import numpy as np
import pytest
import xarray as xr
from contract.command import done
from contract.scene import DISPLACEMENT_VOXEL, DT_S, VOXEL_MM

import lfpiv as library
from lfpiv import open_particles, open_results, open_tracks

BIAS = 0.12
"""Error of the mean displacement of a few windows of some ten particles [voxel]."""
PARTICLE = 0.15
"""Root mean square error of a particle's displacement in images without noise [voxel]."""
VECTORS = ("displacement_x", "displacement_y", "displacement_z", "u", "v", "w", "valid", "masked", "uncertainty")


def arrays(vectors):
    return {name: vectors[name].values for name in VECTORS}


def displacements(vectors):
    """Return valid displacements along x, y, z, shape (vector, 3) [voxel]."""
    return np.stack([vectors[f"displacement_{axis}"].values[vectors.valid.values] for axis in "xyz"], axis=-1)


def test_a_killed_run_goes_on_where_it_was(killed_run):
    assert killed_run.killed == -signal.SIGKILL
    assert (killed_run.out / "vectors" / "pair_0000.nc").read_bytes() == killed_run.early


@pytest.mark.slow
def test_vectors_of_a_killed_run_are_those_of_one_process(killed_run):
    rig = library.prepare(killed_run.experiment, library.load_calibration(killed_run.out / "calibration.h5"))
    results = open_results(killed_run.out)
    for pair in (0, 1):
        vectors = library.measure_pair(rig, pair)
        for name, values in arrays(vectors).items():
            np.testing.assert_array_equal(results[name].sel(pair=pair), values, err_msg=name)


def test_vectors_of_pairs(killed_run, stored, loops):
    results = open_results(killed_run.out)
    assert results.pair.values.tolist() == [0, 1]
    found = displacements(results)
    assert len(found) >= 0.9 * results.valid.size
    np.testing.assert_allclose(found.mean(axis=0), DISPLACEMENT_VOXEL, atol=BIAS)
    np.testing.assert_allclose(results.u, results.displacement_x * VOXEL_MM / 1000 / DT_S, rtol=1e-5)
    stored.check("run: vectors", loops, arrays(results))
    volumes = sorted((killed_run.out / "volumes").iterdir())
    assert [path.name for path in volumes] == [f"pair_000{pair}_{frame}.nc" for pair in (0, 1) for frame in "ab"]
    stored.check("run: volumes", loops, {path.name: xr.load_dataarray(path).values for path in volumes})


def test_particles_of_pairs(killed_run, stored, loops):
    particles = open_particles(killed_run.out)
    assert particles.valid.sum() > 60
    moved = np.stack([particles[f"displacement_{axis}"].values[particles.valid.values] for axis in "xyz"], axis=-1)
    assert np.sqrt(((moved - DISPLACEMENT_VOXEL) ** 2).mean()) < PARTICLE
    columns = {name: particles[name].values for name in ("x", "y", "z", "intensity")}
    stored.check("run: particles", loops, columns, listed=True)


def test_summary_and_report(killed_run):
    summary = json.loads((killed_run.out / "summary.json").read_text("utf-8"))
    assert all(camera["sigma_nor_test"] < 0.02 for camera in summary["calibration"].values())
    assert "<svg" in (killed_run.out / "report.html").read_text("utf-8")


@pytest.mark.slow
def test_a_finished_run_repeats_nothing(killed_run, tmp_path):
    out = shutil.copytree(killed_run.out, tmp_path / "out")
    before = {path: path.stat().st_mtime_ns for path in sorted(out.rglob("*.nc"))}
    done("run", killed_run.experiment, "--out", out, "--keep-volumes")
    assert {path: path.stat().st_mtime_ns for path in sorted(out.rglob("*.nc"))} == before


@pytest.mark.slow
def test_vectors_of_a_series_beside_a_wall(series, stored, loops):
    results = open_results(series.out)
    assert results.instant.values.tolist() == [0, 1, 2]
    np.testing.assert_allclose(results.time, [0, DT_S, 2 * DT_S])
    assert results.masked.any() and not results.masked.all()
    assert not results.valid.values[results.masked.values].any()
    np.testing.assert_allclose(displacements(results).mean(axis=0), DISPLACEMENT_VOXEL, atol=2 * BIAS)
    stored.check("series: vectors", loops, arrays(results))


@pytest.mark.slow
def test_tracks_of_a_series(series, stored, loops):
    tracks = open_tracks(series.out)
    kept = tracks.valid.values
    assert kept.any()
    speed = np.stack([tracks[name].values[kept] for name in "uvw"], axis=-1)
    expected = np.array(DISPLACEMENT_VOXEL) * VOXEL_MM / 1000 / DT_S
    np.testing.assert_allclose(speed.mean(axis=0), expected, atol=BIAS * VOXEL_MM / 1000 / DT_S)
    found = {name: tracks[name].values for name in ("instant", "x", "u", "valid")}
    found["lengths"] = np.bincount(tracks.track.values)  # the numbers themselves grow along the list
    stored.check("series: tracks", loops, found, listed=True)
