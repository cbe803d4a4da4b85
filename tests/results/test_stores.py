"""Stores of many pairs or instants: equal to the files, complete or refused, averaged in parts."""

import importlib.metadata
import importlib.util
import json
import os
import pickle
import resource
import shutil
import tracemalloc

import numpy as np
import pytest
import xarray as xr
from support.vector_sets import DT_S, random_vectors, write_run

import lfpiv
from lfpiv import statistics
from lfpiv.results import netcdf, stacked_files, store_seal, stores
from lfpiv.velocity import statistics as streaming

NUMBERS = (0, 1, 3, 4, 9)
STEP = 2
ROUNDING = 1e-12  # sums in another order


def write_series(folder, numbers, **attributes):
    """Write random vectors of instants of a series, each with its number as seed."""
    for number in numbers:
        stamp = {"instant": number, "step": STEP, "time_s": number * DT_S / STEP, "smart": {"iterations": 20}}
        path = folder / "vectors" / f"instant_{number:06d}.nc"
        netcdf.write_vectors(random_vectors(number), path, attributes=stamp | attributes)


def hide_dask(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "dask" else find(name))


@pytest.fixture(params=["dask", "no dask"])
def dask(request, monkeypatch):
    """Open stores and folders with and without dask."""
    if request.param == "dask":
        pytest.importorskip("dask")
    else:
        hide_dask(monkeypatch)
    return request.param == "dask"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return the folders of a run on image pairs and of one on a time series. Tests export copies of them."""
    folder = tmp_path_factory.mktemp("written")
    write_run(folder / "pairs", NUMBERS)
    write_series(folder / "series", NUMBERS)
    return folder


@pytest.fixture(params=["pairs", "series"])
def run(request, written, tmp_path):
    """Return the folder of a run on image pairs, and of one on a time series."""
    return shutil.copytree(written / request.param, tmp_path / "out")


@pytest.fixture
def pairs(written, tmp_path):
    """Return the folder of a run on image pairs."""
    return shutil.copytree(written / "pairs", tmp_path / "out")


@pytest.fixture(params=["zarr", "netcdf"])
def form(request, monkeypatch):
    """Return a form of store, whose chunks hold two pairs and a part of the volume."""
    if request.param == "zarr":
        pytest.importorskip("zarr")
    monkeypatch.setattr(stores, "CHUNK_PAIRS", 2)
    monkeypatch.setattr(stores, "CHUNK_BYTES", 500)
    return request.param


@pytest.mark.slow(but="pairs-zarr-dask")
def test_a_store_is_the_folder(run, form, dask):
    (path,) = lfpiv.export_results(run, form)
    folder, store = lfpiv.open_results(run), lfpiv.open_results(path)
    assert (store.chunks != {}) == dask
    xr.testing.assert_equal(store.load(), folder.load())
    assert {name: np.asarray(value).tolist() for name, value in folder.attrs.items()} == {
        name: np.asarray(value).tolist() for name, value in store.attrs.items() if name in folder.attrs
    }
    along = store.u.dims[0]
    part = lfpiv.open_results(path, pairs=(2, 8))
    assert part[along].values.tolist() == [3, 4]
    with pytest.raises(lfpiv.InputError, match="found 0 to 9"):
        lfpiv.open_results(path, pairs=(20, None))


def test_a_series_has_times_as_the_cf_conventions_want_them(tmp_path, form):
    write_series(tmp_path, NUMBERS)
    (path,) = lfpiv.export_results(tmp_path, form)
    for place in (tmp_path, path):
        results = lfpiv.open_results(place)
        assert results.u.dims == ("instant", "z", "y", "x")
        assert np.allclose(results.time, np.array(NUMBERS) * DT_S / STEP, rtol=ROUNDING, atol=0)
        assert results.time.attrs["units"] == "s" and results.time.attrs["standard_name"] == "time"
    with pytest.raises(lfpiv.InputError, match="interval: expected for image pairs only"):
        lfpiv.export_results(tmp_path, form, interval_s=1.0)


@pytest.mark.slow(but="pairs")
def test_chunks_suit_a_point_and_a_field(run, form):
    (path,) = lfpiv.export_results(run, form)
    chunks = [sizes[0] for sizes in lfpiv.open_results(path).u.chunksizes.values()]
    assert chunks[0] == 2 and 4 * np.prod(chunks) <= 500 < 8 * np.prod(chunks)


def test_results_of_other_settings_replace_the_store(pairs):
    pytest.importorskip("zarr")
    (path,) = lfpiv.export_results(pairs, "zarr")
    write_run(pairs, NUMBERS[:3], smart={"iterations": 5})
    lfpiv.export_results(pairs, "zarr", pairs=(0, 4))
    store = lfpiv.open_results(path)
    assert json.loads(store.attrs["smart"]) == {"iterations": 5} and store.sizes["pair"] == 3


@pytest.mark.slow(but="netcdf")
def test_a_killed_export_leaves_nothing(pairs, form, monkeypatch):
    inner = stacked_files.StackedFiles.block

    def fail(self, first, after):
        if first >= 4:
            raise KeyboardInterrupt
        return inner(self, first, after)

    monkeypatch.setattr(stacked_files.StackedFiles, "block", fail)
    with pytest.raises(KeyboardInterrupt):
        lfpiv.export_results(pairs, form)
    assert not (pairs / "export").exists()


def test_nothing_else_is_taken_for_a_store_or_removed(tmp_path):
    pytest.importorskip("zarr")
    write_run(tmp_path, (0,))
    with pytest.raises(lfpiv.InputError, match="found another file"):
        lfpiv.open_results(tmp_path / "vectors" / "pair_0000.nc")
    (tmp_path / "bad.nc").write_bytes(b"no NetCDF")
    with pytest.raises(lfpiv.InputError, match=r"bad\.nc: expected a store"):
        lfpiv.open_results(tmp_path / "bad.nc")
    mine = tmp_path / "export" / "vectors.zarr"
    mine.mkdir(parents=True)
    (mine / "thesis.txt").write_text("years of work")
    with pytest.raises(lfpiv.InputError, match="found another folder"):
        lfpiv.export_results(tmp_path, "zarr")
    assert (mine / "thesis.txt").read_text() == "years of work"
    (tmp_path / "empty.zarr").mkdir()
    with pytest.raises(lfpiv.InputError, match=r"empty\.zarr: expected a store"):
        lfpiv.open_results(tmp_path / "empty.zarr")


@pytest.mark.parametrize("package", ["zarr", "xarray"])
def test_older_packages_are_named(tmp_path, monkeypatch, package):
    write_run(tmp_path, (0,))
    found = importlib.metadata.version
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "2.18.3" if name == package else found(name))
    with pytest.raises(lfpiv.InputError, match=rf"{package}: expected .* found 2\.18\.3"):
        lfpiv.export_results(tmp_path, "zarr")
    assert not (tmp_path / "export").exists()


@pytest.mark.slow(but="zarr")
def test_a_damaged_chunk_is_not_read_in_silence(pairs, form, monkeypatch):
    (path,) = lfpiv.export_results(pairs, form)
    chunk = path if form == "netcdf" else max((path / "u" / "c").rglob("[0-9]*"))
    content = bytearray(chunk.read_bytes())
    if form == "netcdf":
        import h5py

        with h5py.File(path, "r") as file:
            place = file["u"].id.get_chunk_info(0)
        content[place.byte_offset + place.size // 2] ^= 1
    else:
        content[len(content) // 2] ^= 1
    chunk.write_bytes(content)
    with pytest.raises(lfpiv.InputError, match=f"{path.name}.*digest differs"):
        lfpiv.open_results(path)
    monkeypatch.setattr(store_seal, "WHOLE_BYTES", 0)  # of a store too large to be read, chunks tell it when read
    with pytest.raises((OSError, RuntimeError, ValueError)):
        lfpiv.open_results(path).u.load()


def change_values(path):
    if path.is_dir():
        import zarr

        stored = zarr.open_group(str(path), mode="r+")["u"]
    else:
        import h5py

        file = h5py.File(path, "r+")
        stored = file["u"]
    stored[...] = 2 * stored[...]


def change_interval(path):
    if path.is_dir():
        text, stated = (path / "zarr.json").read_text(), f'"dt_s": {DT_S}'
        assert stated in text
        (path / "zarr.json").write_text(text.replace(stated, '"dt_s": 7.0'))
    else:
        import h5py

        with h5py.File(path, "r+") as file:
            file.attrs["dt_s"] = 7.0


def remove_chunk(path):
    """Zarr reads a missing chunk as fill values; a NetCDF file is cut off."""
    if path.is_dir():
        max((path / "u" / "c").rglob("[0-9]*")).unlink()
    else:
        path.write_bytes(path.read_bytes()[:-1000])


def put_pipe(path):
    chunk = max((path / "u" / "c").rglob("[0-9]*")) if path.is_dir() else path
    chunk.unlink()
    os.mkfifo(chunk)


@pytest.mark.slow(but="change_values-True")
@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("forge", [change_values, change_interval, remove_chunk, put_pipe])
def test_a_forged_store_is_refused_and_written_anew(pairs, form, forge, whole, monkeypatch):
    """Also where a store is too large to read all of it: sizes, metadata and axes tell."""
    (path,) = lfpiv.export_results(pairs, form)
    wanted = lfpiv.open_results(path).load()
    if not whole:
        monkeypatch.setattr(store_seal, "WHOLE_BYTES", 0)
    forge(path)
    with pytest.raises(lfpiv.InputError, match=path.name):
        lfpiv.open_results(path)
    lfpiv.export_results(pairs, form)
    xr.testing.assert_identical(lfpiv.open_results(path).load(), wanted)


class Touch:
    """An object whose pickle makes a file where it is read."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return open, (str(self.mark), "w")


