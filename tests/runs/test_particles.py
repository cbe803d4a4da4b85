"""Particles of a pair: warnings about them, and instants of a series that are fitted once."""

import dataclasses

import pytest
import xarray as xr
from support.series_run import FIRST, changed, make_work, write_series

from lfpiv.runs.particles import crowded_warnings, unlinked_warnings
from lfpiv.settings.processing import Tracking
from lfpiv.tracking.finding import ParticleSearch
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


@pytest.mark.slow
def test_each_instant_of_a_series_is_fitted_once_with_equal_tables(small_run, tmp_path, monkeypatch):
    fitted, fit = [], ParticleSearch.fit
    monkeypatch.setattr(ParticleSearch, "fit", lambda *given, **named: fitted.append(1) or fit(*given, **named))
    made = make_work(small_run, write_series(small_run, tmp_path / "data"), tmp_path / "made")
    experiment = dataclasses.replace(made.experiment, tracking=Tracking(rounds=1))
    made, pairs = dataclasses.replace(made, experiment=experiment), range(FIRST, FIRST + 2)
    together, apart = (changed(made, tmp_path / name, instants=len(pairs) + 1) for name in ("together", "apart"))
    assert not any(outcome.reason for outcome in together.do(pairs, lambda number, fraction: None))
    assert len(fitted) == len(pairs) + 1
    for pair in pairs:
        assert not any(outcome.reason for outcome in apart.do([pair], lambda number, fraction: None))
    assert len(fitted) == 3 * len(pairs) + 1
    names = sorted(path.name for path in (tmp_path / "together" / "particles").iterdir())
    assert len(names) == len(pairs)
    for name in names:
        one, other = (xr.load_dataset(tmp_path / way / "particles" / name) for way in ("together", "apart"))
        assert one.sizes["particle"] > 0 or name != names[0]
        assert one.drop_attrs().identical(other.drop_attrs())
