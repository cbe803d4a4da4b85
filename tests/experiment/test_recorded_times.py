"""Times of recordings against dt_s: told where they contradict it, silent where nothing is known for certain."""

import struct
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from support.recordings import write_cine, write_mraw, write_seq

from lfpiv.experiment.opening import read_experiment
from lfpiv.experiment.recorded_times import contradictions, proposed

SHAPES = {"left": (48, 64), "right": (56, 40)}
COUNT = 12


def write(folder, suffix, **options):
    rng = np.random.default_rng(1)
    for name, shape in SHAPES.items():
        frames = rng.integers(1, 4096, (COUNT, *shape), np.uint16)
        writer = {"cine": write_cine, "mraw": write_mraw, "seq": write_seq}[suffix]
        writer(folder / f"{name}.{suffix}", frames, **options)


def told(file, images, dt_s, *, series=True, step=1):
    """Return the warnings about an experiment with other particle images and another dt_s."""
    text = file.read_text("utf-8")
    old = next(line for line in text.splitlines() if line.startswith("dt_s"))
    text = text.replace(old, f"dt_s = {dt_s}").replace("particles/{camera}/{pair:04d}{frame}.tif", images)
    if series:
        text = text.replace("pairs = 2", f"instants = {COUNT}\nstep = {step}")
    path = file.with_name("other.toml")
    path.write_text(text, "utf-8")
    return contradictions(read_experiment(path))


@pytest.mark.parametrize("suffix", ["cine", "mraw", "seq"])
def test_the_interval_of_a_series_is_compared(tiny_experiment, suffix):
    rate = {"cine": {"interval_s": 1e-3}, "mraw": {"Record_Rate(fps)": 1000}, "seq": {"interval_s": 1.0}}[suffix]
    true = 1.0 if suffix == "seq" else 1e-3
    write(tiny_experiment.parent, suffix, **rate)
    images = "{camera}." + suffix + "#{instant}"
    assert told(tiny_experiment, images, true) == []
    assert told(tiny_experiment, images, 3 * true, step=3) == []
    for wrong in (true / 1000, true / 10, 10 * true, 1000 * true):
        (warning,) = told(tiny_experiment, images, wrong)
        assert warning.subject == "left, right" and warning.figures["recorded"] in ("1 s", "1 ms")
    (warning,) = told(tiny_experiment, images, true, step=2)
    assert warning.figures["recorded"] in ("2 s", "2 ms")


@pytest.mark.parametrize("suffix", ["cine", "mraw", "seq"])
def test_pulses_on_both_sides_of_the_gap_between_two_exposures_are_no_contradiction(tiny_experiment, suffix):
    """Double frames at 15 Hz, 100 us apart; in a .cine with and without the times and exposures of images."""
    rates = {
        "cine": [{"interval_s": 1 / 15, "exposure_s": 0.0666}, {"rate": 15, "blocks": False}],
        "mraw": [{"Record_Rate(fps)": 15}],
        "seq": [{"interval_s": 1 / 15}],
    }
    for rate in rates[suffix]:
        write(tiny_experiment.parent, suffix, **rate)
        images = "{camera}." + suffix + "#{image}"
        assert told(tiny_experiment, images, 1e-4, series=False) == []
        assert told(tiny_experiment, images, 1 / 15, series=False) == []
        assert len(told(tiny_experiment, images, 1.0, series=False)) == (0 if suffix == "seq" else 1)


def test_short_exposures_bound_the_time_between_pulses(tiny_experiment):
    write(tiny_experiment.parent, "cine", interval_s=1e-3, exposure_s=1e-4)
    assert told(tiny_experiment, "{camera}.cine#{image}", 1e-3, series=False) == []
    for wrong in (1e-4, 1e-2):
        (warning,) = told(tiny_experiment, "{camera}.cine#{image}", wrong, series=False)
        assert warning.figures["recorded"] == "900 us to 1.1 ms"


def test_a_rate_that_another_clock_sets_is_not_believed(tiny_experiment):
    write(tiny_experiment.parent, "cine", rate=1000, blocks=False, TrigFrame=1)
    assert told(tiny_experiment, "{camera}.cine#{instant}", 0.5) == []


