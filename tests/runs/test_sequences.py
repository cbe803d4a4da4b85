"""Instants reconstructed one after the other: the numbers do not depend on where a run began, on workers or deaths."""

import dataclasses
import shutil
from collections import Counter

import hypothesis
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.series_run import FIRST, Processes, changed, make_work, write_series
from support.small_run import damage, same_vectors

from lfpiv.experiment import segments
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.results import netcdf, provenance
from lfpiv.runs import dispatch
from lfpiv.runs.work_units import cut_at_segments
from lfpiv.sequence import solver as sequence
from lfpiv.warn import Code

INSTANTS = 7
"""Number of instants of a run; with those below they are 3 to 5, 6 to 8 and 9, the last two with one to lead in."""


@pytest.fixture(autouse=True)
def short_segments(monkeypatch):
    monkeypatch.setattr(segments, "SEGMENT", 3)
    monkeypatch.setattr(segments, "LEAD_IN", 1)
    monkeypatch.setattr(segments, "REACH", 1)


@pytest.fixture(scope="module")
def made(small_run, tmp_path_factory):
    """Experiment file of the series and the work on all its pairs, with prediction."""
    folder = tmp_path_factory.mktemp("sequence")
    file = write_series(small_run, folder / "data")
    return file, predicting(make_work(small_run, file, folder / "out"))


def predicting(work, predict=True):
    smart = work.experiment.smart.model_copy(update={"predict": predict})
    return dataclasses.replace(work, experiment=dataclasses.replace(work.experiment, smart=smart))


def at(work, file):
    return dataclasses.replace(work, experiment=dataclasses.replace(work.experiment, path=file))


@pytest.fixture
def solved(monkeypatch):
    """Count the instants that are reconstructed."""
    counts, prepare = Counter(), SmartSolver.prepare

    def counted(self, *arguments, **settings):
        counts["volumes"] += 1
        return prepare(self, *arguments, **settings)

    monkeypatch.setattr(SmartSolver, "prepare", counted)
    return counts


def sequential(work, todo=None):
    return list(dispatch.sequential(work, todo or list(work.experiment.numbers), lambda fraction: None))


def in_segments(work, workers, deaths=None):
    """Do all pairs in work units of a segment each; return their outcomes by pair, and the client."""
    client, todo = Processes(work, deaths), list(work.experiment.numbers)
    units = cut_at_segments(todo, work.experiment.recording.step)
    found = dispatch.Dispatch(client, lambda: workers, work.folder.path, units, len(todo), "instant")
    return {outcome.pair: outcome for outcome in found.outcomes(lambda fraction: None)}, client


