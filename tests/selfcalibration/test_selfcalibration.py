"""Self-calibration: cameras that moved since the board was recorded, told and corrected by the particles."""

import shutil
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from support.small_run import small_scene

import lfpiv
from lfpiv.calibration.camera import Calibration
from lfpiv.geometry.grid import Grid
from lfpiv.runs import belonging, moved_cameras, pipeline
from lfpiv.selfcalibration import disparity, masked_correlation, movements
from lfpiv.selfcalibration.disparity import Disparity
from lfpiv.selfcalibration.movements import Movement
from lfpiv.simulation.simulator import simulate
from lfpiv.warn import Code

ROUNDING = 1e-12
"""Float64 sums of a few terms of order one."""
SUMS = 1e-9
"""The same through transforms of some ten thousand points."""
PRIOR_PULL = 0.01
"""Part of a movement that is lost to the prior, which is much weaker than the disparities of these tests."""
LATERAL_MM = 0.01
"""Error of a camera's shift across its view: a tenth of a voxel by 120 particles in four frames."""
AGREE_VOXEL = 0.5
"""Disparity of cameras that did not move, as 120 particles tell it."""
KNOCK_MM = 0.12
"""How far the right camera moves along y: more than a voxel."""
FALSE_ALARMS = 0.04
"""Share of data sets of mere errors that may look like a movement: 0.27 % for each of six numbers, 1.6 % in all, shown
by 200 data sets to 0.9 %."""
SMALL_TURN = 0.03
"""Sine of the angles by which the cameras are misaligned."""
GRID = Grid(shape=(12, 20, 24), voxel_mm=0.1, first_centre_mm=(-0.55, -0.95, 0.05))


def movement(shift, turn, grid=GRID):
    none = Movement.none(grid)
    return Movement(shift_mm=np.array(shift), rotation_rad=np.array(turn), centre_mm=none.centre_mm, std=none.std)


def test_moved_camera_has_the_rays_of_moved_points(small_run):
    camera = lfpiv.load_calibration(small_run.out / "calibration.h5").cameras["left"]
    rotation, shift = Rotation.from_rotvec([0.02, -0.03, 0.05]).as_matrix(), np.array([0.1, -0.2, 0.3])
    rng = np.random.default_rng(1)
    points, pupil = rng.uniform(-1, 1, (50, 3)), rng.uniform(-5, 5, (50, 2))
    assert camera.network is not None and camera.baseline is not None
    expected = camera.map(points @ rotation.T + shift, pupil)
    assert np.abs(camera.moved(rotation, shift).map(points, pupil) - expected).max() < ROUNDING * 100  # mm of order 100
    assert np.abs(camera.map(points, pupil) - expected).max() > 0.05


def test_weights_of_one_camera_are_those_of_all(small_run):
    experiment = lfpiv.open_experiment(small_run.experiment)
    weights = lfpiv.build_weights(lfpiv.load_calibration(small_run.out / "calibration.h5"), experiment.grid)
    volume = np.random.default_rng(7).random(experiment.grid.shape, np.float32)
    one = weights.of_camera("right")
    assert list(one(volume)) == ["right"] and np.array_equal(one(volume)["right"], weights(volume)["right"])


def test_movements_follow_each_other():
    first, step = movement([0.1, 0.2, -0.1], [0.01, 0.02, -0.03]), movement([-0.3, 0.1, 0.2], [0.02, -0.01, 0.04])
    points = np.random.default_rng(2).uniform(-1, 1, (20, 3))
    assert np.abs(first.after(step)(points) - first(step(points))).max() < ROUNDING
    assert np.array_equal(Movement.none(GRID).after(step)(points), step(points))