def state(store, name, change):
    """Change what a store states of an array, or of itself."""
    file = store / name / "zarr.json"
    file.write_text(json.dumps(change(json.loads(file.read_text()))))


def with_codec(name, **configuration):
    return lambda form: form | {"codecs": [{"name": name, "configuration": configuration}]}


@pytest.mark.slow(but="x-<lambda>0-codecs.0.name")
@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("x", with_codec("numcodecs.pickle"), "codecs.0.name"),
        ("pair", with_codec("vlen-utf8"), "codecs.0.name"),
        ("pair", lambda form: form | {"data_type": "string"}, "data_type"),
        ("pair", lambda form: form | {"shape": [1 << 40]}, "bytes at once"),
        ("pair", lambda form: form | {"zarr_format": 2}, "zarr_format"),
    ],
)
def test_no_codec_runs_that_an_export_does_not_write(tmp_path, name, change, said):
    pytest.importorskip("zarr")
    write_run(tmp_path, NUMBERS[:3])
    (path,) = lfpiv.export_results(tmp_path, "zarr")
    wanted = lfpiv.open_results(path).load()
    state(path, name, change)
    for chunk in (path / name / "c").glob("[0-9]*"):
        chunk.write_bytes(pickle.dumps(Touch(tmp_path / "ran")))
    state(path, "", lambda form: form | {"attributes": form["attributes"] | store_seal.zarr_digests(path)})
    with pytest.raises(lfpiv.InputError, match=f"{name}/zarr.json: .*{said}"):
        lfpiv.open_results(path)
    lfpiv.export_results(tmp_path, "zarr")
    xr.testing.assert_equal(lfpiv.open_results(path).load(), wanted)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("other", [".zarray", "x/c/0/.zgroup", "x/more.json"])
