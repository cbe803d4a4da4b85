"""Stored records of any other form are refused by name, or made again: never an unexpected error."""

import dataclasses
import fcntl
import json
import os
import shutil

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.pair_figures import pair_figures
from support.stored import rewrite, small_background, small_calibration
from support.vector_sets import random_vectors

import lfpiv
from lfpiv import records
from lfpiv.errors import InputError
from lfpiv.experiment.recording import Recording
from lfpiv.records import RecordError
from lfpiv.results import datasets, netcdf, provenance, summary_file
from lfpiv.results.folder import Folder, make_writable
from lfpiv.results.pair_files import FrameRecord, FrameVolume, VolumeFile
from lfpiv.runs import background, guard, refinement, summary
from lfpiv.runs.background import Background
from lfpiv.runs.guard import Guard
from lfpiv.runs.moved_cameras import MovementFigures, SelfCalibrationFigures
from lfpiv.runs.pair_figures import PairFigures, Spread
from lfpiv.runs.refinement import Refinement
from lfpiv.warn import Code, Warning

FEWER = settings(max_examples=settings().max_examples // 3, suppress_health_check=[HealthCheck.function_scoped_fixture])
"""For tests that write and read a file for each example."""

DEPTH = 1000
"""Nesting of hostile JSON, as many as Python's stack of calls."""

HOSTILE = {
    "null": "null",
    "number": "7",
    "text": '"text"',
    "list": "[]",
    "object": "{}",
    "deep": "[" * DEPTH + "]" * DEPTH,
    "deeper": '{"a":' * 100_000 + "1" + "}" * 100_000,
    "huge": "1" + "0" * 5000,
    "infinite": "1e999",
    "nan": "NaN",
    "twice": '{"schema_version": 1, "schema_version": 1}',
    "cut off": '{"schema_version": 1, "wei',
    "no text": "\ud800".encode("utf-8", "surrogatepass"),
}

ENTRIES = [
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=20),
    st.just(10**400),
    st.just({"low": 1}),
    st.just({"low": "a", "high": None}),
]
VALUES = st.recursive(
    st.one_of(ENTRIES),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
)


def places(record, path=()):
    """Yield the places of all entries in a nested record."""
    yield path
    items = record.items() if isinstance(record, dict) else enumerate(record) if isinstance(record, list) else ()
    for key, value in items:
        yield from places(value, (*path, key))


REMOVED = object()


def exchanged(record, path, value):
    """Return a copy of a nested record with another value at a place, or none if it is `REMOVED`."""
    if not path:
        return value
    copy = json.loads(json.dumps(record))
    inner = copy
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    if value is REMOVED:
        del inner[path[-1]]
    return copy


@st.composite
def mutations(draw, record):
    """Draw a record of which one entry is another value or missing."""
    path = draw(st.sampled_from(list(places(record))))
    if path and draw(st.booleans()):
        return exchanged(record, path, REMOVED)
    return exchanged(record, path, draw(VALUES))


WARNING = Warning(code=Code.SATURATED, subject="left, frame a", figures={"share": 0.2}, pairs=(1, 2))
FIGURES = pair_figures(
    0.9,
    warnings=(WARNING,),
    velocity_m_per_s={"u": Spread(mean=0.1, sd=0.2, min=None, max=1.0)},
    peak_ratio=2.0,
    residual={"a": [0.9, 0.5]},
    structure={"a": {"left": 0.5}},
    stop={"a": "iteration limit reached"},
)
MOVEMENT = MovementFigures(
    shift_mm=[0.1] * 3, shift_std_mm=[0.01] * 3, rotation_deg=[0.0] * 3, rotation_std_deg=[0.0] * 3
)
SELF_CALIBRATION = SelfCalibrationFigures(
    pairs=[0], disparity_before_voxel=1.0, disparity_voxel=0.1, movements={"left": MOVEMENT}
)
FACE = {"axis": 0, "side": 1, "reach_mm": 0.5, "share": 0.1, "guard_mm": 0.4, "farther": False, "limit": "the sight"}
GUARD = Guard.from_json({"pairs": [0, 1], "faces": [FACE], "layers": [[0, 2], [0, 0], [0, 0]], "short": False})
REFINEMENT = Refinement(pairs=(0, 1), size_voxel=0.7, factor=1.2, demanded=1.35)
CASES = {
    "warning": (Warning.from_json, WARNING.to_json()),
    "pair": (PairFigures.from_json, FIGURES.to_json()),
    "self-calibration": (SelfCalibrationFigures.from_json, SELF_CALIBRATION.to_json()),
    "guard": (Guard.from_json, GUARD.to_json()),
    "refinement": (Refinement.from_json, REFINEMENT.to_json()),
}


