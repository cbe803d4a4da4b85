"""Exports, read back without lfpiv, hold the vectors of the run."""

import csv

import numpy as np
import pytest
import xarray as xr
from contract.command import done

import lfpiv

TEXT = 1e-6
"""Relative rounding of numbers in text and of single precision."""


def export(killed_run, tmp_path, to, **options):
    """Export into a folder of its own; return its files by name."""
    lfpiv.export_results(killed_run.out, to, out=tmp_path / "out", **options)
    return {path.relative_to(tmp_path / "out").as_posix(): path for path in sorted((tmp_path / "out").rglob("*"))}


@pytest.mark.parametrize(("to", "name"), [("netcdf", "vectors.nc"), ("zarr", "vectors.zarr")])
def test_stores_hold_all_pairs(killed_run, tmp_path, to, name):
    path = export(killed_run, tmp_path, to, interval_s=0.5)[name]
    expected = lfpiv.open_results(killed_run.out)
    with xr.open_dataset(path, engine={"netcdf": "h5netcdf", "zarr": "zarr"}[to]) as found:
        assert found.pair.values.tolist() == [0, 1]
        np.testing.assert_allclose(found.time, [0, 0.5])
        for variable in ("u", "v", "w", "displacement_z", "valid"):
            np.testing.assert_array_equal(found[variable].values, expected[variable].values, err_msg=variable)


def test_tables_hold_a_row_for_each_vector(killed_run, tmp_path):
    done("export", killed_run.out, "--to", "csv", "--out", tmp_path, "--pairs", "1")
    assert not (tmp_path / "pair_0000.csv").exists()
    with (tmp_path / "pair_0001.csv").open(encoding="utf-8", newline="") as lines:
        rows = list(csv.DictReader(lines))
    expected = lfpiv.open_results(killed_run.out).sel(pair=1).stack(place=("z", "y", "x"))
    assert len(rows) == expected.sizes["place"]
    by_place = {tuple(round(float(row[f"{axis} [mm]"]), 4) for axis in "zyx"): row for row in rows}
    for number, place in enumerate(expected.place.values):
        row = by_place[tuple(round(float(at), 4) for at in place)]
        for name in "uvw":
            assert float(row[f"{name} [m/s]"]) == pytest.approx(float(expected[name][number]), rel=TEXT)


def test_images_for_paraview_hold_vectors_and_volumes(killed_run, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    files = export(killed_run, tmp_path, "vti")
    reader = pyvista.get_reader(files["vectors.pvd"])
    reader.set_active_time_value(reader.time_values[0])
    image = reader.read()[0]
    expected = lfpiv.open_results(killed_run.out).sel(pair=0)
    velocity = np.asarray(image.point_data["velocity"]).reshape(*expected.u.shape, 3)
    np.testing.assert_array_equal(velocity, np.stack([expected[name] for name in "uvw"], axis=-1))
    assert {"volumes_a.pvd", "volumes_b.pvd"} <= set(files)


def test_particles_for_paraview(killed_run, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    files = export(killed_run, tmp_path, "vtp")
    expected = lfpiv.open_particles(killed_run.out, pairs=(0, 1))
    points = pyvista.read(next(path for name, path in files.items() if name.endswith("0000.vtp"))).points
    np.testing.assert_allclose(points, np.stack([expected[axis] for axis in "xyz"], axis=1), rtol=TEXT, atol=TEXT)


def test_planes_for_pivpy(killed_run, tmp_path):
    files = export(killed_run, tmp_path, "pivpy", depth_mm=0.0)
    path = next(path for name, path in files.items() if name.endswith(".nc"))
    expected = lfpiv.open_results(killed_run.out)
    with xr.open_dataset(path, engine="h5netcdf") as found:
        assert {"u", "v"} <= set(found.variables)
        assert sorted(found.sizes[name] for name in ("x", "y")) == sorted(expected.sizes[name] for name in "xy")
