"""Time series of the simulator: one population in a flow, its truth at every instant, and the files of its images."""

import itertools
import json

import h5py
import numpy as np
import pytest
import tifffile
from scipy.integrate import solve_ivp
from scipy.stats import chi2
from support.simulated_cameras import MONTE_CARLO, ROUNDING, SMALL_SCENE, small_scene

from lfpiv.errors import InputError
from lfpiv.experiment.opening import open_experiment
from lfpiv.simulation.particles import place_particles
from lfpiv.simulation.scene import Scene, open_scene
from lfpiv.simulation.series import place_series, runge_kutta
from lfpiv.simulation.simulator import simulate

FLOWS = {
    "uniform": {"kind": "uniform", "displacement_mm": (0.06, -0.03, 0.02)},
    "shear": {"kind": "shear", "along": "z", "across": "y", "rate": 0.2},
    "ring": {"kind": "ring", "radius_mm": 0.2, "core_mm": 0.1, "peak_mm": 0.05},
    "swirl": {"kind": "swirl", "peak_mm": 0.05, "core_mm": 0.2, "axial_mm": 0.04},
    "jet": {"kind": "swirling_jet", "bulk_mm": 0.05, "nozzle_radius_mm": 0.3, "shear_layer_mm": 0.1},
}
INTEGRATION_MM = 2e-6  # Runge-Kutta with four steps in dt_s, where the flow turns by a quarter of a radian within it
CHANCE = 1e-6  # of a test statistic to exceed its limit


def series(instants=6, *, flow=None, particles=None, **tables):
    """Return the small scene as a series; without `instants` it has pairs."""
    seeded = {"per_microlens": 0.5, "intensity_sd": 0.5, "sigma_mm": 0.02, "instants": instants}
    scene = small_scene(**tables).model_dump(exclude_none=True)
    table = seeded | (particles or {})
    table.pop("per_microlens") if "count" in table else None
    scene["particles"] = table
    scene["flow"] = flow or scene["flow"]
    return Scene.model_validate(scene)


@pytest.mark.parametrize("kind", FLOWS)
def test_particles_follow_the_flow_s_velocity(kind):
    """Against SciPy's integration of each path; the time between instants is half of dt_s."""
    scene = series(5, flow=FLOWS[kind], particles={"count": 40, "step": 2})
    instants = place_series(scene)
    flow = scene.flow_of(0)

    def velocity(_, state):
        return flow(state.reshape(-1, 3)).ravel()

    for start, end in itertools.pairwise(instants):
        path = solve_ivp(velocity, (0, 0.5), start.position_mm.ravel(), rtol=1e-10, atol=1e-12)
        expected = path.y[:, -1].reshape(-1, 3)
        stay = np.isin(start.index, end.index)
        found = end.position_mm[np.isin(end.index, start.index)]
        assert stay.sum() > 20 and np.abs(found - expected[stay]).max() < INTEGRATION_MM


def test_rotation_keeps_its_circles_over_a_hundred_instants():
    solid = {"kind": "swirl", "peak_mm": 0.05, "core_mm": 0.2, "profile": "solid", "axis": "z"}
    scene = series(101, flow=solid, particles={"count": 30})
    first, last = (place_series(scene)[number] for number in (0, -1))
    stay, after = np.isin(first.index, last.index), np.isin(last.index, first.index)
    before, later = first.position_mm[stay], last.position_mm[after]
    assert stay.sum() > 10
    assert np.abs(np.hypot(*before[:, :2].T) - np.hypot(*later[:, :2].T)).max() < 1e-5
    turned = np.angle((later[:, 0] + 1j * later[:, 1]) / (before[:, 0] + 1j * before[:, 1]))
    assert np.abs(np.exp(1j * turned) - np.exp(1j * 100 * 0.25)).max() < 1e-3  # 25 radians


def test_forth_and_back_is_the_start():
    flow, at = series(flow=FLOWS["jet"]).flow, np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
    assert np.abs(runge_kutta(flow, runge_kutta(flow, at, 1.0, 4), -1.0, 4) - at).max() < INTEGRATION_MM


@pytest.mark.parametrize("kind", ["uniform", "swirl"])
def test_density_stays(kind):
    """Number and even distribution after the flow has exchanged the fluid of the volume several times."""
    scene = series(61, flow=FLOWS[kind], particles={"count": 400, "step": 1})
    instants = place_series(scene)
    numbers = [len(one.index) for one in instants]
    exchanged = 1 - np.isin(instants[0].index, instants[-1].index).mean()
    assert exchanged > 0.99 if kind == "uniform" else exchanged > 0.3
    # the number is at most binomially scattered about the wanted one
    assert max(abs(number - 400) for number in numbers) < MONTE_CARLO * np.sqrt(400)
    cells = np.histogramdd(instants[-1].position_mm, bins=(3, 3, 3), range=[(-0.3, 0.3), (-0.25, 0.25), (-0.2, 0.2)])[0]
    expected = cells.sum() / cells.size
    assert ((cells - expected) ** 2 / expected).sum() < chi2.isf(CHANCE, cells.size - 1)