@pytest.mark.parametrize("name", list(CASES))
@given(data=st.data())
def test_a_record_of_another_form_is_refused_or_read(name, data):
    read, stored = CASES[name]
    stored = json.loads(json.dumps(stored))
    assert read(stored) is not None
    changed = data.draw(mutations(stored))
    try:
        found = read(changed)
    except RecordError as error:
        assert len(str(error)) < 400
        return
    json.dumps(found.to_json())  # what is accepted can be used
    if isinstance(found, Warning):
        assert isinstance(found.sentence, str)


@pytest.mark.parametrize("text", HOSTILE.values(), ids=list(HOSTILE))
def test_hostile_texts_are_refused_or_values(text):
    try:
        found = records.read_json(text)
    except RecordError:
        return
    for kind in (PairFigures, Guard, dict[str, float]):
        try:
            assert isinstance(records.validate(kind, found), dict)
        except RecordError:
            continue


SUMMARY = {
    "schema_version": 1,
    "weights": {"method": "footprint", "memory_mib": 1.0, "warnings": [WARNING.to_json()]},
    "timings_s": {"weights": 2.0, "report": None},
    "failed": [{"pair": 3, "reason": "image missing"}],
    "peak_memory_mib": 100.0,
}


@FEWER
@given(changed=mutations(SUMMARY))
def test_an_earlier_summary_of_any_form_is_used_or_left_out(tmp_path, changed):
    path = tmp_path / "summary.json"
    summary_file.write(SUMMARY, path)
    assert summary.read(path).failed == {3: "image missing"} and summary.read(path).weights_s == 2.0
    digest = {"digest": records.digest(changed)} if isinstance(changed, dict) else {}
    path.write_text(json.dumps(changed | digest if digest else changed))
    found = summary.read(path)
    assert (isinstance(found.weights, dict) and found.weights_s >= 0) or np.isnan(found.weights_s)
    assert all(isinstance(reason, str) for reason in found.failed.values())


def test_a_changed_summary_is_left_out_by_name(tmp_path, caplog):
    """A digit of a figure, which no form shows."""
    path = tmp_path / "summary.json"
    summary_file.write(SUMMARY, path)
    whole = path.read_text()
    assert summary.read(path).weights_s == 2.0 and not caplog.messages
    path.write_text(whole.replace("100.0", "900.0"))
    assert summary.read(path) == summary.EarlierSummary()
    assert "summary.json" in caplog.text and "digest differs" in caplog.text


@pytest.mark.parametrize("text", HOSTILE.values(), ids=list(HOSTILE))
def test_hostile_summaries_and_guards_are_left_out_by_name(tmp_path, text, caplog):
    folder = Folder(tmp_path)
    for path, read in (
        (folder.summary, lambda: summary.read(folder.summary)),
        (folder.guard, lambda: guard.read(folder)),
        (folder.refinement, lambda: refinement.read(folder)),
    ):
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        found = read()
        assert found is None or found == summary.EarlierSummary()
        assert path.name in caplog.text


def test_guard_layers_and_a_refinement_that_were_changed_are_measured_again(tmp_path, caplog):
    """The digest is over all entries."""
    folder = Folder(tmp_path)
    for path, read, entry, value, old, new in (
        (folder.guard, guard.read, "guard", GUARD, "[0, 2]", "[0, 3]"),
        (folder.refinement, refinement.read, "refinement", REFINEMENT, "1.2", "1.3"),
    ):
        content = json.loads(json.dumps({"settings_hash": "01", "depends_on": "{}", entry: value.to_json()}))
        path.write_text(json.dumps(content))
        assert read(folder) is None
        caplog.clear()
        sealed = json.dumps(content | {"digest": records.digest(content)})
        path.write_text(sealed)
        assert read(folder)[0] == value and not caplog.text
        path.write_text(sealed.replace(old, new))
        assert read(folder) is None and "digest differs" in caplog.text


# -- attributes of files -----------------------------------------------------------------------------------------------

