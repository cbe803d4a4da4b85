"""The same command again: what is kept, what is noticed, and what the exit status says."""

import json

import h5py
import pytest

from lfpiv import hdf5
from lfpiv.cli import commands


def run(experiment, out, *more):
    """Run the command line quietly and return its exit status."""
    return commands.call(["run", str(experiment), "--out", str(out), "--quiet", *more])


@pytest.fixture
def finished(small_run, tmp_path):
    """Return experiment file and results of a finished run, as copies."""
    return small_run.images(tmp_path / "data"), small_run.results(tmp_path / "out")


def test_a_pair_without_a_valid_vector_is_not_done(finished, capfd):
    experiment, out = finished
    path = out / "vectors" / "pair_0002.nc"
    with h5py.File(path, "r+") as file:
        figures = json.loads(file.attrs["figures"]) | {"valid_fraction": 0.0}
        file.attrs["figures"] = json.dumps(figures)
    hdf5.seal(path)
    assert run(experiment, out, "--pairs", "0:2") == 0
    assert "no vector" not in capfd.readouterr().err
    assert run(experiment, out) == 3
    assert "no vector is valid in pair 2: see" in capfd.readouterr().err
    assert json.loads((out / "summary.json").read_text())["without_vectors"] == [2]
