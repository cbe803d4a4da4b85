"""Checks of images that are correct in form and still wrong: misplaced, saturated, half exposed or copied."""

import dataclasses
import logging
import re
import shutil

import cv2
import numpy as np
import pytest
import tifffile
from support import scenes
from support.small_run import leave_out

import lfpiv
from lfpiv import statistics
from lfpiv.lightfield import frame_comparison, image_checks, lattice_fit
from lfpiv.lightfield.frame_comparison import dark_blocks, same_light
from lfpiv.lightfield.image_checks import GAP_LIGHT, NO_PLACE, gap_light
from lfpiv.results import netcdf
from lfpiv.runs import pair_vectors, pipeline
from lfpiv.simulation.simulator import simulate
from lfpiv.warn import Code, Warning

CLEAR = GAP_LIGHT / 5  # gap light of a camera's own images; real images gave 0.013, rendered ones 0.001
GOOD = 0.02  # [pitch] below every limit that warns
MAGNIFICATION = 0.002  # ten times the spread over rigs and seeds
QUARTER_PITCH_PX = 3  # of 12.5
MOVED_PX = (25, 50)  # whole microlenses, beyond the image of a particle
MIRRORED_PITCH = {"square": 0.4, "hexagonal": np.hypot(0.5, 0.6 - np.sqrt(0.75))}
"""Distance between the lattice of the second of `OFFSETS_MM` and its picture upside down [pitch]."""
SHIFT_PX = 0.3  # four times the step at which shifts are read
TURN_DEG, WIDENING = 0.25, 0.005  # 0.11 pitch at the corner: 60 particles light parts of the pupil
OFFSETS_MM = ((0.0, 0.0), (0.05, 0.03))
"""Offsets of the arrays on their sensors: half a pitch and a third of a pitch apart."""


