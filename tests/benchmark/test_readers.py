"""Vectors in forms of other programs are read right, and whatever is missing or ambiguous is one clear message."""

import tracemalloc

import h5py
import numpy as np
import pytest
import xarray as xr
from support import known_truth

from lfpiv.benchmark.plain_truth import flow_truth
from lfpiv.benchmark.readers import ReadOptions, read_result
from lfpiv.benchmark.score import ScoreOptions, score_results
from lfpiv.errors import InputError

OPTIONS = {"resamples": 4}


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return known_truth.write_truth(tmp_path_factory.mktemp("known") / "data")


def error_of(truth, path, reading=None, **options):
    """Return the mean error and the completeness."""
    chosen = ScoreOptions(reading=reading or ReadOptions(), **(OPTIONS | options))
    (score,) = score_results(truth, [path], chosen)
    return score.figures["error"].value, score.figures["completeness"].value


def stranger(truth, pair):
    """Return true vectors as another program has them: vx, vy, vz in mm/s, metres, axes (x, z, y), y falling, gaps."""
    vectors = known_truth.true_vectors(truth, pair)
    renamed = vectors.rename(u="vx", v="vy", w="vz").transpose("x", "z", "y").isel(y=slice(None, None, -1))
    for name in ("vx", "vy", "vz"):
        renamed[name] = (renamed[name].dims, 1000 * renamed[name].values, {"units": "mm/s"})
    for axis in "xyz":
        renamed[axis] = (axis, renamed[axis].values / 1000, {"units": "m"})
    values = renamed["vx"].values.copy()
    values[0] = np.nan
    renamed["vx"] = (renamed["vx"].dims, values, {"units": "mm/s", "_FillValue": -9999.0})
    return renamed


def test_a_strangers_netcdf_is_scored_right(truth, tmp_path):
    path = known_truth.write_pairs(tmp_path / "result", [stranger(truth, pair) for pair in truth.numbers])
    error, completeness = error_of(truth, path)
    assert error < 1e-5  # metres in the coordinates are rounded
    assert completeness == pytest.approx(1 - 0.5 / 7, abs=0.02)  # half a cell of the eight along x lies inside


def test_pairs_in_one_file_along_any_dimension(truth, tmp_path):
    both = xr.concat([known_truth.true_vectors(truth, pair) for pair in truth.numbers], "frame")
    both.to_netcdf(tmp_path / "stack.nc", engine="h5netcdf")
    assert error_of(truth, tmp_path / "stack.nc") == pytest.approx((0, 1), abs=1e-9)
    reverse = both.isel(frame=[1, 0]).rename(frame="pair").assign_coords(pair=[1, 0])
    reverse.to_netcdf(tmp_path / "reverse.nc", engine="h5netcdf")
    assert error_of(truth, tmp_path / "reverse.nc") == pytest.approx((0, 1), abs=1e-9)


def test_netcdf3_and_the_benchmarks_own_form_of_the_truth(truth, tmp_path):
    known_truth.true_vectors(truth, 0).to_netcdf(tmp_path / "classic_0.nc", engine="scipy")
    assert error_of(truth, tmp_path / "classic_0.nc", pairs=(0, 1))[0] < 1e-9
    flow_truth(truth.scene).to_netcdf(tmp_path / "flow.nc", engine="h5netcdf")
    assert error_of(truth, tmp_path / "flow.nc") == pytest.approx((0, 1), abs=1e-9)


def test_displacements_in_voxels_take_the_voxel_of_the_file(truth, tmp_path):
    vectors = known_truth.true_vectors(truth, 0)
    for name, axis in zip("uvw", "xyz", strict=True):
        moved = vectors[name].values * 1000 * truth.scene.dt_s / 0.05
        vectors[f"d{axis}"] = (vectors[name].dims, moved, {"units": "voxel"})
    fine = vectors.drop_vars(["u", "v", "w"]).assign_attrs(voxel_mm=0.05)
    path = known_truth.write_pairs(tmp_path / "fine", [fine])
    assert error_of(truth, path, pairs=(0, 1))[0] < 1e-9
    unknown = known_truth.write_pairs(tmp_path / "unknown", [fine.drop_attrs(deep=False)])
    (field,) = read_result(unknown, truth)
    assert "voxels are taken to be the data set's" in field.notes[0]