ATTRIBUTES = st.one_of(
    st.sampled_from([text for text in HOSTILE.values() if isinstance(text, str) and len(text) < 60_000]),
    st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(),
    st.lists(st.integers(-5, 5), max_size=4).map(np.array),
    st.just(h5py.Empty("f8")),
    st.none(),
)


def vectors_file(folder):
    path = folder / "pair_0000.nc"
    stamp = {"pair": 0, "depends_on": {"volume": 1}, "settings_hash": "01", "figures": FIGURES.to_json()}
    netcdf.write_vectors(random_vectors(0), path, attributes=stamp | {"warnings": [WARNING.to_json()]})
    return path


def volume_file(folder):
    volume = abs(random_vectors(0)["u"]).astype(np.float32)
    record = FrameRecord(structure={"left": 0.5}, warnings=(WARNING,), seconds=1.0)
    frame = Recording().frame(0)
    origin = {"pair": 0, "frame": "a"}
    stamp = provenance.Stamp({"volume": 1})
    file = VolumeFile(frame=frame, path=folder / "pair_0000_a.nc", stamp=stamp, origin=origin)
    file.write(FrameVolume(volume=volume, record=record))
    return file


def set_attribute(name, value):
    def change(file):
        group = file
        for part in name.split("/")[:-1]:
            group = group[part]
        own = name.split("/")[-1]
        if value is None:
            group.attrs.pop(own, None)
        else:
            group.attrs[own] = value

    return change


@pytest.mark.slow
@FEWER
@given(
    name=st.sampled_from(
        [
            "schema_version",
            "depends_on",
            "figures",
            "warnings",
            "settings_hash",
            "pair",
            "file",
            "dt_s",
            "voxel_mm",
            "smart",
        ]
    ),
    value=ATTRIBUTES,
)
def test_attributes_of_vectors_in_any_form(tmp_path, name, value):
    folder = tmp_path / "vectors"
    folder.mkdir(exist_ok=True)
    path = vectors_file(folder)
    rewrite(path, set_attribute(name, value), sealed=True)
    marks = provenance.read_marks(path)
    assert marks is None or provenance.Stamp({"volume": 1}).changes(marks) is not None
    for read in (netcdf.read_vectors, lambda path: lfpiv.open_results(tmp_path).u.load(), datasets.read_attributes):
        try:
            assert read(path) is not None
        except InputError as error:
            assert path.name in str(error)


@pytest.mark.slow
@FEWER
@given(
    name=st.sampled_from(
        ["schema_version", "depends_on", "warnings", "frame", "seconds", "cameras", "structure", "file"]
    ),
    value=ATTRIBUTES,
)
def test_attributes_of_volumes_in_any_form(tmp_path, name, value):
    file = volume_file(tmp_path)
    assert file.read() is not None
    rewrite(file.path, set_attribute(name, value), sealed=True)
    found = file.read()
    assert found is None or isinstance(found.record.seconds, float)


CALIBRATION_ATTRIBUTES = [
    "schema_version", "cameras", "camera/left/report", "camera/left/warnings", "camera/left/optics.f_number",
    "camera/left/optics.sensor_shape", "camera/left/optics.layout", "camera/left/lattice.origin_mm",
    "camera/left/lattice.basis_mm", "camera/left/decoder/white_counts",
]  # fmt: skip


@FEWER
@given(name=st.sampled_from(CALIBRATION_ATTRIBUTES), value=ATTRIBUTES)
def test_attributes_of_calibrations_in_any_form(tmp_path, calibration_file, name, value):
    path = shutil.copy(calibration_file, tmp_path / "calibration.h5")
    rewrite(path, set_attribute(name, value), sealed=True)
    try:
        assert lfpiv.load_calibration(path).cameras
    except InputError as error:
        assert "calibration.h5" in str(error)


@FEWER
@given(name=st.sampled_from(["figures", "warnings", "left/figures"]), value=ATTRIBUTES)
def test_attributes_of_backgrounds_in_any_form(tmp_path, name, value):
    calibration, path = small_calibration(), tmp_path / "background.h5"
    light = small_background(calibration)
    background.write(Background(light, background.content_hash(light), {"left": {"share": 0.1}}), path, {})
    assert background.load(path, calibration).figures == {"left": {"share": 0.1}}
    rewrite(path, set_attribute(name, value), sealed=True)
    assert provenance.background_content(path) is None or provenance.background_figures(path) is not None
    try:
        assert background.load(path, calibration).content == background.content_hash(light)
    except InputError as error:
        assert "background.h5" in str(error)


