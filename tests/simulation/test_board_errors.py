"""Errors of simulated boards, and cameras that move after the board was recorded."""

import numpy as np
import pytest
import tifffile
from scipy.ndimage import gaussian_filter
from support.simulated_cameras import MONTE_CARLO, ROUNDING, small_scene

from lfpiv.simulation.board_errors import BoardErrors, true_board
from lfpiv.simulation.camera_images import image_area, render_camera
from lfpiv.simulation.scene import true_mapping
from lfpiv.simulation.simulator import simulate
from lfpiv_kernels.rendering import render

PLANES = np.linspace(-1, 1, 400)


def drawn(**keys):
    """Return nominal and true dots of a board of 20 x 20 dots in 400 planes."""
    x, y = np.meshgrid(np.arange(20) - 9.5, np.arange(20) - 9.5)
    nominal = np.stack([np.stack([x.ravel(), y.ravel(), np.full(400, z)], axis=1) for z in PLANES])
    return nominal, true_board(BoardErrors(**keys), nominal, 2, np.random.default_rng(0))


def test_a_board_without_errors_is_the_stated_one():
    nominal, truth = drawn()
    assert np.array_equal(truth.dots_mm, nominal) and truth.present.all() and (truth.light == 1).all()


def test_stage_errors_are_one_shift_per_plane():
    nominal, truth = drawn(stage_z_sd_mm=0.02, stage_xy_sd_mm=0.05)
    shift = truth.dots_mm - nominal
    assert np.ptp(shift, axis=1).max() < ROUNDING * 10
    assert shift[:, 0].std(axis=0) == pytest.approx((0.05, 0.05, 0.02), rel=MONTE_CARLO / np.sqrt(2 * len(PLANES)))


def test_tilts_turn_planes_about_their_middle():
    nominal, truth = drawn(tilt_sd_deg=0.5)
    x, y, rise = nominal[0, :, 0], nominal[0, :, 1], (truth.dots_mm - nominal)[..., 2]
    slopes = np.stack([rise @ x / (x @ x), rise @ y / (y @ y)])
    assert np.degrees(np.arcsin(slopes)).std(axis=1) == pytest.approx(0.5, rel=MONTE_CARLO / np.sqrt(2 * len(PLANES)))
    left = rise - slopes[0][:, None] * x - slopes[1][:, None] * y
    assert np.abs(left).max() < 1e-9  # still planes
    from_first = np.linalg.norm(truth.dots_mm - truth.dots_mm[:, :1], axis=2)
    assert np.abs(from_first - np.linalg.norm(nominal - nominal[:, :1], axis=2)).max() < 1e-9  # and rigid


def test_dots_scatter_and_are_missing_alike_in_all_planes():
    nominal, truth = drawn(dot_sd_mm=0.01, missing_share=0.1)
    shift = truth.dots_mm - nominal
    assert np.ptp(shift, axis=0).max() < ROUNDING * 100 and np.abs(shift[..., 2]).max() == 0
    assert shift[0, :, :2].std() == pytest.approx(0.01, rel=MONTE_CARLO / np.sqrt(2 * 800))
    assert abs((~truth.present).sum() - 40) < MONTE_CARLO * 6


def test_light_falls_off_across_the_board_by_the_stated_part():
    _, truth = drawn(uneven_light=0.4)
    assert truth.light.shape == (2, 400)
    assert truth.light.max(axis=1) == pytest.approx(1) and truth.light.min(axis=1) == pytest.approx(0.6)
    assert not np.allclose(truth.light[0], truth.light[1])  # each camera has its own direction


def test_images_show_the_true_board(device, tmp_path):
    """Re-rendered from ``truth/board.npz``, the dots fit; where the board was stated to be they do not."""
    errors = {
        "stage_z_sd_mm": 0.05,
        "stage_xy_sd_mm": 0.02,
        "tilt_sd_deg": 1.0,
        "dot_sd_mm": 0.01,
        "missing_share": 0.3,
        "uneven_light": 0.5,
    }
    scene = small_scene(board={"errors": errors})
    folder = simulate(scene, tmp_path / "set").parent
    with np.load(folder / "truth" / "board.npz") as file:
        dots, present, light = file["dots_mm"], file["present"], file["light"]
    assert dots.shape == (2, 6, 3) and 0 < present.sum() < 6
    plain = simulate(small_scene(), tmp_path / "plain").parent
    rays, camera = render.ray_table(4096, "disc", 9), scene.camera[0]
    renderer = render_camera(camera, seed=[scene.seed, 3, 0])
    for plane in (0, 1):
        at = dots[plane, present]
        lenses = np.pi / 4 * 0.05**2 * image_area(camera, at) / abs(np.linalg.det(renderer.basis_mm))
        counts = 3500 * renderer.microimage_px * lenses * light[0, present]
        image = render.render_sources(renderer, at, counts, 0.025, rays, rng=np.random.default_rng(0))
        expected = gaussian_filter(image, camera.blur_px)
        name = f"board/one/plane_{plane:02d}.tif"
        recorded, ideal = (tifffile.imread(where / name) - 40.0 for where in (folder, plain))
        error = np.linalg.norm(recorded - expected) / np.linalg.norm(expected)
        assert error < 0.25 and np.linalg.norm(recorded - ideal) / np.linalg.norm(ideal) > 2 * error
    for name in ("white/one.tif", "particles/one/pair_0000_a.tif"):
        assert np.array_equal(tifffile.imread(folder / name), tifffile.imread(plain / name)), name


def test_a_moved_camera_sees_only_the_particles_from_its_new_place(device, tmp_path):
    scene = small_scene()
    moved = {"shift_mm": (0.02, -0.03, 0.01), "yaw_deg": 0.3, "pitch_deg": -0.2, "roll_deg": 0.5}
    first = type(scene.camera[0]).model_validate(scene.camera[0].model_dump() | {"moved": moved})
    folder = simulate(scene.model_copy(update={"camera": (first, scene.camera[1])}), tmp_path / "moved").parent
    plain = simulate(scene, tmp_path / "plain").parent
    for path in sorted(plain.rglob("*.tif")):
        name = path.relative_to(plain).as_posix()
        equal = np.array_equal(tifffile.imread(path), tifffile.imread(folder / name))
        assert equal == (not name.startswith("particles/one")), name
    there = first.at_particles
    assert there.moved is None and there.true_yaw_deg == pytest.approx(44.3) and there.true_roll_deg == 0.5
    # the point that was in focus in the middle has gone the other way on the array
    middle = np.zeros((1, 2))
    assert np.abs(true_mapping(there)(np.array([[0.02, -0.03, 0.01]]), middle)).max() < ROUNDING * 100
    with np.load(folder / "truth" / "particles.npz") as truth:
        position, motion, intensity = (
            truth[f"pair_0000_{key}"] for key in ("positions_mm", "displacement_mm", "intensity")
        )
    recorded = tifffile.imread(folder / "particles/one/pair_0000_a.tif") - 40.0
    rays, errors = render.ray_table(16384, "gaussian", 9), []
    for camera in (there, first):
        renderer = render_camera(camera, seed=[scene.seed, 3, 0])
        image = render.render_sources(
            renderer,
            position - motion / 2,
            600 * renderer.microimage_px * intensity,
            0.02,
            rays,
            rng=np.random.default_rng(0),
        )
        errors.append(np.linalg.norm(recorded - gaussian_filter(image, camera.blur_px)) / np.linalg.norm(recorded))
    assert errors[0] < 0.2 and errors[1] > 2 * errors[0]
