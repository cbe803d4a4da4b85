"""Every file says which program wrote it, and when, after the CF conventions where they apply; vectors come first."""

import json
import re
from pathlib import Path

import h5py
import pytest
import xarray as xr
from support.vector_sets import write_run

import lfpiv
from lfpiv import version
from lfpiv.results import datasets, tables

LINE = rf"\d{{4}}-\d\d-\d\dT\d\d:\d\d:\d\dZ lfpiv {re.escape(lfpiv.__version__)}"
"""A line of a history."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder of a run. Tests must not change it."""
    path = tmp_path_factory.mktemp("run")
    write_run(path, (0, 2))
    return path


def assert_of_this_program(attributes):
    assert re.fullmatch(LINE, attributes["history"]) and attributes["source"] == f"lfpiv {lfpiv.__version__}"


def test_files_of_a_run_state_conventions_program_and_time(small_run):
    written = sorted(path for path in small_run.out.rglob("*") if path.suffix in (".nc", ".h5"))
    assert {path.suffix for path in written} == {".nc", ".h5"}
    for path in written:
        with h5py.File(path) as file:
            assert_of_this_program(file.attrs)
            if path.suffix == ".nc":
                assert file.attrs["Conventions"] == datasets.CONVENTIONS
                assert json.loads(file.attrs["versions"])["lfpiv"] == lfpiv.__version__
    vectors = xr.load_dataset(small_run.out / "vectors" / "pair_0000.nc", engine="h5netcdf")
    assert list(vectors)[:6] == ["u", "v", "w", "displacement_x", "displacement_y", "displacement_z"]
    assert vectors["displacement_x"].attrs["ancillary_variables"] == "uncertainty_x valid"
    assert vectors["valid"].attrs["standard_name"] == "quality_flag"
    for name, variable in vectors.variables.items():
        assert variable.attrs["long_name"], name
        assert "units" in variable.attrs or variable.dtype == bool, name
        assert set(variable.attrs.get("ancillary_variables", "").split()) <= set(vectors)
    condensed = xr.load_dataset(small_run.out / "vectors" / "pair_0000.nc", group="reconstruction", engine="h5netcdf")
    assert not {"Conventions", "history"} & set(condensed.attrs)


@pytest.mark.parametrize("form", ["netcdf", "zarr", "pivpy"])
def test_exported_datasets_do_too(folder, tmp_path, form):
    path = lfpiv.export_results(folder, form, out=tmp_path)[0]
    with xr.open_dataset(path, engine="zarr" if form == "zarr" else "h5netcdf") as dataset:
        assert_of_this_program(dataset.attrs)
        assert dataset.attrs["Conventions"] == datasets.CONVENTIONS
        assert form == "zarr" or list(dataset)[:2] == ["u", "v"]  # folders of a store have no order
    if form != "pivpy":
        assert list(lfpiv.open_results(path))[:3] == ["u", "v", "w"]


def test_files_for_paraview_have_a_comment_that_readers_pass_over(folder, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    (collection,) = lfpiv.export_results(folder, "vti", out=tmp_path)
    for path in (collection, *tmp_path.glob("*.vti")):
        assert re.search(rf"\?>\s*<!-- {LINE} -->".encode(), path.read_bytes()), path.name
    assert pyvista.read(tmp_path / "pair_0002.vti").point_data["velocity"].shape[1] == 3


def test_tables_are_described_beside_them(folder, tmp_path):
    paths = lfpiv.export_results(folder, "csv", out=tmp_path)
    about = json.loads((tmp_path / tables.DESCRIPTION).read_text("utf-8"))
    assert about["@context"] == "http://www.w3.org/ns/csvw" and re.fullmatch(LINE, about["dc:provenance"])
    assert [table["url"] for table in about["tables"]] == [path.name for path in paths]
    for path, table in zip(paths, about["tables"], strict=True):
        columns = table["tableSchema"]["columns"]
        assert path.read_text("utf-8").splitlines()[0] == ",".join(column["titles"] for column in columns)
        assert {column["name"]: column["schema:unitText"] for column in columns}["u"] == "m/s"


def test_a_file_that_is_written_again_keeps_its_history(tmp_path):
    first = xr.Dataset({"u": ("x", [1.0])}, attrs={"history": "2001-01-01T00:00:00Z another program"})
    datasets.write_dataset(first, tmp_path / "first.nc")
    with xr.open_dataset(tmp_path / "first.nc", engine="h5netcdf") as written:
        earlier, line = written.attrs["history"].splitlines()
    assert earlier == first.attrs["history"] and re.fullmatch(LINE, line)
    assert version.history("a\nb").splitlines()[:2] == ["a", "b"]


def test_a_text_that_is_no_xml_stays_as_it_is(tmp_path):
    from lfpiv.files import state_origin

    path = Path(tmp_path / "text")
    path.write_bytes(b"no declaration")
    state_origin(path)
    assert path.read_bytes() == b"no declaration"
