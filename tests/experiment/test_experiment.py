"""The experiment file, its images, and the files of a run: form, messages, whole-or-nothing writing."""

import json

import numpy as np
import pytest
import tifffile
import xarray as xr

import lfpiv
from lfpiv import files
from lfpiv.errors import InputError
from lfpiv.experiment import images
from lfpiv.experiment.experiment import ExperimentTable, open_experiment
from lfpiv.experiment.settings import Compute, Correlation, Network, Smart
from lfpiv.results import netcdf, provenance


def edit(file, old, new):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def test_experiment_says_what_its_file_says(tiny_experiment):
    experiment = open_experiment(tiny_experiment)
    assert [camera.name for camera in experiment.cameras] == ["left", "right"]
    left = experiment.camera("left")
    assert left.optics.sensor_shape == (48, 64)
    assert left.optics.pixel_mm == pytest.approx(0.01)
    assert experiment.grid.shape == (8, 12, 16)  # z, y, x
    centre = [experiment.grid.axis_mm(axis).mean() for axis in range(3)]
    assert centre == pytest.approx([0.1, 0, 0])
    assert experiment.frames == ("a", "b") and experiment.pairs == 2
    assert experiment.dark("left") is None and experiment.dark("right").shape == (56, 40)
    assert experiment.smart == Smart() and experiment.network == Network() and experiment.compute == Compute()
    assert len(experiment.calibration_paths()) == 3 + 4 and len(experiment.pair_paths(1)) == 4


@pytest.mark.sample_data
def test_sample_experiment_is_accepted(sample_data):
    experiment = open_experiment(sample_data / "ring-vortex-2cam" / "experiment.toml")
    assert experiment.grid.shape == (30, 60, 60)
    assert experiment.camera("cam1").optics.sensor_shape == (1280, 1600)


@pytest.mark.parametrize(
    ("flip", "undo"),
    [("none", lambda i: i), ("horizontal", np.fliplr), ("vertical", np.flipud), ("both", lambda i: i[::-1, ::-1])],
)
def test_flip_is_undone_in_every_image_of_the_camera(tiny_experiment, flip, undo):
    plain = open_experiment(tiny_experiment)
    edit(tiny_experiment, 'name = "left"', f'name = "left"\nimage_flip = "{flip}"')
    flipped = open_experiment(tiny_experiment)
    for read in (
        lambda e: e.white("left"),
        lambda e: e.board_image("left", 1),
        lambda e: e.particle_image("left", 1, "b"),
    ):
        image = read(flipped)
        assert image.dtype == np.float32 and image.flags.c_contiguous
        np.testing.assert_array_equal(image, undo(read(plain)))
    np.testing.assert_array_equal(flipped.white("right"), plain.white("right"))


def test_a_byte_order_mark_is_no_part_of_the_file(tiny_experiment):
    plain = open_experiment(tiny_experiment)
    tiny_experiment.write_bytes(b"\xef\xbb\xbf" + tiny_experiment.read_bytes())
    assert open_experiment(tiny_experiment) == plain


@pytest.mark.parametrize("centre", [(1.2, 0.0, 0.0), (0.0, -1.2, 0.0), (0.0, 0.0, 3.0)])
def test_a_volume_that_a_misaligned_camera_may_see_is_accepted(tiny_experiment, centre):
    """Two fields of view aside is odd, but nothing that the nominal rig could be sure of."""
    edit(tiny_experiment, "centre_mm = [0.0, 0.0, 0.1]", f"centre_mm = {list(centre)}")
    assert open_experiment(tiny_experiment).grid.size == 8 * 12 * 16