@pytest.fixture(scope="module")
def reference(made, tmp_path_factory):
    """Output folder of one process, step 1, with volumes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segments, "SEGMENT", 3)
        patch.setattr(segments, "LEAD_IN", 1)
        patch.setattr(segments, "REACH", 1)
        work = changed(made[1], tmp_path_factory.mktemp("reference"), instants=INSTANTS, keep_volumes=True)
        assert [outcome.reason for outcome in sequential(work)] == [""] * (INSTANTS - 1)
    return work.folder.path


def volumes(folder):
    return {path.name: netcdf.read_volume(path).values for path in sorted((folder / "volumes").iterdir())}


@hypothesis.settings(deadline=None)
@given(st.sets(st.integers(0, 200), min_size=1), st.integers(1, 90))
def test_work_units_are_segments_and_cover_each_pair_once(chosen, step):
    todo = sorted(chosen)
    units = list(cut_at_segments(todo, step))
    boundary_pairs = Counter(pair for unit in units for pair in unit.boundary_pairs)
    assert set(boundary_pairs.values()) <= {2}, "a boundary pair lies between two work units"
    assert sorted([*boundary_pairs, *(pair for unit in units for pair in unit.pairs)]) == todo
    stored = Counter()
    for unit in units:
        assert len({segments.segment_of(pair) for pair in unit.pairs}) == 1
        assert unit.pairs == tuple(sorted(unit.pairs))
        reached = {instant for pair in unit.pairs for instant in (pair, pair + step)}
        assert set(unit.stored) <= reached, "an instant that nobody reconstructs"
        stored.update(unit.stored)
    assert set(stored) == {instant for pair in boundary_pairs for instant in (pair, pair + step)}


@given(st.integers(0, 100), st.integers(2, 300), st.data())
def test_an_instant_follows_from_the_beginning_of_its_segment(first, instants, data):
    frames = range(first, first + instants)
    instant = data.draw(st.sampled_from(frames))
    found = segments.followed(frames, instant)
    assert found[-1] == instant and found[0] >= first
    begins = instant - instant % segments.SEGMENT
    assert found[0] == max(begins - segments.LEAD_IN, first)
    later = min(instant + segments.REACH, first + instants - 1)
    assert segments.depended_on(frames, instant) == [one for one in range(found[0], later + 1) if one != instant]


@pytest.mark.slow
def test_the_numbers_are_those_of_one_process_for_any_beginning(made, reference, tmp_path, solved):
    work = changed(made[1], tmp_path / "out", instants=INSTANTS)
    for pair in reversed(work.experiment.numbers):  # each in an invocation of its own, the last one first
        assert not sequential(work, [pair])[0].reason
    assert same_vectors(reference, tmp_path / "out") == INSTANTS - 1
    solved.clear()
    shutil.rmtree(tmp_path / "out")
    sequential(changed(work, tmp_path / "out", instants=INSTANTS))
    assert solved["volumes"] == INSTANTS + 4, "two instants lead in, and two correct the last ones of their segments"


@pytest.mark.slow
def test_a_segment_whose_flow_is_given_up_has_the_numbers_of_instants_by_themselves(
    made, tmp_path, solved, monkeypatch
):
    monkeypatch.setattr(sequence, "ROUGHEST", -1.0)
    monkeypatch.setattr(sequence, "TRIES", 1)
    work = changed(made[1], tmp_path / "out", instants=INSTANTS)
    sequential(work)
    assert solved["volumes"] == INSTANTS + 2, "two instants lead in; none after a segment is reconstructed"
    sequential(predicting(changed(work, tmp_path / "alone", instants=INSTANTS), False))
    assert same_vectors(tmp_path / "alone", tmp_path / "out") == INSTANTS - 1


def warnings_of(folder):
    for path in sorted((folder / "volumes").iterdir()):
        yield from provenance.read_marks(path).warnings


@pytest.mark.slow
def test_the_numbers_are_those_of_one_process_for_several_workers_and_deaths(made, reference, tmp_path):
    work = changed(made[1], tmp_path / "out", instants=INSTANTS, scratch=tmp_path / "scratch")
    outcomes, client = in_segments(work, 3, {FIRST: [1]})
    assert sorted(outcomes) == list(work.experiment.numbers) and not any(one.reason for one in outcomes.values())
    assert any(unit.boundary_pairs for unit in client.submitted)
    assert client.submitted.count(client.submitted[0]) == 2, "a worker died"
    assert not list((tmp_path / "scratch").iterdir()), "volumes that no one needs any more"
    assert same_vectors(reference, tmp_path / "out") == INSTANTS - 1


@pytest.mark.slow
def test_the_step_changes_no_volume(made, reference, tmp_path, step=2):
    one = changed(made[1], tmp_path / "one", step=step, instants=INSTANTS, keep_volumes=True)
    assert not any(outcome.reason for outcome in sequential(one))
    found, expected = volumes(tmp_path / "one"), volumes(reference)
    used = {frame.number for pair in one.experiment.numbers for frame in one.experiment.pair_frames(pair)}
    assert list(found) == [name(instant - FIRST) for instant in sorted(used)]
    assert all(np.array_equal(found[name], expected[name]) for name in found)
    # boundary pairs whose two instants are both within a segment of pairs to do
    many = changed(one, tmp_path / "many", step=step, instants=INSTANTS, scratch=tmp_path / "scratch")
    outcomes, _ = in_segments(dataclasses.replace(many, keep_volumes=False), 2)
    assert not any(one.reason for one in outcomes.values())
    assert same_vectors(tmp_path / "one", tmp_path / "many") == INSTANTS - step


@pytest.mark.slow
def test_without_prediction_an_instant_depends_on_its_images_only(made, reference, tmp_path):
    work = changed(predicting(made[1], False), tmp_path / "out", instants=INSTANTS, keep_volumes=True)
    sequential(work, [FIRST + 4])
    sequential(dataclasses.replace(work, vectors=False), [FIRST])
    alone, follow = volumes(tmp_path / "out"), volumes(reference)
    equal = [number for number in (0, 1, 5) if np.array_equal(*(of[name(number)] for of in (alone, follow)))]
    assert equal == [0, 1], "the first two of a sequence, and one that is predicted"


def name(number):
    return f"instant_{FIRST + number:06d}.nc"


def test_a_new_image_concerns_one_before_the_rest_of_its_segment_and_what_it_leads_into(made, small_run, tmp_path):
    file = write_series(small_run, tmp_path / "data")
    work = at(changed(made[1], tmp_path / "out", instants=INSTANTS, keep_volumes=True), file)

    def frames():
        return {one.frame.number: one.stamp for pair in work.experiment.numbers for one in work.files(pair).frames}

    made_of = {number: provenance.Marks(**stamp.attributes) for number, stamp in frames().items()}

    def changed_since():
        return [number for number, stamp in frames().items() if not stamp.fits(made_of[number])]

    path = file.parent / f"run/left/{FIRST + 2:05d}.tif"  # the last one of its segment
    content = path.read_bytes()
    path.unlink()
    assert frames()[FIRST + 5].parts[provenance.IMAGES_BESIDE] is None and not changed_since()
    path.write_bytes(content)  # as a copy
    assert not changed_since()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    assert changed_since() == [4, 5, 6, 7, 8]


@pytest.mark.slow
def test_after_a_bad_or_repeated_image_the_sequence_begins_anew(made, small_run, tmp_path):
    file = write_series(small_run, tmp_path / "data")
    damage(file.parent / f"run/left/{FIRST + 1:05d}.tif")
    shutil.copy(file.parent / f"run/right/{FIRST + 3:05d}.tif", file.parent / f"run/right/{FIRST + 4:05d}.tif")
    work = at(changed(made[1], tmp_path / "out", instants=INSTANTS, step=2, keep_volumes=True), file)
    outcomes = {outcome.pair: outcome.reason for outcome in sequential(work)}
    assert [pair for pair, reason in outcomes.items() if reason] == [FIRST + 1]
    repeated = [warning for warning in warnings_of(tmp_path / "out") if warning.code is Code.REPEATED]
    assert [(one.instants, one.figures["camera"]) for one in repeated] == [((FIRST + 4,), "right")]
    assert f"instant {FIRST + 3}" in repeated[0].sentence


def test_particles_that_were_exchanged_are_noticed_and_warned_of(reference):
    """The series shows the same particles at instants 3 and 4, others at 5 and 6, and so on.

    In this small volume particles in other places agree with the images by chance: one of two exchanges is noticed.
    """
    missed = [warning for warning in warnings_of(reference) if warning.code is Code.NOT_FOLLOWED]
    assert {(FIRST + 2,)} <= {warning.instants for warning in missed} <= {(FIRST + 2,), (FIRST + 4,)}
    assert all(warning.figures["ratio"] > 0.9 for warning in missed)


@pytest.mark.slow
def test_an_image_out_of_order_in_one_camera_is_named_with_its_instant(made, small_run, tmp_path):
    """Instants 3 and 4 show the same particles, 5 and 6 others. With 3 in place of 6, 4 is more like 6 than 5."""
    file = write_series(small_run, tmp_path / "data")
    first, last = (file.parent / f"run/left/{FIRST + number:05d}.tif" for number in (0, 3))
    shutil.copy2(first, last)
    work = at(changed(made[1], tmp_path / "out", instants=INSTANTS), file)
    assert len(sequential(work)) == INSTANTS - 1
    marks = [provenance.read_marks(work.files(pair).vectors) for pair in work.experiment.numbers]
    found = [(one.subject, one.instants) for mark in marks for one in mark.warnings if one.code is Code.OUT_OF_ORDER]
    assert found == [("left", (FIRST + 2,))]
