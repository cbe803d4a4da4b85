"""Windows and aberrations: rays against Snell's law, kernels against twins, cameras in focus."""

import json
import re

import numpy as np
import pytest
from scipy.optimize import fsolve
from scipy.stats import qmc
from support import ray_twins
from support.calibration_scene import CALIBRATION_SCENE, MAPPING_PITCH, mean_error_pitch
from support.simulated_cameras import SMALL_SCENE, camera, points, refusal, relative_difference, snell

import lfpiv
from lfpiv.simulation.camera_images import image_area, render_camera
from lfpiv.simulation.scene import SceneCamera, open_scene, true_mapping
from lfpiv.simulation.simulator import simulate
from lfpiv_kernels.rendering import collect, real_optics, render

SNELL_MM = 1e-8  # two float64 solvers: fsolve to 1e-11 in the slope, times 200 mm to the lens
MOVED_RAYS = 3e-3  # share of the light in other pixels: float32 places these rays to 4e-4 px
EDGE_SAMPLES = 2.5  # rays of one pixel that float32 may put on the other side of an edge
FOCUS_MM = 1e-9  # cameras are moved until they are in focus to 1e-11 mm
SEIDEL_MM = 1e-12  # polynomials of a few terms in float64

GLASS = {"point_mm": (0, 0, 30), "normal": (0, 0, 1), "thickness_mm": 5.0, "index": 1.5}
WATER = {"point_mm": (0, 0, 20), "normal": (0.1, 0.3, -1), "thickness_mm": 8.0, "index": 1.49, "medium_index": 1.333}
OUTER = {"point_mm": (30, 0, 80), "normal": (0.8, -0.1, 1), "thickness_mm": 6.0, "index": 1.46}
LENS = {
    "spherical_pitch": 0.4,
    "coma_pitch": -0.3,
    "astigmatism_pitch": 0.15,
    "field_curvature_pitch": -0.15,
    "distortion_percent": 2.0,
    "centre_mm": (0.1, -0.2),
}
RIGS = {
    "glass": {"window": (GLASS,)},
    "tank": {"window": (WATER, OUTER), "nominal_angle_deg": 25},
    "lens": {"aberrations": LENS},
    "all": {"window": (WATER, OUTER), "aberrations": LENS, "microlens_layout": "hexagonal", "nominal_angle_deg": -20},
}

EVEN = {"vignetting": 0, "lens_gain_sd": 0}


def rig(name, **changes):
    return camera("ideal", **({"nominal_angle_deg": 45} | RIGS.get(name, {}) | changes))


def pupil_points(count, radius=12.5, seed=3):
    rng = np.random.default_rng(seed)
    length, angle = radius * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
    return np.stack([length * np.cos(angle), length * np.sin(angle)], 1)


def forward(direction, point, scene_camera):
    """Trace one ray from a world point through all plates to the plane of the lens: (u, v)."""
    place, index = np.array(point, float), scene_camera.window[0].medium_index
    towards_lens = scene_camera.rotation[2]
    for window in scene_camera.window:
        normal = np.array(window.normal) / np.linalg.norm(window.normal)
        normal = normal * np.sign(normal @ towards_lens)
        for surface, after in ((0.0, window.index), (window.thickness_mm, 1.0)):
            level = normal @ window.point_mm + surface
            place = place + (level - normal @ place) / (normal @ direction) * direction
            direction = snell(direction, normal, index, after)
            index = after
    place, direction = (
        scene_camera.rotation @ (place - scene_camera.axis_point_mm),
        scene_camera.rotation @ direction,
    )
    slope = direction / direction[2]
    return (place + (scene_camera.optics.object_distance_mm - place[2]) * slope)[:2], place, slope


@pytest.mark.parametrize("name", ["glass", "tank"])
def test_true_rays_obey_snell_s_law(name):
    """The ray iterated from the lens equals the ray traced from the particle by Snell's law."""
    scene_camera = rig(name)
    optics, at, pupil = scene_camera.optics, 8 * points(12, 1), pupil_points(12)
    expected = []
    for point, target in zip(at, pupil, strict=True):

        def miss(tilt, point=point, target=target):
            direction = np.array([*tilt, 1.0]) / np.linalg.norm([*tilt, 1.0])
            return forward(scene_camera.rotation.T @ direction, point, scene_camera)[0] - target

        tilt = fsolve(miss, [0.0, 0.0], xtol=1e-11)
        direction = np.array([*tilt, 1.0]) / np.linalg.norm([*tilt, 1.0])
        _, place, slope = forward(scene_camera.rotation.T @ direction, point, scene_camera)
        in_focus = (place - place[2] * slope)[:2]  # where the ray in air, prolonged backward, meets the focal plane
        expected.append(-in_focus * optics.image_distance_mm / optics.object_distance_mm)
    found = true_mapping(scene_camera)(at, pupil)
    assert np.abs(found - expected).max() < SNELL_MM
    without = camera("ideal", nominal_angle_deg=scene_camera.nominal_angle_deg)
    assert np.abs(found - true_mapping(without)(at, pupil)).max() > 0.02  # the windows matter: a fifth of a microlens


