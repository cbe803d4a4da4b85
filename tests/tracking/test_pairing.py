"""A particle that is found in one of two frames only is looked for in the other one."""

import numpy as np
import pytest
from support.tracking_rig import READ_NOISE, SIGMA_VOXEL, VOXEL_MM, TrackingRig

from lfpiv.metrics.particles import match_particles
from lfpiv.tracking.finding import ParticleSearch
from lfpiv.tracking.pairing import exchange

SHIFT_MM = np.array([0.04, -0.03, 0.02])
COUNT = 18


@pytest.fixture(scope="module")
def fitted(device):
    """Places in the first frame, the search, and the images of both frames; particle 0 is dark in the second frame."""
    rig = TrackingRig()
    first = 0.9 * rig.random(COUNT, 5)
    search = ParticleSearch(rig.weights, sigma_voxel=SIGMA_VOXEL, rounds=1)
    return first, search, rig.images(first, 1), rig.images(first[1:] + SHIFT_MM, 2)


def test_lost_particles_come_back_and_absent_ones_do_not(fitted):
    first, search, *images = fitted
    fits = [search.fit(one, noise=READ_NOISE) for one in images]
    places = first[1:] + SHIFT_MM
    lost = match_particles(fits[1].cloud.positions_mm, places[:1], VOXEL_MM)
    assert len(lost) == 1
    search.add(fits[1], fits[1].cloud[:0], np.arange(len(fits[1].cloud)) == lost[0, 0])
    assert not len(match_particles(search.particles(fits[1]).positions_mm, places[:1], VOXEL_MM))
    _, second = exchange(search, fits)
    assert len(match_particles(second.positions_mm, places, VOXEL_MM)) == len(places) == len(second)


def test_too_few_links_leave_both_frames_as_they_are(fitted):
    _, search, image, _ = fitted
    fits = [search.fit(one, noise=READ_NOISE) for one in (image, {name: 0 * one for name, one in image.items()})]
    first, second = exchange(search, fits)
    assert len(first) == COUNT and len(second) == 0
