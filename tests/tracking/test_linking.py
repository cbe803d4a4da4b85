"""Links between two frames: displacements, ambiguity, outliers."""

import numpy as np
import pytest
from support.found_particles import VOXEL_MM, cloud, field, scattered

from lfpiv import link_particles
from lfpiv.tracking.linking import NEIGHBOURS, linked, nearby


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
