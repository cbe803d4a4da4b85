"""Derived fields against analytic flows; statistics against their definitions and known random ensembles."""

import numpy as np
import pytest
import xarray as xr
from support.vector_sets import axes, from_flow, random_vectors

from lfpiv import derived, statistics
from lfpiv.velocity.derived import check_velocity
from lfpiv.velocity.statistics import STRESSES

ROUNDING = 1e-9  # of double precision differences of positions in millimetres, relative to gradients of order 1
SAMPLING = 5.0  # standard errors that a seeded random figure may be off
WAVE = 400.0  # wave number of the periodic flow [1/m], 2 pi in 16 mm
FIELDS = ("velocity_gradient", "vorticity", "divergence", "q_criterion", "strain_rate")


# -- derived fields ----------------------------------------------------------------------------------------------------


def as_dataset(field):
    return field.to_dataset() if isinstance(field, xr.DataArray) else field


def linear(matrix):
    """Flow whose velocity gradient is the matrix everywhere; differences of it are exact."""
    return from_flow(lambda x, y, z: np.tensordot(matrix, np.stack([x, y, z]), 1))


@pytest.mark.parametrize("seed", range(3))
def test_a_linear_flow_gives_its_own_matrix(seed):
    matrix = np.random.default_rng(seed).normal(size=(3, 3))
    vectors = linear(matrix)
    antisymmetric, symmetric = (matrix - matrix.T) / 2, (matrix + matrix.T) / 2
    gradient = derived.velocity_gradient(vectors).transpose("z", "y", "x", ...)
    assert np.abs(gradient.values - matrix).max() < ROUNDING
    curl = derived.vorticity(vectors)
    expected = [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    for axis, value in zip("xyz", expected, strict=True):
        assert np.abs(curl[f"vorticity_{axis}"] - value).max() < ROUNDING
    assert np.abs(curl.vorticity_magnitude - np.linalg.norm(expected)).max() < ROUNDING
    assert np.abs(derived.divergence(vectors) - np.trace(matrix)).max() < ROUNDING
    q = (np.sum(antisymmetric**2) - np.sum(symmetric**2)) / 2
    assert np.abs(derived.q_criterion(vectors) - q).max() < ROUNDING
    strain = derived.strain_rate(vectors)
    for row, one in enumerate("xyz"):
        for column in range(row, 3):
            assert np.abs(strain[f"strain_{one}{'xyz'[column]}"] - symmetric[row, column]).max() < ROUNDING
    assert np.abs(strain.strain_rate_magnitude - np.sqrt(2 * np.sum(symmetric**2))).max() < ROUNDING


def taylor_green(x, y, z):
    """Periodic vortices whose divergence is zero [m/s]."""
    return (
        np.cos(WAVE * x) * np.sin(WAVE * y) * np.cos(WAVE * z),
        -np.sin(WAVE * x) * np.cos(WAVE * y) * np.cos(WAVE * z),
        0 * x,
    )


def test_errors_in_taylor_green_vortices_are_those_of_second_order_differences():
    errors = []
    for count in (9, 17):  # vectors over the same 8 mm
        step = 8.0 / (count - 1)
        vectors = from_flow(taylor_green, axes((count,) * 3, (step,) * 3, (0.3, 0.5, 0.7)))
        z, y, x = np.meshgrid(*(1e-3 * vectors[name].values for name in "zyx"), indexing="ij")
        curl = -2 * WAVE * np.cos(WAVE * x) * np.cos(WAVE * y) * np.cos(WAVE * z)
        error = np.abs(derived.vorticity(vectors).vorticity_z - curl)
        # h^2 / 6 f''' inside, h^2 / 3 f''' and the next order, h^3 / 4 f'''', at the border; two derivatives
        one = WAVE * (WAVE * 1e-3 * step) ** 2
        assert error[1:-1, 1:-1, 1:-1].max() < 2 * one / 6
        assert error.max() < 2 * one * (1 / 3 + WAVE * 1e-3 * step / 4)
        assert np.abs(derived.divergence(vectors)).max() < 2 * one * (1 / 3 + WAVE * 1e-3 * step / 4)
        errors.append(float(error[1:-1, 1:-1, 1:-1].max()))
    assert errors[0] / errors[1] > 3.5  # 4 in the limit of small steps


def test_the_flag_marks_values_that_depend_on_measured_vectors_only():
    vectors = random_vectors(5, (6, 7, 8))
    assert 0.05 < float(1 - vectors.valid.mean()) < 0.5
    changed = vectors.copy(deep=True)
    for name in "uvw":
        changed[name] = changed[name].where(changed.valid, 1e3)
    for name in FIELDS:
        one, other = (as_dataset(getattr(derived, name)(kind)) for kind in (vectors, changed))
        for variable in one.data_vars:
            same = (one[variable] == other[variable]) | ~one.valid
            assert bool(same.all()), (name, variable)
    # and no more than that: a lone replaced vector reaches its neighbours along the axes, and over the border's three
    vectors["valid"] = xr.ones_like(vectors.valid)
    vectors.valid[2, 3, 4] = False
    doubtful = np.argwhere(~derived.divergence(vectors).valid.values).tolist()
    near = [[1, 3, 4], [3, 3, 4], [2, 2, 4], [2, 4, 4], [2, 3, 3], [2, 3, 5], [2, 3, 4], [0, 3, 4]]
    assert sorted(doubtful) == sorted(near)


def test_nan_spreads_as_far_as_the_differences_reach():
    vectors = random_vectors(5, (6, 7, 8))
    vectors["valid"] = xr.ones_like(vectors.valid)
    vectors.u[3, 3, 4] = np.nan
    vectors.valid[3, 3, 4] = False
    field = derived.q_criterion(vectors)
    assert bool(field.where(field.valid, 0).notnull().all()) and bool(field.isnull().any())


def test_without_a_flag_there_is_none_and_units_are_those_of_the_docstrings():
    vectors = linear(np.eye(3))
    assert "valid" not in derived.divergence(vectors).coords
    units = {name: variable.attrs["units"] for name, variable in derived.vorticity(vectors).data_vars.items()}
    assert set(units.values()) == {"1/s"} and derived.q_criterion(vectors).attrs["units"] == "1/s^2"
    assert derived.q_criterion(vectors).x.attrs["units"] == "mm" and derived.q_criterion(vectors).dims == (
        "z",
        "y",
        "x",
    )


def test_order_of_axes_and_further_dimensions_change_nothing():
    single = [random_vectors(seed) for seed in (1, 2)]
    both = xr.concat(single, xr.IndexVariable("pair", [3, 7])).transpose("x", "pair", "z", "y")
    for number, vectors in zip((3, 7), single, strict=True):
        for name in ("q_criterion", "divergence"):
            one, other = getattr(derived, name)(both).sel(pair=number), getattr(derived, name)(vectors)
            xr.testing.assert_allclose(one.drop_vars("pair"), other, rtol=ROUNDING)


def test_dask_arrays_stay_lazy():
    dask = pytest.importorskip("dask.array")
    vectors = xr.concat([random_vectors(seed) for seed in range(4)], xr.IndexVariable("pair", range(4)))
    lazy = vectors.chunk(pair=1)
    for call in (*(getattr(derived, name) for name in FIELDS), statistics.mean, statistics.reynolds_stresses):
        one, other = call(lazy), call(vectors)
        assert all(isinstance(part.data, dask.Array) for part in as_dataset(one).data_vars.values())
        xr.testing.assert_allclose(one.compute(), other, rtol=ROUNDING)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: derived.vorticity(np.zeros((3, 4, 4, 4))), "Dataset.*ndarray"),
        (lambda: derived.vorticity(random_vectors(0).drop_vars("w")), "found no w"),
        (lambda: derived.divergence(random_vectors(0).drop_vars("z")), "found no z"),
        (lambda: derived.divergence(random_vectors(0, (2, 4, 4))), "at least 3 along z, found 2"),
        (lambda: derived.q_criterion(random_vectors(0).isel(z=0)), "z"),
        (lambda: derived.strain_rate(random_vectors(0).sortby("x").isel(x=[0, 2, 1])), "x that rise or fall"),
        (
            lambda: derived.divergence(random_vectors(0).assign_coords(x=("x", np.arange(6.0), {"units": "m"}))),
            "x in mm",
        ),
        (lambda: statistics.mean(random_vectors(0)), "u over pair.*open_results"),
        (lambda: statistics.mean(random_vectors(0).expand_dims(pair=2, instant=2)), "found it over.*pair"),
        (lambda: statistics.standard_error(ensemble(np.zeros((2, 3))).assign_coords(pair=[1, 1])), "each once"),
    ],
)
def test_bad_input_is_refused_by_name(call, words):
    with pytest.raises(ValueError, match=f"(?s)vectors: .*{words}"):
        call()


