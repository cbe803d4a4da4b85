"""Main lenses of surfaces: traced rays, their polynomial, images, and what is refused."""

import json

import numpy as np
import pytest
from support import ray_twins
from support.simulated_cameras import SMALL_SCENE, camera, points, relative_difference, snell

from lfpiv.errors import InputError
from lfpiv.geometry.optics import random_on_pupil
from lfpiv.simulation.camera_images import image_area, render_camera
from lfpiv.simulation.lens import PRESCRIPTIONS
from lfpiv.simulation.scene import open_scene, true_mapping
from lfpiv_kernels.rendering import collect, real_optics, render

TRACED_MM = 1e-10  # a path of 400 mm in float64 through eleven surfaces
POLYNOMIAL_PITCH = 1e-5  # a tenth of the 1e-4 that a calibration could notice
REVERSED_MM = 1e-10  # iterated to 1e-12, from a pupil point a hundred times as far away
THIN_PITCH = 1e-3  # a lens of 2 um in a beam of f/400 departs from a thin lens by its third order
MOVED_RAYS = 3e-3  # share of the light in other pixels: float32 places these rays to 4e-4 px
SAME_AREA = 0.1  # the magnification changes by some percent over this field and these rays
EDGE_RAYS = 0.02  # Monte Carlo: some 10,000 rays of a dot

BICONVEX = (
    {"radius_mm": 20.0, "thickness_mm": 0.002, "index": 1.5, "stop": True},
    {"radius_mm": -20, "thickness_mm": 0},
)


def rig(lens, **changes):
    return camera("ideal", **({"nominal_angle_deg": 30, "lens": lens} | changes))


def rays(scene_camera, count=200, seed=1):
    """Draw points on the sensor, pupil points and depths."""
    rng, optics = np.random.default_rng(seed), scene_camera.optics
    half = np.array(optics.sensor_shape[::-1]) * optics.pixel_mm / 2
    pupil = random_on_pupil(optics.pupil_radius_mm, count, rng)
    return rng.uniform(-half, half, (count, 2)), pupil, rng.uniform(-2, 2, count)


@pytest.mark.parametrize("name", PRESCRIPTIONS)
def test_a_lens_obeys_snell_s_law(name):
    """Rays traced back are traced forward again, surface by surface, and meet the same points of pupil and array."""
    scene_camera = rig({"prescription": name})
    lens = scene_camera.lens.system(scene_camera.optics)
    array, pupil, _ = rays(scene_camera, 20)
    place, slope = lens.object_rays(array, pupil)
    for number in range(len(array)):
        at = np.array([*place[number], lens.object_mm])
        ray = np.array([*slope[number], 1.0]) / np.linalg.norm([*slope[number], 1.0])
        for k, curvature in enumerate(lens.curvature):
            arm = at - [0, 0, lens.place_mm[k]]
            length = -arm[2] / ray[2]
            if curvature:  # both crossings of the sphere: take the nearer to its vertex
                centre = arm - [0, 0, 1 / curvature]
                root = np.sqrt((centre @ ray) ** 2 - centre @ centre + curvature**-2)
                length = min((-(centre @ ray) + sign * root for sign in (1, -1)), key=lambda x: abs((arm + x * ray)[2]))
            at = at + length * ray
            normal = np.array([0, 0, 1.0])
            if curvature:
                normal = np.array([0, 0, lens.place_mm[k] + 1 / curvature]) - at
                normal = normal / np.linalg.norm(normal) * np.sign(normal[2])
            ray = snell(ray, normal, lens.index[k], lens.index[k + 1])
        pupil_found, found = (at[:2] + (z - at[2]) / ray[2] * ray[:2] for z in (lens.pupil_mm, lens.image_mm))
        distance, optics = lens.image_mm - lens.pupil_mm, scene_camera.optics
        scales = [1 + optics.microlens_focal_length_mm / d for d in (distance, optics.image_distance_mm)]
        assert np.abs(found * scales[0] / scales[1] - array[number]).max() < TRACED_MM
        assert np.abs(pupil_found * optics.image_distance_mm / distance - pupil[number]).max() < TRACED_MM


@pytest.mark.parametrize("name", PRESCRIPTIONS)
def test_the_polynomial_is_the_traced_rays(name):
    scene_camera = rig({"prescription": name}, sensor_width_px=1200, sensor_height_px=1000)
    array, pupil, depth = rays(scene_camera)
    optics, scales = (
        scene_camera.optics,
        (scene_camera.optics.object_distance_mm, scene_camera.optics.image_distance_mm),
    )
    place, slope = scene_camera.lens.system(optics).object_rays(array, pupil)
    lens = scene_camera.lens_rays
    start, direction = real_optics.object_lines(array, pupil, *scales, scene_camera.plates, scene_camera.seidel, lens)
    seen = start + (depth / direction[:, 2])[:, None] * direction
    assert np.abs(seen[:, :2] - place - depth[:, None] * slope).max() < POLYNOMIAL_PITCH * optics.microlens_pitch_mm
    found = true_mapping(scene_camera)(seen @ scene_camera.rotation, pupil)
    assert np.abs(found - array).max() < REVERSED_MM
    thin = true_mapping(rig(None))(seen @ scene_camera.rotation, pupil)
    assert np.abs(found - thin).max() > 0.02  # the lens matters: a fifth of a microlens


