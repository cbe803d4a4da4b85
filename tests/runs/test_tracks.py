"""Tracks of a run on a time series: of the true particles, kept while they fit, removed where none are asked for."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import KDTree
from support.small_run import small_scene

import lfpiv
from lfpiv.experiment.experiment import Frame
from lfpiv.results.folder import Folder
from lfpiv.results.provenance import Stamp
from lfpiv.runs import pipeline, tracks
from lfpiv.settings.particles import Series
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.simulator import simulate

PAIRS = [3, 4, 5]


def experiment(*, tracking=True, step=1):
    """Return what is asked of an experiment."""
    return SimpleNamespace(
        tracking=object() if tracking else None,
        series=Series(instants=6, first=3, step=step),
        pair_frames=lambda pair: (Frame(pair, "a"), Frame(pair + step, "a")),
    )


def stamp(*, images="known"):
    return lambda pairs: Stamp({"images": images, "tracks": list(pairs)})


def unwanted():
    raise AssertionError("no weights are needed")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder whose stored tracks are of `PAIRS`."""
    found = Folder(tmp_path)
    found.tracks.write_bytes(b"stored")
    monkeypatch.setattr(
        tracks.provenance,
        "read_marks",
        lambda path: SimpleNamespace(
            settings_hash=stamp()(PAIRS).hash, depends_on=stamp()(PAIRS).attributes["depends_on"]
        ),
    )
    return found


def decide(folder, pairs=PAIRS, **changed):
    images = changed.pop("images", "known")
    tracks.decide(experiment(**changed), folder, stamp(images=images), pairs, unwanted, lambda fraction: None)
    return folder.tracks.is_file()


def test_tracks_that_fit_are_kept(folder):
    assert decide(folder)


def test_tracks_that_nobody_asks_for_or_that_cannot_be_are_removed(folder):
    assert not decide(folder, tracking=False)
    folder.tracks.write_bytes(b"stored")
    assert not decide(folder, pairs=[3]), "two instants are no track"


def test_other_pairs_need_new_tracks_and_missing_images_leave_them(folder, caplog):
    with pytest.raises(AssertionError, match="weights"):
        decide(folder, pairs=[*PAIRS, 6])
    assert decide(folder, pairs=[*PAIRS, 6], images=None) and "missing" in caplog.text


INSTANTS, TRACERS, CUBE_MM = 6, 1000, 5.0
"""Instants of the simulated series; its tracers, some 40 of them in the volume; the edge of the cube that they fill."""
MOVED_MM = np.array([0.08, -0.06, 0.04])
"""Between two instants."""
NEAR_MM = 0.03
"""Distance within which a row is of a true particle: a third of a voxel."""


def series_of_one_flow(folder):
    """Simulate a series of tracers that move alike; return the experiment file and the positions by instant [mm]."""
    start = np.random.default_rng(5).uniform(-0.5, 0.5, (TRACERS, 3)) * CUBE_MM
    positions = start + np.arange(INSTANTS)[:, None, None] * MOVED_MM - MOVED_MM * INSTANTS / 2
    np.savez(folder / "tracers.npz", positions=positions / CUBE_MM + 0.5)
    of = small_scene().model_dump(mode="json", exclude_none=True)
    tracers = {"kind": "tracers", "file": str(folder / "tracers.npz"), "series": "positions", "as_given": True}
    of["flow"] = tracers | {"size_mm": (CUBE_MM,) * 3, "box": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))}
    of["particles"] = {"count": TRACERS, "instants": INSTANTS, "step": 1, "sigma_mm": 0.05}
    file = simulate(Scene.model_validate(of), folder / "data")
    file.write_text(file.read_text("utf-8") + "\n[tracking]\n", "utf-8")
    return file, positions


@pytest.mark.slow
def test_a_run_follows_the_true_particles_and_keeps_its_tracks(tmp_path):
    file, positions = series_of_one_flow(tmp_path)
    summary = pipeline.run(file, tmp_path / "out")
    table = lfpiv.open_tracks(tmp_path / "out")
    valid = table.isel(particle=table["valid"].values)
    assert summary["tracks"]["tracks"] == table.attrs["tracks"] == len(np.unique(valid["track"])) > 20
    true = 0
    for number in range(INSTANTS):
        rows = valid.isel(particle=valid["instant"].values == number)
        distance, _ = KDTree(positions[number]).query(np.stack([rows[axis].values for axis in "xyz"], axis=1))
        true += (distance < NEAR_MM).sum()
    assert true >= 0.97 * valid.sizes["particle"]
    moved = np.stack([valid[name].values for name in "uvw"], axis=1) * 1e3 * table.attrs["dt_s"]
    assert np.abs(np.median(moved, axis=0) - MOVED_MM).max() < 0.1 * NEAR_MM

    stored = tmp_path / "out" / "tracks.nc"
    written, values = stored.stat().st_mtime_ns, table.drop_attrs()
    pipeline.run(file, tmp_path / "out", pairs=(0, INSTANTS - 1))
    assert stored.stat().st_mtime_ns == written
    stored.unlink()
    pipeline.run(file, tmp_path / "out")
    assert lfpiv.open_tracks(tmp_path / "out").drop_attrs().identical(values), "the same tracks from the same particles"
