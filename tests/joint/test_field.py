"""Field of a joint fit: derivatives of the fitted displacement in its units, its place in the results, refusals."""

import numpy as np
import pytest
import xarray as xr

import lfpiv
from lfpiv.joint.field import STEP
from lfpiv.joint.pair import MOVED, UNSHARED
from lfpiv.results.netcdf import write_vectors

SHAPE, VOXEL_MM, DT_S = (12, 16, 20), 0.1, 1e-3
ROUNDING = 1e-4
"""Single precision, relative to the largest derivative."""


def displacement(z, y, x):
    """Return polynomials of the voxels' numbers, along z, y, x [voxel]: a cubic spline has them exactly."""
    return 0.02 * x + 0.001 * y * z, 0.003 * x * x - 0.01 * y, 0.0001 * y**3 + 0.005 * z


@pytest.fixture(scope="module")
def volumes():
    """Two volumes as a joint fit returns them, with a displacement that is known."""
    rng, axes = np.random.default_rng(1), {axis: VOXEL_MM * np.arange(n) for axis, n in zip("zyx", SHAPE, strict=True)}
    moved = displacement(*np.indices(SHAPE).astype(float))
    coordinates = {MOVED[axis]: (tuple("zyx"), one.astype(np.float32)) for axis, one in zip("zyx", moved, strict=True)}
    made = []
    for _ in range(2):
        light = rng.random(SHAPE).astype(np.float32)
        made.append(xr.DataArray(light, axes | {UNSHARED: (tuple("zyx"), light)}, dims=tuple("zyx")))
    return made[0].assign_coords(coordinates), made[1]


@pytest.fixture(scope="module")
def vectors(volumes, device):
    """Vectors of noise, half of them said to come from the fit."""
    found = lfpiv.correlate(*(volume.values for volume in volumes), windows=(8,), dt_s=DT_S, voxel_mm=VOXEL_MM)
    joint = found.valid.copy(data=np.arange(found.valid.size).reshape(found.valid.shape) % 2 == 0)
    return found.assign(joint=joint, valid=xr.ones_like(found.valid))


def test_velocity_vorticity_and_divergence_are_those_of_the_fit(volumes, vectors):
    field = lfpiv.joint_field(volumes, vectors)
    z, y, x = np.meshgrid(*(field[axis].values / VOXEL_MM for axis in "zyx"), indexing="ij")
    assert np.allclose(np.diff(field.x), STEP * VOXEL_MM) and field.divergence.units == "1/s"
    expected = {
        "divergence": 0.001 * y - 0.01 + 0 * x,
        "vorticity_x": 0.001 * z - 0.0 * y,
        "vorticity_y": 0.005 - 0.02 + 0 * x,
        "vorticity_z": 0.006 * x - 0.0003 * y**2,
    }
    for name, values in expected.items():
        np.testing.assert_allclose(field[name].values, values / DT_S, atol=ROUNDING * 0.1 / DT_S, err_msg=name)
    for axis, moved in zip("zyx", displacement(z, y, x), strict=True):
        np.testing.assert_allclose(field[f"displacement_{axis}"], moved, atol=1e-5)
    np.testing.assert_allclose(field.w, field.displacement_z * VOXEL_MM / 1000 / DT_S, rtol=1e-6)


def test_places_are_valid_where_the_nearest_vector_comes_from_the_fit(volumes, vectors):
    field = lfpiv.joint_field(volumes, vectors)
    near = vectors.joint.sel({axis: field[axis] for axis in "zyx"}, method="nearest")
    inner = slice(1, -1)  # beside the faces no vector is near
    assert (field.valid.values == near.values)[inner, inner, inner].all() and 0 < field.valid.mean() < 1
    assert not lfpiv.joint_field(volumes, vectors.assign(valid=xr.zeros_like(vectors.valid))).valid.any()


def test_the_field_is_kept_beside_the_vectors(volumes, vectors, tmp_path):
    vectors = vectors.assign(valid=vectors.valid.copy(data=np.isfinite(vectors.u.values)))
    field = lfpiv.joint_field(volumes, vectors)
    write_vectors(vectors, tmp_path / "vectors" / "pair_0003.nc", attributes={"pair": 3}, field=field)
    write_vectors(vectors, tmp_path / "vectors" / "pair_0004.nc", attributes={"pair": 4})
    xr.testing.assert_allclose(lfpiv.open_field(tmp_path, 3), field)
    assert lfpiv.open_results(tmp_path).sizes["pair"] == 2
    with pytest.raises(
        lfpiv.InputError, match=r"pair_0004.nc: expected the field of a joint fit, found none. Set smart"
    ):
        lfpiv.open_field(tmp_path, 4)


def test_what_was_not_fitted_jointly_is_refused(volumes, vectors):
    with pytest.raises(ValueError, match="expected volumes of a joint fit"):
        lfpiv.joint_field([volume.drop_vars(UNSHARED) for volume in volumes], vectors)
    with pytest.raises(ValueError, match="expected the result of joint_vectors"):
        lfpiv.joint_field(volumes, vectors.drop_vars("joint"))
