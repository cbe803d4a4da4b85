"""Refinement of a run: measured once, stamped, told, bounded by the memory, and not seen in the grid of the results."""

import dataclasses
import json

import numpy as np
import pytest

from lfpiv.experiment.mask import Mask
from lfpiv.experiment.opening import read_experiment
from lfpiv.results import netcdf, provenance, stamps
from lfpiv.results.folder import Folder
from lfpiv.results.stamps import Inputs
from lfpiv.runs import guard, memory, pipeline, refinement
from lfpiv.runs.refinement import Refinement
from lfpiv.settings.volume import Box
from lfpiv.warn import Code


@pytest.fixture
def experiment(small_run):
    return read_experiment(small_run.experiment)


def stated(experiment, value):
    return dataclasses.replace(experiment, smart=experiment.smart.model_copy(update={"refinement": value}))


def test_the_outcome_is_stored_and_fits_until_the_volume_changes(small_run, experiment):
    stamp = stamps.of_calibration(experiment).hash
    found, marks = refinement.read(Folder(small_run.out))
    assert found.pairs and Refinement.from_json(json.loads(json.dumps(found.to_json()))) == found
    moved = dataclasses.replace(experiment.grid, first_centre_mm=(0.0, 0.0, 0.0))
    assert stamps.of_guard(experiment, stamp, found.pairs).fits(marks)
    assert not stamps.of_guard(dataclasses.replace(experiment, grid=moved), stamp, found.pairs).fits(marks)
    told = small_run.summary["refinement"]
    assert told["factor"] == found.factor > 1 and told["particle_size_voxel"] == found.size_voxel
    assert told["voxel_mm"] == pytest.approx(experiment.grid.voxel_mm / found.factor)


def test_results_of_other_voxels_are_others(experiment):
    plain, finer = (stamps.of_pair(experiment, Inputs("c", refinement=one), 0) for one in (1.0, 1.25))
    marks = provenance.Marks(**plain.volumes[0].attributes)
    assert finer.volumes[0].changes(marks) == ["refinement"] and plain.volumes[0].fits(marks)


def test_the_file_of_the_experiment_decides_if_it_states_a_number(experiment):
    found = Refinement(pairs=(0,), size_voxel=0.7, factor=1.3, demanded=1.3)
    assert refinement.factor(experiment, found) == 1.3 and refinement.factor(experiment, None) == 1
    assert refinement.factor(stated(experiment, 1.5), found) == 1.5
    assert refinement.warnings(experiment, found) == []


def test_memory_that_allows_larger_voxels_only_is_told(experiment):
    found = Refinement(pairs=(0,), size_voxel=0.5, factor=1.1, demanded=1.35)
    (warning,) = refinement.warnings(experiment, found)
    assert warning.code is Code.COARSE_VOXELS and "0.50 voxel" in warning.sentence and "memory" in warning.sentence
    assert refinement.warnings(stated(experiment, 1.1), found) == []


def test_estimates_of_memory_count_the_finer_voxels(experiment):
    finer = refinement.refined(experiment, 1.3)
    assert finer.grid.size > 2 * experiment.grid.size
    assert memory.worker_bytes(finer) > memory.worker_bytes(experiment)
    assert memory.weights_bytes(finer) > memory.weights_bytes(experiment)


def test_finer_voxels_are_solid_where_their_centres_are(experiment):
    box = Box(centre_mm=tuple(experiment.grid.centre_mm), size_mm=(0.3, 0.4, 0.2))
    masked = dataclasses.replace(
        experiment, mask=Mask(path=experiment.path, grid=experiment.grid, file=None, solid=(box,))
    )
    frame = experiment.pair_frames(0)[0]
    finer = refinement.refined(guard.with_guard(masked, ((1, 1),) * 3), 1.3).grid
    solid = masked.solid(frame, finer)
    assert solid.shape == finer.shape and 0 < solid.mean() < 1
    np.testing.assert_array_equal(solid[experiment.grid.nearest_in(finer)], masked.solid(frame))


@pytest.mark.slow
def test_volumes_are_written_on_the_voxels_of_the_experiment_without_guard_layers(small_run, tmp_path):
    file = small_run.images(tmp_path / "data")
    text = file.read_text()
    assert "[smart]\n" in text
    text = text.replace("[volume]", "[volume]\nguard_mm = [0.0, 0.1, 0.2]")
    file.write_text(text.replace("[smart]\n", "[smart]\nrefinement = 1.25\nsieve_voxel = 0.6\n"))
    out, experiment = small_run.calibrated(tmp_path / "out"), read_experiment(file)
    summary = pipeline.run(file, out, pairs=(0, 1), keep_volumes=True)
    assert summary["guard"]["thickness_mm"] == [[0.0, 0.0], [0.1, 0.1], [0.2, 0.2]]
    assert summary["refinement"]["factor"] == 1.25 and not (out / "refinement.json").exists()
    volume = netcdf.read_volume(out / "volumes" / "pair_0000_a.nc", grid=experiment.grid)
    assert volume.shape == experiment.grid.shape
    assert volume.z.values[0] == pytest.approx(experiment.grid.axis_mm(0)[0])
    assert volume.attrs["sieve_voxel"] == pytest.approx(0.6)
    assert volume.attrs["reconstruction_voxel_mm"] == pytest.approx(experiment.grid.voxel_mm / 1.25)
    assert "vectors of pair 0" in pipeline.run(file, out, pairs=(0, 1), keep_volumes=True)["reused"]
    file.write_text(text.replace("[smart]\n", "[smart]\nrefinement = 1.5\nsieve_voxel = 0.6\n"))
    assert "vectors of pair 0" not in pipeline.run(file, out, pairs=(0, 1), keep_volumes=True)["reused"]
