"""Guard layers of a run: decided once, stamped, told, and cut away."""

import dataclasses
import json

import pytest

from lfpiv.experiment.opening import read_experiment
from lfpiv.geometry.grid import NO_LAYERS
from lfpiv.reconstruction.beyond import FaceLight
from lfpiv.results import provenance, stamps
from lfpiv.results.folder import Folder
from lfpiv.results.stamps import Inputs
from lfpiv.runs import guard, memory
from lfpiv.runs.guard import Guard
from lfpiv.warn import Code

FACE = FaceLight(axis=0, side=1, reach_mm=0.2, share=0.1, guard_mm=0.3, farther=False, limit="the end of the search")


@pytest.fixture
def experiment(small_run):
    return read_experiment(small_run.experiment)


def test_the_outcome_is_stored_and_fits_until_the_volume_changes(small_run, experiment, tmp_path):
    stamp = stamps.of_calibration(experiment).hash
    found, marks = guard.read(Folder(small_run.out))
    assert found.pairs and Guard.from_json(json.loads(json.dumps(found.to_json()))) == found
    moved = dataclasses.replace(experiment.grid, first_centre_mm=(0.0, 0.0, 0.0))

    def fits(experiment, stamp, background=None):
        return stamps.of_guard(experiment, stamp, found.pairs, background).fits(marks)

    assert fits(experiment, stamp) and not fits(experiment, "another calibration")
    assert not fits(experiment, stamp, "other light") and not fits(dataclasses.replace(experiment, grid=moved), stamp)
    assert small_run.summary["guard"]["pairs"] == list(found.pairs)


def test_results_with_guard_layers_are_others(experiment):
    plain, guarded = (
        stamps.of_pair(experiment, Inputs("c", guard=one), 0) for one in (NO_LAYERS, ((1, 2), (0, 0), (0, 0)))
    )
    marks = provenance.Marks(**plain.volumes[0].attributes)
    assert guarded.volumes[0].changes(marks) == ["guard"] and plain.volumes[0].fits(marks)


def test_a_warning_names_the_face_and_whether_layers_hold_the_light(experiment):
    found = Guard(pairs=(0,), faces=(FACE,), layers=((0, 3), (0, 0), (0, 0)))
    (handled,) = guard.warnings(experiment, found)
    assert handled.code is Code.LIGHT_GUARDED and "z = 0.6 mm" in handled.sentence and "0.2 mm" in handled.sentence
    (without,) = guard.warnings(dataclasses.replace(experiment, guard_mm=0.0), found)
    assert without.code is Code.LIGHT_UNGUARDED and "volume.guard_mm" in without.sentence
    (short,) = guard.warnings(experiment, dataclasses.replace(found, layers=NO_LAYERS, short=True))
    assert short.code is Code.LIGHT_UNGUARDED and "memory" in short.sentence
    farther = dataclasses.replace(found, faces=(dataclasses.replace(FACE, farther=True),))
    assert guard.warnings(experiment, farther)[0].code is Code.LIGHT_UNGUARDED
    assert guard.warnings(experiment, None) == []


def test_estimates_of_memory_count_the_guard_layers(experiment):
    padded = guard.with_guard(experiment, ((6, 6), (0, 0), (0, 0)))
    assert padded.grid.shape[0] == experiment.grid.shape[0] + 12
    assert memory.worker_bytes(padded) > memory.worker_bytes(experiment)
    assert memory.weights_bytes(padded) > memory.weights_bytes(experiment)
