"""The table of tracks of a run: written, read, refused, exported."""

import csv
from xml.etree import ElementTree

import numpy as np
import pytest
import xarray as xr

import lfpiv
from lfpiv.errors import InputError
from lfpiv.results import tables, track_files
from lfpiv.results.provenance import Stamp


def table(lengths=(4, 5, 1)):
    """Tracks of given lengths; the last one is left out."""
    track = np.repeat(np.arange(len(lengths)), lengths)
    rng, data = np.random.default_rng(0), {}
    for name, unit in track_files.TRACK_UNITS.items():
        data[name] = ("particle", rng.random(len(track)), {"units": unit})
    for name, values in (("track", track), ("valid", track < len(lengths) - 1)):
        data[name] = ("particle", values, {"units": "1"})
    return xr.Dataset(data, attrs={"tracks": len(lengths) - 1, "error_factor": [1.0, 1.0, 2.0]})


@pytest.fixture
def folder(tmp_path):
    track_files.write_tracks(table(), tmp_path / "tracks.nc", stamp=Stamp({"tracks": [0, 1]}))
    return tmp_path


def test_a_table_comes_back_with_its_figures(folder):
    found = lfpiv.open_tracks(folder)
    xr.testing.assert_allclose(found.drop_attrs(), table().drop_attrs())
    figures = track_files.track_figures(folder / "tracks.nc")
    assert figures == {"tracks": 2, "rows": 9, "left_out": 1, "error_factor": [1.0, 1.0, 2.0]}
    assert track_files.track_figures(folder / "none.nc") is None


def test_a_folder_without_tracks_is_named(tmp_path):
    with pytest.raises(InputError, match="tracking"):
        lfpiv.open_tracks(tmp_path)


def test_damage_and_another_form_are_noticed(folder):
    with pytest.raises(ValueError, match="'w'"):
        track_files.write_tracks(table().drop_vars("w"), folder / "tracks.nc", stamp=Stamp({}))
    path = folder / "tracks.nc"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"tracks\.nc"):
        lfpiv.open_tracks(folder)


def test_text_and_lines_hold_the_table(tmp_path):
    wanted = table()
    tables.write_columns(wanted.to_dataframe(), tmp_path / "a.csv", track_files.TRACK_UNITS)
    rows = list(csv.DictReader((tmp_path / "a.csv").open()))
    assert len(rows) == 10 and np.allclose(
        [float(row["acceleration_x [m/s2]"]) for row in rows], wanted["acceleration_x"]
    )
    track_files.write_track_vtp(wanted, tmp_path / "a.vtp")
    root = ElementTree.parse(tmp_path / "a.vtp").getroot()
    arrays = {one.get("Name"): np.array(one.text.split(), float) for one in root.iter("DataArray")}
    assert np.allclose(arrays["position"].reshape(-1, 3)[:, 2], wanted["z"][:9])
    assert arrays["offsets"].tolist() == [4, 9] and arrays["connectivity"].tolist() == list(range(9))
    assert root.find("PolyData/Piece").get("NumberOfLines") == "2"
