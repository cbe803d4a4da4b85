"""Runs on a time series: each instant is read and reconstructed once, whatever the step, the workers and the deaths."""

import dataclasses
import json
import re
import shutil
import weakref
from collections import Counter

import hypothesis
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from support.series_run import FIRST, chained, changed, in_processes, make_work, write_series
from support.small_run import PAIRS, damage, same_vectors
from xarray.testing import assert_equal

import lfpiv
from lfpiv.cli import commands
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import read_experiment
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.results import datasets, netcdf, provenance
from lfpiv.results.folder import Folder
from lfpiv.results.pair_files import FrameVolume
from lfpiv.runs import background, dispatch, guard, pipeline, refinement
from lfpiv.runs.run import open_run
from lfpiv.runs.work_units import MOST_INSTANTS, cut
from lfpiv.warn import Code, from_text

INSTANTS = 6
"""Number of instants of a run; `write_series` writes two for each pair of the small run."""


@pytest.fixture(scope="module")
def made(small_run, tmp_path_factory):
    """Experiment file of the series and the work on all its pairs."""
    folder = tmp_path_factory.mktemp("series")
    file = write_series(small_run, folder / "data")
    return file, make_work(small_run, file, folder / "out")


@pytest.fixture
def solved(monkeypatch):
    """Count the reconstructions and the images that are read."""
    counts, prepare, read = Counter(), SmartSolver.prepare, Experiment.frame_image

    def counted_prepare(self, *arguments, **settings):
        counts["volumes"] += 1
        return prepare(self, *arguments, **settings)

    def counted_read(self, name, frame):
        counts["images"] += 1
        return read(self, name, frame)

    monkeypatch.setattr(SmartSolver, "prepare", counted_prepare)
    monkeypatch.setattr(Experiment, "frame_image", counted_read)
    return counts


def sequential(work, todo=None):
    todo = todo or chained(work.experiment.numbers, work.experiment.recording.step)
    return list(dispatch.sequential(work, todo, lambda fraction: None))


@pytest.fixture(scope="module")
def reference(made, tmp_path_factory):
    """Output folder of one process, step 1."""
    work = changed(made[1], tmp_path_factory.mktemp("reference"))
    assert [outcome.reason for outcome in sequential(work)] == [""] * (INSTANTS - 1)
    return work.folder.path


TODO = st.tuples(st.integers(0, 50), st.sets(st.integers(0, 120), min_size=1), st.integers(1, 5), st.integers(1, 9))


@hypothesis.settings(deadline=None)
@given(TODO)
def test_work_units_cover_each_pair_once_and_share_no_instant(case):
    first, chosen, step, workers = case
    todo = sorted(first + pair for pair in chosen)
    units = list(cut(chained(todo, step), step, workers))
    boundary_pairs = Counter(pair for unit in units for pair in unit.boundary_pairs)
    assert set(boundary_pairs.values()) <= {2}, "a boundary pair lies between two work units"
    assert sorted([*boundary_pairs, *(pair for unit in units for pair in unit.pairs)]) == todo
    instants = Counter()
    for unit in units:
        assert 1 <= len(unit.pairs) < MOST_INSTANTS
        assert all(after == before + step for before, after in zip(unit.pairs, unit.pairs[1:], strict=False))
        own = {*unit.pairs, unit.pairs[-1] + step}
        instants.update(own)
        assert set(unit.stored) <= own
    assert set(instants.values()) <= {1} and set(instants) == {*todo, *(pair + step for pair in todo)}
    stored = {instant for unit in units for instant in unit.stored}
    assert stored == {instant for pair in boundary_pairs for instant in (pair, pair + step)}
    assert [unit.pairs for unit in cut(todo, None, workers)] == [(pair,) for pair in todo]