def write_table(truth, path, *, head, separator=",", decimal=".", keep=lambda x: x == x, pairs=(0,)):
    lines = [head]
    for pair in pairs:
        vectors = known_truth.true_vectors(truth, pair)
        frame = vectors.to_dataframe().reset_index()
        for row in frame[keep(frame["x"])].itertuples():
            values = [row.x, row.y, row.z, row.u, row.v, row.w] + ([pair] if len(pairs) > 1 else [])
            lines.append(separator.join(f"{value:.9g}".replace(".", decimal) for value in values))
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return path


@pytest.mark.parametrize(
    ("head", "separator", "decimal"),
    [
        ("x [mm],y [mm],z [mm],u [m/s],v [m/s],w [m/s]", ",", "."),
        ("x_mm;y_mm;z_mm;Vx (m/s);Vy (m/s);Vz (m/s)", ";", ","),
        ("# x_mm y_mm z_mm u v w", " ", "."),
        ('"x [mm]"\t"y [mm]"\t"z [mm]"\t"velocity_x [m s-1]"\t"velocity_y [m s-1]"\t"velocity_z [m s-1]"', "\t", "."),
    ],
    ids=["comma", "semicolon", "blanks", "tab"],
)
def test_tables_of_any_kind(truth, tmp_path, head, separator, decimal):
    path = write_table(truth, tmp_path / "table_0.csv", head=head, separator=separator, decimal=decimal)
    reading = ReadOptions(units={} if "s" in head.lower().split("mm")[-1] else {"velocity": "m/s"})
    error, completeness = error_of(truth, path, reading, pairs=(0, 1))
    assert error < 1e-6 and completeness == pytest.approx(1)


def test_a_table_that_lacks_the_rows_of_a_half_is_half_complete(truth, tmp_path):
    head = "x [mm],y [mm],z [mm],u [m/s],v [m/s],w [m/s],pair"
    path = write_table(truth, tmp_path / "half.csv", head=head, keep=lambda x: x < 0, pairs=truth.numbers)
    assert error_of(truth, path) == pytest.approx((0, 0.5), abs=0.01)


def test_every_second_row_missing_is_half_complete_too(truth, tmp_path):
    vectors = known_truth.true_vectors(truth, 0)
    order = np.arange(vectors["u"].size).reshape(vectors["u"].shape)
    kept = xr.DataArray(order % 2 == 0, dims=("z", "y", "x"))
    path = known_truth.write_pairs(tmp_path / "result", [vectors.where(kept)])
    assert error_of(truth, path, pairs=(0, 1))[1] == pytest.approx(0.5, abs=0.03)


def test_what_a_file_does_not_say_is_asked_for(truth, tmp_path):
    vectors = known_truth.true_vectors(truth, 0)

    def refused(dataset, match, reading=None, name="result.nc"):
        dataset.to_netcdf(tmp_path / name, engine="h5netcdf")
        with pytest.raises(InputError, match=match):
            read_result(tmp_path / name, truth, reading)

    refused(vectors, "the number of the pair, one of 2, found none. State it by --number")
    one = vectors.assign_attrs(pair=0)
    refused(one.assign(vx=one["u"]), "one variable for u, found u, vx. Choose one by --name u=NAME")
    refused(one.rename(w="third"), "the velocity w, found .*third.* Name it by --name w=NAME")
    refused(one.drop_vars("z"), "the position z")
    refused(one, "the variable 'speed' of --name u", ReadOptions(names={"u": "speed"}))
    bare = one.copy()
    bare["u"] = (bare["u"].dims, bare["u"].values)
    refused(bare, "the unit of 'u', found none. State it by --unit velocity=UNIT")
    bare["u"].attrs["units"] = "furlong"
    refused(bare, "u: expected it in m/s, mm/s, mm, m or voxel, found the unit 'furlong'")
    refused(one.assign_attrs(pair=7), "pair 0 to 1 of the data set, found 7")
    refused(one.expand_dims(a=2, b=2), "one dimension beside those of x, y and z, .* found a, b")


