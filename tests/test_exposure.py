"""Images that are right in form and wrong otherwise: of another camera, misplaced, saturated, half exposed, copied."""

import dataclasses
import re

import numpy as np
import pytest
import scenes
import tifffile

import lfpiv
from lfpiv.exposure import GAP_LIGHT, NO_PLACE, SATURATED, dark_blocks, gap_light, pair_warnings, saturated_share
from lfpiv.simulate import simulate

CLEAR = GAP_LIGHT / 5  # what belongs together keeps clear of the limit; real images gave 0.013, rendered ones 0.001
GOOD = 0.02  # pitch; nobody would look twice
MAGNIFICATION = 0.002  # ten times the spread over rigs and seeds
QUARTER_PITCH_PX = 3  # of 12.5
OFFSETS_MM = ((0.0, 0.0), (0.05, 0.03))
"""Of the arrays on their sensors: half a pitch and a third of one apart, as likely as any."""


@pytest.fixture(scope="module", params=[("square", 4.0), ("hexagonal", 5.5)], ids=lambda rig: rig[0])
def pair_of_cameras(request, tmp_path_factory, device):
    """Experiment and calibration of two cameras whose arrays lie differently on their sensors.

    At f/4 the microimages of a hexagonal array touch all around and leave no gaps to look at.
    """
    layout, f_number = request.param
    optics = {"microlens_layout": layout, "f_number": f_number}
    cameras = [
        scenes.camera(name, angle, (420, 400), true_array_offset_mm=offset, **optics)
        for name, angle, offset in zip(("left", "right"), (35.0, -35.0), OFFSETS_MM, strict=True)
    ]
    scene = scenes.scene(
        "exposure",
        cameras,
        planes_mm=(-0.5, 0.5),
        particles={"count": 60, "sigma_mm": 0.03},
        displacement_mm=(0.05, 0.0, 0.0),
    )
    experiment = lfpiv.open_experiment(simulate(scene, tmp_path_factory.mktemp("exposure") / "data"))
    return experiment, lfpiv.thin_lens(experiment)


def test_light_between_the_microimages_tells_another_cameras_image(pair_of_cameras):
    experiment, calibration = pair_of_cameras
    left, right = (calibration.cameras[name].decoder for name in ("left", "right"))
    for image in (experiment.particle_image("left", 0, "a"), experiment.board_image("left", 0)):
        assert gap_light(image, left) < CLEAR
        assert gap_light(image, right) > NO_PLACE
        assert gap_light(np.roll(image, QUARTER_PITCH_PX, axis=1), left) > GAP_LIGHT
        slope = np.add.outer(np.linspace(0, 1, len(image)), np.linspace(0, 1, image.shape[1])) * image.max()
        assert gap_light(image + slope, left) < CLEAR  # ambient light
        weak = 0.02 * image + np.random.default_rng(0).normal(100, 3, image.shape)
        assert gap_light(weak, left) < CLEAR
    noise = np.random.default_rng(0).normal(100, 5, left.gain.shape)
    assert gap_light(noise, left) == 0 == gap_light(np.zeros(left.gain.shape), left)


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("justified", ["right", "left"])
def test_saturation_is_told_at_the_end_of_a_range(bits, justified):
    rng = np.random.default_rng(bits)
    top = 2**bits - 1
    step = 2 ** (16 - bits) if justified == "left" else 1
    light = rng.exponential(0.2 * top, (300, 300))
    assert saturated_share(np.minimum(light * 4, top).round() * step) > SATURATED
    assert saturated_share((light * 0.9 * top / light.max()).round() * step) == 0
    assert saturated_share(np.minimum(light, 0.7 * top)) == 0  # flat, but not at the end


def test_the_frames_of_a_pair_are_lit_alike(pair_of_cameras):
    experiment, _ = pair_of_cameras
    first, second = (experiment.particle_image("right", 0, frame) for frame in "ab")
    assert dark_blocks(first, second) == 0 == dark_blocks(first, 0.4 * second)
    half = second.copy()
    half[200:] = np.median(half)
    assert dark_blocks(first, half) >= 2 and dark_blocks(half, first) == dark_blocks(first, half)


def write(experiment, name, frame, image):
    tifffile.imwrite(experiment.particle_path(name, 0, frame), image.astype(np.uint16))


def test_what_is_suspicious_about_a_pair_is_said(pair_of_cameras, tmp_path):
    experiment, calibration = pair_of_cameras
    assert pair_warnings(experiment, calibration, 0) == []
    whole = {(name, frame): experiment.particle_image(name, 0, frame) for name in ("left", "right") for frame in "ab"}
    copy = dataclasses.replace(experiment, path=tmp_path / "experiment.toml")
    for name in ("left", "right"):
        copy.particle_path(name, 0, "a").parent.mkdir(parents=True)
    write(copy, "left", "a", whole["right", "a"][::-1])
    write(copy, "left", "b", whole["left", "b"] * 0.05)
    write(copy, "right", "a", np.minimum(whole["right", "a"] * 40, 4095))
    write(copy, "right", "b", np.minimum(whole["right", "a"] * 40, 4095))
    said = " ".join(pair_warnings(copy, calibration, 0))
    assert "right, pair 0, frame b: the same image as right, pair 0, frame a" in said
    assert "right, pair 0, frame a" in said and "saturated" in said and "left, pair 0: " in said
    copy.particle_path("left", 0, "a").unlink()
    assert pair_warnings(copy, calibration, 0) == []  # the pair itself will say what is missing


def spoil(experiment, pattern, change):
    for path in experiment.parent.glob(pattern):
        changed = np.ascontiguousarray(change(tifffile.imread(path)))
        tifffile.imwrite(path, changed.astype(np.uint16))


def calibrate_first(file):
    experiment = lfpiv.open_experiment(file)
    return lfpiv.calibrate(dataclasses.replace(experiment, cameras=experiment.cameras[:1])).cameras["left"]


def test_a_white_image_of_another_place_is_refused(small_run, tmp_path):
    file = small_run.images(tmp_path / "data")
    spoil(file, "white/left.tif", lambda image: np.roll(image, 6, axis=1))
    with pytest.raises(lfpiv.InputError, match=r"plane_01\.tif.*'left'.*light falls between the microimages"):
        calibrate_first(file)


def test_a_saturated_white_image_and_pictures_on_their_side_are_named(small_run, tmp_path):
    file = small_run.images(tmp_path / "data")
    spoil(file, "white/*.tif", lambda image: np.minimum(image * 4.0, 4095))
    spoil(file, "**/*.tif", np.rot90)
    report = calibrate_first(file).report
    assert report["sigma_nor_test"] < GOOD
    saturated, turned = report["warnings"]
    assert "white image's bright pixels are saturated" in saturated and "turned by 90 degrees" in turned


def test_a_wrong_spacing_of_the_dots_shows_in_the_magnification(small_run, tmp_path):
    file = small_run.images(tmp_path / "data")
    file.write_text(file.read_text("utf-8").replace("spacing_mm = 0.5", "spacing_mm = 0.45"), "utf-8")
    report = calibrate_first(file).report
    assert report["sigma_nor_test"] < GOOD
    assert len(report["warnings"]) == 1 and re.search(r"magnified 1\.(09\d|1\d\d) times, not 1", report["warnings"][0])
    right = small_run.summary["calibration"]["left"]
    assert right["magnification"] == pytest.approx(1, abs=MAGNIFICATION) and right["warnings"] == []