def naive_coefficients(first, second, window, centre, reach):
    """Correlation coefficient lag by lag around `centre`, of the voxels that both volumes have."""
    out = np.zeros((2 * reach + 1,) * 3)
    at = np.stack(np.meshgrid(*(np.arange(part.start, part.stop) for part in window), indexing="ij"), -1).reshape(-1, 3)
    for place in np.ndindex(*out.shape):
        to = at + np.array(place) - reach + centre
        inside = ((to >= 0) & (to < second[0].shape)).all(1)
        if inside.sum() < masked_correlation.LEAST_OVERLAP * len(at):
            continue
        products = spread = other = 0.0
        for one, two in zip(first, second, strict=True):
            scale = one[window].std()
            around = np.zeros([part.stop - part.start + 2 * reach for part in window])
            low = [part.start - reach + lag for part, lag in zip(window, centre, strict=True)]
            for index in np.ndindex(*around.shape):
                voxel = tuple(np.add(index, low))
                if all(0 <= v < n for v, n in zip(voxel, two.shape, strict=True)):
                    around[index] = two[voxel]
            a = one[tuple(at[inside].T)] / scale
            b = two[tuple(to[inside].T)] / around.std()
            products += ((a - a.mean()) * (b - b.mean())).sum()
            spread += ((a - a.mean()) ** 2).sum()
            other += ((b - b.mean()) ** 2).sum()
        out[place] = products / np.sqrt(spread * other)
    return out


@pytest.mark.parametrize("centre", [(0, 0, 0), (1, -2, 0)])
def test_coefficients_are_those_of_the_overlap(centre):
    rng = np.random.default_rng(3)
    first, second = ([rng.gamma(0.3, size=(5, 7, 6)) for _ in range(2)] for _ in range(2))
    window = slice(0, 4), slice(3, 7), slice(1, 5)
    found = masked_correlation.masked_correlation(first, second, window, centre, reach=2)
    assert np.abs(found - naive_coefficients(first, second, window, centre, 2)).max() < SUMS
    assert (found == 0).any() and (np.abs(found) > 0.1).any()


@pytest.mark.parametrize("count", [2, 3])
def test_rigid_movements_explain_their_disparities(count):
    rng = np.random.default_rng(4)
    names = ["left", "right", "top"][:count]
    turns = 0.01 * rng.standard_normal((count, 3))
    shifts = 0.1 * rng.standard_normal((count, 3))
    turns, shifts = turns - turns.mean(0), shifts - shifts.mean(0)  # what all share cannot be told
    true = {name: movement(shift, turn) for name, shift, turn in zip(names, shifts, turns, strict=True)}
    found = []
    for first, second in combinations(names, 2):
        for _ in range(30):
            at = rng.uniform(-1, 1, 3)
            shift = (true[second](at[None]) - true[first](at[None]))[0]
            pair = Disparity(
                cameras=(first, second), centre_mm=at, shift_mm=shift, sharpness=np.eye(3), peak=0.5, rival=0.1
            )
            found.append(pair)
    fit = movements.fit_movements(found, names, GRID)
    fitted = fit.movements
    for name in names:
        assert np.allclose(fitted[name].shift_mm, true[name].shift_mm, atol=PRIOR_PULL * 0.1)
        assert np.allclose(fitted[name].rotation_rad, true[name].rotation_rad, atol=PRIOR_PULL * 0.1)
        assert (fitted[name].std > 0).all() and (fitted[name].std[:3] < 0.01).all()
    told = np.sqrt(np.mean([one.shift_mm @ one.shift_mm for one in found]))
    assert fit.separation.mm == pytest.approx(told, rel=PRIOR_PULL) and fit.separation.significant
    kept = fit.projected(fit.significant_directions(1.0)).movements
    assert all(np.allclose(kept[name].shift_mm, true[name].shift_mm, atol=PRIOR_PULL * 0.1) for name in names)


def test_a_movement_that_one_disparity_alone_shows_is_not_significant():
    """Its residual is zero by construction, however wrong it is."""

    def one(cameras, at, shift):
        across = np.diag([0.0, 1.0, 0.0])  # what two cameras in a horizontal plane show
        centre_mm, shift_mm = np.array([*at, 0.0]), np.array([0.0, shift, 0.0])
        return Disparity(
            cameras=cameras, centre_mm=centre_mm, shift_mm=shift_mm, sharpness=across, peak=0.14, rival=0.06
        )

    places, names = [(-0.6, -0.65), (-0.6, 0.65), (0.6, 0.65)], ["left", "middle", "right"]
    still = [one(("middle", "right"), at, shift) for at, shift in zip(places, (-0.011, -0.001, -0.029), strict=True)]
    alone = movements.fit_movements([one(("left", "middle"), (0.6, 0.65), -0.122), *still], names, GRID)
    assert alone.separation.mm > 0.03 and not alone.separation.significant
    confirmed = [one(("left", "middle"), at, -0.122) for at in (*places, (0.6, -0.65))]
    assert movements.fit_movements([*confirmed, *still], names, GRID).separation.significant


