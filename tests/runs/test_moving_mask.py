"""A body that moves: a run with a mask of each frame, and a changed mask."""

import numpy as np
import pytest
import xarray as xr
from support import series_run

from lfpiv.experiment.opening import read_experiment
from lfpiv.results import netcdf
from lfpiv.runs import pipeline


def write_masks(experiment, frames):
    """Write a mask for each frame: a slab that moves along x, on the grid of the volume."""
    grid = experiment.grid
    for number, frame in enumerate(frames):
        mask = xr.DataArray(np.zeros(grid.shape, bool), grid.coordinates(), ("z", "y", "x"), "mask")
        mask[..., 2 * number : 2 * number + 8] = True
        pair, name = (*frame.fields.values(), "a")[:2]
        path = experiment.path.parent / "mask" / f"{pair}{name}.nc"
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
        mask.to_netcdf(path, engine="h5netcdf")


def with_mask(file, pattern):
    file.write_text(file.read_text().replace("[volume]", f'[volume]\nmask = "{pattern}"', 1))


@pytest.mark.slow
def test_volumes_are_dark_in_their_own_body_and_a_changed_mask_concerns_its_pair(coarse_run, tmp_path):
    file, out = coarse_run.images(tmp_path / "data"), coarse_run.prepared(tmp_path / "out")
    plain = read_experiment(file)
    frames = [frame for pair in (0, 1, 2, 3) for frame in plain.pair_frames(pair)]
    write_masks(plain, frames)
    with_mask(file, "mask/{pair}{frame}.nc")
    experiment = read_experiment(file)
    summary = pipeline.run(file, out, pairs=(0, 2), keep_volumes=True)
    assert summary["failed"] == [] and len(summary["reused"]) == 1
    for pair in (0, 1):
        volumes = [netcdf.read_volume(out / "volumes" / f"pair_{pair:04d}_{frame}.nc") for frame in "ab"]
        solids = [experiment.solid(frame) for frame in experiment.pair_frames(pair)]
        for volume, solid in zip(volumes, solids, strict=True):
            np.testing.assert_array_equal(volume["masked"].values, solid)
            assert not volume.values[solid].any() and volume.values[~solid].any()
        vectors = netcdf.read_vectors(out / "vectors" / f"pair_{pair:04d}.nc")
        assert vectors["masked"].values.any() and not vectors["valid"].values[vectors["masked"].values].any()
    write_masks(plain, [*frames[:2], *frames[3:1:-1]])
    again = pipeline.run(file, out, pairs=(0, 2), keep_volumes=True)
    assert "vectors of pair 0" in again["reused"] and "vectors of pair 1" not in again["reused"]


@pytest.mark.slow
def test_instants_that_follow_each_other_have_their_own_masks(small_run, tmp_path):
    file = series_run.write_series(small_run, tmp_path / "data")
    plain = read_experiment(file)
    write_masks(plain, dict.fromkeys(plain.all_frames()))
    file.write_text(file.read_text().replace("[smart]", "[smart]\npredict = true", 1))
    with_mask(file, "mask/{instant}a.nc")
    work = series_run.changed(
        series_run.make_work(small_run, file, tmp_path / "out"), tmp_path / "out", keep_volumes=True
    )
    assert [outcome.reason for outcome in work.do(work.experiment.numbers, lambda number, fraction: None)] == [""] * 5
    for frame in dict.fromkeys(work.experiment.all_frames()):
        volume = netcdf.read_volume(work.folder.volume(min(frame.number, 7), int(frame.number > 7)))
        np.testing.assert_array_equal(volume["masked"].values, work.experiment.solid(frame))