def test_times_in_blocks_without_header_are_compared(tiny_experiment):
    rng = np.random.default_rng(2)
    for name, shape in SHAPES.items():
        blocks = [
            rng.bytes(2 * shape[0] * shape[1]) + struct.pack("<Q", 10**15 + 250 * k) + bytes(8) for k in range(COUNT)
        ]
        (tiny_experiment.parent / f"{name}.raw").write_bytes(b"".join(blocks))
    text = tiny_experiment.read_text("utf-8")
    for name, (rows, columns) in SHAPES.items():
        time = f'{{ at_byte = {2 * rows * columns}, dtype = "uint64", unit_s = 1e-6 }}'
        key = f'name = "{name}"'
        raw = (
            f'{key}\nraw = {{ shape = [{rows}, {columns}], dtype = "uint16", frame_footer_bytes = 16, time = {time} }}'
        )
        text = text.replace(key, raw)
    tiny_experiment.write_text(text, "utf-8")
    assert told(tiny_experiment, "{camera}.raw#{instant}", 250e-6) == []
    (warning,) = told(tiny_experiment, "{camera}.raw#{instant}", 250e-3)
    assert warning.sentence.startswith(
        "left, right: the recording says that the two frames of a vector are 250 us apart"
    )


@pytest.fixture
def buffers(monkeypatch):
    """Replace LaVision's library by buffers of two double frames with attributes."""
    pixels = [np.ones(shape, np.uint16) for shape in SHAPES.values() for _ in "ab"]
    attributes = {}

    def read_buffer(path):
        number = int(Path(path).stem[-5:])
        own = {name: value(number) for name, value in attributes.items()}
        return [types.SimpleNamespace(attributes=own) for _ in pixels]

    module = types.ModuleType("lvpyio")
    module.read_buffer = read_buffer
    monkeypatch.setitem(sys.modules, "lvpyio", module)
    return attributes


def test_pulses_and_times_of_davis_are_compared(tiny_experiment, buffers):
    for name in SHAPES:
        for number in range(COUNT):
            (tiny_experiment.parent / f"{name}{number:05d}.im7").write_bytes(b"packed")
    pairs, series = "{camera}{pair:05d}.im7#{frame}", "{camera}{instant:05d}.im7#0"
    text = tiny_experiment.read_text("utf-8").replace("pairs = 2", 'pairs = 2\nframes = ["0", "1"]')
    of_pairs = tiny_experiment.with_name("pairs.toml")
    of_pairs.write_text(text, "utf-8")
    buffers["AcqTimeSeries"] = lambda number: f"{number * 66_667} µs"
    assert told(of_pairs, pairs, 80e-6, series=False) == []  # two frames of one time say nothing
    buffers["FrameDt"] = lambda number: "80 \u03bcs"
    assert told(of_pairs, pairs, 80e-6, series=False) == []
    assert told(of_pairs, pairs, 80e-3, series=False)[0].figures["recorded"] == "80 us"
    assert told(tiny_experiment, series, 66.7e-3) == []
    assert told(tiny_experiment, series, 66.7e-6)[0].figures["recorded"] == "66.67 ms"


def test_damaged_and_other_files_say_nothing(tiny_experiment):
    assert contradictions(read_experiment(tiny_experiment)) == []
    for name in SHAPES:
        (tiny_experiment.parent / f"{name}.cine").write_bytes(b"CI")
    assert told(tiny_experiment, "{camera}.cine#{instant}", 1.0) == []


def test_a_new_experiment_is_proposed_the_time_of_its_recording(tmp_path):
    write(tmp_path, "cine", interval_s=250e-6, exposure_s=200e-6)
    file = tmp_path / "experiment.toml"
    assert float(proposed(file, "{camera}.cine#{instant}", "left")) == pytest.approx(250e-6, rel=1e-3)
    assert proposed(file, "{camera}.cine#{image}", "left") is None
    assert proposed(file, "{camera}_{instant}.tif", "left") is None
    assert proposed(file, "{", "left") is None
