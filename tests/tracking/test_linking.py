"""Links between two frames and tracks over many: displacements, ambiguity, outliers, gaps."""

import numpy as np
import pytest
import xarray as xr

from lfpiv import link_particles, particle_tracks
from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.linking import NEIGHBOURS, linked, nearby

VOXEL_MM = 0.1


def cloud(positions_mm, light=None, error_mm=0.001):
    count = len(positions_mm)
    return FoundParticles(
        positions_mm=np.asarray(positions_mm, float),
        errors_mm=np.full((count, 3), error_mm),
        light=np.full(count, 100.0) if light is None else np.asarray(light, float),
        residual=np.ones(count),
        sigma_voxel=0.7,
        voxel_mm=VOXEL_MM,
        explained=1.0,
        crowding=0.0,
        hidden=0.0,
        per_microlens=0.05,
        signal_to_noise=np.full(count, 30.0),
    )


def scattered(count=60, seed=0):
    return np.random.default_rng(seed).uniform(-2, 2, (count, 3))


def field(displacement_voxel):
    """A correlation's vectors of one displacement everywhere."""
    axis = np.array([-1.5, 0.0, 1.5])
    dims = ("z", "y", "x")
    data = {
        f"displacement_{name}": (dims, np.full((3, 3, 3), value))
        for name, value in zip("xyz", displacement_voxel, strict=True)
    }
    return xr.Dataset(
        {**data, "valid": (dims, np.ones((3, 3, 3), bool))}, {name: axis for name in dims}, {"voxel_mm": [VOXEL_MM] * 3}
    )


def moved(table):
    return np.stack([table[f"displacement_{axis}"].values for axis in "xyz"], axis=1)


def test_a_shear_is_followed_without_predictor():
    at = scattered()
    shift = np.stack([0.3 * at[:, 1], 0 * at[:, 0], -0.2 * at[:, 0]], axis=1) * 0.5 * VOXEL_MM
    table = link_particles(cloud(at - shift / 2), cloud((at + shift / 2)[::-1]), dt_s=1e-3)
    assert table.sizes["particle"] > 50 and table.attrs["valid_links"] > 45
    places = np.stack([table[axis].values for axis in "xyz"], axis=1)
    exact = np.stack([0.3 * places[:, 1], 0 * places[:, 0], -0.2 * places[:, 0]], axis=1) * 0.5
    valid = table["valid"].values
    assert np.allclose(moved(table)[valid], exact[valid], atol=1e-9)
    assert np.allclose(table["u"], table["displacement_x"] * VOXEL_MM * 1e-3 / 1e-3)


def test_large_displacements_need_the_field():
    at, shift = scattered(40, 1), np.array([0.6, -0.4, 0.5])
    first, second = cloud(at), cloud(at + shift)
    table = link_particles(first, second, field(shift / VOXEL_MM), dt_s=1.0)
    assert table.sizes["particle"] == 40 and np.allclose(moved(table), shift / VOXEL_MM)
    alone = link_particles(first, second, dt_s=1.0, spread_voxel=0.5)
    assert alone.sizes["particle"] < 10


def test_ambiguous_links_are_dropped():
    first = cloud([[0.0, 0, 0]])
    table = link_particles(first, cloud([[0.05, 0, 0], [-0.05, 0, 0]]), dt_s=1.0)
    assert table.sizes["particle"] == 0
    by_light = link_particles(first, cloud([[0.05, 0, 0], [-0.05, 0, 0]], light=[100.0, 900.0]), dt_s=1.0)
    assert by_light.sizes["particle"] == 1 and by_light["displacement_x"].item() == pytest.approx(0.5)


def test_outliers_are_not_valid():
    at = scattered(80, 2)
    to = at + 0.02
    to[7] += 0.12
    table = link_particles(cloud(at), cloud(to), field([0.2, 0.2, 0.2]), dt_s=1.0)
    wrong = np.abs(moved(table) - 0.2).max(1) > 0.5
    assert not table["valid"].values[wrong].any() and table["valid"].values[~wrong].mean() > 0.95


def test_uncertainties_are_those_of_both_positions():
    table = link_particles(cloud([[0, 0, 0]], error_mm=0.003), cloud([[0.01, 0, 0]], error_mm=0.004), dt_s=1.0)
    assert table["uncertainty_z"].item() == pytest.approx(0.05)


