"""The value from which on pixels are saturated is read from a recording's header."""

import numpy as np
import pytest
from support.recordings import write_cine

import lfpiv
from lfpiv.experiment.experiment import white_level
from lfpiv.experiment.images import FLIPS
from lfpiv.runs.frame_light import frame_light, read_darks
from lfpiv.warn import Code

TOP = 3600
"""White level of a camera of 12 bits."""


@pytest.fixture(scope="module")
def recorded(small_run, tmp_path_factory):
    """Record the small run anew with too much light; each pixel saturates at a value of its own above the level."""
    file = small_run.images(tmp_path_factory.mktemp("recorded") / "data")
    experiment = lfpiv.open_experiment(file)
    rng = np.random.default_rng(4)
    for camera in experiment.cameras:
        images = [
            experiment.frame_image(camera.name, frame)[FLIPS[camera.image_flip]]
            for pair in experiment.numbers
            for frame in experiment.pair_frames(pair)
        ]
        light = np.array(images) * (3 * TOP / np.max(images))
        clipped = np.minimum(light, TOP * (1 + 0.1 * rng.random(light.shape[1:])))
        write_cine(file.parent / f"{camera.name}.cine", np.round(clipped).astype(np.uint16), RealBPP=12, WhiteLevel=TOP)
    text = file.read_text("utf-8")
    (line,) = [line for line in text.splitlines() if line.startswith("images") and "frame" in line]
    file.write_text(text.replace(line, 'images = "{camera}.cine#{image}"'), "utf-8")
    return file, lfpiv.load_calibration(small_run.out / "calibration.h5").cameras


def saturated(file, cameras):
    experiment = lfpiv.open_experiment(file)
    frame = experiment.pair_frames(0)[0]
    light = frame_light(experiment, cameras, read_darks(experiment), frame)
    told = [warning for warning in light.warnings if warning.code == Code.SATURATED]
    return len(told), [int(light.clipped[name].sum()) for name in cameras]


def test_saturated_pixels_are_found_by_the_header(recorded):
    file, cameras = recorded
    told, clipped = saturated(file, cameras)
    assert told == 2
    experiment = lfpiv.open_experiment(file)
    for name, count in zip(cameras, clipped, strict=True):
        assert count == (experiment.particle_image(name, 0, "a") >= TOP).sum() > 1000


def test_without_a_level_such_pixels_are_not_seen(recorded):
    file, cameras = recorded
    for path in file.parent.glob("*.cine"):
        path.write_bytes(path.read_bytes().replace(TOP.to_bytes(4, "little", signed=True), bytes(4), 1))
    assert saturated(file, cameras) == (0, [0, 0])


@pytest.mark.parametrize(
    ("bits", "real", "level", "found"),
    [
        (16, 12, 4064, 4064),
        (12, 12, 4064, 4064),
        (10, 10, 4064, 4064),  # read as 12-bit counts
        (10, 10, 1016, None),
        (8, 8, 254, 254),
        (8, 12, 4064, None),
        (16, 14, 16256, 16256),
        (16, 12, 5000, None),
        (16, 12, 1000, None),
        (16, 12, -1, None),
        (16, 0, 4064, None),
    ],
)
def test_a_level_counts_where_pixels_can_have_it(tiny_experiment, bits, real, level, found):
    camera = lfpiv.open_experiment(tiny_experiment).camera("left")
    path = tiny_experiment.parent / "run.cine"
    frames = np.arange(2 * 12 * 16).reshape(2, 12, 16) % 256
    write_cine(path, frames.astype(np.uint8 if bits == 8 else np.uint16), bits, RealBPP=real, WhiteLevel=level)
    assert white_level(path.with_name("run.cine#1"), camera) == found


def test_a_stated_level_comes_first(tiny_experiment):
    text = tiny_experiment.read_text("utf-8")
    tiny_experiment.write_text(text.replace("white_image", "white_level = 3000\nwhite_image", 1), "utf-8")
    camera = lfpiv.open_experiment(tiny_experiment).cameras[0]
    path = tiny_experiment.parent / "run.cine"
    write_cine(path, np.zeros((1, 12, 16), np.uint16), RealBPP=12, WhiteLevel=4064)
    assert white_level(path.with_name("run.cine#0"), camera) == 3000


def test_files_without_a_level_have_none(tiny_experiment):
    camera = lfpiv.open_experiment(tiny_experiment).cameras[0]
    assert white_level(camera.white_path, camera) is None
    assert white_level(camera.white_path.with_name("missing.tif"), camera) is None
