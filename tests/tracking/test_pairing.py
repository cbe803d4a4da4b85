"""A particle that is found in a single frame is looked for in the other one; candidates are confirmed."""

from copy import copy

import numpy as np
import pytest
from support.tracking_rig import READ_NOISE, SIGMA_VOXEL, VOXEL_MM, TrackingRig

from lfpiv.metrics.particles import match_particles
from lfpiv.tracking.finding import ParticleSearch
from lfpiv.tracking.pairing import exchange
from lfpiv.tracking.refinement import Cloud

SHIFT_MM = np.array([0.04, -0.03, 0.02])
COUNT = 18


@pytest.fixture(scope="module")
def fitted(device):
    """The search, places in the first frame, images and fits of both; particle 0 is dark in the second frame."""
    rig = TrackingRig()
    first = 0.9 * rig.random(COUNT, 5)
    search = ParticleSearch(rig.weights, sigma_voxel=SIGMA_VOXEL, rounds=1)
    images = rig.images(first, 1), rig.images(first[1:] + SHIFT_MM, 2)
    return search, first, images, [search.fit(one, noise=READ_NOISE) for one in images]


def test_lost_particles_come_back_and_absent_ones_do_not(fitted):
    search, first, _, fits = fitted
    fits = [copy(one) for one in fits]
    places = first[1:] + SHIFT_MM
    lost = match_particles(fits[1].cloud.positions_mm, places[:1], VOXEL_MM)
    assert len(lost) == 1
    search.add(fits[1], fits[1].cloud[:0], np.arange(len(fits[1].cloud)) == lost[0, 0])
    assert not len(match_particles(search.particles(fits[1]).positions_mm, places[:1], VOXEL_MM))
    _, second = exchange(search, fits)
    assert len(match_particles(second.positions_mm, places, VOXEL_MM)) == len(places) == len(second)


def test_too_few_links_leave_both_frames_as_they_are(fitted):
    search, _, images, fits = fitted
    dark = search.fit({name: 0 * one for name, one in images[0].items()}, noise=READ_NOISE)
    first, second = exchange(search, [copy(fits[0]), dark])
    assert len(first) == COUNT and len(second) == 0


def test_candidates_of_a_track_are_confirmed_or_not(fitted):
    """Particle 0 is dark in the second frame; all others begin a third of a voxel beside their place."""
    search, first, images, _ = fitted
    predicted = Cloud(positions_mm=first + SHIFT_MM + 0.2 * VOXEL_MM, light=np.full((COUNT, 2), 5000.0))
    found = search.look(images[1], predicted, noise=dict.fromkeys(images[1], READ_NOISE))
    places = first[1:] + SHIFT_MM
    assert len(match_particles(found.positions_mm, places, 0.5 * VOXEL_MM)) == len(places) == len(found)