def test_a_particle_keeps_its_number_and_brightness_and_truth_holds_beyond_the_border():
    scene = series(
        8,
        flow=FLOWS["uniform"],
        particles={"count": 200, "step": 3},
        brightness={"camera_log_sd": 0.4, "size_log_sd": 0.2},
    )
    instants = place_series(scene)
    left = 0
    for number, one in enumerate(instants):
        assert len(set(one.index.tolist())) == len(one.index) and (np.diff(one.index) > 0).all()
        if number + 3 >= len(instants):
            assert one.displacement_mm is None
            continue
        later = instants[number + 3]
        stay, same = np.isin(one.index, later.index), np.isin(later.index, one.index)
        left += int((~stay).sum())
        assert np.array_equal(one.brightness[:, stay], later.brightness[:, same])
        assert np.array_equal(one.intensity[stay], later.intensity[same])
        assert np.allclose(one.position_mm[stay] + one.displacement_mm[stay], later.position_mm[same], atol=ROUNDING)
        assert np.allclose(one.displacement_mm, (0.06, -0.03, 0.02), atol=ROUNDING)
    assert left > 50


def test_a_shorter_series_is_the_beginning_of_a_longer_one():
    short, long = place_series(series(3)), place_series(series(7))
    for one, other in zip(short, long, strict=False):
        assert np.array_equal(one.index, other.index) and np.array_equal(one.position_mm, other.position_mm)
        assert np.array_equal(one.brightness, other.brightness)


def test_walls_hide_particles_and_shed_no_shadow():
    slab = {"kind": "box", "centre_mm": (0.0, 0.0, 0.0), "size_mm": (0.1, 2.0, 2.0)}
    scene = series(
        31, flow={"kind": "uniform", "displacement_mm": (0.03, 0.0, 0.0)}, particles={"count": 600}, wall=slab
    )
    instants = place_series(scene)
    x = np.concatenate([one.position_mm[:, 0] for one in instants[20::10]])
    assert (np.abs(x) >= 0.05).all()
    before, behind = (x < 0).sum(), (x > 0).sum()
    assert abs(before - behind) < MONTE_CARLO * np.sqrt(before + behind)


def test_pulses_of_a_sheet_take_turns():
    sheet = {"profile": "gaussian", "thickness_mm": (0.3, 0.2), "power": (1.0, 0.5)}
    scene = series(4, sheet=sheet)
    for number, one in enumerate(place_series(scene)):
        pulse = number % 2
        light = (1.0, 0.5)[pulse] * np.exp(-2 * (one.position_mm[:, 2] / ((0.3, 0.2)[pulse] / 2)) ** 2)
        assert one.power == (1.0, 0.5)[pulse]
        assert np.allclose(one.brightness, one.intensity * light, rtol=1e-9)


def test_turbulence_is_steady_in_a_series():
    turbulence = {"rms_mm": 0.01, "integral_scale_mm": 0.3, "smallest_mm": 0.1, "modes": 40}
    scene = series(3, turbulence=turbulence)
    at = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3))
    assert np.array_equal(scene.flow_of(0)(at), scene.flow_of(1)(at))
    assert not np.array_equal(scene.flow_of(0)(at), scene.flow(at))
    assert not np.array_equal(
        small_scene(turbulence=turbulence).flow_of(0)(at), small_scene(turbulence=turbulence).flow_of(1)(at)
    )


TRACERS = {"kind": "tracers", "series": "positions", "size_mm": (0.8, 0.8, 0.8), "box": ((0, 0, 0), (1, 1, 1))}


@pytest.fixture(scope="module")
def tracer_file(tmp_path_factory):
    """2,000 tracers in a solid rotation about the middle of the unit cube, by 0.05 rad from instant to instant."""
    rng = np.random.default_rng(4)
    start = rng.uniform(-0.5, 0.5, (2000, 3))
    angle = 0.05 * np.arange(8)[:, None]
    x = np.cos(angle) * start[:, 0] - np.sin(angle) * start[:, 1]
    y = np.sin(angle) * start[:, 0] + np.cos(angle) * start[:, 1]
    positions = np.stack([x, y, np.broadcast_to(start[:, 2], x.shape)], axis=-1) + 0.5
    path = tmp_path_factory.mktemp("tracers") / "tracers.npz"
    np.savez(path, positions=positions, flat=positions[0])
    return path, positions