@pytest.mark.parametrize(("at_rest", "found"), [(0.0, True), (0.5, False)])
def test_a_peak_elsewhere_stands_out_from_the_coefficients_at_rest(at_rest, found):
    rng, shape = np.random.default_rng(8), (12, 20, 24)
    fields = [gaussian_filter(rng.standard_normal(shape), 0.7) for _ in range(3)]
    first, second = fields[0], 0.55 * np.roll(fields[0], 5, axis=1) + at_rest * fields[0] + fields[1]
    window, slanted = tuple(slice(0, edge) for edge in shape), np.diag([1.0, 0.0, 1.0])
    told = disparity.disparity_in(([first], [second]), window, GRID, ("left", "right"), slanted)
    assert (told is not None) == found
    if told is not None:
        assert told.shift_mm[1] == pytest.approx(0.5, abs=LATERAL_MM * 2)


def test_shift_along_the_views_counts_for_little():
    sharpness = np.diag([1.0, 100.0, 4.0])
    one = Disparity(
        cameras=("left", "right"),
        centre_mm=np.zeros(3),
        shift_mm=np.ones(3),
        sharpness=sharpness,
        peak=0.5,
        rival=0.1,
    )
    assert one.observable_mm(np.array([0, 0.3, 0])) == pytest.approx(0.3)
    assert one.observable_mm(np.array([0.3, 0, 0])) == pytest.approx(0.003)
    assert one.observable_mm(np.array([0, 0, 0.3])) == pytest.approx(0.012)


@pytest.fixture(scope="module")
def knocked(small_run, tmp_path_factory):
    """The small run's calibration images, and particles recorded after the right camera had moved along y."""
    folder = tmp_path_factory.mktemp("knocked")
    moved = simulate(small_scene(right={"true_offset_mm": (0.0, KNOCK_MM, 0.0)}), folder / "moved")
    file = small_run.images(folder / "data")
    shutil.rmtree(file.parent / "particles")
    shutil.copytree(moved.parent / "particles", file.parent / "particles")
    return file


def test_cameras_that_stood_still_agree(small_run):
    weights = small_run.summary["weights"]
    assert weights["disparity_voxel"] < AGREE_VOXEL and 0 < weights["disparity_std_voxel"] < AGREE_VOXEL
    assert not any("apart" in text for text in small_run.summary["warnings"])


@pytest.mark.slow
def test_run_tells_that_a_camera_moved_and_corrects_it_where_asked(
    small_run, knocked, tmp_path, empty_report, monkeypatch
):
    out = small_run.calibrated(tmp_path / "out")
    summary = pipeline.run(knocked, out, pairs=(0, 1))
    apart = [text for text in summary["warnings"] if "show the same particles" in text]
    assert len(apart) == 1 and "left and right" in apart[0] and "self_calibration.pairs = 4" in apart[0]
    assert summary["weights"]["disparity_voxel"] == pytest.approx(KNOCK_MM / 0.1, abs=0.2)
    assert not (out / "self_calibration.h5").exists()

    file = knocked.with_name("corrected.toml")
    file.write_text(knocked.read_text("utf-8") + "\n[self_calibration]\npairs = 4\n", "utf-8")
    summary = pipeline.run(file, out, pairs=(0, 1))
    assert "vectors of pair 0" not in summary["reused"]  # made by the other calibration
    assert not any("apart" in text for text in summary["warnings"])
    figures = summary["weights"]["self_calibration"]
    assert figures["pairs"] == [0, 1, 2, 3] and figures["disparity_voxel"] < 0.1 < 1 < figures["disparity_before_voxel"]
    shift = {name: np.array(move["shift_mm"]) for name, move in figures["movements"].items()}
    assert np.allclose(shift["left"], -shift["right"], atol=1e-5)
    assert shift["left"][1] - shift["right"][1] == pytest.approx(KNOCK_MM, abs=LATERAL_MM)
    corrected = lfpiv.load_calibration(out / "self_calibration.h5")
    board = lfpiv.load_calibration(out / "calibration.h5")
    rotation, at = movement(figures["movements"]["right"]["shift_mm"], [0, 0, 0], small_grid(file)).affine
    expected = board.cameras["right"].moved(rotation, at)
    points, pupil = np.random.default_rng(5).uniform(-0.5, 0.5, (20, 3)), np.zeros((20, 2))
    assert np.allclose(corrected.cameras["right"].map(points, pupil), expected.map(points, pupil), atol=0.01)

    monkeypatch.undo()
    again = pipeline.run(file, out, pairs=(0, 1))
    assert "vectors of pair 0" in again["reused"] and again["weights"]["self_calibration"] == figures
    assert "Cameras against each other" in (out / "report.html").read_text("utf-8")
    for path in (file.parent / "particles").glob("*/*"):
        path.unlink()
    assert [pair["pair"] for pair in pipeline.report(file, out)["pairs"]] == [0]  # results outlive their images