@pytest.fixture(scope="module", params=[("square", 4.0), ("hexagonal", 5.5)], ids=lambda rig: rig[0])
def pair_of_cameras(request, tmp_path_factory, device):
    """Experiment and calibration of two cameras whose arrays have different offsets.

    The hexagonal array has f/5.5, because its microimages leave no gaps at f/4.
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


@pytest.mark.slow
def test_light_between_the_microimages_shows_another_cameras_image(pair_of_cameras):
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


def test_the_lattice_of_the_particle_images_shows_what_is_misplaced(pair_of_cameras):
    """Of its own array an image is not shifted, however weak, uneven or noisy; else shift and remedy are named."""
    experiment, calibration = pair_of_cameras
    left, right = (calibration.cameras[name].decoder for name in ("left", "right"))
    pitch = right.optics.microimage_pitch_px
    rng = np.random.default_rng(0)
    for image in (experiment.particle_image("right", 0, "a"), experiment.board_image("right", 0)):
        light = image - np.float32(right.background(image)[0])
        pupil = right.pupil_mm[..., 0] / right.optics.pupil_radius_mm
        for own in (light, 0.02 * light + rng.normal(0, 3, light.shape), light * (1 + 0.5 * pupil), light + 100):
            assert lattice_fit.disagreement(own.astype(np.float32), right, {"left": left}) is None
        shifted = lattice_fit.disagreement(np.roll(light, QUARTER_PITCH_PX, axis=1), right, {"left": left})
        assert abs(shifted["shift_px"] - QUARTER_PITCH_PX) < SHIFT_PX and lattice_fit.MOVED in shifted["fit"]
        upside_down = lattice_fit.disagreement(light[::-1], right, {"left": left})
        assert abs(upside_down["shift_pitch"] - MIRRORED_PITCH[right.optics.layout]) < SHIFT_PX / pitch
        assert "mirrored upside down" in upside_down["fit"]
        assert "white image of camera right" in lattice_fit.disagreement(light, left, {"right": right})["fit"]
    noise = rng.normal(0, 4, light.shape).astype(np.float32)
    assert lattice_fit.disagreement(noise, right, {"left": left}) is None


@pytest.mark.parametrize(("turn_deg", "widening"), [(1.0, 0), (-1.5, 0), (0, 0.018), (0, -0.025), (0.8, 0.012)])
def test_a_turned_or_refocused_array_is_told_by_its_turn_and_pitch(pair_of_cameras, turn_deg, widening):
    experiment, calibration = pair_of_cameras
    decoder = calibration.cameras["right"].decoder
    image = experiment.particle_image("right", 0, "a").astype(np.float32)
    rows, columns = image.shape
    turn = np.radians(turn_deg)
    matrix = (1 + widening) * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    middle = (np.array([columns, rows]) - 1) / 2
    moved = cv2.warpAffine(
        image, np.c_[matrix, middle - matrix @ middle], (columns, rows), borderMode=cv2.BORDER_REFLECT
    )
    assert lattice_fit.disagreement(image - np.float32(decoder.background(image)[0]), decoder) is None
    fit = lattice_fit.disagreement(moved - np.float32(decoder.background(moved)[0]), decoder)["fit"]
    told = re.search(r"turned by (\S+) degrees and (\S+)% (farther|closer)", fit)
    assert abs(float(told[1]) - turn_deg) < TURN_DEG
    assert abs(float(told[2]) / 100 * (1 if told[3] == "farther" else -1) - widening) < WIDENING


def test_a_board_of_another_camera_is_named(pair_of_cameras, tmp_path):
    experiment, _ = pair_of_cameras
    folder = shutil.copytree(experiment.path.parent, tmp_path / "data")
    shutil.rmtree(folder / "board" / "left")
    shutil.copytree(folder / "board" / "right", folder / "board" / "left")
    with pytest.raises(lfpiv.InputError, match=r"camera 'left'.*it fits the white image of camera right"):
        lfpiv.calibrate(folder / experiment.path.name)


@pytest.mark.parametrize("strength", [0.5, 1, 1.5])
def test_rims_that_a_subtracted_background_leaves_are_no_turned_array(pair_of_cameras, strength):
    """Any turn blurs a rim to a disc, and so does the opposite turn."""
    experiment, calibration = pair_of_cameras
    decoder = calibration.cameras["right"].decoder
    image = experiment.particle_image("right", 0, "a")
    light = image - np.float32(decoder.background(image)[0])
    rim = (decoder.coverage > 0) & (decoder.coverage < 0.3)
    left = strength * light[decoder.coverage > 0.9].mean() * rim
    assert lattice_fit.disagreement((light + left).astype(np.float32), decoder) is None


def test_the_frames_of_a_pair_are_lit_alike(pair_of_cameras):
    experiment, _ = pair_of_cameras
    first, second = (experiment.particle_image("right", 0, frame) for frame in "ab")
    assert dark_blocks(first, second) == 0 == dark_blocks(first, 0.4 * second)
    half = second.copy()
    half[200:] = np.median(half)
    assert dark_blocks(first, half) >= 2 and dark_blocks(half, first) == dark_blocks(first, half)


def test_a_frame_whose_counts_are_shifted_by_4_bits_is_told():
    light = 50 * np.random.default_rng(0).random((120, 160)) ** 4
    assert not frame_comparison.uneven_warnings(light, np.roll(light, 3, axis=1), "left")
    (warning,) = frame_comparison.uneven_warnings(light, 16 * light, "left")
    assert warning.sentence.startswith("left: 9 of 9 parts") and "shifted by some bits" in warning.sentence


def test_particles_that_leave_a_part_of_the_sensor_do_not_make_it_dark():
    """Six particles: single ones carry the light of a part. Some cross its edge, one leaves the sensor."""
    rows, columns = np.mgrid[:400, :400]
    rng = np.random.default_rng(4)
    for _ in range(5):
        places = np.vstack([rng.uniform(0, 400, (4, 2)), [(130, 200), (5, 200)]])
        first, second = (
            sum(1000 * np.exp(-((rows - y) ** 2 + (columns - x) ** 2) / 2 / 6**2) for y, x in places + shift)
            for shift in (0, (8, -25))
        )
        assert dark_blocks(first, second) == 0 == dark_blocks(second, first)


def test_suspicious_images_are_found(pair_of_cameras):
    experiment, calibration = pair_of_cameras
    decoder = calibration.cameras["left"].decoder
    first, second = (experiment.particle_image("left", 0, frame) for frame in "ab")

    def found(image):
        return [item.code for item in image_checks.image_warnings(image, image - 40, decoder, "left", "a")]

    assert found(first) == found(second) == frame_comparison.uneven_warnings(first, second, "left") == []
    assert found(np.roll(first, QUARTER_PITCH_PX, axis=1)) == [Code.SHIFTED]
    assert found(np.minimum(first * 40, 4095)) == [Code.SATURATED]
    assert found(np.round(4095 * (first / 4095) ** (1 / 2.2))) == [Code.TONE_CURVE]
    assert [item.code for item in frame_comparison.uneven_warnings(first, second * 0.05, "left")] == [Code.UNEVEN]
    images = [(name, frame_comparison.fingerprint(image)) for name, image in (("one", first), ("other", second))]
    frame_comparison.require_different(images)
    with pytest.raises(lfpiv.InputError, match=r"a copy: .* found the same image as one\. Check particles\.images"):
        frame_comparison.require_different([*images, ("a copy", frame_comparison.fingerprint(first.copy()))])


@pytest.mark.parametrize("energy", [0.8, 1.0, 1.25])
def test_a_frame_of_one_camera_with_both_exposures_is_told_whatever_the_pulses_have(pair_of_cameras, energy):
    experiment, calibration = pair_of_cameras
    light = {name: experiment.particle_image(name, 0, "a") for name in calibration.cameras}
    first = {name: image - np.median(image) for name, image in light.items()}
    second = {name: energy * np.roll(image, MOVED_PX, (0, 1)) for name, image in first.items()}
    slow = {name: energy * (image + np.roll(image, 1, 0)) / 2 for name, image in first.items()}

    def told(one, other):
        found = frame_comparison.double_warnings(one, other)
        return [(item.subject, item.figures["holding"]) for item in found]

    doubled = {name: 2 * image for name, image in second.items()}
    assert told(first, second) == told(first, slow) == told(first, doubled) == []
    both = {name: first[name] + second[name] for name in first}
    for name in first:
        assert told(first, {**second, name: both[name]}) == [(name, "second")]
        assert told({**first, name: both[name]}, second) == [(name, "first")]


def test_a_bright_particle_at_rest_beside_others_that_move_is_no_second_exposure():
    first, second = np.zeros((2, 200, 200))
    first[90:106, 90:106] = second[90:106, 90:106] = 100.0
    first[20:40, 20:40] = second[60:80, 20:40] = 60.0
    assert frame_comparison.double_warnings({"left": first}, {"left": second}) == []


@pytest.mark.parametrize("noise", [0.4, 1.0, 5.0])
@pytest.mark.parametrize("top", [250, 4000])
def test_an_exposure_is_told_from_another_one_of_particles_at_rest(noise, top):
    """The other one is clipped alike. A copy may have other pixels, a time in its corner, or another background."""
    random = np.random.default_rng(0)
    light = 3 * top * random.random((120, 160)) ** 20

    def exposure():
        return np.clip(np.rint(light + random.normal(7, noise, light.shape)), 0, top).astype(np.float32)

    first, second = exposure(), exposure()
    assert not same_light(first, second) and not same_light(first, np.roll(first, 5, axis=1))
    for change in (first + 3, *(np.where(part, top, first) for part in _parts(first.shape))):
        assert same_light(first, change)


def test_few_particles_on_a_background_of_zeros_are_no_copy():
    """They light fewer pixels than the brightest that are compared; the others are all alike."""
    first, second = np.zeros((2, 120, 160), np.float32)
    first[50:54, 40:48], second[50:54, 43:51] = np.random.default_rng(0).integers(20, 200, (2, 4, 8))
    assert not same_light(first, second) and not same_light(first, np.zeros_like(first))
    assert same_light(first, first.copy())


def _parts(shape):
    """Yield no pixel, one in the middle, and the corner with a text."""
    row, column = np.indices(shape)
    yield np.zeros(shape, bool)
    yield (row == shape[0] // 2) & (column == shape[1] // 2)
    yield (row < 12) & (column < 60)


@pytest.mark.parametrize(
    ("cameras", "empty", "unmeasured"),
    [
        (1, ["a only"], True),
        (2, [], False),
        (2, ["b left"], True),
        (3, ["a left", "b right"], False),  # two cameras show each frame
        (3, ["b left", "b right"], True),
    ],
)
def test_vectors_count_where_two_cameras_show_particles(cameras, empty, unmeasured):
    frames = [
        [Warning(code=Code.EMPTY, subject=name) for name in empty if name.startswith(frame)]
        + [Warning(code=Code.DIM, subject="left")]
        for frame in "ab"
    ]
    assert image_checks.unmeasured(frames, cameras) == unmeasured


def test_vectors_do_not_count_where_an_image_is_misplaced():
    def frames(code, **figures):
        return [[], [Warning(code=code, subject="left", figures=figures)]]

    assert image_checks.misplaced(frames(Code.SHIFTED, shift_px=3.0, shift_pitch=0.3, fit=""))
    assert image_checks.misplaced(frames(Code.MISPLACED, gap_light=2 * NO_PLACE))
    assert not image_checks.misplaced(frames(Code.MISPLACED, gap_light=2 * GAP_LIGHT))
    assert not image_checks.misplaced(frames(Code.SATURATED, share=1.0))


@pytest.fixture(scope="module")
def spoilt(small_run, tmp_path_factory):
    """Run an experiment with different bad images in each pair and a silent log. Return file, folder and summary."""
    folder = tmp_path_factory.mktemp("spoilt")
    file, out = small_run.images(folder / "data"), small_run.calibrated(folder / "out")
    rng = np.random.default_rng(0)
    spoil(file, "particles/*/*0000*", lambda image: rng.normal(np.median(image), 4, image.shape).round())
    for path in file.parent.glob("particles/*/*0001_a.tif"):
        shutil.copy(path, path.with_name(path.name.replace("_a", "_b")))
    spoil(file, "particles/*/*0002*", lambda image: np.minimum(image * 40.0, 4095))
    spoil(file, "particles/left/*0003_b*", lambda image: np.where(np.arange(400)[:, None] < 200, image, 40))
    logger = logging.getLogger("lfpiv")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with pytest.MonkeyPatch.context() as patch:
            leave_out(patch.setattr)
            summary = pipeline.run(file, out, keep_volumes=True)
    finally:
        logger.setLevel(before)
    return file, out, summary


@pytest.mark.slow
def test_the_images_of_every_pair_are_checked(spoilt):
    """A copied image fails its pair; each doubt appears once with its pairs, independent of the log level."""
    _, out, summary = spoilt
    ((failed),) = summary["failed"]
    assert failed["pair"] == 1 and "frame b: expected an image of its own, found the same image as" in failed["reason"]
    assert [pair["pair"] for pair in summary["pairs"]] == [0, 2, 3] == lfpiv.open_results(out).pair.values.tolist()
    said = summary["warnings"]
    saturated = [text for text in said if "saturated" in text]
    assert [text.split(": ")[0] for text in saturated] == [
        f"{name}, frame {frame}, pair 2" for frame in "ab" for name in ("left", "right")
    ]
    (uneven,) = [text for text in said if "of 9 parts" in text]
    assert uneven.startswith("left, pair 3: ")
    assert all(
        f"{name}, frame {frame}, pair 0: no particles" in " ".join(said) for name in ("left", "right") for frame in "ab"
    )


@pytest.mark.slow
def test_a_pair_of_noise_enters_no_mean(spoilt, brief_run):
    """The correlation marks its vectors as valid, but the images show no particles."""
    file, out, summary = spoilt
    vectors = netcdf.read_vectors(out / "vectors" / "pair_0000.nc")
    assert not vectors["valid"].any() and np.isnan(vectors["uncertainty"]).all()
    assert vectors.attrs["verdict"] == summary["pairs"][0]["verdict"] == pair_vectors.NO_PARTICLES
    assert summary["pairs"][0]["valid_fraction"] == 0 < summary["pairs"][1]["valid_fraction"]
    results = lfpiv.open_results(out)
    mean, good = statistics.mean(results), statistics.mean(results.sel(pair=[2, 3]))
    assert [pair["pair"] for pair in summary["pairs"] if pair["valid_fraction"] > 0] == [2, 3]
    assert int(mean["pairs_counted"].max()) == 2
    np.testing.assert_array_equal(mean["u"], good["u"])
    (out / "vectors" / "pair_0000.nc").unlink()  # the same from stored volumes
    pipeline.correlate(file, out, pairs=(0, 1))
    assert netcdf.read_vectors(out / "vectors" / "pair_0000.nc").equals(vectors)


@pytest.mark.slow
def test_warnings_outlive_the_invocation(spoilt, brief_run, tmp_path, monkeypatch):
    """A second run and a new report give the warnings of the first run."""
    file, out, first = spoilt
    pages = []
    monkeypatch.setattr("lfpiv.report.page.write_report", lambda *arguments: pages.append(arguments[2]["warnings"]))
    for again in (pipeline.run(file, out, keep_volumes=True), pipeline.report(file, out)):
        assert again["warnings"] == first["warnings"] and len(first["warnings"]) > len(first["pairs"])
    assert pages == [first["warnings"]] * 2
    alone = shutil.copytree(out, tmp_path / "out")
    shutil.rmtree(alone / "vectors")  # the volumes hold the warnings, too
    assert [text for text in pipeline.report(file, alone)["warnings"] if "saturated" in text or "of 9" in text]


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
    with pytest.raises(lfpiv.InputError, match=r"plane_00\.tif.*'left'.*light falls between the microimages"):
        calibrate_first(file)


@pytest.mark.slow
def test_a_saturated_white_image_and_pictures_on_their_side_are_named(small_run, tmp_path):
    file = small_run.images(tmp_path / "data")
    spoil(file, "white/*.tif", lambda image: np.minimum(image * 4.0, 4095))
    spoil(file, "**/*.tif", np.rot90)
    camera = calibrate_first(file)
    assert camera.report.sigma_nor_test < GOOD
    saturated, turned = (warning.sentence for warning in camera.warnings)
    assert "white image's bright pixels are saturated" in saturated and "turned by 90 degrees" in turned


@pytest.mark.slow
def test_wrong_spacing_and_size_of_the_dots_show(small_run, tmp_path, caplog):
    """The magnification and the apparent diameter show them; the calibration holds both warnings at any log level."""
    file = small_run.images(tmp_path / "data")
    text = file.read_text("utf-8").replace("spacing_mm = 0.5", "spacing_mm = 0.45")
    assert "dot_diameter_mm = 0.1\n" in text
    file.write_text(text.replace("dot_diameter_mm = 0.1\n", "dot_diameter_mm = 0.15\n"), "utf-8")
    with caplog.at_level(logging.CRITICAL, "lfpiv"):
        camera = calibrate_first(file)
    assert camera.report.sigma_nor_test < GOOD
    wide, magnified = (warning.sentence for warning in camera.warnings)
    # dots say 1.11, planes 1, since these are stated as they are
    assert re.search(r"magnified 1\.(08\d|09\d|10\d) times, not 1", magnified)
    assert wide.startswith("left: the board's dots look 0.") and "mm wide, not 0.15 mm" in wide
    right = small_run.summary["calibration"]["left"]
    assert right["magnification"] == pytest.approx(1, abs=MAGNIFICATION) and right["warnings"] == []