def test_tracers_move_as_given(tracer_file):
    path, positions = tracer_file
    scene = series(7, flow=TRACERS | {"file": str(path), "as_given": True}, particles={"count": 150, "step": 2})
    instants = place_series(scene)
    assert np.mean([len(one.index) for one in instants]) == pytest.approx(150, abs=MONTE_CARLO * np.sqrt(150))
    for number, one in enumerate(instants):
        expected = 0.8 * (positions[number, one.index] - 0.5)
        assert np.allclose(one.position_mm, expected, atol=ROUNDING)
        assert (np.abs(one.position_mm) <= np.array([0.3, 0.25, 0.2])).all()
        if one.displacement_mm is not None:
            assert np.allclose(
                one.displacement_mm, 0.8 * positions[number + 2, one.index] - 0.4 - expected, atol=ROUNDING
            )
    chosen = set().union(*(one.index.tolist() for one in instants))
    inside = (np.abs(0.8 * (positions[3] - 0.5)) <= np.array([0.3, 0.25, 0.2])).all(1)
    seen = np.flatnonzero(inside & np.isin(np.arange(2000), sorted(chosen)))
    assert np.array_equal(instants[3].index, seen)  # whoever is in the region is seen, at every instant


def test_other_particles_move_between_tracers(tracer_file):
    """The local linear fit is exact for a rotation, and so is the point midway between two instants."""
    path, _ = tracer_file
    scene = series(5, flow=TRACERS | {"file": str(path)}, particles={"count": 60, "first": 3})
    instants = place_series(scene)
    first, last = instants[0], instants[-1]
    stay, after = np.isin(first.index, last.index), np.isin(last.index, first.index)
    x, y, _ = first.position_mm[stay].T
    c, s = np.cos(0.2), np.sin(0.2)
    expected = np.stack([c * x - s * y, s * x + c * y], 1)
    assert stay.sum() > 30 and np.abs(last.position_mm[after, :2] - expected).max() < 1e-6
    middle = first.position_mm + first.displacement_mm / 2
    assert np.allclose(scene.flow_of(3)(middle), first.displacement_mm, atol=1e-6)
    with pytest.raises(ValueError, match="expected 0 <= start < end < 8"):
        scene.flow_of(11)


def test_sample_series_goes_through_with_constant_index(sample_data):
    file = sample_data / "dns-tracers" / "rayleigh_benard_series.npz"
    scene = series(12, flow=TRACERS | {"file": str(file), "as_given": True}, particles={"count": 300, "step": 3})
    instants = place_series(scene)
    with np.load(file) as data:
        positions = data["positions"].astype(float)
    for number, one in enumerate(instants):
        assert np.allclose(one.position_mm, 0.8 * (positions[number, one.index] - 0.5), atol=ROUNDING)


@pytest.fixture(scope="module")
def written(tmp_path_factory, device):
    """The small scene as a series of three instants from number 5 on, with all that lights its images."""
    return simulate(written_scene(), tmp_path_factory.mktemp("series") / "data")


def written_scene(**particles):
    tables = {
        "sheet": {"power": (1.0, 0.7), "power_sd": 0.05},
        "stray_light": {"lens_counts": 30.0, "ambient_counts": 9.0},
        "background": {"averaged": 2},
        "sensor": {"gain_sd": 0.01},
    }
    return series(3, particles={"first": 5} | particles, **tables)


def images_of(path):
    experiment = open_experiment(path)
    return {
        (camera.name, number): experiment.particle_image(camera.name, number, "a")
        for camera in experiment.cameras
        for number in experiment.numbers
    }


def test_series_on_disk_is_an_experiment_with_its_truth(written):
    experiment, scene = open_experiment(written), written_scene()
    assert experiment.recording.is_series and experiment.numbers == range(5, 7)
    names = sorted(path.name for path in (written.parent / "particles" / "one").iterdir())
    assert names == [f"instant_{number:06d}.tif" for number in (5, 6, 7)]
    assert {path.name for path in (written.parent / "background").iterdir()} == {"one.tif", "two.tif"}
    spec = json.loads((written.parent / "truth" / "spec.json").read_text())
    assert Scene.model_validate(spec).particles == scene.particles
    with np.load(written.parent / "truth" / "particles.npz") as truth:
        for number, one in zip((5, 6, 7), place_series(scene), strict=True):
            name = f"instant_{number:06d}_"
            assert np.array_equal(truth[f"{name}index"], one.index)
            assert np.array_equal(truth[f"{name}positions_mm"], one.position_mm)
            assert truth[f"{name}power"] == one.power and np.array_equal(truth[f"{name}brightness"], one.brightness)
            assert (f"{name}displacement_mm" in truth) == (number < 7)
        speed = truth["instant_000005_velocity_m_s"]
        assert np.allclose(speed, truth["instant_000005_displacement_mm"] / 2e-4 / 1000)