@pytest.mark.parametrize("name", [*RIGS, "ideal"])
def test_rays_are_reversible(name):
    """A ray from a point to the array, and back to the plane of the point: iterated one way, explicit the other."""
    scene_camera = rig(name)
    at, pupil, scales = points(200, 1), pupil_points(200), scene_camera.optics
    array = true_mapping(scene_camera)(at, pupil)
    start, direction = real_optics.object_lines(
        array, pupil, scales.object_distance_mm, scales.image_distance_mm, scene_camera.plates, scene_camera.seidel
    )
    start, direction = start @ scene_camera.rotation + scene_camera.axis_point_mm, direction @ scene_camera.rotation
    back = start + ((at[:, 2] - start[:, 2]) / direction[:, 2])[:, None] * direction
    assert np.abs(back - at).max() < SNELL_MM


def test_order_and_normal_sign_of_windows_in_air_do_not_matter():
    at, pupil = 5 * points(50), pupil_points(50)
    both = true_mapping(rig("glass", window=(GLASS, OUTER)))(at, pupil)
    other = true_mapping(rig("glass", window=(OUTER, GLASS | {"normal": (0, 0, -7), "point_mm": (9, 3, 30)})))(
        at, pupil
    )
    assert np.abs(both - other).max() < SNELL_MM
    halves = (GLASS | {"thickness_mm": 2.0}, GLASS | {"thickness_mm": 3.0, "point_mm": (0, 0, 40)})
    whole = true_mapping(rig("glass"))(at, pupil)
    assert np.abs(true_mapping(rig("glass", window=halves))(at, pupil) - whole).max() < SNELL_MM
    air = GLASS | {"index": 1.0}
    none = true_mapping(camera("ideal", nominal_angle_deg=45))(at, pupil)
    assert np.abs(true_mapping(rig("glass", window=(air,)))(at, pupil) - none).max() < SNELL_MM


@pytest.mark.parametrize("name", ["glass", "tank"])
def test_cameras_are_in_focus_through_their_windows(name):
    """The stated point is imaged at the sensor's centre. The mean slope of its rays over the pupil is zero."""
    focused = (0.3, -0.2, 0.5)
    scene_camera = rig(name, true_offset_mm=focused)
    pupil = 12.5 / np.sqrt(2) * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    array = true_mapping(scene_camera)(np.tile(focused, (5, 1)), pupil)
    assert np.abs(array[0]).max() < FOCUS_MM and abs((array * pupil).sum() / (pupil**2).sum()) < FOCUS_MM
    assert np.linalg.norm(scene_camera.axis_point_mm - focused) > 1  # it had to move


def test_each_aberration_follows_seidel_theory():
    """Values hold at the edge of pupil and field, in pitches. Exponents of field and pupil are Seidel's."""
    optics = camera("ideal").optics
    field = np.hypot(*optics.sensor_shape) * optics.pixel_mm / 2
    edge, up, across = np.array([field, 0.0]), np.array([0, 12.5]), np.array([12.5, 0])

    def error(array, pupil, **lens):
        seidel = camera("ideal", aberrations=lens).seidel
        return real_optics.aberration_mm(np.atleast_2d(array), np.atleast_2d(pupil), seidel)[0] / 0.1

    cases = [
        ({"spherical_pitch": 0.5}, 0 * edge, across / 2, [0.5 / 8, 0]),
        ({"spherical_pitch": 0.5}, edge, up, [0, 0.5]),
        ({"coma_pitch": 0.6}, edge, across, [0.6, 0]),  # tangential coma
        ({"coma_pitch": 0.6}, edge, up, [0.2, 0]),  # sagittal: a third
        ({"coma_pitch": 0.6}, edge / 2, -across / 2, [0.6 / 8, 0]),
        ({"astigmatism_pitch": 0.3}, edge, across, [0.3, 0]),
        ({"astigmatism_pitch": 0.3}, edge, up, [0, 0]),
        ({"field_curvature_pitch": 0.7}, edge / 2, up, [0, 0.7 / 4]),
        ({"distortion_percent": 2.0}, edge / 2, up, [0.02 * field / 8 / 0.1, 0]),
        ({"coma_pitch": 0.6, "centre_mm": (field, 0)}, 0 * edge, across, [-0.6, 0]),  # decentred: coma on the axis
    ]
    for lens, array, pupil, expected in cases:
        assert np.abs(error(array, pupil, **lens) - expected).max() < SEIDEL_MM / 0.1, lens


