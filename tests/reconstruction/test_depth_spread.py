"""Where rows of the pupil resolve depth: between cameras, not in the pupil of a single one."""

from dataclasses import dataclass

import numpy as np
import pytest
from support.ideal_rig import IdealCamera, lattice, optics, rotation

import lfpiv
from lfpiv.reconstruction.depth_spread import depth_spread, rows_resolve_depth
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.solver import SmartSolver


@dataclass
class Rig:
    cameras: dict
    grid: lfpiv.Grid


def rig_at(*angles_deg):
    cameras = {f"cam{angle}": IdealCamera(f"cam{angle}", rotation(angle)) for angle in angles_deg}
    return Rig(cameras, lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.5, 0.4, 0.3), voxel_mm=0.1))


def test_the_spread_is_the_mean_square_sine_to_the_worst_direction():
    angle = np.radians(20.0)
    cross = np.array([[np.sin(angle), 0, np.cos(angle)], [-np.sin(angle), 0, np.cos(angle)]])
    assert depth_spread(cross) == pytest.approx(np.sin(angle) ** 2)
    assert depth_spread(cross * [[1], [-1]]) == pytest.approx(np.sin(angle) ** 2)  # lines have no sign
    assert depth_spread(cross[:1]) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize(
    ("angles_deg", "resolve"),
    [((0,), False), ((45,), False), ((45, -45), True), ((10, -10), True), ((1, -1), False), ((45, 0, -45), True)],
)
def test_rows_of_the_pupil_resolve_depth_between_cameras(angles_deg, resolve):
    assert rows_resolve_depth(rig_at(*angles_deg)) == resolve


def test_the_default_takes_all_rays_of_one_camera_at_once():
    own = IdealCamera("one", rotation(0.0, 0.2), optics(260, 280), lattice(roll_deg=0.05))
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.6, 1.5, 1.4), voxel_mm=0.05)
    weights = lfpiv.build_weights(Rig({"one": own}, grid), grid)
    assert weights.rows > 1
    assert len(SmartSolver(weights, SmartSettings()).subsets) == 1
    assert len(SmartSolver(weights, SmartSettings(subsets=2)).subsets) == 2  # a stated number is taken
