"""The flow of a series: one pass near a known flow finds what all passes find, and all passes follow if it fails."""

import itertools

import numpy as np
import pytest
from support import plain_steps

import lfpiv
from lfpiv import metrics
from lfpiv.sequence import flow
from lfpiv.simulation.flows import Swirl

GRID = lfpiv.Grid.from_extent(centre_mm=(0.1, -0.1, 0.2), size_mm=(2.8, 2.6, 2.4), voxel_mm=0.1)
BLOB = 0.7  # standard deviation of the particles [voxel]
FLOW = Swirl(peak_mm=0.15, core_mm=1.3, axial_mm=0.08)
CORRELATION = {"windows": (16, 12, 8, 8), "overlap": 0.5, "smoothing_voxel": 0.5, "intensity_power": 0.5}
NAMES = [f"displacement_{axis}" for axis in "zyx"]

LARGER = 1.1  # error of one pass near a flow of the instant before, relative to that of all passes


@pytest.fixture(scope="module")
def volumes(device):
    """Three instants of a densely seeded flow."""
    size = np.array([2.8, 2.6, 2.4])
    at = np.random.default_rng(5).uniform(-0.5, 0.5, (900, 3)) * (size + 0.6) + [0.1, -0.1, 0.2]
    found = []
    for _ in range(3):
        found.append(metrics.truth_volume(at, None, GRID, BLOB))
        at = at + FLOW(at + FLOW(at) / 2)
    return found


@pytest.fixture(scope="module")
def full(volumes):
    """The flow between each two instants, by all passes."""
    pairs = itertools.pairwise(volumes)
    return [plain_steps.correlate(*pair, **CORRELATION) for pair in pairs]


def error(vectors):
    z, y, x = np.meshgrid(*(vectors[axis].values for axis in "zyx"), indexing="ij")
    exact = FLOW(np.stack([x, y, z], -1).reshape(-1, 3)).reshape(*x.shape, 3)[..., ::-1] / GRID.voxel_mm
    found = np.stack([vectors[name].values for name in NAMES], -1)
    return float(np.linalg.norm(found - exact, axis=-1)[vectors["valid"].values].mean())


def test_one_pass_near_a_known_flow_finds_what_all_passes_find(volumes, full):
    near = flow.measure_flow(*volumes[1:], CORRELATION, full[0])
    assert "uncertainty" not in near, "measured by one pass"
    for axis in "zyx":
        assert np.array_equal(near[axis], full[1][axis]), "flows are averaged where their vectors lie"
    assert error(near) < LARGER * error(full[1])
    assert near.attrs["valid_fraction"] > flow.GOOD_SHARE * near.attrs["measurable_fraction"]


def test_nothing_known_takes_all_passes(volumes, full):
    assert flow.measure_flow(*volumes[1:], CORRELATION).identical(full[1])


def test_a_flow_that_has_changed_takes_all_passes(volumes, full):
    wrong = full[0].assign({name: full[0][name] + 6.0 for name in NAMES})
    assert flow.measure_flow(*volumes[1:], CORRELATION, wrong).identical(full[1])


def test_vectors_that_are_masked_are_continued(volumes, full):
    hole = full[0].copy(deep=True)
    for name in NAMES:
        hole[name][0, 0, 0] = np.nan
    near = flow.measure_flow(*volumes[1:], CORRELATION, hole)
    assert error(near) < LARGER * error(full[1])