def test_aberrations_are_the_gradient_of_one_wave_aberration():
    """Rays are normal to wave fronts (Malus and Dupin): the curl of the error over the pupil is zero."""
    seidel = rig("lens").seidel
    array, pupil, step = 0.4 * points(50)[:, :2], pupil_points(50), 1e-4
    slopes = [
        (real_optics.aberration_mm(array, pupil + h, seidel) - real_optics.aberration_mm(array, pupil - h, seidel))
        / 2e-4
        for h in step * np.eye(2)
    ]
    assert np.abs(slopes[0][:, 1] - slopes[1][:, 0]).max() < 1e-10  # differences of 1e-15 mm over 1e-4 mm


@pytest.mark.parametrize("name", RIGS)
def test_sources_seen_through_real_optics_equal_their_twin(device, name):
    scene_camera = rig(name)
    renderer = render_camera(scene_camera)
    centres, counts = points(10), np.full(10, 1e5)
    rays = render.ray_table(4096, "ball", 0)
    found = render.render_sources(renderer, centres, counts, 0.03, rays, rng=np.random.default_rng(2))
    expected = ray_twins.sources(scene_camera, renderer, centres, counts, 0.03, rays, np.random.default_rng(2))
    assert expected.sum() > 0.1 * counts.sum()
    assert relative_difference(found, expected) < MOVED_RAYS
    plain = render_camera(camera("ideal", nominal_angle_deg=scene_camera.nominal_angle_deg))
    ideal = render.render_sources(plain, centres, counts, 0.03, rays, rng=np.random.default_rng(2))
    assert relative_difference(ideal, expected) > 10 * MOVED_RAYS


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tank", "all"])
def test_a_board_seen_through_real_optics_equals_its_twin(device, name):
    """Trace the rays of each pixel of a small sensor back in float64, without the short cut of the kernel."""
    weak = {key: 0.05 for key in LENS if key.endswith("pitch")} | {"spherical_pitch": 0.6}  # the field is tiny
    changes = {"sensor_width_px": 40, "sensor_height_px": 30, "true_offset_mm": (0, 0, 0.15)}
    scene_camera = rig(name, **changes | ({"aberrations": weak} if name == "all" else {}))
    board, samples = {"dots": (3, 2), "spacing_mm": 0.12, "dot_diameter_mm": 0.08}, 64
    table = qmc.Sobol(4, scramble=True, seed=np.random.default_rng(3)).random(samples) - 0.5
    renderer = render_camera(scene_camera)
    expected = ray_twins.board(scene_camera, renderer, 0.15, **board, table=table)
    found = collect.render_board(renderer, 0.15, **board, dot_light=1, board_light=0, samples=samples, seed=3)
    assert expected.max() > 0.3
    assert np.abs(found - expected).max() <= EDGE_SAMPLES / samples
    assert (np.abs(found - expected) < 1e-6).mean() > 0.95


@pytest.mark.slow(but="all")
@pytest.mark.parametrize(
    ("scene_camera", "uneven", "noise"),
    [
        (camera("ideal", **EVEN), 0.002, 0.02),
        (camera("misaligned", **EVEN), 0.02, 0.02),
        (camera("hexagonal", **EVEN), 0.02, 0.02),
        (rig("glass", true_offset_mm=(0, 0, 0.1)), 0.03, 0.03),
        (rig("all", true_offset_mm=(0, 0, 0.1)), 0.03, 0.03),
    ],
    ids=["ideal", "misaligned", "hexagonal", "glass", "all"],
)
def test_dots_traced_forward_and_backward_agree(device, scene_camera, uneven, noise):
    """Two independent kernels, one radiometry: light of a dot = level x microimage x lenses that its image covers.

    Forward rays leave a dot evenly towards the pupil. A radiant tilted board favours one side of the pupil, and
    aberrations stretch the image unevenly. `noise` is the rays' noise.
    """
    renderer, dots = render_camera(scene_camera), np.array([[-0.1, 0, 0.1], [0.1, 0, 0.1]])
    lenses = np.pi * 0.05**2 * image_area(scene_camera, dots) / abs(np.linalg.det(renderer.basis_mm))
    rays = render.ray_table(1 << 17, "disc", 0)
    forward = render.render_sources(
        renderer, dots, lenses * renderer.microimage_px, 0.05, rays, rng=np.random.default_rng(0)
    )
    backward = collect.render_board(
        renderer,
        0.1,
        dots=(2, 1),
        spacing_mm=0.2,
        dot_diameter_mm=0.1,
        dot_light=1,
        board_light=0,
        samples=1024,
        seed=0,
    )
    assert forward.sum() == pytest.approx(backward.sum(), rel=uneven)
    assert np.linalg.norm(forward - backward) < (uneven + noise) * np.linalg.norm(backward)


