"""Images of cameras that do not belong together: found, named, and refused with their pairs."""

import functools
import types

import numpy as np
import pytest
import tifffile
import xarray as xr
from support.pair_figures import pair_figures as figures_like

import lfpiv
from lfpiv.calibration.camera import Calibration
from lfpiv.runs import belonging, pair_figures, pipeline
from lfpiv.runs.frame_light import frame_light, read_darks
from lfpiv.runs.moved_cameras import ShownParticles
from lfpiv.runs.reversed_pairs import reversed_pairs, still
from lfpiv.selfcalibration.belonging import ImageFit, Judgement, judge
from lfpiv.selfcalibration.mistakes import FLIPS, Kind, Mistake
from lfpiv.warn import Code

OTHERS, NEAR = (1, 2), (3,)
"""Distances of pairs with other particles, and of more that may be mistaken for the first of four pairs."""


@pytest.fixture(scope="module")
def rig(small_run):
    experiment = lfpiv.open_experiment(small_run.experiment)
    return experiment, lfpiv.build_weights(lfpiv.load_calibration(small_run.out / "calibration.h5"), experiment.grid)


@pytest.fixture(scope="module")
def shown(rig):
    experiment, weights = rig
    darks = read_darks(experiment)

    @functools.cache
    def images(pair, frame):
        if pair not in experiment.numbers:
            return None
        return frame_light(experiment, weights.cameras, darks, experiment.pair_frames(pair)[frame]).images

    return images


def judged(rig, shown):
    return judge(ImageFit(rig[1]), shown, 0, OTHERS, NEAR)


def test_images_that_belong_together_are_told_by_few_trials(rig, shown):
    found = judged(rig, shown)
    assert found.fits and not found.mistakes and found.over_chance > 3
    assert max(len(frames) for frames in found.left.values()) <= 2 and Mistake(Kind.BOTH, ("left",)) not in found.left


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (lambda shown, pair, frame: shown(pair, 1 - frame)["left"], Mistake(Kind.FRAMES, ("left",))),
        (
            lambda shown, pair, frame: shown(pair, frame)["left"][FLIPS[Kind.HORIZONTAL]],
            Mistake(Kind.HORIZONTAL, ("left",)),
        ),
        (lambda shown, pair, frame: shown((pair - 1) % 4, frame)["left"], Mistake(Kind.LATE, ("left",), 1)),
    ],
    ids=["frames", "mirrored", "late"],
)
def test_what_was_done_to_one_camera_is_named(rig, shown, wrong, named):
    def mistaken(pair, frame):
        images = shown(pair, frame)
        return None if images is None else {**images, "left": np.ascontiguousarray(wrong(shown, pair, frame))}

    found = judged(rig, mistaken)
    assert found.mistakes[0] == named and not found.fits


RIGHT = Mistake()
PARTS = 60
"""Parts of each of two sensors in judgements that are made here."""


def judgement(levels, *, chance=(), apart=1, seed=1):
    """Judge images by the light that mistakes leave, a level or the levels of two frames each."""
    rng = np.random.default_rng(seed)
    noise = rng.gamma(20.0, 1 / 20.0, (2, 2 * PARTS)) / (2 * PARTS)  # the same images in every trial
    left = {
        one: [level * part * rng.gamma(400.0, 1 / 400.0, 2 * PARTS) for part in noise] for one, level in levels.items()
    }
    return Judgement(left, list(chance), np.repeat(["left", "right"], PARTS), apart=apart)


def test_delays_that_explain_as_much_are_named_together(rig):
    late, early, other = (Mistake(Kind.LATE, ("left",), number) for number in (1, -1, -2))
    judged = [
        judgement({RIGHT: 0.31, late: 0.29, early: 0.29, other: 0.31}, chance=(late, early, other)),
        judgement({RIGHT: 0.31, late: 0.29, other: 0.31}, chance=(late, other), seed=2),
    ]
    made = belonging.shared_mistakes(judged)
    assert set(made) == {late, early}
    said = belonging.refusal(rig[0], ["left", "right"], made).figures["found"]
    assert said == "the images of left or right are of another pair"


def test_a_delay_is_found_beside_instants_that_show_the_same_particles():
    """The neighbours of the right instant fit, too, so they are no measure of chance."""
    true, near, far = (Mistake(Kind.LATE, ("left",), number) for number in (-2, -3, 3))
    levels = {RIGHT: 0.54, true: 0.34, near: 0.44, far: 0.58}
    assert judgement(levels, chance=(near, far), apart=3).mistakes == (true,)
    assert not judgement(levels, chance=(near, far), apart=1).mistakes