def test_a_store_holds_nothing_but_its_arrays(tmp_path, other):
    pytest.importorskip("zarr")
    write_run(tmp_path, NUMBERS[:1])
    (path,) = lfpiv.export_results(tmp_path, "zarr")
    (path / "x" / "c" / "0").unlink()
    (path / other).parent.mkdir(exist_ok=True)
    (path / other).write_text("{}")
    state(path, "", lambda form: form | {"attributes": form["attributes"] | store_seal.zarr_digests(path)})
    with pytest.raises(lfpiv.InputError, match="no part of such a store"):
        lfpiv.open_results(path)


@pytest.mark.slow
def test_a_disk_that_fills_up_anywhere_leaves_no_store(pairs, form, monkeypatch):
    """HDF5 would crash the process. No disk, but files that may not grow: all of them, or only the last bytes."""
    (path,) = lfpiv.export_results(pairs, form)
    largest = max(file.stat().st_size for file in (path, *path.rglob("*")) if file.is_file())
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in (0, largest // 3, largest - 1):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            with pytest.raises(lfpiv.errors.StorageError, match="cannot be written: file too large"):
                lfpiv.export_results(pairs, form)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        left = list((pairs / "export").iterdir()) if (pairs / "export").exists() else []
        assert left == []
    lfpiv.export_results(pairs, form)
    xr.testing.assert_equal(lfpiv.open_results(path).load(), lfpiv.open_results(pairs).load())


@pytest.mark.slow(but="netcdf")
def test_two_exports_at_once_leave_a_whole_store(tmp_path, form, monkeypatch):
    write_run(tmp_path, NUMBERS[:2])
    inner = stacked_files.StackedFiles.block

    def export_too(self, first, after):
        monkeypatch.setattr(stacked_files.StackedFiles, "block", inner)
        lfpiv.export_results(tmp_path, form)
        return inner(self, first, after)

    monkeypatch.setattr(stacked_files.StackedFiles, "block", export_too)
    (path,) = lfpiv.export_results(tmp_path, form)
    assert lfpiv.open_results(path).sizes["pair"] == 2 and [path] == list(path.parent.iterdir())


def test_pairs_and_a_series_in_one_folder_are_refused(tmp_path):
    write_run(tmp_path, (0,))
    write_series(tmp_path, (1,))
    with pytest.raises(lfpiv.InputError, match="expected vectors of image pairs or of a time series, found both"):
        lfpiv.open_results(tmp_path)


def test_files_beyond_those_that_are_compared_at_first_are_compared_when_read(tmp_path, monkeypatch):
    hide_dask(monkeypatch)
    monkeypatch.setattr(stacked_files, "CHECKED_FILES", 3)
    write_run(tmp_path, range(8))
    write_run(tmp_path, (5,), smart={"iterations": 30})
    results = lfpiv.open_results(tmp_path)  # 0, 3 and 7 are compared
    assert np.isfinite(results.u.isel(pair=[4, 6])).all()
    with pytest.raises(lfpiv.InputError, match=r"pair_0005\.nc.*smart\.iterations = 30 instead of 20"):
        results.u.isel(pair=5).load()


@pytest.mark.slow
@pytest.mark.parametrize("block", [1, 20_000])
def test_statistics_in_parts_are_those_of_the_whole(run, block, monkeypatch):
    (path,) = lfpiv.export_results(run, "netcdf")
    hide_dask(monkeypatch)
    whole = lfpiv.open_results(run).load()
    expected = [statistics.mean(whole), statistics.reynolds_stresses(whole), statistics.standard_error(whole)]
    monkeypatch.setattr(streaming, "BLOCK_BYTES", block)
    for place in (run, path):
        results = lfpiv.open_results(place)
        found = [statistics.mean(results), statistics.reynolds_stresses(results), statistics.standard_error(results)]
        for one, other in zip(expected, found, strict=True):
            xr.testing.assert_allclose(one, other, rtol=1e-9, atol=ROUNDING)
        shared = [one[2].standard_error_u.attrs["pairs_per_independent"] for one in (expected, found)]
        assert shared[0] == pytest.approx(shared[1], rel=1e-9)


@pytest.mark.slow
def test_statistics_hold_a_block_and_not_the_run(tmp_path, monkeypatch):
    """Without dask, 30 files are averaged in much less memory than they take."""
    hide_dask(monkeypatch)
    shape, count, block = (8, 32, 32), 30, 1 << 19
    for number in range(count):
        write_run(tmp_path, (number,), shape=shape)
    monkeypatch.setattr(streaming, "BLOCK_BYTES", block)
    results = lfpiv.open_results(tmp_path)
    statistics.mean(results.isel(pair=slice(0, 2)))  # imports
    tracemalloc.start()
    average = statistics.mean(results)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    whole = 3 * 8 * count * np.prod(shape)
    assert results.sizes["pair"] == count and count / 2 < float(average.pairs_counted.mean()) < count
    assert peak < 6 * block < whole / 1.8
