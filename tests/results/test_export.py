"""Exports, read back by the programs that they are made for."""

import json
import logging
import os
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from support.vector_sets import DT_S, VOXEL_MM, from_flow, random_vectors, random_volume, write_run

import lfpiv
from lfpiv import derived
from lfpiv.cli import commands
from lfpiv.errors import StorageError
from lfpiv.results import export, netcdf

NUMBERS = (0, 2, 3)
SINGLE = 1e-6  # relative rounding of single precision, in which images are stored
INTERVAL_S = 0.25


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the folder of a run with the volumes of one pair, and its vectors. Tests must not change it."""
    folder = tmp_path_factory.mktemp("run")
    written = write_run(folder, NUMBERS)
    for frame in "ab":
        volume = random_volume(ord(frame), units="counts")
        netcdf.write_volume(volume, folder / "volumes" / f"pair_0002_{frame}.nc", attributes={})
    return folder, written


def at_points(image, name):
    """Return an array of a VTK image as (z, y, x[, component])."""
    values = np.asarray(image.point_data[name])
    return values.reshape(*image.dimensions[::-1], *values.shape[1:])


def test_paraview_images_hold_the_vectors_at_their_places(run, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    folder, written = run
    collections = lfpiv.export_results(folder, "vti", out=tmp_path, interval_s=INTERVAL_S)
    assert [path.name for path in collections] == ["vectors.pvd", "volumes_a.pvd", "volumes_b.pvd"]
    reader = pyvista.get_reader(collections[0])
    assert list(reader.time_values) == [INTERVAL_S * number for number in NUMBERS]
    for number, time in zip(NUMBERS, reader.time_values, strict=True):
        reader.set_active_time_value(time)
        image, vectors = reader.read()[0], written[number]
        z, y, x = np.meshgrid(*(vectors[axis] for axis in "zyx"), indexing="ij")
        assert np.allclose(np.asarray(image.points).reshape(*x.shape, 3), np.stack([x, y, z], -1), rtol=SINGLE)
        for name, parts in (("velocity", "uvw"), ("displacement", [f"displacement_{axis}" for axis in "xyz"])):
            np.testing.assert_array_equal(at_points(image, name), np.stack([vectors[part] for part in parts], -1))
        np.testing.assert_array_equal(at_points(image, "valid"), vectors.valid)
        np.testing.assert_array_equal(at_points(image, "uncertainty"), vectors.uncertainty)
        curl = derived.vorticity(vectors)
        expected = np.stack([curl[f"vorticity_{axis}"] for axis in "xyz"], -1)
        assert np.allclose(at_points(image, "vorticity"), expected, rtol=SINGLE, atol=SINGLE * np.abs(expected).max())
        assert np.allclose(at_points(image, "q_criterion"), derived.q_criterion(vectors), rtol=SINGLE)
    volumes = pyvista.get_reader(collections[2])
    assert list(volumes.time_values) == [2 * INTERVAL_S]
    stored = netcdf.read_volume(folder / "volumes" / "pair_0002_b.nc")
    image = volumes.read()[0]
    np.testing.assert_array_equal(at_points(image, "intensity"), stored.values)
    assert np.allclose(image.origin, 0.0) and np.allclose(image.spacing, 0.1)


def test_a_single_layer_of_vectors_is_an_image_too(tmp_path):
    pyvista = pytest.importorskip("pyvista")
    written = write_run(tmp_path, (0,), shape=(1, 5, 6))
    lfpiv.export_results(tmp_path, "vti")
    image = pyvista.read(tmp_path / "export" / "pair_0000.vti")
    assert image.dimensions == (6, 5, 1) and "vorticity" not in image.point_data and image.spacing[2] > 0
    np.testing.assert_array_equal(at_points(image, "valid"), written[0].valid)


def test_volumes_of_other_settings_are_not_exported(tmp_path, caplog):
    def depends_on(voxel_mm, images, **more):
        return json.dumps({"volume": {"voxel_mm": voxel_mm}, "calibration": "cafe", "images": images, **more})

    images = {0: [["a.tif", 7, 1]], 1: [["a.tif", 7, 2]], 2: [["a.tif", 7, 3]], 3: None}
    for number, kept in images.items():  # vectors of one voxel size, of images that are gone by now for the last pair
        write_run(tmp_path, (number,), depends_on=depends_on(0.08, kept, correlation={"overlap": 0.5}))
    made = {0: (0.08, images[0]), 1: (0.1, images[1]), 2: (0.08, [["a.tif", 7, 9]]), 3: (0.08, [["a.tif", 7, 4]])}
    for number, stamp in made.items():
        for frame in "ab":
            path = tmp_path / "volumes" / f"pair_{number:04d}_{frame}.nc"
            netcdf.write_volume(random_volume(0), path, attributes={"depends_on": depends_on(*stamp)})
    with caplog.at_level(logging.WARNING):
        lfpiv.export_results(tmp_path, "vti", out=tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").glob("volume_*.vti")} == {
        f"volume_{number:04d}_{frame}.vti" for number in (0, 3) for frame in "ab"
    }
    listed = (tmp_path / "out" / "volumes_b.pvd").read_text()
    assert "volume_0003_b.vti" in listed and "volume_0001_b.vti" not in listed
    names = "pair_0001_a.nc, pair_0001_b.nc, pair_0002_a.nc, pair_0002_b.nc"
    assert f"{names}: left out, made with other settings" in caplog.text and "--keep-volumes" in caplog.text


def test_tecplots_text_holds_the_vectors_at_their_places(run, tmp_path):
    """A reader of another program finds an ordered zone; it does not read times, and writes _ for /."""
    pyvista = pytest.importorskip("pyvista")
    folder, written = run
    paths = lfpiv.export_results(folder, "tecplot", out=tmp_path, interval_s=INTERVAL_S)
    assert [path.name for path in paths] == [f"pair_{number:04d}.dat" for number in NUMBERS]
    for number, path in zip(NUMBERS, paths, strict=True):
        assert f"SOLUTIONTIME={INTERVAL_S * number:g}\n" in path.read_text()
        zone, vectors = pyvista.get_reader(path).read()[0], written[number]
        z, y, x = np.meshgrid(*(vectors[axis] for axis in "zyx"), indexing="ij")
        assert np.allclose(np.asarray(zone.points).reshape(*x.shape, 3), np.stack([x, y, z], -1), rtol=SINGLE)
        for title, name in (("u [m_s]", "u"), ("displacement_z [voxel]", "displacement_z"), ("valid", "valid")):
            np.testing.assert_allclose(at_points(zone, title), vectors[name], rtol=SINGLE)


def test_tecplots_text_has_no_nan_and_says_so(tmp_path):
    (vectors,) = write_run(tmp_path, [0]).values()
    gap = vectors.copy(deep=True)
    gap["uncertainty"].values[0, 1, 2] = np.nan
    netcdf.write_vectors(gap, tmp_path / "vectors" / "pair_0000.nc", attributes={"pair": 0})
    done = export.export(tmp_path, "tecplot")
    assert "nan" not in done.files[0].read_text().lower()
    assert [one.what for one in done.left_out] == [("NaN of uncertainty",)]


def test_planes_have_the_form_pivpy_reads(run, tmp_path):
    folder, written = run
    paths = lfpiv.export_results(folder, "pivpy", out=tmp_path)
    assert len(paths) == written[0].sizes["z"]
    with xr.open_dataset(paths[1]) as plane:
        assert plane.u.dims == plane.v.dims == plane.chc.dims == ("y", "x", "t")
        assert plane.u.attrs["units"] == "mm/s" and plane.x.attrs["units"] == "mm" and plane.t.attrs["units"] == "frame"
        assert plane.attrs["delta_t"] == 1e-3 and plane.t.values.tolist() == list(NUMBERS)
        for index, number in enumerate(NUMBERS):
            layer = written[number].isel(z=1)
            assert np.allclose(plane.v.isel(t=index), 1e3 * layer.v, rtol=SINGLE)
            np.testing.assert_array_equal(plane.chc.isel(t=index), layer.valid)
        assert float(plane.z) == float(written[0].z[1])


def test_pivpy_computes_with_the_planes(tmp_path):
    pytest.importorskip("pivpy", reason="pivpy is not installed; its form is tested without it")
    from pivpy import io, schema

    rates = np.array([[1.0, 2.0, 0.0], [-3.0, 4.0, 0.0], [0.0, 0.0, 0.0]])  # velocity gradient [1/s]
    flow = from_flow(lambda x, y, z: np.tensordot(rates, np.stack([x, y, z]), 1))
    for number in range(3):
        vectors = random_vectors(number)
        for name, axis in zip("uvw", "xyz", strict=True):
            vectors[name].values = flow[name]
            vectors[f"displacement_{axis}"].values = flow[name] * DT_S / (1e-3 * VOXEL_MM)
        path = tmp_path / "vectors" / f"pair_{number:04d}.nc"
        netcdf.write_vectors(vectors, path, attributes={})
    (path,) = lfpiv.export_results(tmp_path, "pivpy", depth_mm=float(flow.z[2]) + 0.1)
    with xr.open_dataset(path) as plane:
        schema.validate(plane)
        plane = plane.load()
    for data in (plane, io.read_piv(path)):
        vorticity = data.piv.vorticity(name="curl")["curl"]
        assert np.allclose(vorticity, rates[1, 0] - rates[0, 1], rtol=1e-4)
        assert np.allclose(data.piv.divergence(name="source")["source"], rates[0, 0] + rates[1, 1], rtol=1e-4)
        assert data.piv.average.u.shape[:2] == (5, 6)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"to": "xlsx"}, "to: expected one of vti, netcdf, zarr, csv, tecplot, vtp, pivpy, found 'xlsx'"),
        ({"to": "csv", "depth_mm": 0.0}, "depth: expected with pivpy only"),
        ({"to": "pivpy", "depth_mm": 9.0}, "depth: expected a z among the vectors, -1 to 0.8 mm, found 9 mm"),
        ({"to": "pivpy", "depth_mm": float("nan")}, "depth: .*found nan"),
        ({"to": "vti", "interval_s": 0.0}, "interval: expected a time above 0 s"),
        ({"to": "vti", "pairs": (9, None)}, "found pairs 0 to 3"),
        ({"to": "csv", "out": "file"}, "expected an output folder that can be written"),
    ],
)
def test_bad_arguments_are_one_message_and_leave_nothing(run, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("not a folder")
    with pytest.raises(lfpiv.InputError, match=words):
        lfpiv.export_results(run[0], **{"out": "out", **arguments})
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.slow(but="netcdf")
@pytest.mark.parametrize("to", ["vti", "netcdf", "csv", "tecplot", "pivpy"])
def test_a_failure_leaves_earlier_files_whole(run, tmp_path, monkeypatch, to):
    folder, _ = run
    (tmp_path / "new").mkdir()
    first = lfpiv.export_results(folder, to, out=tmp_path / "old")
    before = {path.name: path.read_bytes() for path in (tmp_path / "old").iterdir()}
    assert set(first) <= set((tmp_path / "old").iterdir())

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)  # the last step of every writer
    for name in ("old", "new"):
        with pytest.raises(StorageError, match=r"(?i)cannot be written: no space left"):
            lfpiv.export_results(folder, to, out=tmp_path / name)
    assert {path.name: path.read_bytes() for path in (tmp_path / "old").iterdir()} == before
    assert not any((tmp_path / "new").iterdir())


def test_the_command_writes_and_prints_the_path(run, tmp_path, capfd):
    folder, _ = run
    assert commands.call(["export", str(folder), "--to", "csv", "--out", str(tmp_path / "a"), "--pairs", "0:3"]) == 0
    assert capfd.readouterr().out == f"export: 2 files in {tmp_path / 'a'}\n"
    plane = ["export", str(folder), "--to", "pivpy", "--out", str(tmp_path / "a"), "--depth", "-0.9", "--interval", "2"]
    assert commands.call(plane) == 0
    message = capfd.readouterr().out
    path = Path(message.removeprefix("export: ").strip())
    with xr.open_dataset(path) as opened:
        assert opened.t.values.tolist() == [0, 4, 6] and float(opened.z) == -1.0
    for wrong, word in (([str(tmp_path), "--to", "csv"], "no vectors"), ([str(folder), "--to", "xls"], "--to")):
        assert commands.call(["export", *wrong]) == 2
        message = capfd.readouterr().err
        assert message.count("\n") == 1 and word in message


THIN = (2, 5, 1)


@pytest.mark.parametrize("to", [form.name.lower() for form in export.Format if form.name != "VTP"])
def test_what_an_export_leaves_out_is_logged_and_in_the_result(to, tmp_path, capfd):
    """Everything that a file lacks of the vectors and their derivatives is named, and nothing that it has."""
    if to == "zarr":
        pytest.importorskip("zarr")
    write_run(tmp_path, [0], shape=THIN)
    assert commands.call(["export", str(tmp_path), "--to", to, "--json"]) == 0
    said = capfd.readouterr()
    result = json.loads(said.out)
    named = {name: one["why"] for one in result["left_out"] for name in one["what"]}
    if to == "vti":
        assert set(named) == {"vorticity", "q_criterion"} and "2 along z" in named["vorticity"]
        assert "1 along x" in named["vorticity"] and "along y" not in named["vorticity"]
        image = next((tmp_path / "export").glob("*.vti")).read_bytes()
        assert b"vorticity" not in image and b"velocity" in image
    elif to == "pivpy":
        assert set(named) == set(netcdf.VECTOR_UNITS) - {"u", "v", "w", "valid"}
    elif to == "tecplot":
        assert set(named) == {"NaN of uncertainty"}
    else:
        assert not named
    assert all(name in said.err for name in named)


def test_nothing_is_left_out_of_images_of_enough_vectors(run, tmp_path):
    assert not export.export(run[0], "vti", out=tmp_path).left_out
