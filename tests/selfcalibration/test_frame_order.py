"""Frames of one camera that are exchanged show in the volumes of each camera alone."""

import numpy as np
import pytest
from scipy import ndimage
from support.ideal_rig import two_cameras

import lfpiv
from lfpiv.selfcalibration.frame_order import MOVING_VOXEL, exchanged, own_motion

GRID = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(4.8, 4.8, 2.4), voxel_mm=0.1)
MOVED = (0, 2, 0)
"""Displacement along (z, y, x), across both lines of sight [voxel]."""


def particles(moved, seed=1):
    """Return the flat volumes of two frames of particles that move."""
    first = np.random.default_rng(seed).random(GRID.shape) < 0.01
    return [ndimage.gaussian_filter(np.roll(first, move, (0, 1, 2)).astype("f4"), 1) for move in ((0, 0, 0), moved)]


@pytest.mark.parametrize(("moved", "told"), [(MOVED, True), ((0, 0, 0), False)])
def test_opposite_motion_in_two_cameras_is_told_where_particles_move(moved, told):
    cameras = two_cameras().cameras
    sound = dict.fromkeys(cameras, particles(moved))
    motion = own_motion(sound, GRID)
    for found in motion.values():
        assert np.nanmax(np.abs(found - moved[::-1])) < MOVING_VOXEL
    assert exchanged([motion], cameras, GRID) == ()
    first, second = cameras
    wrong = own_motion({first: sound[first], second: sound[second][::-1]}, GRID)
    assert exchanged([wrong], cameras, GRID) == ((first, second) if told else ())


def test_volumes_without_particles_in_common_tell_nothing():
    cameras = two_cameras().cameras
    unlike = [particles(MOVED, seed)[frame] for frame, seed in enumerate((1, 2))]
    motion = own_motion(dict.fromkeys(cameras, unlike), GRID)
    assert exchanged([motion], cameras, GRID) == ()