def test_empty_frames_give_an_empty_table():
    empty = cloud(np.zeros((0, 3)))
    assert link_particles(empty, cloud([[0, 0, 0]]), dt_s=1.0).sizes["particle"] == 0


@pytest.mark.parametrize("arguments", [{"dt_s": 0.0}, {"dt_s": 1.0, "spread_voxel": -1.0}])
def test_bad_arguments_are_named(arguments):
    with pytest.raises(ValueError, match="expected a number > 0"):
        link_particles(cloud([[0, 0, 0]]), cloud([[0, 0, 0]]), **arguments)


def series(instants=6, count=30, lost=()):
    """Links of particles that move evenly; `lost` are (instant, particle)."""
    at, speed = scattered(count, 3), np.array([0.03, -0.02, 0.04])
    tables = []
    for instant in range(instants):
        kept = [particle for particle in range(count) if (instant, particle) not in lost]
        first, second = at[kept] + instant * speed, at[kept] + (instant + 1) * speed
        table = link_particles(cloud(first), cloud(second), field(speed / VOXEL_MM), dt_s=1.0)
        tables.append(
            table.drop_vars("particle").assign(instant=("particle", np.full(table.sizes["particle"], instant)))
        )
    joined = xr.concat(tables, "particle", combine_attrs="override")
    return joined.assign_attrs(step=1)


def test_tracks_join_links_and_bridge_one_gap():
    table = particle_tracks(series(lost={(3, 4)}))
    assert table["track"].max() == 29 and (table["track"] >= 0).all()
    length = table["track_length"].values[np.unique(table["track"], return_index=True)[1]]
    assert sorted(length) == [5] + [6] * 29
    broken = particle_tracks(series(lost={(3, 4)}), gap_voxel=0.0)
    assert broken["track"].max() == 30


def test_tracks_do_not_depend_on_the_order_of_the_links():
    table = series()
    mixed = table.isel(particle=np.random.default_rng(0).permutation(table.sizes["particle"]))
    one, other = particle_tracks(table), particle_tracks(mixed)
    assert one["track"].max() == other["track"].max()
    assert np.bincount(one["track"]).tolist() == np.bincount(other["track"]).tolist()


def test_tracks_need_a_series():
    with pytest.raises(ValueError, match="time series"):
        particle_tracks(link_particles(cloud([[0, 0, 0]]), cloud([[0, 0, 0]]), dt_s=1.0))


def test_a_gradient_is_followed_and_an_outlier_is_not():
    """The plane's slope is held to `GRADIENT`, which costs a tenth of a voxel at most beside exact links."""
    places = np.random.default_rng(3).uniform(0, 20, (80, 3))
    off = 0.1 * places[:, [1, 2, 0]] + (1.0, 0.0, -1.0)
    wrong = off.copy()
    wrong[7] += 3.0
    value, _ = nearby(places, wrong)
    inner = (np.abs(places - 10) < 7).all(1)
    assert np.abs(value - off)[inner].max() < 0.1
    median = np.median(off[np.argsort(np.linalg.norm(places[:, None] - places, axis=2), axis=1)[:, 1:11]], axis=1)
    assert np.abs(median - off)[inner].max() > 0.3, "a median of the neighbours is off by the gradient"


def test_flow_leads_back_to_where_it_came_from():
    at = scattered()
    shift = np.stack([0.03 * at[:, 1], 0 * at[:, 0], -0.02 * at[:, 0]], axis=1)
    links = linked(cloud(at), cloud(at + shift))
    assert links.flow.known and links.valid.sum() > NEIGHBOURS
    there = at + links.flow(at)
    assert np.allclose(there + links.flow.back(there), at, atol=0.01 * VOXEL_MM)
    assert links.unlinked(0, len(at)).tolist() == np.setdiff1d(np.arange(len(at)), links.pairs[links.valid, 0]).tolist()


def test_links_name_the_particles_they_join():
    at = scattered()
    first, second = cloud(at), cloud(at[::-1] + (0.02, 0.0, 0.0))
    table = link_particles(first, second, dt_s=1e-3)
    assert table.sizes["particle"] > 50
    assert np.array_equal(table["first"].values + table["second"].values, np.full(table.sizes["particle"], len(at) - 1))