def small_grid(file):
    return lfpiv.open_experiment(file).grid


@pytest.mark.slow
def test_library_call_recovers_a_known_movement(small_run):
    experiment = lfpiv.open_experiment(small_run.experiment)
    calibration = lfpiv.load_calibration(small_run.out / "calibration.h5")
    moved = dict(calibration.cameras)
    moved["left"] = moved["left"].moved(np.eye(3), np.array([0.0, -2.5 * KNOCK_MM, 0.0]))
    images = []
    for pair in range(experiment.pairs):
        frame = {name: experiment.particle_image(name, pair, "a") for name in moved}
        images.append({name: image - np.median(image) for name, image in frame.items()})
    found = lfpiv.self_calibrate(Calibration(moved), experiment.grid, images)
    assert found.verdict is movements.Verdict.CORRECTED
    relative = found.movements["left"].shift_mm - found.movements["right"].shift_mm
    assert relative[1] == pytest.approx(2.5 * KNOCK_MM, abs=LATERAL_MM)
    told = [np.median([one.observable_mm(one.shift_mm) for one in some]) for some in (found.before, found.after)]
    assert told[1] < 0.2 * told[0]


def test_what_cannot_be_told_is_refused(small_run, knocked, tmp_path):
    experiment = lfpiv.open_experiment(small_run.experiment)
    calibration = lfpiv.load_calibration(small_run.out / "calibration.h5")
    with pytest.raises(ValueError, match="two cameras or more"):
        lfpiv.self_calibrate(Calibration({"left": calibration.cameras["left"]}), experiment.grid, [{}])
    with pytest.raises(ValueError, match="images of 0 instants"):
        lfpiv.self_calibrate(calibration, experiment.grid, [])
    shape = calibration.cameras["left"].optics.sensor_shape
    rng = np.random.default_rng(6)
    noise = {name: rng.normal(0, 5, shape).astype(np.float32) for name in calibration.cameras}
    with pytest.raises(ValueError, match="found none"):
        lfpiv.self_calibrate(calibration, experiment.grid, [noise])


@pytest.mark.slow
def test_cameras_of_different_instants_are_named(small_run, tmp_path, empty_report):
    file = small_run.images(tmp_path / "data")
    images = sorted((file.parent / "particles" / "right").iterdir())
    for path in images:
        path.rename(path.with_name(f"old_{path.name}"))
    for old, new in zip(images, images[2:] + images[:2], strict=True):  # each pair's are another's
        old.with_name(f"old_{old.name}").rename(new)
    summary = pipeline.run(file, small_run.calibrated(tmp_path / "out"), pairs=(0, 3))
    codes = (Code.MISMATCHED.value, Code.NOTHING_IN_COMMON.value)  # the first pair has no partner within two pairs
    (said,) = [one for one in summary["warning_records"] if one["code"] in codes]
    assert said["pairs"] == [0, 1, 2] and summary["valid_fraction"] == 0
    assert "disparity_voxel" not in summary["weights"]
    file.write_text(file.read_text("utf-8") + "\n[self_calibration]\npairs = 1\n", "utf-8")
    summary = pipeline.run(file, tmp_path / "out", pairs=(0, 1))
    said = [text for text in summary["warnings"] if "self-calibration keeps the calibration of the board" in text]
    assert len(said) == 1 and "no images show the same particles" in said[0]
    assert [pair["pair"] for pair in summary["pairs"]] == [0]  # the run goes on


