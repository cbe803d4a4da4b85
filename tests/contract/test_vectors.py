"""Vectors between two volumes that are known."""

import numpy as np
import pytest
import xarray as xr
from contract.ideal import Rig

import lfpiv

SHIFTED = 0.05
"""Error of the mean displacement of particles that move by a whole voxel [voxel]."""


@pytest.fixture(scope="module")
def volumes():
    """Two volumes of an attribute each that states a residual; the particles move by a voxel along x."""
    rig = Rig((), particles=40)
    places = {axis: 0.1 * np.arange(n) for axis, n in zip("zyx", rig.shape, strict=True)}
    return [
        xr.DataArray(rig.blobs(7, moved_voxel=moved), places, ("z", "y", "x"), attrs={"residual": [0.4, 0.2]})
        for moved in [(0, 0, 0), (1, 0, 0)]
    ]


def moved(vectors):
    """Return the displacements, shape (z, y, x, 3) [voxel]."""
    return np.stack([vectors[f"displacement_{axis}"] for axis in "xyz"], axis=-1)


def test_displacement_is_that_of_the_particles(volumes):
    vectors = lfpiv.correlate(*volumes, windows=(6, 6), dt_s=1e-3)
    np.testing.assert_allclose(moved(vectors)[vectors.valid.values].mean(axis=0), (1, 0, 0), atol=SHIFTED)
    np.testing.assert_allclose(vectors.u, vectors.displacement_x * 0.1, rtol=1e-5)


def test_exchange_of_the_volumes_negates(volumes):
    there, back = lfpiv.correlate(*volumes, windows=(6, 6)), lfpiv.correlate(*volumes[::-1], windows=(6, 6))
    np.testing.assert_allclose(moved(back), -moved(there), atol=1e-5)
    np.testing.assert_array_equal(back.valid, there.valid)


def test_residual_widens_the_uncertainty_measured_or_not(volumes):
    def stated(residual):
        own = [volume.assign_attrs(residual=residual) for volume in volumes]
        return lfpiv.correlate(*own, windows=(6, 6)).uncertainty.values

    some, more = stated([0.4, 0.2]), stated([0.4, 0.8])
    known = np.isfinite(some)
    assert known.any()
    assert np.all(more[known] > some[known])
    np.testing.assert_array_equal(stated([0.4, 0.2, np.nan]), some)