@pytest.fixture(scope="module")
def calibration_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("calibration") / "calibration.h5"
    small_calibration().save(path)
    return path


def change_dataset(name, change):
    def apply(file):
        file[name][...] = change(file[name][()])

    return apply


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (change_dataset("camera/left/network/weight_0", lambda values: values * np.nan), "network.weight_0"),
        (change_dataset("camera/left/network/input_scale", lambda values: 0 * values), "scale of an input is 0"),
        (change_dataset("camera/left/baseline/thin_lens_rotation", lambda values: 2 * values), "no rotation"),
        (change_dataset("camera/left/decoder/gain", lambda values: values + np.inf), "decoder.gain"),
        (change_dataset("camera/left/region_mm", lambda values: values[::-1]), "two corners"),
        (lambda file: file.move("camera/left", "camera/middle"), "one group for each"),
        (lambda file: file["camera/left"].pop("network/bias_0"), "bias_0"),
        (lambda file: file["camera/left"].pop("decoder"), "decoder"),
    ],
)
def test_numbers_that_no_calibration_has_are_refused_by_name(tmp_path, calibration_file, change, words):
    path = shutil.copy(calibration_file, tmp_path / "calibration.h5")
    rewrite(path, change, sealed=True)
    with pytest.raises(InputError, match=rf"calibration\.h5.*{words}"):
        lfpiv.load_calibration(path)


def test_a_network_that_corrects_nothing_is_whole(tmp_path):
    """Training shrinks a correction that explains nothing of the test dots to 0."""
    calibration = small_calibration()
    cameras = {
        name: dataclasses.replace(camera, network=camera.network.with_scaled_output(0.0))
        for name, camera in calibration.cameras.items()
    }
    dataclasses.replace(calibration, cameras=cameras).save(tmp_path / "calibration.h5")
    points = np.zeros((3, 3)), np.zeros((3, 2))
    assert not np.any(lfpiv.load_calibration(tmp_path / "calibration.h5").cameras["left"].network(np.hstack(points)))


def test_a_background_of_other_cameras_or_other_light_is_refused(tmp_path):
    calibration, path = small_calibration(), tmp_path / "background.h5"
    light = small_background(calibration)
    found = Background(light, background.content_hash(light))
    for change, words in (
        (change_dataset("left/light", lambda values: 2 * values), "not that of its figures"),
        (change_dataset("left/light", lambda values: values * np.nan), "finite"),
        (lambda file: file.move("left", "top"), "other cameras: top"),
    ):
        background.write(found, path, {})
        rewrite(path, change, sealed=True)
        with pytest.raises(InputError, match=words):
            background.load(path, calibration)


# -- lock and temporary files ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["pipe", "folder", "link"])
def test_what_is_no_lock_file_is_refused_at_once(tmp_path, kind):
    folder = Folder(tmp_path)
    target = tmp_path / "precious"
    target.write_text("text")
    {"pipe": os.mkfifo, "folder": os.mkdir, "link": lambda path: path.symlink_to(target)}[kind](folder.lock)
    with pytest.raises(InputError, match=r"\.lock: expected the lock file"), folder.held():
        pass
    assert target.read_text() == "text"


@pytest.mark.parametrize("text", HOSTILE.values(), ids=list(HOSTILE))
def test_a_held_lock_of_any_content_names_another_process(tmp_path, text):
    folder = Folder(tmp_path)
    folder.lock.write_bytes(text if isinstance(text, bytes) else text.encode())
    with folder.lock.open("r+") as holder:
        fcntl.flock(holder, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="held by another process"), folder.held():
            pass


def test_remains_of_any_kind_are_swept_or_left_alone(tmp_path):
    folder = Folder(tmp_path)
    (tmp_path / "vectors").mkdir()
    os.mkfifo(tmp_path / "vectors" / ".pair.0123.tmp")
    (tmp_path / ".folder.tmp").mkdir()
    (tmp_path / ".file.tmp").touch()
    os.mkfifo(folder.shared)
    folder.sweep()
    assert sorted(path.name for path in tmp_path.rglob("*")) == [".folder.tmp", "vectors"]
    (tmp_path / "guard.json").mkdir()
    with pytest.raises(InputError, match=r"guard\.json: expected a place for a file, found a folder"):
        make_writable(tmp_path)
