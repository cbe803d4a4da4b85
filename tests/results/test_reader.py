"""Results of a run, opened by xarray and by `open_results`: complete, lazy, and refused if pairs differ."""

import importlib.util
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from support.stored import rewrite
from support.vector_sets import random_vectors, random_volume, write_run

import lfpiv
from lfpiv.results import datasets, netcdf

NUMBERS = (0, 1, 3, 7)  # pairs may be missing


@pytest.fixture(params=["dask", "no dask"])
def dask(request, monkeypatch):
    """Return whether dask is installed. Without it the indexing of xarray reads the files."""
    if request.param == "dask":
        pytest.importorskip("dask")
    else:
        monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None)
    return request.param == "dask"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a run and its vectors. Tests must not change it."""
    folder = tmp_path_factory.mktemp("run")
    return folder, write_run(folder, NUMBERS, error_correlation_voxel=[9.1, 9.1, 8.5])


def test_all_pairs_are_one_dataset(run, dask):
    folder, written = run
    opened = lfpiv.open_results(folder)
    assert opened.pair.values.tolist() == list(NUMBERS) and (opened.chunks != {}) == dask
    assert list(opened.data_vars)[:3] == ["u", "v", "w"] and opened.attrs["dt_s"] == 1e-3
    assert opened.attrs["error_correlation_voxel"].tolist() == [9.1, 9.1, 8.5]
    for number, vectors in written.items():
        xr.testing.assert_equal(opened.sel(pair=number, drop=True).load(), vectors)
    assert opened.valid.dtype == bool and opened.u.attrs["units"] == "m/s" and opened.x.attrs["units"] == "mm"
    assert lfpiv.open_results(folder, pairs=(1, 4)).pair.values.tolist() == [1, 3]
    assert lfpiv.open_results(folder, pairs=(2, None)).pair.values.tolist() == [3, 7]


@pytest.mark.parametrize(
    "index",
    [
        {"pair": 2},
        {"pair": [3, 0]},
        {"pair": slice(None, None, -1), "z": 1, "x": slice(1, 4)},
        {"pair": [1], "z": [2, 0], "y": 3, "x": [5, 0, 5]},
        {"pair": -1, "z": slice(3, None, -2), "y": -2, "x": 0},
        {"pair": slice(2, 2)},
        {"pair": [], "y": 1, "x": [0, 2]},
    ],
)
def test_indexing_equals_numpy(run, dask, index):
    folder, written = run
    whole = xr.concat([vectors.u for vectors in written.values()], xr.IndexVariable("pair", list(NUMBERS)))
    part = lfpiv.open_results(folder).u.isel(index)
    np.testing.assert_array_equal(part.values, whole.isel(index).values)
    assert part.dims == whole.isel(index).dims


def test_values_are_read_lazily(tmp_path, dask, monkeypatch):
    written = write_run(tmp_path, NUMBERS)
    opened = lfpiv.open_results(tmp_path)
    read, get = [], h5py.Group.__getitem__

    def record(group, name):
        if name != "/":  # h5py reads attributes of the file through it
            read.append((Path(group.file.filename).name, name))
        return get(group, name)

    monkeypatch.setattr(h5py.Group, "__getitem__", record)
    assert float(opened.w.isel(pair=2, z=0, y=1, x=2)) == float(written[3].w[0, 1, 2])
    assert read == [("pair_0003.nc", "w")]
    monkeypatch.setattr(h5py.Group, "__getitem__", get)
    (tmp_path / "vectors" / "pair_0007.nc").write_bytes(b"damaged since")
    assert np.isfinite(opened.u.isel(pair=slice(0, 3)).values).all()
    with pytest.raises(lfpiv.InputError, match=r"pair_0007\.nc.*damaged"):
        opened.u.values  # noqa: B018


def test_opening_decodes_one_file_and_reads_the_axes_of_the_others(run, monkeypatch):
    folder, _ = run
    decoded, named, inner, get = [], [], netcdf.read_vectors, h5py.Group.__getitem__
    monkeypatch.setattr(netcdf, "read_vectors", lambda path: decoded.append(path.name) or inner(path))
    lfpiv.open_results(folder)
    monkeypatch.setattr(netcdf, "read_vectors", lambda path: random_vectors(0).assign_attrs(dt_s=1e-3))
    monkeypatch.setattr(h5py.Group, "__getitem__", lambda self, name: named.append(name) or get(self, name))
    lfpiv.open_results(folder)
    named = [name for name in named if name != "/"]  # the file itself
    assert decoded == ["pair_0000.nc"] and set(named) == {"z", "y", "x"} and len(named) == 3 * len(NUMBERS)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"smart": {"iterations": 30}}, "smart.iterations = 30 instead of 20"),
        ({"dt_s": 2e-3}, "dt_s = 0.002 instead of 0.001"),
        ({"depends_on": '{"calibration": "f00d", "images": [3]}'}, 'calibration = "f00d" instead of "cafe"'),
        ({"depends_on": "{}"}, 'calibration = none instead of "cafe"'),
    ],
)
def test_pairs_of_other_settings_are_refused_by_both_names(tmp_path, change, words):
    parts = (f'"{name}": [%(pair)d]' for name in ("images", "images_beside", "mask_files"))  # each pair has its own
    stamp = f'{{"calibration": "cafe", {", ".join(parts)}}}'
    for number in (0, 1):
        write_run(tmp_path, (number,), depends_on=stamp % {"pair": number})
    write_run(tmp_path, (2,), **{"depends_on": stamp % {"pair": 2}, **change})
    with pytest.raises(lfpiv.InputError, match=rf"(?s)pair_0002\.nc.*pair_0000\.nc.*{words}.*lfpiv run"):
        lfpiv.open_results(tmp_path)
    assert lfpiv.open_results(tmp_path, pairs=(0, 2)).sizes["pair"] == 2


def test_pairs_on_other_axes_or_with_other_variables_are_refused(tmp_path):
    write_run(tmp_path, (0,))
    write_run(tmp_path, (1,), shape=(4, 5, 7))
    with pytest.raises(lfpiv.InputError, match=r"pair_0001\.nc.*positions along x"):
        lfpiv.open_results(tmp_path)
    more = random_vectors(1).assign(correlation=random_vectors(2).u)
    netcdf.write_vectors(more, tmp_path / "vectors" / "pair_0001.nc", attributes={"smart": {"iterations": 20}})
    with pytest.raises(lfpiv.InputError, match=r"pair_0001\.nc.*other variables: correlation"):
        lfpiv.open_results(tmp_path)


def test_a_folder_without_a_finished_run_is_refused(tmp_path):
    with pytest.raises(lfpiv.InputError, match="no such folder"):
        lfpiv.open_results(tmp_path / "nothing")
    with pytest.raises(lfpiv.InputError, match="no vectors in it"):
        lfpiv.open_results(tmp_path)
    (tmp_path / "vectors").mkdir()
    (tmp_path / "vectors" / ".pair_0000.nc.tmp").touch()
    with pytest.raises(lfpiv.InputError, match=r"finished pairs.*found none"):
        lfpiv.open_results(tmp_path)
    write_run(tmp_path, (0, 1))
    with pytest.raises(lfpiv.InputError, match=r"finished pairs 5:, found pairs 0 to 1"):
        lfpiv.open_results(tmp_path, pairs=(5, None))
    with pytest.raises(lfpiv.InputError, match="A < B"):
        lfpiv.open_results(tmp_path, pairs=(1, 1))
    (tmp_path / "vectors" / "pair_0001.nc").write_bytes(b"no NetCDF")
    with pytest.raises(lfpiv.InputError, match=r"pair_0001\.nc.*damaged"):
        lfpiv.open_results(tmp_path)
    change = {"schema_version": 99}
    rewrite(tmp_path / "vectors" / "pair_0000.nc", lambda file: file.attrs.update(change), sealed=True)
    with pytest.raises(lfpiv.InputError, match=r"pair_0000\.nc.*schema version"):
        lfpiv.open_results(tmp_path)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda v: v.u.values.__imul__(1000), r"'u' to be 'displacement_x' times voxel_mm / dt_s, found 119 of 120"),
        (lambda v: v.w.values.__setitem__((0, 1, 2), 9), r"'w' to be 'displacement_z' .*found 1 of 120"),
        (lambda v: v.displacement_y.values.__setitem__((3, 4, 5), np.nan), r"'v' to be 'displacement_y' .*found 1 of"),
        (lambda v: v.attrs.update(voxel_mm=[0.2, 0.1, 0.1]), r"'w' to be 'displacement_z' "),
        (lambda v: v.attrs.update(dt_s=1e-4), r"'[uvw]' to be 'displacement_[xyz]' "),
        (lambda v: v.attrs.update(voxel_mm=0.1), r"voxel_mm, edges \(z, y, x\) > 0, found 0.1"),
        (lambda v: v.attrs.pop("voxel_mm"), r"voxel_mm, edges \(z, y, x\) > 0, found None"),
        (lambda v: v.x.attrs.update(units="m"), "coordinate x in mm, found it in m"),
        (lambda v: v.z.attrs.pop("units"), "coordinate z in mm, found it in no unit"),
    ],
)
def test_velocities_that_contradict_their_displacements_are_refused(tmp_path, spoil, words):
    vectors = random_vectors(0)
    vectors["u"].values[0, 0, 0] = vectors["displacement_x"].values[0, 0, 0] = np.nan  # both unknown: that is fine
    netcdf.write_vectors(vectors, tmp_path / "good.nc", attributes={})
    spoil(vectors)
    with pytest.raises(ValueError, match=words):
        netcdf.write_vectors(vectors, tmp_path / "bad.nc", attributes={})
    datasets.write_dataset(vectors, tmp_path / "bad.nc")
    with pytest.raises(lfpiv.InputError, match=rf"bad\.nc.*{words}"):
        netcdf.read_vectors(tmp_path / "bad.nc")


def test_plain_xarray_opens_every_file(tmp_path):
    """Open files without engine, group or settings."""
    written, frames = (
        random_vectors(0),
        {
            name: random_volume(name == "b", residual=[0.9, 0.5], stop="iteration limit reached", units="counts")
            for name in "ab"
        },
    )
    path = tmp_path / "pair_0000.nc"
    netcdf.write_vectors(written, path, attributes={}, reconstruction=netcdf.build_reconstruction(frames))
    netcdf.write_volume(frames["a"], tmp_path / "volume.nc", attributes={})
    with xr.open_dataset(path) as opened:
        xr.testing.assert_equal(opened.load(), written)
        assert {name: opened[name].attrs.get("units", "1") for name in netcdf.VECTOR_UNITS} == netcdf.VECTOR_UNITS
        assert opened.valid.dtype == bool and opened.valid.attrs["flag_meanings"] == "replaced measured"
        assert [opened[axis].attrs["axis"] + opened[axis].attrs["units"] for axis in "xyz"] == ["Xmm", "Ymm", "Zmm"]
    with xr.open_dataset(tmp_path / "volume.nc") as opened:
        np.testing.assert_array_equal(opened.intensity.values, frames["a"].values)
        assert opened.intensity.attrs["units"] == "counts" and opened.z.attrs["units"] == "mm"
    with xr.open_datatree(path) as tree:  # axes of the group have names of their own
        assert tree["reconstruction"]["projection_z"].sizes == {"frame": 2, "voxel_y": 4, "voxel_x": 5}
    xr.testing.assert_equal(netcdf.read_reconstruction(path), netcdf.build_reconstruction(frames))
