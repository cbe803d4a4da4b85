"""Warnings about the particles of a pair."""

import pytest
import xarray as xr

from lfpiv.runs.particles import crowded_warnings, unlinked_warnings
from lfpiv.warn import Code


def table(*, linked=40, hidden=0.1):
    attributes = {"found": [50, 50], "linked": linked, "hidden": [hidden, 0.0], "per_microlens": [0.05, 0.05]}
    return xr.Dataset(attrs=attributes)


@pytest.mark.parametrize(("hidden", "cameras", "expected"), [(0.4, 2, 0), (0.6, 2, 1), (0.4, 1, 1)])
def test_overlapping_images_are_told(hidden, cameras, expected):
    found = crowded_warnings(table(hidden=hidden), cameras)
    assert [warning.code for warning in found] == [Code.CROWDED] * expected


@pytest.mark.parametrize(("linked", "expected"), [(40, 0), (20, 1)])
def test_particles_without_partners_are_told(linked, expected):
    found = unlinked_warnings(table(linked=linked))
    assert [warning.code for warning in found] == [Code.UNLINKED] * expected
    assert all("40 %" in warning.sentence for warning in found)