BAD_KEYS = {
    "misspelt": ("pairs = 2", "pairs = 2\n[smart]\niteration = 4", ["smart.iteration", "unknown", "'iterations'"]),
    "unknown table": ("pairs = 2", "pairs = 2\n[smarts]\n", ["smarts", "'smart'"]),
    "misspelt, so missing": ("f_number = 4.0", "fnumber = 4.0", ["camera 'left', fnumber", "'f_number'"]),
    "missing": ("dt_s = 1e-3", "", ["dt_s", "missing"]),
    "text for a number": ("f_number = 4.0", 'f_number = "four"', ["camera 'left', f_number", "a number", "'four'"]),
    "truth for a number": ("dt_s = 1e-3", "dt_s = true", ["dt_s", "a number", "true"]),
    "not a number": ("dt_s = 1e-3", "dt_s = nan", ["dt_s", "finite"]),
    "fraction": ("dots = [5, 5]", "dots = [5.5, 5]", ["board.dots[0]", "whole number", "5.5"]),
    "negative pitch": (
        "microlens_pitch_mm = 0.1",
        "microlens_pitch_mm = -0.1",
        ["microlens_pitch_mm", "above 0", "-0.1"],
    ),
    "zero size": ("size_mm = [0.8,", "size_mm = [0,", ["volume.size_mm[0]", "above 0"]),
    "less than a window": ("size_mm = [0.8,", "size_mm = [0.1,", ["volume.size_mm", "along x", "0.1 mm"]),
    "two sizes": ("size_mm = [0.8, 0.6, 0.4]", "size_mm = [0.8, 0.6]", ["volume.size_mm", "[0.8, 0.6]"]),
    "no magnification": ("magnification = -1.0", "magnification = 0", ["magnification", "other than 0"]),
    "layout": (
        'name = "left"',
        'name = "left"\nmicrolens_layout = "hex"',
        ["microlens_layout", "'hexagonal'", "'hex'"],
    ),
    "camera twice": ('name = "right"', 'name = "left"', ["camera.name", "'left'", "twice"]),
    "name leaves folder": ('name = "right"', 'name = "../right"', ["name", "'../right'"]),
    "plane twice": ("planes_mm = [-0.2, 0.2]", "planes_mm = [0.2, 0.2]", ["board.planes_mm", "different depth"]),
    "one plane": ("planes_mm = [-0.2, 0.2]", "planes_mm = [0.2]", ["board.planes_mm", "at least 2"]),
    "touching dots": ("dot_diameter_mm = 0.02", "dot_diameter_mm = 0.2", ["board", "smaller than spacing_mm"]),
    "unknown field": ("{plane:02d}", "{plan:02d}", ["board.images", "{plane}", "{plan}"]),
    "field left out": ("plane_{plane:02d}", "plane_00", ["board.images", "{plane}"]),
    "bad field format": ("{pair:04d}", "{pair:04q}", ["particles.images", "{pair}"]),
    "one frame": ("pairs = 2", 'pairs = 2\nframes = ["a", "a"]', ["particles.frames", "different"]),
    "no pairs": ("pairs = 2", "pairs = 0", ["particles.pairs", "1 or more"]),
    "big window": (
        "pairs = 2",
        "pairs = 2\n[correlation]\nwindows = [[16, 16, 16]]",
        ["correlation.windows", "16", "along z"],
    ),
    "no hidden layer": ("pairs = 2", "pairs = 2\n[network]\nhidden = []", ["network.hidden", "at least 1"]),
    "million dots": ("dots = [5, 5]", "dots = [1000000, 1000000]", ["board.dots", "1000000 x 1000000", "sees about"]),
    "tiny board": (
        "dots = [5, 5]\nspacing_mm = 0.1\ndot_diameter_mm = 0.02",
        "dots = [5, 5]\nspacing_mm = 0.001\ndot_diameter_mm = 0.0002",
        ["board.spacing_mm", "microlens", "0.001"],
    ),
    "far volume": (
        "centre_mm = [0.0, 0.0, 0.1]",
        "centre_mm = [20.0, 0.0, 0.1]",
        ["volume.centre_mm", "'left'", "(20, 0, 0.1) mm"],
    ),
    "volume behind the lens": (
        "centre_mm = [0.0, 0.0, 0.1]",
        "centre_mm = [0.0, 0.0, 1000.0]",
        ["volume.centre_mm", "behind the lens"],
    ),
    "no TOML": ("pairs = 2", "pairs = = 2", ["TOML", "line"]),
    "microlens unit": (
        "microlens_focal_length_mm = 0.8",
        "microlens_focal_length_mm = 800.0",
        ["camera 'left', microlens_focal_length_mm", "200 mm", "800", "in mm"],
    ),
    "lens unit": (
        "\nfocal_length_mm = 100.0",
        "\nfocal_length_mm = 0.1",
        ["camera 'left', microlens_focal_length_mm", "0.2 mm", "focal_length_mm in mm"],
    ),
    "pixel unit": ("pixel_um = 10.0", "pixel_um = 0.01", ["microlens_pitch_mm", "pixel_um"]),
}


