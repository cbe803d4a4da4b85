"""NetCDF files of vectors and volumes: read back as written, other forms refused."""

import json

import numpy as np
import pytest
import xarray as xr
from support.stored import rewrite
from support.vector_sets import random_vectors, random_volume

from lfpiv.errors import InputError
from lfpiv.results import netcdf, provenance
from lfpiv.results.pair_files import FrameRecord, FrameVolume, PairVolumes, VolumeFile
from lfpiv.warn import Code, Warning


def volume(seed, residual):
    return random_volume(seed, residual=residual, stop="iteration limit reached")


def test_vectors_and_volumes_come_back_as_written(tmp_path):
    written, pair = random_vectors(0), {"a": volume(1, [0.9, 0.5, 0.4]), "b": volume(2, [0.8, 0.6])}
    path = tmp_path / "pair_0000.nc"
    reconstruction = netcdf.build_reconstruction(pair)
    attributes = {"settings_hash": "0123", "smart": {"iterations": 2}}
    netcdf.write_vectors(written, path, attributes=attributes, reconstruction=reconstruction)
    back = netcdf.read_vectors(path)
    xr.testing.assert_equal(back, written)
    assert back["valid"].dtype == bool and back["w"].attrs["units"] == "m/s"
    assert provenance.read_marks(path) == provenance.Marks(settings_hash="0123")
    assert json.loads(back.attrs["smart"]) == {"iterations": 2}
    condensed = netcdf.read_reconstruction(path)
    np.testing.assert_array_equal(condensed["projection_y"].values[1], pair["b"].values.max(1))
    profile = pair["b"].values.mean((1, 2))
    np.testing.assert_allclose(condensed["profile_z"].sel(frame="b"), profile, rtol=1e-6)  # single precision
    np.testing.assert_array_equal(condensed["residual"].values, [[0.9, 0.5, 0.4], [0.8, 0.6, np.nan]])
    netcdf.write_volume(pair["a"], tmp_path / "volume.nc", attributes={"settings_hash": "4567"})
    again = netcdf.read_volume(tmp_path / "volume.nc")
    xr.testing.assert_equal(again, pair["a"])
    xr.testing.assert_equal(netcdf.build_reconstruction({"a": again, "b": pair["b"]}), reconstruction)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["pair_0000.nc", "volume.nc"]


def test_flags_that_are_no_flags_are_refused(tmp_path):
    """Reading as a dataset turns every number but 0 into True."""
    path = tmp_path / "pair.nc"
    netcdf.write_vectors(random_vectors(0), path, attributes={})
    rewrite(path, lambda file: file["valid"].__setitem__(0, 7), sealed=True)
    with pytest.raises(InputError, match="other than 0 and 1"):
        netcdf.read_vectors(path)


def test_what_is_known_of_the_images_travels_with_the_volumes(tmp_path):
    volumes, records = [volume(1, [0.9, 0.5]), volume(2, [0.8, 0.6])], []
    for one, frame, values in zip(volumes, "ab", ([0.5, 0.01], [0.4, 0.6]), strict=True):
        one.attrs |= {"camera_gain": [1.0, 0.4], "light_outside": [0.25, values[1]]}
        structure = dict(zip(("left", "right"), values, strict=True))
        doubt = Warning(code=Code.SATURATED, subject=f"left, frame {frame}", figures={"share": 0.1})
        record = FrameRecord(structure=structure, warnings=(doubt,), seconds=2.0)
        records.append(FrameVolume(volume=one, record=record))
    pair, stored = PairVolumes(frames=tuple(records)), []
    for name, found in zip("ab", pair.frames, strict=True):
        file = VolumeFile(frame=(0, name), path=tmp_path / name, stamp=provenance.Stamp({"volume": 1}), origin={})
        file.write(found)
        stored.append(file.read())
    stored = PairVolumes(frames=tuple(stored))
    assert stored.records == pair.records
    condensed = stored.condensed()
    assert condensed["structure"].sel(frame="a", camera="right") == 0.01
    assert condensed["camera_gain"].sel(frame="b", camera="right") == 0.4
    assert condensed["light_outside"].sel(frame="b", camera="right") == 0.6
    xr.testing.assert_equal(condensed, pair.condensed())


def test_a_vector_file_of_another_form_is_refused(tmp_path):
    with pytest.raises(ValueError, match="peak_ratio"):
        netcdf.write_vectors(random_vectors(0).drop_vars("peak_ratio"), tmp_path / "pair.nc", attributes={})
    wrong = random_vectors(0)
    wrong["u"].attrs["units"] = "mm/s"
    with pytest.raises(ValueError, match="m/s"):
        netcdf.write_vectors(wrong, tmp_path / "pair.nc", attributes={})
    assert not any(tmp_path.iterdir())
    netcdf.write_vectors(random_vectors(0).assign_attrs(schema_version=99), tmp_path / "pair.nc", attributes={})
    with pytest.raises(InputError, match="schema version"):
        netcdf.read_vectors(tmp_path / "pair.nc")
    (tmp_path / "pair.nc").write_bytes(b"no NetCDF")
    with pytest.raises(InputError, match=r"pair\.nc"):
        netcdf.read_vectors(tmp_path / "pair.nc")
    assert provenance.read_marks(tmp_path / "pair.nc") is None
