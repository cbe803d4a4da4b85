"""Damping by ghosts of a run: measured once, stamped, told, and taken off by the readers of results."""

import json
import shutil

import numpy as np
import pytest

import lfpiv
from lfpiv.results import datasets, netcdf, stored_damping
from lfpiv.results.folder import Folder
from lfpiv.runs import bootstrap, pipeline
from lfpiv.settings.processing import Bootstrap, Smart
from lfpiv.velocity.damping import AxisDamping, Damping

AXIS = AxisDamping(slope=0.8, slope_error=0.02, offset=0.1, offset_error=0.01, fluctuation=0.5, uncertainty_factor=1.2)


@pytest.fixture(scope="module")
def simulated(coarse_run, tmp_path_factory):
    """Folder of a finished run that simulated pairs afterwards, its experiment and its summary."""
    folder = tmp_path_factory.mktemp("bootstrap")
    experiment, out = coarse_run.images(folder / "data"), coarse_run.results(folder / "out")
    with experiment.open("a") as file:
        file.write("\n[bootstrap]\npairs = 2\n")
    return experiment, out, pipeline.run(experiment, out)


@pytest.mark.parametrize(("pairs", "count"), [(1, 0), (19, 0), (20, 1), (50, 4), (5000, 12)])
def test_auto_takes_a_tenth_of_the_pairs_and_at_most_a_dozen(pairs, count):
    assert Bootstrap().count(pairs) == count and Bootstrap(pairs=7).count(pairs) == 7


def test_a_short_run_measures_nothing(coarse_run):
    assert coarse_run.summary["damping"] is None and not Folder(coarse_run.out).bootstrap.exists()
    assert "displacement_unbiased_x" not in lfpiv.open_results(coarse_run.out)


@pytest.mark.slow
def test_finished_pairs_get_the_damping_from_one_file(coarse_run, simulated):
    _, out, summary = simulated
    damping, _ = stored_damping.read(Folder(out).bootstrap)
    assert summary["damping"] == damping.to_json() and summary["damping"]["simulated"] == 2
    assert summary["timings_s"]["bootstrap"] == damping.seconds > 0
    assert "Damping by ghosts" in Folder(out).report.read_text("utf-8")
    for pair in range(4):  # files of pairs stay as they were
        assert Folder(out).vectors(pair).read_bytes() == Folder(coarse_run.out).vectors(pair).read_bytes()
    results = lfpiv.open_results(out)
    for pair in results.pair.values:
        expected = damping.damping.unbiased(netcdf.read_vectors(Folder(out).vectors(pair)))
        for name in ("displacement_unbiased_x", "w_unbiased", "uncertainty_unbiased_y", "uncertainty_z", "u"):
            assert np.array_equal(results[name].sel(pair=pair).values, expected[name].values, equal_nan=True)


@pytest.mark.slow
def test_it_is_measured_once_and_again_if_lost_or_damaged(simulated, caplog):
    experiment, out, _ = simulated
    path = Folder(out).bootstrap
    before = path.read_bytes()
    caplog.set_level("INFO", "lfpiv")
    pipeline.run(experiment, out)
    assert path.read_bytes() == before and "measured before, kept" in caplog.text
    stored = json.loads(before)
    stored["damping"]["axes"]["x"]["slope"] += 0.1  # the digest differs
    path.write_text(json.dumps(stored))
    assert "displacement_unbiased_x" not in lfpiv.open_results(out)  # a damaged file is not used
    pipeline.run(experiment, out)
    again = json.loads(path.read_text())
    assert again["damping"] == json.loads(before)["damping"]  # the same seeds, vectors and images


@pytest.mark.slow
def test_simulated_images_get_the_limit_of_the_counts_of_recorded_ones(coarse_run, tmp_path, monkeypatch):
    experiment, out = coarse_run.images(tmp_path / "data"), coarse_run.results(tmp_path / "out")
    with experiment.open("a") as file:
        file.write("\n[bootstrap]\npairs = 2\n")
    seen = []

    def refuse(weights, vectors, images, measure, **options):
        seen.append(measure.keywords["reconstructor"].solver.smart)
        raise ValueError("nothing is simulated")

    monkeypatch.setattr(bootstrap, "measure_damping", refuse)
    assert pipeline.run(experiment, out)["damping"]["reason"] == "nothing is simulated"
    assert Smart().intensity_cap == "auto" and isinstance(seen[0].settings.intensity_cap, float)


def with_damping(coarse_run, folder, **parts):
    """Copy results and give them a damping whose stamp has the parts of their vectors, some of them changed."""
    out = coarse_run.results(folder)
    depends_on = json.loads(datasets.read_attributes(Folder(out).vectors(0))["depends_on"])
    found = stored_damping.StoredDamping(
        damping=Damping(axes=dict.fromkeys("xyz", AXIS), simulated=2), pairs=(0, 2), seconds=1.5
    )
    stamp = stored_damping.Stamp({**depends_on, "images": [["other", 1, 2]], "bootstrap": 2, **parts})
    stored_damping.write(found, stamp, Folder(out).bootstrap)
    return out, found


def test_readers_take_it_off_vectors_of_the_same_settings_only(coarse_run, tmp_path):
    out, found = with_damping(coarse_run, tmp_path / "one")
    results = lfpiv.open_results(out)
    raw = lfpiv.open_results(coarse_run.out)
    assert results.u_unbiased.dims == raw.u.dims and results.u.equals(raw.u)
    assert json.loads(results.attrs["damping"]) == found.damping.to_json()
    assert (results.uncertainty > raw.uncertainty).where(raw.valid, True).all()
    other, _ = with_damping(coarse_run, tmp_path / "other", dt_s=1.0)
    assert set(lfpiv.open_results(other)) == set(raw)


@pytest.mark.slow
def test_exported_stores_have_it_and_are_made_anew_when_it_comes(coarse_run, tmp_path):
    out, _ = with_damping(coarse_run, tmp_path / "out")
    late = Folder(out).bootstrap.rename(tmp_path / "later")
    (store,) = lfpiv.export_results(out, "netcdf")
    assert "u_unbiased" not in lfpiv.open_results(store)
    shutil.move(late, Folder(out).bootstrap)
    lfpiv.export_results(out, "netcdf")
    stored, results = lfpiv.open_results(store), lfpiv.open_results(out)
    assert np.array_equal(stored["u_unbiased"].values, results["u_unbiased"].values, equal_nan=True)


@pytest.mark.slow
def test_switching_it_off_removes_it(simulated):
    experiment, out, _ = simulated
    experiment.write_text(experiment.read_text().replace("pairs = 2\n", "pairs = 0\n"))
    summary = pipeline.run(experiment, out)
    assert summary["damping"] is None and not Folder(out).bootstrap.exists()