def disparity_at(at, shift):
    return Disparity(cameras=("left", "right"), centre_mm=at, shift_mm=shift, sharpness=np.eye(3), peak=0.5, rival=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_errors_of_disparities_are_no_movement(noise):
    rng = np.random.default_rng(9)
    shares = []
    for _ in range(200):
        found = [disparity_at(rng.uniform(-1, 1, 3), noise * rng.standard_normal(3)) for _ in range(10)]
        fit = movements.fit_movements(found, ["left", "right"], GRID)
        kept = fit.projected(fit.significant_directions(1.0)).movements.values()
        shares.append((fit.separation.significant, any(np.any(move.shift_mm) for move in kept)))
    assert np.mean(shares, axis=0).max() < FALSE_ALARMS
    still = disparity_at(np.zeros(3), np.array([0, 0.2, 0]))
    shifted = [replace(one, shift_mm=one.shift_mm + still.shift_mm) for one in found]
    assert movements.fit_movements(shifted, ["left", "right"], GRID).separation.significant


def test_light_that_stays_in_place_is_left_out():
    rng = np.random.default_rng(10)
    still = rng.uniform(0, 500, (20, 30)).astype(np.float32)
    moving = np.zeros((2, 20, 30), np.float32)
    moving[0, 5, 6] = moving[1, 8, 9] = 300
    instants = [{"left": still * energy + own} for energy, own in zip((1.0, 0.9), moving, strict=True)]
    kept = disparity.still_light(instants)
    first, second = (disparity.without_still_light(one, kept)["left"] for one in instants)
    assert (first > 0).sum() == (second > 0).sum() == 1 and first[5, 6] > 0 and second[8, 9] > 0


@pytest.mark.slow
def test_particles_that_hardly_move_between_the_frames_of_a_pair_are_no_still_light(small_run, tmp_path):
    file = small_run.images(tmp_path / "data")
    for folder in (file.parent / "particles").iterdir():
        images = sorted(folder.iterdir())
        for first, second in zip(images[::2], images[1::2], strict=True):
            shutil.copyfile(first, second)
    experiment = lfpiv.open_experiment(file)
    weights = lfpiv.build_weights(lfpiv.load_calibration(small_run.out / "calibration.h5"), experiment.grid)
    found = belonging.check(experiment, weights, [0]).disparity
    assert found is not None and found.voxel < AGREE_VOXEL


def test_cameras_that_did_not_move_stay(small_run, tmp_path):
    file = small_run.images(tmp_path / "data")
    file.write_text(file.read_text("utf-8") + "\n[self_calibration]\npairs = 2\n", "utf-8")
    calibration = lfpiv.load_calibration(small_run.out / "calibration.h5")
    corrected, figures = moved_cameras.correct(lfpiv.open_experiment(file), calibration, lambda fraction: None)
    assert corrected is calibration and figures.verdict == movements.Verdict.UNMOVED.value
    assert not figures.warnings and figures.corrections == 0 and len(figures.pairs) == 2
    assert all(not np.any(move.shift_mm) for move in figures.movements.values())


def test_slant_is_the_plane_of_the_lines_of_sight(small_run):
    calibration = lfpiv.load_calibration(small_run.out / "calibration.h5")
    grid = small_grid(small_run.experiment)
    both = disparity.slant(list(calibration.cameras.values()), grid)
    assert np.abs(both - np.diag([1, 0, 1])).max() < SMALL_TURN  # cameras turned about y look along x and z
    one = disparity.slant([calibration.cameras["left"]] * 2, grid)
    assert np.linalg.matrix_rank(one, tol=0.5) == 1 and np.allclose(one @ one, one)


def test_chance_peaks_do_not_move_cameras():
    rng = np.random.default_rng(8)
    found = []
    for number in range(18):
        at = rng.uniform(-1, 1, 3)
        shift = rng.uniform(-0.4, 0.4, 3) if number % 6 == 0 else 0.01 * rng.standard_normal(3)
        pair = Disparity(
            cameras=("left", "right"), centre_mm=at, shift_mm=shift, sharpness=np.eye(3), peak=0.5, rival=0.1
        )
        found.append(pair)
    fitted = movements.fit_movements(found, ["left", "right"], GRID).movements
    assert all(np.abs(move.shift_mm).max() < LATERAL_MM for move in fitted.values())
    plain = np.mean([one.shift_mm for one in found], axis=0)
    assert np.abs(plain).max() / 2 > LATERAL_MM  # what least squares alone would make of it