def test_a_thin_lens_of_surfaces_is_a_thin_lens():
    scene_camera = rig({"surfaces": BICONVEX}, f_number=400.0)
    _, pupil, _ = rays(scene_camera)
    at = points(200)
    difference = true_mapping(scene_camera)(at, pupil) - true_mapping(rig(None))(at, pupil)
    assert np.abs(difference).max() < THIN_PITCH * scene_camera.optics.microlens_pitch_mm


def test_rays_that_do_not_reach_the_array_have_no_part_in_a_dot_s_area():
    """Towards the edge of the field a dot loses its rays one after the other; none makes its light nan."""
    scene_camera = rig({"prescription": "cooke_triplet"})
    at = np.column_stack([np.linspace(1, 0, 40), np.zeros(40), np.full(40, 2.0)])
    reaches = np.isfinite(true_mapping(scene_camera)(np.repeat(at, 2, 0), np.tile([[9.0, 0], [-9, 0]], (40, 1))))
    partly = (reaches.all(1).reshape(-1, 2).sum(1) == 1).nonzero()[0]
    area = image_area(scene_camera, at)
    assert len(partly) and np.isfinite(area).all() and area[-1] == 0
    np.testing.assert_allclose(area[partly], area[0], rtol=SAME_AREA)


def test_sources_and_boards_seen_through_a_lens_equal_their_twins(device):
    window = {
        "point_mm": (0, 0, 20),
        "normal": (0.1, 0.3, -1),
        "thickness_mm": 8.0,
        "index": 1.49,
        "medium_index": 1.33,
    }
    scene_camera = rig({"prescription": "cooke_triplet"}, window=(window,), true_offset_mm=(0, 0, 0.1))
    renderer = render_camera(scene_camera)
    centres, table = points(6), render.ray_table(4096, "ball", 0)
    found = render.render_sources(renderer, centres, 1e5, 0.03, table, rng=np.random.default_rng(2))
    counts = np.full(len(centres), 1e5)
    expected = ray_twins.sources(scene_camera, renderer, centres, counts, 0.03, table, np.random.default_rng(2))
    assert relative_difference(found, expected) < MOVED_RAYS

    board = {"dots": (1, 1), "spacing_mm": 1.0, "dot_diameter_mm": 0.1}
    backward = collect.render_board(renderer, 0.1, **board, dot_light=1, board_light=0, samples=256, seed=3)
    dot = render.render_sources(
        renderer,
        [[0, 0, 0.1]],
        backward.sum(),
        0.05,
        render.ray_table(1 << 14, "disc", 0),
        rng=np.random.default_rng(0),
    )
    smooth = [image.reshape(11, 10, 15, 10).sum((1, 3)) for image in (dot, backward)]
    assert relative_difference(*smooth) < EDGE_RAYS


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        (
            'prescription = "tessar"\nsurfaces = [{thickness_mm = 1.0}]',
            "exactly one of prescription, surfaces and file",
        ),
        ("surfaces = [{thickness_mm = 1.0}]", "exactly one surface with stop = true"),
        ("surfaces = [{radius_mm = -9.0, thickness_mm = 1.0, stop = true, index = 1.5}]", "a converging lens in air"),
        (
            "surfaces = [{radius_mm = 20.0, thickness_mm = 2.0, index = 1.5, stop = true, semi_diameter_mm = 1.0}, "
            "{radius_mm = -20.0, thickness_mm = 0.0}]",
            "raise f_number",
        ),
        ('file = "absent.zmx"', "absent.zmx: "),
    ],
)
def test_lenses_that_cannot_be_are_refused(tmp_path, lens, expected):
    path = tmp_path / "scene.toml"
    path.write_text(SMALL_SCENE + f"[lens]\n{lens}\n", "utf-8")
    with pytest.raises(InputError, match=expected):
        open_scene(path)


def test_a_scene_s_lens_is_in_its_truth(tmp_path):
    """The truth's cameras state their surfaces, so that it can be compared without the scene."""
    path = tmp_path / "scene.toml"
    path.write_text(SMALL_SCENE + '[lens]\nprescription = "double_gauss"\n', "utf-8")
    one = open_scene(path).camera[0]
    stored = json.loads(json.dumps(one.model_dump(mode="json")))
    at, pupil = points(5), np.zeros((5, 2))
    np.testing.assert_array_equal(true_mapping(stored)(at, pupil), true_mapping(one)(at, pupil))


def test_a_zemax_file_is_read_by_optiland(tmp_path):
    optiland = pytest.importorskip("optiland.fileio")
    samples = pytest.importorskip("optiland.samples.objectives")
    optiland.save_zemax_file(samples.TessarLens(), str(tmp_path / "lens.zmx"))
    path = tmp_path / "scene.toml"
    path.write_text(SMALL_SCENE + '[lens]\nfile = "lens.zmx"\n', "utf-8")
    read = open_scene(path).camera[0].lens.surfaces
    expected = PRESCRIPTIONS["tessar"][1]
    assert [(one.radius_mm, one.index) for one in read] == [
        (pytest.approx(row[0]), pytest.approx(row[2], abs=1e-4)) for row in expected
    ]
