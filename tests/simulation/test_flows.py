"""Flows: exact against independent formulas, means over windows, tracers from files."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lfpiv.errors import InputError
from lfpiv.simulation import flows, swirl, turbulence

ROUNDING = 1e-12  # a few float64 operations on values of order one
TRUTH_ROUNDING = 1e-11  # the sample's writer adds 1e-12 mm to the distance from the core line, to avoid 0/0
LINEAR_FIT = 1e-8  # the local fit's ridge of 1e-10, times the condition of four points per unknown
DIFFERENCE_STEP = 1e-5  # mm; central differences are good to its square, about 1e-10
DIFFERENCE_ERROR = 1e-6  # rounding 1e-16 / step 1e-5, and third derivatives times the step's square, with a margin


TRAPEZOID = 1e-6  # curvature times step squared / 12, of thousands of steps
MONTE_CARLO = 5.0  # standard errors; 1e-6 chance per comparison


def points(count, seed=0, half=3.0):
    return np.random.default_rng(seed).uniform(-half, half, (count, 3))


def gradient(flow, at):
    """Return the displacement gradient [i, j] = d displacement_i / d x_j by central differences."""
    step = DIFFERENCE_STEP * np.eye(3)
    return (flow(at + step) - flow(at - step)).T / (2 * DIFFERENCE_STEP)


def test_uniform_and_shear_follow_their_formulas():
    at = points(50)
    assert np.array_equal(flows.Uniform(displacement_mm=(1, 2, 3))(at), np.tile([1.0, 2, 3], (50, 1)))
    shear = flows.Shear(along="z", across="y", rate=0.2, centre_mm=(5, 1, 7))
    assert np.allclose(shear(at), np.stack([0 * at[:, 0], 0 * at[:, 0], 0.2 * (at[:, 1] - 1)], 1), atol=ROUNDING)


def test_ring_circles_its_core_line():
    """In a half plane through the axis the ring is a plane vortex with the stated profile."""
    ring = flows.Ring(radius_mm=1.7, core_mm=0.8, peak_mm=0.2, centre_mm=(0.3, -0.2, 0.1))
    rng = np.random.default_rng(1)
    azimuth, angle, r = rng.uniform(0, 2 * np.pi, 200), rng.uniform(0, 2 * np.pi, 200), rng.uniform(0, 1.6, 200)
    outward = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1)
    up = np.array([0.0, 0.0, 1.0])
    at = (1.7 + r * np.cos(angle))[:, None] * outward + (r * np.sin(angle))[:, None] * up + ring.centre_mm
    along = -np.sin(angle)[:, None] * outward + np.cos(angle)[:, None] * up  # direction of growing angle
    expected = (0.2 * r / 0.8 * np.exp(1 - r / 0.8))[:, None] * along
    assert np.allclose(ring(at), expected, atol=ROUNDING)
    assert ring(np.array([ring.centre_mm]))[0, 2] < 0  # the fluid inside the ring moves along -z
    core = np.array(ring.centre_mm) + [1.7, 0, 0]
    assert np.allclose(ring(core[None]), 0, atol=ROUNDING)


def test_ring_is_the_sample_data_s_flow(sample_data):
    folder = sample_data / "ring-vortex-2cam" / "truth"
    table = json.loads((folder / "spec.json").read_text())["flow"]
    ring = flows.Ring.model_validate(table)
    with np.load(folder / "particles.npz") as truth:
        for pair in (0, 1):
            moved = truth[f"pair_{pair:04d}_displacement_mm"]
            assert np.abs(ring(truth[f"pair_{pair:04d}_positions_mm"]) - moved).max() < TRUTH_ROUNDING


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_swirl_turns_about_its_axis(axis):
    number, centre = "xyz".index(axis), np.array([0.4, -0.3, 0.2])
    along = np.eye(3)[number]
    vortex = flows.Swirl(axis=axis, peak_mm=0.3, core_mm=0.7, centre_mm=tuple(centre), axial_mm=0.5, axial_core_mm=1.2)
    at = points(100, 2)
    arm = at - centre - ((at - centre) @ along)[:, None] * along
    distance = np.linalg.norm(arm, axis=1)
    moved = vortex(at)
    assert np.abs((moved * arm).sum(1)).max() < ROUNDING  # no motion towards the axis
    assert np.allclose(moved @ along, 0.5 * np.exp(-((distance / 1.2) ** 2)), atol=ROUNDING)
    assert ((np.cross(arm, moved) @ along) > 0).all()  # right-handed
    sideways = np.eye(3)[(number + 1) % 3]
    radii = np.linspace(0, 3, 3001)
    speed = np.linalg.norm(np.cross(along, vortex(centre + radii[:, None] * sideways)), axis=1)
    assert radii[speed.argmax()] == pytest.approx(0.7, abs=radii[1])  # peaks at the core radius,
    assert speed.max() == pytest.approx(0.3, abs=1e-6)  # where the profile is flat to the grid's step squared
    assert speed[0] == 0
    for place in at[:5]:  # swirl and jet carry no volume source
        assert abs(np.trace(gradient(vortex, place))) < DIFFERENCE_ERROR
    solid = flows.Swirl(axis=axis, peak_mm=0.3, core_mm=0.7, profile="solid")
    spin = gradient(solid, at[0])
    assert np.allclose(spin, -spin.T, atol=DIFFERENCE_ERROR)  # rotation without deformation
    assert np.allclose(solid(0.7 * sideways[None]), 0.3 * np.cross(along, sideways), atol=ROUNDING)


def test_window_mean_is_exact_for_cubics_and_converged_for_a_ring():
    at, window = points(40, 3), (0.8, 1.2, 1.6)

    def cubic(x):
        return np.stack([x[:, 0] ** 3, x[:, 1] ** 2 * x[:, 2], 1 + x[:, 0] * x[:, 1] * x[:, 2]], 1)

    x, y, z = at.T
    a, b, _ = (edge**2 / 12 for edge in window)  # mean square of the distance from a window's centre
    expected = np.stack([x**3 + 3 * x * a, (y**2 + b) * z, 1 + x * y * z], 1)
    assert np.allclose(flows.window_mean(cubic, at, window), expected, rtol=1e-12, atol=1e-11)

    ring = flows.Ring(radius_mm=1.7, core_mm=0.8, peak_mm=0.2)
    offset = (np.indices((48, 48, 48)).reshape(3, -1).T + 0.5) / 48 - 0.5
    dense = np.stack([ring(place + offset * window).mean(0) for place in at[:10]])
    midpoint_and_kink = 2e-4  # of 0.2 mm: midpoint rule at 1/48 window; the ring's profile has a kink on the core line
    assert np.abs(flows.window_mean(ring, at[:10], window) - dense).max() < midpoint_and_kink


def test_average_truth_is_the_mean_of_the_particles_inside():
    at, centres, window = points(400, 4, 1.0), points(30, 5, 1.4), np.array([0.5, 0.6, 0.7])
    moved = flows.Swirl(peak_mm=1.0, core_mm=1.0)(at)
    mean = flows.average_truth(at, moved, centres, tuple(window))
    for centre, found in zip(centres, mean, strict=True):
        inside = (np.abs(at - centre) <= window / 2).all(1)
        if inside.any():
            assert np.allclose(found, moved[inside].mean(0), atol=ROUNDING)
        else:
            assert np.isnan(found).all()
    assert 0 < np.isnan(mean[:, 0]).sum() < len(mean)


def test_tracers_reproduce_a_linear_flow_in_their_box(tmp_path):
    rng = np.random.default_rng(6)
    middle, spin = rng.uniform([0, 1, 2], [10, 3, 3], (3000, 3)), rng.standard_normal((3, 3)) / 50
    moved = (middle - [5, 2, 2.5]) @ spin.T
    np.savez(tmp_path / "t.npz", t0=middle - moved / 2, t1=middle + moved / 2)
    box = {"box": ((0, 1, 2), (10, 3, 3)), "size_mm": (5, 4, 3), "centre_mm": (1, 0, -1)}
    flow = flows.Tracers(file=str(tmp_path / "t.npz"), **box)
    stretch = np.diag([5 / 10, 4 / 2, 3 / 1])
    at = np.array([1, 0, -1]) + rng.uniform(-0.45, 0.45, (200, 3)) * [5, 4, 3]
    expected = (at - [1, 0, -1]) @ (stretch @ spin @ np.linalg.inv(stretch)).T
    assert np.abs(flow(at) - expected).max() < LINEAR_FIT
    position, displacement = flow.tracers()
    assert np.allclose(position, (middle - [5, 2, 2.5]) @ stretch + [1, 0, -1], atol=ROUNDING)
    scaled = flows.Tracers(file=str(tmp_path / "t.npz"), peak_mm=0.25, **box).tracers()[1]
    assert np.linalg.norm(scaled, axis=1).max() == pytest.approx(0.25)
    assert np.allclose(scaled / scaled[0, 0], displacement / displacement[0, 0], rtol=1e-9)
    far = flow(np.array([[100.0, 0, -1]]))  # outside: that of the nearest point of the box, never extrapolated
    assert np.abs(far - flow(np.array([[position[:, 0].max(), 0, -1]]))).max() < ROUNDING


def test_tracers_predict_left_out_tracers_of_a_turbulent_flow(sample_data, tmp_path):
    with np.load(sample_data / "dns-tracers" / "rayleigh_benard_20000.npz") as data:
        start, end = data["t0"].astype(float), data["t1"].astype(float)
    kept = np.random.default_rng(7).random(len(start)) < 0.9
    np.savez(tmp_path / "kept.npz", t0=start[kept], t1=end[kept])
    flow = flows.Tracers(file=str(tmp_path / "kept.npz"), size_mm=(1, 1, 1), box=((0, 0, 0), (1, 1, 1)))
    at = (start[~kept, :3] + end[~kept, :3]) / 2 - 0.5
    moved = end[~kept, :3] - start[~kept, :3]
    spread = ((moved - moved.mean(0)) ** 2).sum()
    distance, index = cKDTree((start + end)[kept, :3] / 2 - 0.5).query(at, k=8)
    weight = 1 / distance**2 / (1 / distance**2).sum(1, keepdims=True)
    plain = (((end - start)[kept, :3][index] * weight[..., None]).sum(1) - moved) ** 2
    left = ((flow(at) - moved) ** 2).sum() / spread
    # The tracers, 0.04 apart, leave 7 to 11 % of the variance open whatever the method (radial basis functions: 7 %).
    assert left < 0.11 and left < plain.sum() / spread


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (None, "no file"),
        ({"t0": np.zeros((50, 3))}, "'t1'"),
        ({"t0": np.zeros((50, 2)), "t1": np.zeros((50, 2))}, "shape"),
        ({"t0": np.zeros((50, 3)), "t1": np.zeros((50, 3))}, "plane"),
        ({"t0": np.full((50, 3), np.nan), "t1": np.zeros((50, 3))}, "finite"),
    ],
)
def test_bad_tracer_files_are_named(tmp_path, arrays, message):
    path = tmp_path / "bad.npz"
    if arrays is not None:
        np.savez(path, **arrays)
    with pytest.raises(InputError, match=message) as error:
        flows.Tracers(file=str(path), size_mm=(1, 1, 1)).tracers()
    assert "bad.npz" in str(error.value)


def test_shapes_are_checked():
    ring = flows.Ring(radius_mm=1, core_mm=1, peak_mm=1)
    with pytest.raises(ValueError, match=r"points_mm: expected shape \(n, 3\), got \(3,\)"):
        ring(np.zeros(3))
    with pytest.raises(ValueError, match="window_mm"):
        flows.window_mean(ring, np.zeros((1, 3)), -1.0)
    assert ring(np.zeros((0, 3))).shape == (0, 3)


def top_hat(radius_ratio, mass_ratio, angle_deg, nodes=20_001):
    """Return the profiles that lead to Eq. 17: two flat streams, the outer one with swirl; their step is at a node."""
    radius = np.concatenate([np.linspace(0, radius_ratio, nodes), np.linspace(radius_ratio, 1, nodes)])
    outer = np.arange(len(radius)) >= nodes
    axial = np.where(outer, 1.0, mass_ratio * (1 / radius_ratio**2 - 1))
    return radius, axial, np.where(outer, np.tan(np.radians(angle_deg)), 0.0)


def test_swirl_number_of_profiles_in_closed_form():
    """Solid-body rotation in a uniform jet has half the ratio at the wall. An annulus with swirl follows Eq. 17."""
    radius = np.linspace(0, 3, 2001)
    solid = swirl.swirl_number(radius, np.full(2001, 2.0), 0.7 * radius, nozzle_radius=3.0)
    assert solid == pytest.approx(0.7 * 3 / (2 * 2.0), rel=TRAPEZOID)
    for ratio, mass, angle in ((12 / 17, 0.42, 37.0), (0.5, 1.3, -50.0), (0.3, 0.0, 20.0)):
        found = swirl.swirl_number(*top_hat(ratio, mass, angle), nozzle_radius=1.0)
        assert found == pytest.approx(swirl.injector_swirl_number(angle, ratio, mass), rel=TRAPEZOID)
    # the paper's injector: 37 degree vanes, radii of 12 and 17 mm, S = 0.55 to the digits given
    assert round(swirl.injector_swirl_number(37.0, 12 / 17, 0.42), 2) == 0.55


@pytest.mark.parametrize(
    ("profiles", "message"),
    [
        (([0, 1], [1, 1, 1], [0, 0]), "one length"),
        (([1, 0], [1, 1], [0, 0]), "rise"),
        (([0, 1], [0, 0], [1, 1]), "no.* axis|not defined"),
        (([0, np.nan], [1, 1], [1, 1]), "finite"),
    ],
)
def test_bad_profiles_are_named(profiles, message):
    with pytest.raises(ValueError, match=message):
        swirl.swirl_number(*profiles, nozzle_radius=1.0)


@pytest.mark.parametrize(
    "changes", [{}, {"swirl_number": -0.8, "mass_ratio": 2.0, "shear_layer_mm": 3.0, "axis": "z", "spreading": 0.2}]
)
def test_swirling_jet_conserves_swirl_number_and_volume_flow(changes):
    jet = flows.SwirlingJet(bulk_mm=0.4, centre_mm=(1.0, -2.0, 0.5), **changes)
    number = "xyz".index(jet.axis)
    along, sideways = np.eye(3)[number], np.eye(3)[(number + 1) % 3]
    radius = np.linspace(0, 80, 8001)
    for height in (0.0, 20.0):
        at = np.array(jet.centre_mm) + height * along + radius[:, None] * sideways
        moved = jet(at)
        axial, azimuthal = moved @ along, moved @ np.cross(along, sideways)
        flow = 2 * np.trapezoid(axial * radius, radius) / jet.nozzle_radius_mm**2
        assert flow == pytest.approx(0.4, rel=TRAPEZOID * 10)  # the volume flow is kept at every height
        turning = np.trapezoid(axial * azimuthal * radius**2, radius)
        if height == 0:
            found = swirl.swirl_number(radius, axial, azimuthal, nozzle_radius=jet.nozzle_radius_mm)
            assert found == pytest.approx(jet.swirl_number, rel=TRAPEZOID * 10)
            angular_momentum = turning
        assert turning == pytest.approx(angular_momentum, rel=TRAPEZOID * 10)  # and its angular momentum
    for place in np.array(jet.centre_mm) + 15 * points(40, 8, 1.0):
        assert abs(np.trace(gradient(jet, place))) < DIFFERENCE_ERROR
    on_axis = jet(np.array(jet.centre_mm) + np.outer([0, 5.0, 40], along))
    assert np.allclose(on_axis, np.outer(on_axis @ along, along), atol=ROUNDING)
    assert abs(on_axis[2] @ along) < abs(on_axis[0] @ along)  # the jet spreads and slows down


def test_turbulence_has_the_stated_scales():
    """Mean zero, equal RMS along x, y, z, no divergence, the stated integral scale, one field for each seed."""
    table = turbulence.Turbulence(rms_mm=0.2, integral_scale_mm=1.5, smallest_mm=0.3, modes=400)
    fields = [table.realisation(seed=(1, pair)) for pair in range(40)]
    at = points(500, 9, 30.0)
    moved = np.stack([field(at) for field in fields])
    assert abs(moved.mean()) < MONTE_CARLO * 0.2 / np.sqrt(40 * 100)  # 40 fields of 60 mm hold thousands of scales
    assert np.allclose((moved**2).mean((0, 1)), 0.2**2, rtol=0.03)  # 40 times 400 modes of random direction
    for place in at[:5]:
        assert abs(np.trace(gradient(fields[0], place))) < DIFFERENCE_ERROR
    # longitudinal correlation over all space, a sum over modes, integrated until it has died away
    many = [table.realisation(seed=(2, pair)) for pair in range(300)]
    energy, wave = (np.concatenate([getattr(f, key)[:, 0] for f in many]) for key in ("amplitude_mm", "wave"))
    lag = np.linspace(0, 15, 301)
    correlation = np.array([(energy**2 * np.cos(wave * r)).sum() for r in lag]) / (energy**2).sum()
    assert np.trapezoid(correlation, lag) == pytest.approx(1.5, rel=0.04)  # 120,000 modes
    assert np.array_equal(table.realisation(seed=(1, 3))(at[:9]), fields[3](at[:9]))
    assert abs(np.corrcoef(moved[0].ravel(), moved[1].ravel())[0, 1]) < 0.15
    with pytest.raises(ValueError, match="smallest_mm"):
        turbulence.Turbulence(rms_mm=0.2, integral_scale_mm=1.0, smallest_mm=3.0)


def test_window_mean_of_turbulence_is_exact():
    """The closed form equals a fine quadrature at all wavelengths, and the mean flow is averaged as well."""
    field = turbulence.Turbulence(rms_mm=0.2, integral_scale_mm=1.0, smallest_mm=0.4, modes=50).realisation(seed=4)
    centres, window = points(3, 1), (1.6, 0.8, 1.2)
    ring = flows.Ring(radius_mm=1.5, core_mm=0.7, peak_mm=0.2)
    fine = flows.window_mean(lambda at: field(at), centres, window, order=24)
    exact = flows.window_mean(turbulence.TurbulentFlow(ring, field), centres, window)
    assert np.abs(exact - fine - flows.window_mean(ring, centres, window)).max() < 1e-9  # 24 nodes on four waves