@pytest.mark.parametrize("storage", ["sparse", "inflating"])
def test_a_file_that_grows_in_memory_is_not_read(truth, tmp_path, storage):
    with h5py.File(tmp_path / "result_0.nc", "w") as file:
        for name in ("x", "y", "z", "u", "v", "w"):
            file.create_dataset(name, (1 << 28,), "f8", chunks=(1 << 20,), compression="gzip")
            if storage == "inflating":
                file[name][: 1 << 20] = 0
    tracemalloc.start()
    with pytest.raises(InputError, match=r"bytes declare [\d,]+ values"):
        read_result(tmp_path / "result_0.nc", truth)
    assert tracemalloc.get_traced_memory()[1] < 1 << 26
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("name", "value"),
    [("pair", "first"), ("voxel_mm", "small"), ("window_mm", [1.0, 2.0]), ("seconds", "long"), ("memory_mib", np.nan)],
)
def test_attributes_of_another_form_are_named(truth, tmp_path, name, value):
    vectors = known_truth.true_vectors(truth, 0).assign_attrs(pair=0).assign_attrs({name: value})
    vectors.to_netcdf(tmp_path / "result.nc", engine="h5netcdf")
    with pytest.raises(InputError, match=f"result.nc: expected .*{name}"):
        read_result(tmp_path / "result.nc", truth)


def test_given_names_and_units_are_used(truth, tmp_path):
    vectors = known_truth.true_vectors(truth, 0).rename(u="first", v="second", w="third", x="east")
    for name in ("first", "second", "third"):
        del vectors[name].attrs["units"]
    path = known_truth.write_pairs(tmp_path / "result", [vectors])
    reading = ReadOptions(
        names={"u": "first", "v": "second", "w": "third", "x": "east"}, units={"velocity": "m s^-1"}, number=0
    )
    assert error_of(truth, path, reading, pairs=(0, 1))[0] < 1e-9


def test_bad_files_and_folders_are_refused(truth, tmp_path):
    (tmp_path / "damaged_0.nc").write_bytes(b"\x89HDF\r\n\x1a\n and nothing more")
    (tmp_path / "words.csv").write_text("these are words,1,2,3\n", "utf-8")
    (tmp_path / "empty_0.csv").write_text("x [mm],y [mm],z [mm],u [m/s],v [m/s],w [m/s]\n", "utf-8")
    (tmp_path / "text_0.csv").write_text("x [mm],y [mm],z [mm],u [m/s],v [m/s],w [m/s]\na,b,c,d,e,f\n", "utf-8")
    (tmp_path / "none").mkdir()
    for name, match in [
        ("damaged_0.nc", "cannot be read"),
        ("words.csv", "titles of six or more columns"),
        ("empty_0.csv", "rows below the titles"),
        ("text_0.csv", "numbers in the column 'x'"),
        ("none", "files of vectors"),
        ("absent", "nothing of that name"),
    ]:
        with pytest.raises(InputError, match=match) as caught:
            read_result(tmp_path / name, truth)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="found both"):
        read_result(tmp_path, truth)


def test_files_in_a_folder_are_the_pairs_in_their_order(truth, tmp_path):
    folder = known_truth.write_pairs(
        tmp_path / "result", [known_truth.true_vectors(truth, pair) for pair in truth.numbers]
    )
    for pair, name in ((1, "run_2.nc"), (0, "run_1.nc")):  # counted from 1
        (folder / f"pair_{pair:04d}.nc").rename(folder / name)
    assert error_of(truth, folder) == pytest.approx((0, 1), abs=1e-9)
    (folder / "run_2.nc").rename(folder / "run_7.nc")
    (folder / "run_1.nc").unlink()
    with pytest.raises(InputError, match="number of the pair"):
        read_result(folder, truth)