def test_exchanged_frames_are_refused_where_several_pairs_doubt_their_order(rig):
    frames, other = Mistake(Kind.FRAMES, ("left",)), Mistake(Kind.LATE, ("left",), 1)
    levels = {RIGHT: 0.160, frames: 0.157, other: 0.22}
    judged = {pair: judgement(levels, chance=(other,), seed=pair) for pair in range(2)}
    names = ["left", "right"]
    assert all(one.doubted == (frames,) and not one.mistakes for one in judged.values())
    (refusal,) = belonging.mistakes_of_pairs(rig[0], names, judged)
    assert refusal.figures["found"] == "the frames a and b of left or right are exchanged"
    alone = {0: judged[0]}
    assert not belonging.mistakes_of_pairs(rig[0], names, alone)
    assert "left or right would fit better if they were exchanged" in belonging.not_told(names, alone)


def test_images_of_two_cameras_that_are_exchanged_are_named(rig, shown):
    def mistaken(pair, frame):
        images = shown(pair, frame)
        return None if images is None else {"left": images["right"], "right": images["left"]}

    assert judged(rig, mistaken).mistakes == (Mistake(Kind.CAMERAS, ("left", "right")),)


def test_images_of_other_particles_do_not_fit(rig, shown):
    def foreign(pair, frame):
        images = shown(pair, frame)
        return None if images is None else {**images, "left": np.flipud(np.roll(images["left"], 25, axis=1))}

    assert not judged(rig, foreign).fits


@pytest.mark.slow
@pytest.mark.parametrize("pair", range(4))
def test_images_of_another_pair_do_not_fit_however_well_they_are_explained(rig, shown, pair):
    """Images of few particles leave little light: pair 2 beside pair 1 leaves less than others."""
    experiment, coarse = rig
    weights = lfpiv.build_weights(Calibration(coarse.cameras), experiment.grid.refined(2.0))

    def late(number, frame):
        images = shown(number, frame)
        return None if images is None else {**images, "right": shown((number - 1) % 4, frame)["right"]}

    near = [late for late in (1, -1, 2, -2) if pair + late in experiment.numbers]
    assert not judge(ImageFit(weights), late, pair, near, [], images=(1, -1)).fits


def test_one_camera_cannot_be_checked_and_that_is_said(rig):
    experiment, weights = rig
    found = belonging.check(experiment, weights.of_camera("left"), [0])
    assert "one camera" in found.sentence and not found.refusals


