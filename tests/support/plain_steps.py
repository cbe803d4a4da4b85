"""The bare steps, for tests that are about something else than the default settings: SMART over all rays without sieve
and limit of the counts, correlation of the volumes as they are."""

import functools

import lfpiv
from lfpiv.reconstruction.settings import PLAIN

SMART = {"iterations": 10, **PLAIN}
CORRELATION = {"smoothing_voxel": 0.0, "intensity_power": 1.0}


def reconstruct(weights, images, iterations=SMART["iterations"], *args, **settings):
    """Reconstruct by bare SMART; settings given count."""
    return lfpiv.reconstruct(weights, images, iterations, *args, **{**PLAIN, **settings})


def reconstruct_pair(weights, images, **settings):
    """Reconstruct a pair by bare SMART, each frame by itself; settings given count."""
    return lfpiv.reconstruct_pair(weights, images, **{**SMART, **settings})


correlate = functools.partial(lfpiv.correlate, **CORRELATION)
"""Correlate volumes as they are; settings given count."""