@pytest.mark.parametrize("case", BAD_KEYS)
def test_bad_key_is_named_with_what_was_expected(tiny_experiment, case):
    old, new, words = BAD_KEYS[case]
    edit(tiny_experiment, old, new)
    with pytest.raises(InputError) as caught:
        open_experiment(tiny_experiment)
    message = str(caught.value)
    assert all(word in message for word in [tiny_experiment.name, *words]), message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("encoding", "words"), [("latin-1", "0xb5 in line 2"), ("utf-16", "found UTF-16"), ("utf-8-sig", "")]
)
def test_text_of_another_encoding_is_named(tiny_experiment, encoding, words):
    text = tiny_experiment.read_text("utf-8")
    tiny_experiment.write_bytes(f"\n# pixels of 5.5 µm\n{text}".replace("\n", "\r\n").encode(encoding))
    if words:
        with pytest.raises(InputError, match=rf"experiment\.toml.*UTF-8.*{words}.*Save it as UTF-8"):
            open_experiment(tiny_experiment)
    else:  # the mark and the line ends of Windows do no harm
        assert open_experiment(tiny_experiment).name == "tiny"


@pytest.mark.parametrize("model", [ExperimentTable, Smart, Correlation, Network, Compute])
def test_every_misspelt_key_finds_its_own(tiny_experiment, model):
    """A key with its last letter lost is answered with the right one, in every table."""
    for key in model.model_fields:
        text = {Smart: "[smart]", Correlation: "[correlation]", Network: "[network]", Compute: "[compute]"}.get(
            model, ""
        )
        file = tiny_experiment.with_name("misspelt.toml")
        line = f"{key[:-1]} = 1\n"
        file.write_text(
            line + tiny_experiment.read_text() if not text else f"{tiny_experiment.read_text()}\n{text}\n{line}"
        )
        with pytest.raises(InputError, match=f"Did you mean '{key}'"):
            open_experiment(file)


BAD_IMAGES = {
    "missing white": ("white/left.tif", lambda path: path.unlink(), ["white_image of camera 'left'", "no such file"]),
    "missing plane": (
        "board/right/plane_01.tif",
        lambda path: path.unlink(),
        ["board.images", "plane 1", "no such file"],
    ),
    "missing frame": (
        "particles/left/0001b.tif",
        lambda path: path.unlink(),
        ["particles.images", "pair 1", "no such"],
    ),
    "other shape": (
        "particles/left/0001a.tif",
        lambda path: tifffile.imwrite(path, np.ones((48, 63), np.uint16)),
        ["(48, 64)", "(48, 63)", "white"],
    ),
    "other dtype": (
        "board/left/plane_00.tif",
        lambda path: tifffile.imwrite(path, np.ones((48, 64), np.complex64)),
        ["uint16", "complex64"],
    ),
    "colour": (
        "board/left/plane_00.tif",
        lambda path: tifffile.imwrite(path, np.ones((48, 64, 3), np.uint8), photometric="rgb"),
        ["single-channel", "colour"],
    ),
    "two pages": (
        "particles/right/0000a.tif",
        lambda path: tifffile.imwrite(path, np.ones((2, 56, 40), np.uint8), photometric="minisblack"),
        ["one", "2 pages"],
    ),
    "black white image": (
        "white/right.tif",
        lambda path: tifffile.imwrite(path, np.zeros((56, 40), np.uint16)),
        ["white_image of camera 'right'", "all black"],
    ),
    "black board": (
        "board/left/plane_01.tif",
        lambda path: tifffile.imwrite(path, np.zeros((48, 64), np.uint16)),
        ["plane 1", "all black"],
    ),
    "black particles": (
        "particles/left/0001b.tif",
        lambda path: tifffile.imwrite(path, np.zeros((48, 64), np.uint16)),
        ["pair 1", "all black"],
    ),
    "dark brighter than white": (
        "dark/right.tif",
        lambda path: tifffile.imwrite(path, np.full((56, 40), 5000, np.uint16)),
        ["white", "brighter than the dark"],
    ),
    "infinite counts": (
        "white/left.tif",
        lambda path: tifffile.imwrite(path, np.full((48, 64), np.inf, np.float32)),
        ["finite"],
    ),
    "empty file": ("board/left/plane_00.tif", lambda path: path.write_bytes(b""), ["truncated", "empty"]),
    "no image": ("board/left/plane_00.tif", lambda path: path.write_text("text"), ["truncated or damaged"]),
}


