"""Tracks over a series whose images confirm what is there: ends, gaps, ghosts, order, tables."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial import cKDTree
from support.found_particles import VOXEL_MM, cloud, field, scattered

from lfpiv import link_particles
from lfpiv.metrics.particles import match_particles
from lfpiv.tracking import trajectory
from lfpiv.tracking.following import Candidates, follow
from lfpiv.tracking.tracks import REASONS, SHORTEST, track_table

SPEED_MM = np.array([0.03, -0.02, 0.04])
ERROR_MM = 0.001
COUNT, INSTANTS = 24, 7


def places(instant):
    """Particles on parabolas, shape (particle, 3) [mm]."""
    return scattered(COUNT, 3) + instant * SPEED_MM + instant**2 * np.array([0.0, 0.002, 0.0])


def tables(lost=(), wrong=None):
    """Links of successive instants; `lost` are (instant, particle), `wrong` is an instant with a false particle."""
    found = []
    for instant in range(INSTANTS - 1):
        first, second = (seen(one, lost) for one in (instant, instant + 1))
        if instant == wrong:
            first, second = (np.concatenate([one, [[1.0, 1.0, 1.0]]]) for one in (first, second))
        vectors = field(SPEED_MM / VOXEL_MM)
        found.append(link_particles(cloud(first), cloud(second), vectors, dt_s=1.0))
    return found


def seen(instant, lost=()):
    kept = [particle for particle in range(COUNT) if (instant, particle) not in lost]
    return places(instant)[kept]


def followed(lost=(), wrong=None, order=None):
    """Follow particles that the images show with errors of `ERROR_MM`, wherever a candidate is near."""
    links = tables(lost, wrong)

    def look(instant, positions, light):
        there = seen(instant, lost)
        if wrong in (instant, instant - 1):
            there = np.concatenate([there, [[1.0, 1.0, 1.0]]])
        pairs = match_particles(positions * VOXEL_MM, there, 0.5 * VOXEL_MM)
        rng = np.random.default_rng([5, instant])
        shown = (there + ERROR_MM * rng.standard_normal(there.shape))[np.sort(pairs[:, 1])]
        return cloud(shown if order is None else shown[::order], error_mm=ERROR_MM)

    def candidates(instant):
        ends = [(links[pair], instant - pair) for pair in (instant, instant - 1) if 0 <= pair < len(links)]
        return Candidates.from_links(ends, 1)

    return follow(((instant, candidates(instant)) for instant in range(INSTANTS)), look)


@pytest.fixture(scope="module", autouse=True)
def short_fits():
    """A few steps of the fit of the motion are enough here; `test_trajectory` tests it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trajectory, "FIT_STEPS", 15)
        yield


@pytest.fixture(scope="module")
def clean():
    return followed()


def nearest(positions, true):
    """Distance of each position from the nearest true position; two positions of a particle differ by far more than
    errors."""
    return cKDTree(true).query(positions)[0]


def table_of(found):
    return track_table(found, voxel_mm=VOXEL_MM, dt_s=0.5)


def test_all_particles_are_followed_with_velocity_and_acceleration(clean):
    table = table_of(clean)
    assert table["valid"].all() and np.bincount(table["track"]).tolist() == [INSTANTS] * COUNT
    middle = table.isel(particle=(table["instant"] > 1) & (table["instant"] < INSTANTS - 2))
    exact = 1e-3 * (0.04 * middle["instant"] / 10 - 0.02) / 0.5
    assert np.abs(middle["v"] - exact).max() < 6 * middle["uncertainty_v"].max()
    assert np.abs(middle["acceleration_y"] - 1e-3 * 0.004 / 0.25).median() < 2e-3 * 1e-3 / 0.25
    smoothed, raw = (np.stack([table[f"{name}{axis}"].values for axis in "xyz"], 1) for name in ("", "found_"))
    true = np.concatenate([places(instant) for instant in range(INSTANTS)])
    miss = [np.square(nearest(one, true)).mean() for one in (smoothed, raw)]
    assert miss[0] < 0.8 * miss[1], "the fit along the track lessens the error of a position"


def test_a_particle_missed_once_stays_on_its_track_and_one_missed_twice_does_not():
    once, twice = (table_of(followed(lost)) for lost in ({(4, 7)}, {(2, 7), (3, 7), (4, 7)}))
    assert once["track"].max() == COUNT - 1 and sorted(np.bincount(once["track"]))[0] == INSTANTS - 1
    assert twice["track"].max() == COUNT
    short = twice.isel(particle=~twice["valid"].values)
    assert set(short["reason"].values) == {REASONS.index("short")} and short.sizes["particle"] == 2 + 2


def test_a_ghost_of_two_instants_is_left_out_with_its_reason():
    table = table_of(followed(wrong=3))
    short = table.isel(particle=~table["valid"].values)
    assert short.sizes["particle"] == 2 < SHORTEST and set(short["instant"].values) == {3, 4}
    assert set(short["reason"].values) == {REASONS.index("short")}


def test_tracks_do_not_depend_on_the_order_of_the_particles(clean):
    one, other = table_of(clean), table_of(followed(order=-1))
    xr.testing.assert_identical(one, other)


def test_a_particle_that_leaves_its_neighbours_is_unlike_them(clean):
    found = clean
    moved = found.positions_voxel.copy()
    own = found.track == 4
    moved[own] += np.arange(INSTANTS)[:, None] * np.array([0.0, 0.0, 2.0])
    table = track_table(type(found)(**{**vars(found), "positions_voxel": moved}), voxel_mm=VOXEL_MM, dt_s=0.5)
    assert set(table["reason"].values[own]) == {REASONS.index("unlike_neighbours")}
    assert table["valid"].values[~own].mean() > 0.95


def test_no_particles_give_an_empty_table():
    empty = cloud(np.zeros((0, 3)))
    found = follow(((instant, Candidates.from_links([], 1)) for instant in range(5)), lambda *given: empty)
    assert table_of(found).sizes["particle"] == 0


def test_copies_of_a_candidate_are_one_and_a_valid_link_counts_first():
    links = link_particles(cloud([[0.0, 0, 0]]), cloud([[0.04, 0, 0]]), dt_s=1.0)
    both = Candidates.from_links([(links.assign(valid=~links["valid"]), 0), (links, 0)], 2)
    assert both.positions_voxel == pytest.approx(np.zeros((1, 3))) and both.valid.tolist() == [True]
    assert both.moved_voxel == pytest.approx(np.array([[0.2, 0, 0]]))