@pytest.mark.slow(but="8")
@pytest.mark.parametrize(("bits", "remedy"), [(4, "divided out"), (8, "shifted by 8 bits")])
def test_cameras_of_unlike_scales_are_told_with_the_ratio(rig, small_run, tmp_path, caplog, bits, remedy):
    """Half of the bits of a shift are lost in one camera, the others gained in the other: no image is clipped."""
    file = small_run.images(tmp_path / "data")
    for name, factor in (("left", 2.0 ** (bits // 2)), ("right", 2.0 ** (bits // 2 - bits))):
        for path in (file.parent / "particles" / name).iterdir():
            tifffile.imwrite(path, tifffile.imread(path) * np.float32(factor))
    with caplog.at_level("INFO", "lfpiv"):
        found = belonging.check(lfpiv.open_experiment(file), rig[1], [0])
    assert not found.refusals
    (said,) = [text for text in caplog.messages if "times the counts of right" in text]
    assert remedy in said
    assert 0.75 < float(said.split(" have ")[1].split()[0]) / 2**bits < 1.25  # the cameras are not equally bright


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [16, 1 / 16])
def test_a_camera_on_another_scale_in_one_pair_is_not_refused(rig, small_run, tmp_path, ratio):
    """Images of other pairs, on the usual scale, are the measure of chance and of the light that stands still."""
    file = small_run.images(tmp_path / "data")
    for path in sorted((file.parent / "particles" / "left").iterdir())[:2]:
        tifffile.imwrite(path, tifffile.imread(path) * np.float32(ratio))
    experiment, weights = lfpiv.open_experiment(file), rig[1]
    shown = ShownParticles(experiment, weights.cameras, [0, 1, 2])
    assert not belonging.refusals_of(shown, ImageFit(weights), 0)
    assert belonging.check(experiment, weights, [0]).sentence == belonging.check(rig[0], weights, [0]).sentence


@pytest.mark.slow(but="False")
@pytest.mark.parametrize("foreign", [False, True])
def test_a_pair_with_a_frame_that_is_half_dark_is_judged_by_the_other_frame(rig, small_run, tmp_path, foreign):
    file = small_run.images(tmp_path / "data")
    left, right = (sorted((file.parent / "particles" / name).iterdir()) for name in ("left", "right"))
    if foreign:
        for own, other in zip(left[:2], left[4:6], strict=True):
            own.write_bytes(other.read_bytes())
    image = tifffile.imread(right[1])
    image[: len(image) // 2] = np.percentile(image, 1)
    tifffile.imwrite(right[1], image)
    experiment, weights = lfpiv.open_experiment(file), rig[1]
    shown = ShownParticles(experiment, weights.cameras, [0, 1, 3])
    assert bool(belonging.refusals_of(shown, ImageFit(weights), 0)) is foreign


@pytest.mark.slow
def test_scales_that_cannot_be_divided_out_are_named_in_place_of_other_mistakes(rig, small_run, tmp_path):
    file = small_run.images(tmp_path / "data")
    for path in (file.parent / "particles" / "left").iterdir():
        tifffile.imwrite(path, np.ascontiguousarray(tifffile.imread(path)[:, ::-1]))
    for path in (file.parent / "particles" / "right").iterdir():
        tifffile.imwrite(path, (tifffile.imread(path) * np.float32(1 / 50)).astype(np.float32))
    (refusal,) = belonging.check(lfpiv.open_experiment(file), rig[1], [0]).refusals
    assert "times the counts of right" in refusal.sentence and "on one scale" in refusal.sentence
    assert "mirrored" not in refusal.sentence


@pytest.mark.slow
def test_a_pair_whose_frames_are_exchanged_in_one_camera_is_refused(small_run, tmp_path, empty_report):
    file = small_run.images(tmp_path / "data")
    left = sorted((file.parent / "particles" / "left").iterdir())
    for first, second in zip(left[::2], left[1::2], strict=True):
        first.rename(kept := first.with_suffix(".kept"))
        second.rename(first)
        kept.rename(second)
    out = small_run.prepared(tmp_path / "out")
    summary = pipeline.run(file, out, pairs=(0, 1))
    said = [text for text in summary["warnings"] if "the frames a and b of left or right are exchanged" in text]
    assert len(said) == 1 and said[0].startswith("pair 0: ")
    assert summary["pairs"][0]["valid_fraction"] == 0 and "exchanged" in summary["weights"]["cameras"]
    again = pipeline.run(file, out, pairs=(0, 1))
    assert said[0] in again["warnings"] and again["pairs"][0]["valid_fraction"] == 0
    assert any(one["code"] == Code.MISMATCHED.value for one in again["warning_records"])


def figures_of(displacement, scatter, seed):
    noise = np.random.default_rng(seed).standard_normal((3, 4, 5, 6))
    moved = np.asarray(displacement) + scatter * noise
    vectors = xr.Dataset(
        {f"displacement_{axis}": (("z", "y", "x"), part) for axis, part in zip("xyz", moved, strict=True)}
    )
    flow = pair_figures.flow_in_eighths(vectors, np.ones((4, 5, 6), bool))
    return types.SimpleNamespace(flow_voxel=flow, valid_fraction=1.0)


ROTATION = np.stack([-np.indices((4, 5, 6))[1] + 2.0, np.indices((4, 5, 6))[2] - 2.5, np.zeros((4, 5, 6))])


@pytest.mark.parametrize(("count", "scatter"), [(2, 0.1), (3, 0.5), (60, 0.5)])
def test_a_pair_whose_flow_runs_against_the_others_is_named(count, scatter):
    wrong = count - 1
    figures = {pair: figures_of(-ROTATION if pair == wrong else ROTATION, scatter, pair) for pair in range(count)}
    (found,) = reversed_pairs(figures)
    assert (
        found.pairs == ((0, 1) if count == 2 else (wrong,)) and "the frames of a pair are exchanged" in found.sentence
    )


def test_runs_in_which_nothing_moves_are_told():
    rest = figures_like(1.0, moved_voxel=0.001, flow_voxel=[0.0004] * 24)
    jet = figures_like(1.0, moved_voxel=0.001, flow_voxel=[0.0] * 23 + [0.3])
    (found,) = still({0: rest, 1: rest})
    assert "at most 0.001 voxel" in found.sentence and "the same exposure" in found.sentence
    assert not still({0: rest, 1: jet}) and not still({0: figures_like(0.0)})


@pytest.mark.parametrize("count", [1, 2, 3, 8, 60])
def test_flows_that_fluctuate_or_oscillate_are_not_reversed(count):
    assert not reversed_pairs({pair: figures_of(0 * ROTATION, 1.0, pair) for pair in range(count)})
    assert not reversed_pairs({pair: figures_of(ROTATION, 1.0, pair) for pair in range(count)})
    if count > 3:
        assert not reversed_pairs({pair: figures_of((-1) ** pair * ROTATION, 0.1, pair) for pair in range(count)})


def test_a_single_pair_of_twice_the_same_frame_that_fits_no_other_camera_is_not_compared(rig, small_run, tmp_path):
    """Nothing of it moves, so no light is left. What was copied is named where the pair is reconstructed."""
    file = small_run.images(tmp_path / "data")
    for camera in ("left", "right"):
        first, second, *rest = sorted((file.parent / "particles" / camera).iterdir())
        shown = first.read_bytes() if camera == "left" else rest[0].read_bytes()
        first.write_bytes(shown)
        second.write_bytes(shown)
        for path in rest:
            path.unlink()
    file.write_text(file.read_text("utf-8").replace("pairs = 4", "pairs = 1"), "utf-8")
    found = belonging.check(lfpiv.open_experiment(file), rig[1], [0])
    assert not found.refusals and "cannot be told from pair 0" in found.sentence