@pytest.mark.parametrize("case", BAD_IMAGES)
def test_bad_image_is_named_with_what_was_expected(tiny_experiment, case):
    name, spoil, words = BAD_IMAGES[case]
    path = tiny_experiment.parent / name
    spoil(path)
    with pytest.raises(InputError) as caught:
        open_experiment(tiny_experiment)
    message = str(caught.value)
    assert all(word in message for word in [str(path), *words]), message
    assert "\n" not in message


@pytest.mark.parametrize("compression", [None, "zlib", "lzw"])
@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_a_file_cut_anywhere_is_refused(tmp_path, suffix, compression):
    """Cut after any of its bytes, an image is refused already by its header or at the latest when decoded."""
    pixels = np.random.default_rng(1).integers(0, 4096, (40, 30), dtype=np.uint16)
    path, part = tmp_path / f"whole{suffix}", tmp_path / f"part{suffix}"
    if suffix == ".png":
        import imagecodecs

        path.write_bytes(imagecodecs.png_encode(pixels))
    else:
        tifffile.imwrite(path, pixels, compression=compression, rowsperstrip=7)
    np.testing.assert_array_equal(images.read_image(path, "whole"), pixels)
    whole = path.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 60).astype(int):
        part.write_bytes(whole[:length])
        with pytest.raises(InputError, match="part"):
            images.read_image(part, "cut")


@pytest.mark.parametrize("dtype", images.DTYPES)
@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_grey_values_are_read_as_they_are(tmp_path, dtype, byteorder):
    pixels = np.arange(12, dtype=dtype).reshape(3, 4)
    tifffile.imwrite(tmp_path / "image.tif", pixels, byteorder=byteorder, photometric="minisblack")
    assert images.read_header(tmp_path / "image.tif", "test") == images.Header((3, 4), dtype)
    np.testing.assert_array_equal(images.read_image(tmp_path / "image.tif", "test"), pixels)


def vectors(seed=0, shape=(2, 3, 4)):
    """A small vector dataset in the form every correlation writes."""
    rng = np.random.default_rng(seed)
    names = [name for name in netcdf.VECTOR_UNITS if name != "valid"]
    variables = {
        name: (("z", "y", "x"), rng.normal(size=shape), {"units": netcdf.VECTOR_UNITS[name]}) for name in names
    }
    variables["valid"] = (("z", "y", "x"), rng.random(shape) > 0.2)
    variables["uncertainty"][1][0, 0, 0] = np.nan
    for name, axis in zip("uvw", "xyz", strict=True):  # 0.1 mm per voxel in 1 ms
        variables[name] = (("z", "y", "x"), 0.1 * variables[f"displacement_{axis}"][1], {"units": "m/s"})
    coordinates = {name: (name, np.arange(n) * 0.4, {"units": "mm"}) for name, n in zip("zyx", shape, strict=True)}
    return xr.Dataset(
        variables,
        coordinates,
        {"dt_s": 1e-3, "voxel_mm": [0.1] * 3, "verdict": "most vectors are valid", "passes": [{"window": [8, 8, 8]}]},
    )


def volume(seed, residual):
    rng = np.random.default_rng(seed)
    coordinates = {name: (name, np.arange(n) * 0.1) for name, n in zip("zyx", (3, 4, 5), strict=True)}
    attributes = {"residual": residual, "stop": "iteration limit reached"}
    return xr.DataArray(rng.random((3, 4, 5), np.float32), coordinates, ("z", "y", "x"), attrs=attributes)


def test_vectors_and_volumes_come_back_as_written(tmp_path):
    written, pair = vectors(), {"a": volume(1, [0.9, 0.5, 0.4]), "b": volume(2, [0.8, 0.6])}
    path = tmp_path / "pair_0000.nc"
    reconstruction = netcdf.build_reconstruction(pair)
    attributes = {"settings_hash": "0123", "smart": {"iterations": 2}}
    netcdf.write_vectors(written, path, attributes=attributes, reconstruction=reconstruction)
    back = netcdf.read_vectors(path)
    xr.testing.assert_equal(back, written)
    assert back["valid"].dtype == bool and back["w"].attrs["units"] == "m/s"
    assert provenance.marks(path) == {"settings_hash": "0123"} and json.loads(back.attrs["smart"]) == {"iterations": 2}
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