# -- statistics --------------------------------------------------------------------------------------------------------


def ensemble(u, v=None, w=None, valid=None, numbers=None):
    """Return vectors over pairs at positions along x, from components of shape (pair, position)."""
    parts = {"u": u, "v": u if v is None else v, "w": u if w is None else w}
    dims = ("pair", "z", "y", "x")
    variables = {name: (dims, part[:, None, None, :], {"units": "m/s"}) for name, part in parts.items()}
    if valid is not None:
        variables["valid"] = (dims, valid[:, None, None, :])
    places = {"x": ("x", np.arange(u.shape[1], dtype=float), {"units": "mm"}), "y": [0.0], "z": [0.0]}
    return xr.Dataset(variables, places | {"pair": np.arange(len(u)) if numbers is None else numbers})


def test_statistics_are_their_definitions_over_the_valid_vectors():
    rng = np.random.default_rng(3)
    parts, valid = rng.normal(2.0, 1.5, (3, 9, 40)), rng.random((9, 40)) > 0.5
    valid[:, 0], valid[:, 1] = False, np.arange(9) == 4  # none, a single one
    parts[0, 2, 5] = np.nan
    vectors = ensemble(*parts, valid=valid)
    mean, stresses = statistics.mean(vectors), statistics.reynolds_stresses(vectors)
    energy, rms = statistics.turbulent_kinetic_energy(vectors), statistics.rms(vectors)
    for place in range(40):
        counted = valid[:, place] & np.isfinite(parts[:, :, place]).all(0)
        chosen = parts[:, counted, place]
        assert mean.pairs_counted[0, 0, place] == counted.sum() and mean.valid[0, 0, place] == counted.any()
        at = {"z": 0, "y": 0, "x": place}
        if not counted.any():
            assert np.isnan(mean.u.isel(at))
        else:
            assert np.allclose([mean[name].isel(at) for name in "uvw"], chosen.mean(1), rtol=ROUNDING)
        if counted.sum() < 2:
            assert all(np.isnan(stresses[name].isel(at)) for name in STRESSES)
            continue
        covariance = np.cov(chosen)
        for name in STRESSES:
            row, column = ("uvw".index(letter) for letter in name)
            assert np.isclose(stresses[name].isel(at), covariance[row, column], rtol=1e-7, atol=ROUNDING)
        assert np.isclose(energy.isel(at), np.trace(covariance) / 2)
        assert np.allclose([rms[f"{name}_rms"].isel(at) for name in "uvw"], np.sqrt(np.diag(covariance)))
    assert stresses.uv.attrs["units"] == energy.attrs["units"] == "m^2/s^2" and rms.u_rms.attrs["units"] == "m/s"
    assert check_velocity(mean) is None and mean.x.attrs["units"] == "mm"