@pytest.mark.parametrize("step", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_each_instant_is_read_and_reconstructed_once_and_two_volumes_are_held(
    made, tmp_path, solved, step, monkeypatch
):
    volumes, build = [], FrameVolume.__init__

    def remembered(self, **fields):
        build(self, **fields)
        volumes.append(weakref.ref(self))

    # `gc.get_objects` would break a tuple that another thread is building.
    monkeypatch.setattr(FrameVolume, "__init__", remembered)
    work, held = changed(made[1], tmp_path, step=step), []
    for outcome in dispatch.sequential(work, chained(work.experiment.numbers, step), lambda fraction: None):
        assert not outcome.reason
        held.append(sum(volume() is not None for volume in volumes))
    assert solved == {"volumes": INSTANTS, "images": 2 * INSTANTS}
    assert len(held) == INSTANTS - step and 1 <= min(held) and max(held) <= 2


@pytest.mark.slow
@pytest.mark.parametrize(("step", "workers", "instants"), [(1, 3, 6), (2, 2, 8)])
def test_several_workers_reconstruct_each_instant_once_with_equal_numbers(
    made, reference, tmp_path, solved, step, workers, instants
):
    work = changed(made[1], tmp_path / "out", step=step, instants=instants, scratch=tmp_path / "scratch")
    outcomes, client = in_processes(work, workers)
    assert sorted(outcomes) == list(work.experiment.numbers) and not any(one.reason for one in outcomes.values())
    assert solved == {"volumes": instants, "images": 2 * instants}
    assert len(client.submitted) > workers and any(unit.boundary_pairs for unit in client.submitted)
    assert not list((tmp_path / "scratch").iterdir()), "volumes that no one needs any more"
    if step > 1:
        reference = tmp_path / "one"
        sequential(changed(made[1], reference, step=step, instants=instants))
    assert same_vectors(reference, tmp_path / "out") == instants - step


@pytest.mark.slow
def test_vectors_are_those_of_the_same_images_as_pairs(small_run, made, reference):
    smart = made[1].experiment.smart.model_copy(update={"estimate": "correlation"})
    alone = dataclasses.replace(read_experiment(small_run.experiment), smart=smart)
    rig = lfpiv.prepare(alone, lfpiv.load_calibration(small_run.out / "calibration.h5"))
    for pair in range(INSTANTS // 2):
        one = lfpiv.measure_pair(rig, pair)
        other = netcdf.read_vectors(reference / "vectors" / f"instant_{FIRST + 2 * pair:06d}.nc")
        assert_equal(one, other)


@pytest.mark.slow
def test_a_work_unit_whose_worker_dies_goes_on_after_its_finished_pairs(made, reference, tmp_path, solved):
    work = changed(made[1], tmp_path / "out", scratch=tmp_path / "scratch")
    plain = list(cut(list(work.experiment.numbers), 1, 1))
    longest = max(plain, key=lambda unit: len(unit.pairs))
    assert len(longest.pairs) == 2
    outcomes, client = in_processes(work, 1, {longest.pairs[0]: [1]})
    assert client.submitted.count(longest) == 2
    assert not any(outcome.reason for outcome in outcomes.values()) and len(outcomes) == INSTANTS - 1
    assert solved["volumes"] <= INSTANTS + 1, "at most the instant that the lost process held, once more"
    assert same_vectors(reference, tmp_path / "out") == INSTANTS - 1


@pytest.mark.slow
def test_a_work_unit_that_kills_two_workers_has_failed_but_for_its_finished_pairs(small_run, made, tmp_path):
    work = changed(made[1], tmp_path / "out", scratch=tmp_path / "scratch")
    outcomes, client = in_processes(work, 1, {FIRST: [1, 1]})
    died = client.submitted[0].pairs
    assert [pair for pair, outcome in outcomes.items() if outcome.died] == list(died) and len(died) == 2
    shutil.copy2(small_run.out / "calibration.h5", tmp_path / "out")
    with open_run(made[0], tmp_path / "out", None, None) as run:
        folder = Folder(small_run.out)
        run = dataclasses.replace(run, guard=guard.read(folder)[0], refinement=refinement.read(folder)[0])
        run.folder.vectors(died[1]).unlink()  # it died before it wrote this one
        tried = set()
        for pair in died:
            run.record(outcomes[pair], tried)
    reasons = {outcome.pair: outcome.reason for outcome in tried}
    assert not reasons[died[0]] and "in each of two trials" in reasons[died[1]]


@pytest.mark.slow
def test_a_stopped_series_goes_on_at_any_instant(made, reference, tmp_path, solved):
    work = changed(made[1], tmp_path / "out")
    some = dispatch.sequential(work, list(work.experiment.numbers), lambda fraction: None)
    done = [next(some).pair for _ in range(3)]
    some.close()
    assert done == [FIRST, FIRST + 1, FIRST + 2] and solved["volumes"] == 5, "one more is done when it stops"
    (tmp_path / "out" / "vectors" / f"instant_{FIRST + 1:06d}.nc").unlink()
    todo = [pair for pair in work.experiment.numbers if work.files(pair).fitting_vectors() is None]
    assert todo == [FIRST + 1, FIRST + 4]
    solved.clear()
    sequential(work, todo)
    assert solved["volumes"] == 4, "those that a pair needs, each once"
    assert same_vectors(reference, tmp_path / "out") == INSTANTS - 1


@pytest.mark.slow(but="None")
@pytest.mark.parametrize("workers", [None, 2])
def test_a_bad_image_fails_its_two_pairs_and_is_read_once(small_run, made, tmp_path, solved, workers):
    file = write_series(small_run, tmp_path / "data")
    spoilt = FIRST + 2
    damage(file.parent / f"run/left/{spoilt:05d}.tif")
    settings = {} if workers is None else {"scratch": tmp_path / "scratch"}
    work = changed(made[1], tmp_path / "out", **settings)
    work = dataclasses.replace(work, experiment=dataclasses.replace(work.experiment, path=file))
    outcomes = sequential(work) if workers is None else in_processes(work, workers)[0].values()
    reasons = {outcome.pair: outcome.reason for outcome in outcomes if outcome.reason}
    assert sorted(reasons) == [spoilt - 1, spoilt] and len(set(reasons.values())) == 1
    assert f"camera 'left', instant {spoilt}" in reasons[spoilt]
    assert len(list((tmp_path / "out" / "vectors").iterdir())) == INSTANTS - 3
    assert solved["volumes"] == INSTANTS - 1
    if workers is None:
        assert solved["images"] == 2 * INSTANTS - 1, "the first camera's image ends the reading of its instant"


@pytest.mark.slow
def test_an_instant_has_one_volume_which_both_its_pairs_use(made, reference, tmp_path, solved):
    work = changed(made[1], tmp_path, keep_volumes=True)
    only = dataclasses.replace(work, vectors=False)
    assert not any(outcome.reason for outcome in sequential(only)) and solved["volumes"] == INSTANTS
    names = [f"instant_{FIRST + number:06d}.nc" for number in range(INSTANTS)]
    assert sorted(path.name for path in (tmp_path / "volumes").iterdir()) == names
    stored = netcdf.read_volume(tmp_path / "volumes" / names[2])
    about = datasets.read_attributes(tmp_path / "volumes" / names[2])
    assert about["instant"] == FIRST + 2 and about["time_s"] == pytest.approx(2e-3) and stored.dims == ("z", "y", "x")
    (tmp_path / "volumes" / names[5]).unlink()
    solved.clear()
    assert not any(outcome.reason for outcome in sequential(only, [FIRST + 4])) and solved["volumes"] == 1
    sequential(dataclasses.replace(work, weights=None))
    assert solved["volumes"] == 1 and same_vectors(reference, tmp_path) == INSTANTS - 1
    found = datasets.read_attributes(tmp_path / "vectors" / names[2])
    assert (found["instant"], found["step"], found["time_s"]) == (FIRST + 2, 1, pytest.approx(2e-3))
    assert "pair" not in found
    (tmp_path / "volumes" / names[5]).unlink()
    (tmp_path / "vectors" / names[4]).unlink()
    (missing,) = sequential(dataclasses.replace(work, weights=None), [FIRST + 4])
    assert f"{names[5]}: expected the volume of instant {FIRST + 5}" in missing.reason


def test_a_new_image_concerns_its_volume_and_two_pairs(made, small_run, tmp_path):
    file = write_series(small_run, tmp_path / "data")
    work = changed(made[1], tmp_path / "out", keep_volumes=True)
    work = dataclasses.replace(work, experiment=dataclasses.replace(work.experiment, path=file))
    numbers = work.experiment.numbers
    made_of = {pair: provenance.Marks(**work.files(pair).stamp.attributes) for pair in numbers}
    of_volumes = {
        one.frame: provenance.Marks(**one.stamp.attributes) for pair in numbers for one in work.files(pair).frames
    }
    path = file.parent / f"run/left/{FIRST + 3:05d}.tif"
    shutil.copy(path, tmp_path / "copy")
    path.unlink()
    (tmp_path / "copy").rename(path)
    after = {pair: work.files(pair) for pair in numbers}
    assert all(after[pair].stamp.fits(made_of[pair]) for pair in numbers), "a copy is the same image"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    after = {pair: work.files(pair) for pair in numbers}
    assert [pair for pair in numbers if not after[pair].stamp.fits(made_of[pair])] == [FIRST + 2, FIRST + 3]
    volumes = {one.frame: one.stamp for pair in numbers for one in after[pair].frames}
    changed_frames = [frame for frame, stamp in volumes.items() if not stamp.fits(of_volumes[frame])]
    assert changed_frames == [work.experiment.recording.frame(FIRST + 3)]
    step = changed(work, tmp_path / "out", step=2).files(FIRST)
    assert step.frames[0].stamp.hash == after[FIRST].frames[0].stamp.hash, "the step does not change a volume"
    assert step.stamp.hash != after[FIRST].stamp.hash


@pytest.mark.slow
def test_what_two_instants_show_together_is_kept_with_their_vectors_only(small_run, made, tmp_path):
    """The left half of one image is dark: uneven with both neighbours, named by instant; nothing in its volume."""
    file = write_series(small_run, tmp_path / "data")
    dark = FIRST + 2
    path = file.parent / f"run/left/{dark:05d}.tif"
    image = tifffile.imread(path)
    image[:, :200] = np.median(image)
    tifffile.imwrite(path, image)
    work = changed(made[1], tmp_path / "out", keep_volumes=True, instants=5)
    work = dataclasses.replace(work, experiment=dataclasses.replace(work.experiment, path=file))
    assert not any(outcome.reason for outcome in sequential(work))
    uneven = {}
    for pair in work.experiment.numbers:
        found = from_text(datasets.read_attributes(work.folder.vectors(pair))["warnings"])
        uneven[pair] = [warning.subject for warning in found if warning.code is Code.UNEVEN]
    assert uneven == {FIRST: [], FIRST + 1: ["left"], FIRST + 2: ["left"], FIRST + 3: []}
    marks = provenance.read_marks(work.folder.volume(dark, 0))
    assert not any(warning.code is Code.UNEVEN for warning in marks.warnings)


def test_a_copied_instant_is_refused_in_the_pair_that_holds_both(small_run, made, tmp_path):
    file = write_series(small_run, tmp_path / "data")
    for camera in ("left", "right"):
        folder = file.parent / "run" / camera
        shutil.copy(folder / f"{FIRST + 1:05d}.tif", folder / f"{FIRST + 2:05d}.tif")
    work = changed(made[1], tmp_path / "out", instants=4)
    work = dataclasses.replace(work, experiment=dataclasses.replace(work.experiment, path=file))
    reasons = {outcome.pair: outcome.reason for outcome in sequential(work)}
    assert [pair for pair, reason in reasons.items() if reason] == [FIRST + 1]
    assert f"left, instant {FIRST + 2}: expected an image of its own" in reasons[FIRST + 1]


def test_standing_light_comes_from_images_of_one_laser(made):
    file, work = made
    experiment = read_experiment(file)
    pairs = background.series(experiment)
    images = [frame for pair in pairs for frame in experiment.recording.new_frames(pair)]
    assert len(set(images)) == len(images) == len(pairs) == PAIRS, "an image is used twice, or a neighbour of it"
    median = dataclasses.replace(experiment, background="median")
    light = background.estimate(median, work.cameras, pairs, lambda fraction: None).cameras["left"].light
    stack = np.stack([light[0], light[1]])
    assert np.array_equal(stack[0], stack[1]), "one laser, one light"


def test_a_background_image_of_a_series_is_one(small_run, tmp_path):
    file = write_series(small_run, tmp_path / "data")
    text = file.read_text()
    file.write_text(text.replace('name = "left"\n', 'name = "left"\nbackground_image = "empty_{frame}.tif"\n'))
    with pytest.raises(InputError, match=r"background_image: expected no \{frame\}, because one laser"):
        read_experiment(file)


@pytest.mark.slow
def test_the_command_runs_a_series_in_two_processes(small_run, tmp_path, capfd):
    """From images to summary; a bad instant, its mending, and what is printed, in the words of a series."""
    file, out = write_series(small_run, tmp_path / "data"), small_run.calibrated(tmp_path / "out")
    file.write_text(file.read_text().replace(f"instants = {2 * PAIRS}", f"instants = {INSTANTS}"))
    spoilt = file.parent / f"run/right/{FIRST + 3:05d}.tif"
    good = spoilt.read_bytes()
    damage(spoilt)
    assert commands.call(["run", str(file), "--out", str(out), "--workers", "2"]) == 3
    printed, said = capfd.readouterr()
    assert len(re.findall(r"instant \d+: reconstructed in", said)) == INSTANTS - 1
    assert f"failed: instant {FIRST + 2}: " in printed and f"failed: instant {FIRST + 3}: " in printed
    summary = json.loads((out / "summary.json").read_text())
    assert [item["pair"] for item in summary["failed"]] == [FIRST + 2, FIRST + 3]
    assert summary["experiment"]["series"] == {"instants": INSTANTS, "first": FIRST, "step": 1}
    spoilt.write_bytes(good)
    result = pipeline.run(file, out)
    assert result["failed"] == []
    assert [item["pair"] for item in result["pairs"]] == [*range(FIRST, FIRST + INSTANTS - 1)]
    assert all("pair" not in text for text in result["warnings"] if "vectors are valid" in text)
    assert [item["valid_fraction"] > 0.9 for item in result["pairs"]] == [True, False, True, False, True]