@pytest.mark.parametrize("version", [1, 2, 3])
def test_files_of_earlier_versions_are_read(tmp_path, version):
    """1: the group shares its axes' names with the vectors; 2: no profile over the depth."""
    path = tmp_path / "pair_0000.nc"
    reconstruction = netcdf.build_reconstruction({"a": volume(1, [0.9])})
    netcdf.write_vectors(vectors().assign_attrs(schema_version=version), path, attributes={})
    older = reconstruction if version == 3 else reconstruction.drop_vars("profile_z")
    names = {} if version == 1 else {axis: f"voxel_{axis}" for axis in "zyx"}
    older.assign_attrs(schema_version=version).rename(names).to_netcdf(
        path, mode="a", group="reconstruction", engine="h5netcdf"
    )
    xr.testing.assert_equal(netcdf.read_vectors(path), vectors())
    xr.testing.assert_equal(netcdf.read_reconstruction(path), older)


def test_what_is_known_of_the_images_travels_with_the_volumes(tmp_path):
    pair = {"a": volume(1, [0.9, 0.5]), "b": volume(2, [0.8, 0.6])}
    for frame, values in (("a", [0.5, 0.01]), ("b", [0.4, 0.6])):
        pair[frame].attrs |= {"cameras": ["left", "right"], "structure": values}
        pair[frame].attrs |= {"camera_gain": [1.0, 0.4], "light_outside": [0.25, values[1]]}
        netcdf.write_volume(pair[frame], tmp_path / f"{frame}.nc", attributes={})
    condensed = netcdf.build_reconstruction({frame: netcdf.read_volume(tmp_path / f"{frame}.nc") for frame in "ab"})
    assert condensed["structure"].sel(frame="a", camera="right") == 0.01
    assert condensed["camera_gain"].sel(frame="b", camera="right") == 0.4
    assert condensed["light_outside"].sel(frame="b", camera="right") == 0.6
    xr.testing.assert_equal(condensed, netcdf.build_reconstruction(pair))


def test_a_vector_file_of_another_form_is_refused(tmp_path):
    with pytest.raises(ValueError, match="peak_ratio"):
        netcdf.write_vectors(vectors().drop_vars("peak_ratio"), tmp_path / "pair.nc", attributes={})
    wrong = vectors()
    wrong["u"].attrs["units"] = "mm/s"
    with pytest.raises(ValueError, match="m/s"):
        netcdf.write_vectors(wrong, tmp_path / "pair.nc", attributes={})
    assert not any(tmp_path.iterdir())
    netcdf.write_vectors(vectors().assign_attrs(schema_version=99), tmp_path / "pair.nc", attributes={})
    with pytest.raises(InputError, match="schema version"):
        netcdf.read_vectors(tmp_path / "pair.nc")
    (tmp_path / "pair.nc").write_bytes(b"no NetCDF")
    with pytest.raises(InputError, match=r"pair\.nc"):
        netcdf.read_vectors(tmp_path / "pair.nc")
    assert provenance.marks(tmp_path / "pair.nc") is None


def test_a_failed_write_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "summary.json"
    files.write_json({"value": float("nan"), "array": np.arange(2), "path": (1, 2)}, path)
    old = path.read_text()
    assert json.loads(old) == {"value": None, "array": [0, 1], "path": [1, 2]}
    with pytest.raises(RuntimeError), files.replacing(path) as scratch:
        scratch.write_text("half")
        raise RuntimeError
    assert path.read_text() == old and list(tmp_path.iterdir()) == [path]


def test_settings_hash_sees_every_value_and_no_order():
    settings = Smart().model_dump()
    hashes = {files.settings_hash(smart=settings), files.settings_hash(smart=dict(reversed(settings.items())))}
    assert len(hashes) == 1
    for key, value in settings.items():
        hashes.add(files.settings_hash(smart=settings | {key: f"{value}, but another"}))
    assert len(hashes) == 1 + len(settings)


def test_camera_and_name_lookups_name_the_known_ones(tiny_experiment):
    with pytest.raises(ValueError, match="camera: expected one of left, right, got 'middle'"):
        open_experiment(tiny_experiment).white("middle")
    with pytest.raises(AttributeError, match="frobnicate"):
        _ = lfpiv.frobnicate