def test_windows_and_aberrations_do_not_change_uniform_light(device):
    plain = collect.render_white(render_camera(rig("all", window=(), aberrations={})), samples=64, seed=0)
    assert np.array_equal(collect.render_white(render_camera(rig("all")), samples=64, seed=0), plain)


OPTICS = """
[window]
point_mm = [0.0, 0.0, 30.0]
normal = [0.0, 0.0, 1.0]
thickness_mm = 5.0
index = 1.5
[aberrations]
coma_pitch = 0.3
"""


def test_cameras_and_truth_take_the_optics_of_the_scene(device, tmp_path):
    own = "[camera.aberrations]\nspherical_pitch = 0.2\n[[camera.window]]\nindex = 1.4\nthickness_mm = 2.0\n"
    own += "point_mm = [-20.0, 0.0, 20.0]\nnormal = [-1.0, 0.0, 1.0]\n"
    text = (
        SMALL_SCENE.replace("dark_image = true\n", "dark_image = true\n" + own).replace("pairs = 2", "pairs = 1")
        + OPTICS
    )
    (tmp_path / "scene.toml").write_text(text)
    scene = open_scene(tmp_path / "scene.toml")
    one, two = scene.camera
    assert one.window == scene.window and one.window[0].index == 1.5 and one.aberrations.coma_pitch == 0.3
    assert two.window[0].index == 1.4 and two.aberrations.coma_pitch == 0 and two.aberrations.spherical_pitch == 0.2
    path = simulate(scene, tmp_path / "data")
    assert "[window" not in path.read_text() and "aberration" not in path.read_text()  # the truth stays hidden
    spec = json.loads((path.parent / "truth" / "spec.json").read_text())
    at, pupil = points(20), pupil_points(20)
    for number in (0, 1):
        assert SceneCamera.model_validate(spec["camera"][number]) == scene.camera[number]
        found = true_mapping(spec["camera"][number])(at, pupil)
        assert np.array_equal(found, true_mapping(scene.camera[number])(at, pupil))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("point_mm = [0.0, 0.0, 30.0]", "point_mm = [0.0, 0.0, 0.1]", "window[0]"),  # cuts the particles
        ("point_mm = [0.0, 0.0, 30.0]", "point_mm = [0.0, 0.0, 140.0]", "pupil"),  # cuts the lens at 45 degrees
        ("normal = [0.0, 0.0, 1.0]", "normal = [0.0, 0.0, 0.0]", "direction other than"),
        ("normal = [0.0, 0.0, 1.0]", "normal = [1.0, 0.0, -1.0]", "camera 'one' meets it at 89 degrees"),
        ("index = 1.5", "index = 0.9", "window.index"),
        ("index = 1.5", "index = 1.5\nmedium = 1.3", "medium"),
        ("coma_pitch = 0.3", "coma_pitch = 99.0", "aberrations.coma_pitch"),
        ("coma_pitch = 0.3", "distortion_percent = 9.0\ncentre_mm = [0.5, 0.0]", "camera 'one' has"),
    ],
)
def test_impossible_optics_are_refused(tmp_path, old, new, message):
    assert old in OPTICS
    assert message in refusal(SMALL_SCENE + OPTICS.replace(old, new), tmp_path)


def test_only_the_window_next_to_the_particles_has_a_medium():
    with pytest.raises(ValueError, match="only in the first window"):
        rig("glass", window=(GLASS, WATER))


@pytest.mark.slow
def test_the_network_learns_what_the_thin_lens_cannot(device, tmp_path):
    """A camera at its nominal position, behind a window and with aberrations: only the network maps it."""
    lens = "[aberrations]\ncoma_pitch = 0.27\ndistortion_percent = 1.0\ncentre_mm = [-2.3, 0.0]\n"
    text = re.sub(r"true_(yaw|pitch|roll|offset)\w* = .*\n", "", CALIBRATION_SCENE)
    (tmp_path / "scene.toml").write_text(text + OPTICS.split("[aberrations]")[0] + lens)
    experiment = lfpiv.open_experiment(simulate(tmp_path / "scene.toml", tmp_path / "data"))
    truth = json.loads((tmp_path / "data" / "truth" / "spec.json").read_text())["camera"][0]
    error = {
        name: mean_error_pitch(found.cameras["only"], truth)
        for name, found in (("network", lfpiv.calibrate(experiment)), ("drt", lfpiv.thin_lens(experiment)))
    }
    assert error["network"] < MAPPING_PITCH
    assert error["drt"] > 5 * MAPPING_PITCH, error