def test_an_instant_does_not_depend_on_the_length_or_the_number_of_the_series(written, tmp_path):
    longer = simulate(written_scene(instants=4, first=0), tmp_path / "data")
    one, other = images_of(written), images_of(longer)
    for camera in ("one", "two"):
        for number in range(2):
            assert np.array_equal(one[camera, 5 + number], other[camera, number])
    assert np.array_equal(open_experiment(written).white("two"), open_experiment(longer).white("two"))


@pytest.mark.parametrize(
    "images", ["{camera}.tif#{instant}", "run/{camera}.h5#images[{instant}]", "run/{instant}_{camera}.tif"]
)
def test_images_are_equal_in_every_form_of_file(written, tmp_path, images):
    path = simulate(written_scene(first=0, images=images), tmp_path / "data")
    for camera in ("one", "two"):
        for number in range(3):
            single = tifffile.imread(written.parent / "particles" / camera / f"instant_{5 + number:06d}.tif")
            file = path.parent / images.format(camera=camera, instant=number)
            name, _, part = str(file).partition("#")
            if name.endswith("h5"):
                with h5py.File(name) as stack:
                    assert stack["images"].shape == (3, *single.shape)
                    found = stack["images"][number]
            else:
                found = tifffile.imread(name, key=int(part or 0))
            assert found.dtype == np.uint16 and np.array_equal(found, single)
    assert f'images = "{images}"' in path.read_text()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("pairs = 2", "pairs = 2\ninstants = 3", "either pairs or instants"),
        ("pairs = 2", "pairs = 2\nstep = 2", "step only with instants"),
        ("pairs = 2", "instants = 3\nstep = 3", "step below the 3 instants"),
        ("pairs = 2", 'instants = 3\nimages = "{camera}.tif"', "{camera} and {instant}"),
        ("pairs = 2", 'instants = 3\nimages = "{camera}{instant}.png"', ".tif#{instant}"),
        ("pairs = 2", 'instants = 3\nimages = "{camera}.h5#{instant}"', ".h5#NAME[{instant}]"),
        ("pairs = 2", 'instants = 3\nimages = "../{camera}{instant}.tif"', "below the folder"),
        ("pairs = 2", 'instants = 3\nfirst = 2\nimages = "{camera}.tif#{instant}"', "first = 0 with a stack"),
        ("[smart]\niterations = 3", '[smart]\nestimate = "joint"', "smart.estimate = 'correlation'"),
    ],
)
def test_scenes_that_are_no_series_are_refused(tmp_path, old, new, message):
    text = SMALL_SCENE.replace(old, new, 1)
    text = text if "pairs" in old else text.replace("pairs = 2", "instants = 3")
    (tmp_path / "scene.toml").write_text(text)
    with pytest.raises(InputError) as error:
        open_scene(tmp_path / "scene.toml")
    assert message in str(error.value)


def test_a_scene_file_names_tracers_relative_to_itself(tracer_file):
    path, positions = tracer_file
    flow = 'kind = "tracers"\nfile = "tracers.npz"\nseries = "positions"\nsize_mm = [0.8, 0.8, 0.8]\nas_given = true'
    text = SMALL_SCENE.replace("pairs = 2", "instants = 4")
    text = text.replace('kind = "swirl"\npeak_mm = 0.05\ncore_mm = 0.2', flow)
    (path.parent / "scene.toml").write_text(text)
    scene = open_scene(path.parent / "scene.toml")
    assert scene.flow.file == str(path) and scene.flow.positions().shape == positions.shape
    (path.parent / "scene.toml").write_text(text.replace("tracers.npz", "other.npz"))
    with pytest.raises(InputError, match=r"other\.npz"):
        open_scene(path.parent / "scene.toml")


def test_tracer_files_that_do_not_suit_are_refused(tracer_file):
    path, _ = tracer_file
    flow = TRACERS | {"file": str(path)}
    with pytest.raises(InputError, match="at most the 8 instants"):
        place_series(series(9, flow=flow))
    with pytest.raises(InputError, match="expected the array 'other'"):
        place_series(series(3, flow=flow | {"series": "other"}))
    with pytest.raises(InputError, match=r"shape \(instant, tracer, 3 or more\)"):
        place_series(series(3, flow=flow | {"series": "flat"}))
    with pytest.raises(ValueError, match="no peak_mm with series"):
        series(3, flow=flow | {"peak_mm": 0.1})
    with pytest.raises(ValueError, match=r"flow\.series for tracers that move as_given"):
        pair = {key: value for key, value in flow.items() if key != "series"}
        series(3, flow=pair | {"as_given": True})
    with pytest.raises(ValueError, match=r"particles\.instants with flow\.series"):
        series(None, flow=flow)
    with pytest.raises(ValueError, match="Call place_series"):
        place_particles(series(3), 0)
    with pytest.raises(ValueError, match="Call place_particles"):
        place_series(small_scene())