def test_a_known_gaussian_ensemble_gives_its_covariance():
    rng = np.random.default_rng(4)
    covariance = np.array([[4.0, 1.2, -0.5], [1.2, 1.0, 0.2], [-0.5, 0.2, 0.5]])
    pairs, places = 400, 100
    draws = rng.multivariate_normal([1.0, 0.0, -1.0], covariance, (pairs, places)).transpose(2, 0, 1)
    stresses = statistics.reynolds_stresses(ensemble(*draws)).mean()
    for name in STRESSES:
        row, column = ("uvw".index(letter) for letter in name)
        variance = covariance[row, column] ** 2 + covariance[row, row] * covariance[column, column]
        error = np.sqrt(variance / (pairs * places))  # of a sample covariance of Gaussian numbers
        assert abs(float(stresses[name]) - covariance[row, column]) < SAMPLING * error


def correlated_series(rng, pairs, places, memory):
    """Return Gaussian numbers with correlation memory^k between pairs k apart."""
    series = np.empty((pairs, places))
    series[0] = rng.normal(size=places)
    for step in range(1, pairs):
        series[step] = memory * series[step - 1] + np.sqrt(1 - memory**2) * rng.normal(size=places)
    return series


@pytest.mark.parametrize("memory", [0.0, 0.6, 0.9])
def test_the_standard_error_is_the_scatter_of_means_of_correlated_pairs(memory):
    rng = np.random.default_rng(5)
    pairs, places = 600, 500  # as many realisations as places, independent of one another
    series = correlated_series(rng, pairs, places, memory)
    present = np.sort(rng.choice(pairs, 450, replace=False))  # pairs may be missing
    valid = rng.random((450, places)) > 0.1
    vectors = ensemble(series[present], valid=valid, numbers=present)
    errors = statistics.standard_error(vectors).standard_error_u
    scatter = float(statistics.mean(vectors).u.std())
    sampling = SAMPLING / np.sqrt(2 * places)  # of a standard deviation over the places
    bias = 2 * (1 + memory) / (1 - memory) / pairs  # of correlations about an estimated mean, in the long run
    assert abs(float(errors.mean()) / scatter - 1) < sampling + bias
    if memory == 0:
        assert errors.attrs["pairs_per_independent"] < 1.1


SHORT = 0.12
"""Part of the true error by which that of a short series may be off: what is left of the estimated mean's part."""


@pytest.mark.parametrize(("memory", "pairs"), [(0.0, 3), (0.0, 10), (0.5, 10), (0.5, 20), (0.8, 50)])
@pytest.mark.parametrize("complete", [True, False])
def test_the_standard_error_of_short_series_allows_for_their_estimated_mean(memory, pairs, complete):
    rng = np.random.default_rng(6)
    places = 4000  # independent of one another
    series = correlated_series(rng, pairs, places, memory)
    valid = rng.random(series.shape) >= (0.0 if complete else 0.15)
    errors = statistics.standard_error(ensemble(series, valid=valid)).standard_error_u.values.ravel()
    counted = valid.astype(float)
    apart = np.abs(np.subtract.outer(np.arange(pairs), np.arange(pairs)))
    total = np.einsum("ip,ij,jp->p", counted, memory**apart, counted)
    known = counted.sum(0) > 1
    true = np.sqrt(total[known]) / counted.sum(0)[known]
    assert np.isnan(errors[~known]).all()
    assert abs(np.sqrt((errors[known] ** 2).mean() / (true**2).mean()) - 1) < SHORT
