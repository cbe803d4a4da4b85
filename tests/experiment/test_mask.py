"""Masks of an experiment: files of any grid, half-spaces and boxes, and messages for those that cannot be meant."""

import gc

import numpy as np
import pytest
import xarray as xr

from lfpiv.errors import InputError
from lfpiv.experiment.mask import read_mask
from lfpiv.experiment.opening import open_experiment, read_experiment
from lfpiv.experiment.recording import Recording
from lfpiv.geometry.grid import Grid

GRID = Grid.from_extent(centre_mm=(0.0, 0.0, 0.1), size_mm=(0.8, 0.6, 0.4), voxel_mm=0.05)  # of `tiny_experiment`


def add(file, text):
    written = file.read_text()
    assert "voxel_mm = 0.05\n" in written
    file.write_text(written.replace("voxel_mm = 0.05\n", f"voxel_mm = 0.05\n{text}\n", 1))
    return file


def ball(points, radius=0.17):
    return np.linalg.norm(points - np.array([0.05, -0.02, 0.1]), axis=-1) < radius


def places(grid=GRID):
    z, y, x = np.meshgrid(*grid.axes_mm, indexing="ij")
    return np.stack([x, y, z], -1)


def stored(path, values_of, step_mm, *, reach=0.6, dtype=bool, order=("z", "y", "x"), name="mask"):
    """Write a mask on a grid of its own."""
    axis = np.arange(-reach, reach + 1e-9, step_mm)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    values = values_of(np.stack([x, y, z], -1)).astype(dtype)
    mask = xr.DataArray(
        values, dict.fromkeys("zyx", axis) | {a: (a, axis, {"units": "mm"}) for a in "zyx"}, tuple("zyx")
    )
    mask.rename(name).transpose(*order).to_netcdf(path, engine="h5netcdf")
    return path


def test_without_a_mask_all_is_fluid(tiny_experiment):
    assert open_experiment(tiny_experiment).mask is None


@pytest.mark.parametrize("step_mm", [0.01, 0.05, 0.08])
@pytest.mark.parametrize("dtype", [bool, np.uint8, float])
def test_a_file_of_any_grid_is_sampled_onto_the_voxels(tmp_path, step_mm, dtype):
    solid = read_mask(stored(tmp_path / "mask.nc", ball, step_mm, dtype=dtype), GRID)
    distance = np.linalg.norm(places() - np.array([0.05, -0.02, 0.1]), axis=-1)
    room = max(step_mm, 0.05)  # nearer to the surface either is right
    assert solid[distance < 0.17 - room].all() and not solid[distance > 0.17 + room].any()
    np.testing.assert_allclose(solid.sum() * 0.05**3, 4 / 3 * np.pi * 0.17**3, rtol=0.15)


def test_order_and_direction_of_a_file_do_not_matter(tmp_path):
    plain = read_mask(stored(tmp_path / "mask.nc", ball, 0.03), GRID)
    turned = xr.load_dataarray(stored(tmp_path / "turned.nc", ball, 0.03, order=("x", "z", "y")))
    turned.isel(x=slice(None, None, -1)).to_netcdf(tmp_path / "falling.nc", engine="h5netcdf")
    np.testing.assert_array_equal(read_mask(tmp_path / "turned.nc", GRID), plain)
    np.testing.assert_array_equal(read_mask(tmp_path / "falling.nc", GRID), plain)


def test_beyond_a_file_there_is_fluid(tmp_path):
    path = stored(tmp_path / "mask.nc", lambda points: np.ones(points.shape[:-1]), 0.055, reach=0.11)
    expected = (np.abs(places()) < 0.11 + 0.0275).all(-1)
    np.testing.assert_array_equal(read_mask(path, GRID), expected)


def test_solids_of_the_experiment_file(tiny_experiment):
    text = """[[volume.solid]]
kind = "half_space"
point_mm = [0.21, 0.0, 0.0]
normal = [-2.0, -1.0, 0.0]
[[volume.solid]]
kind = "box"
centre_mm = [-0.3, 0.0, 0.1]
size_mm = [0.2, 0.21, 0.11]"""
    solid = open_experiment(add(tiny_experiment, text)).solid(Recording().frame(0))
    x, y, z = np.moveaxis(places(), -1, 0)
    behind = 2 * (x - 0.21) + y > 0
    inside = (np.abs(x + 0.3) <= 0.1) & (np.abs(y) <= 0.105) & (np.abs(z - 0.1) <= 0.055)
    assert behind.any() and inside.any()
    np.testing.assert_array_equal(solid, behind | inside)


def test_a_file_and_solids_add_up(tiny_experiment):
    stored(tiny_experiment.parent / "mask.nc", ball, 0.03)
    box = '[[volume.solid]]\nkind = "box"\ncentre_mm = [0.4, 0.3, 0.3]\nsize_mm = [0.2, 0.2, 0.2]'
    solid = open_experiment(add(tiny_experiment, f'mask = "mask.nc"\n{box}')).solid(Recording().frame(3))
    alone = read_mask(tiny_experiment.parent / "mask.nc", GRID)
    assert solid[alone].all() and solid[-1, -1, -1] and solid.sum() == alone.sum() + 8


BAD_KEYS = {
    "no such kind": ('[[volume.solid]]\nkind = "ball"', ["volume.solid[0]", "half_space"]),
    "no direction": (
        '[[volume.solid]]\nkind = "half_space"\npoint_mm = [0, 0, 0]\nnormal = [0, 0, 0]',
        ["volume.solid[0].normal", "direction"],
    ),
    "beside the volume": (
        '[[volume.solid]]\nkind = "box"\ncentre_mm = [3, 0, 0]\nsize_mm = [1, 1, 1]',
        ["volume.solid[0]", "reaches into the volume"],
    ),
    "nothing left": (
        '[[volume.solid]]\nkind = "half_space"\npoint_mm = [1, 0, 0]\nnormal = [1, 0, 0]',
        ["volume", "some fluid", "inverted"],
    ),
    "no file": ('mask = "none.nc"', ["none.nc", "no such file"]),
}


@pytest.mark.parametrize("bad", BAD_KEYS)
def test_bad_keys_are_named(tiny_experiment, bad):
    text, words = BAD_KEYS[bad]
    with pytest.raises(InputError) as error:
        open_experiment(add(tiny_experiment, text))
    assert all(word in str(error.value) for word in words), str(error.value)


def away(mask):
    return mask.assign_coords(x=mask["x"] + 40)


BAD_FILES = {
    "in metres": (lambda mask: mask.assign_coords(x=("x", mask["x"].values / 1e3, {"units": "m"})), "mm"),
    "elsewhere": (away, "overlaps the volume"),
    "grey values": (lambda mask: mask.astype(np.uint8) * 255, "from 0 to 255"),
    "not a number": (lambda mask: mask.astype(float).where(mask), "not finite"),
    "two dimensions": (lambda mask: mask.isel(z=3, drop=True), "over z, y, x"),
    "no coordinates": (lambda mask: mask.drop_vars("y"), "coordinates"),
    "nothing solid": (lambda mask: mask & False, "some solid"),
    "unordered": (lambda mask: mask.assign_coords(y=np.cos(np.arange(mask.sizes["y"]))), "rise or fall"),
    "two variables": (lambda mask: mask.rename("one").to_dataset().assign(two=mask), "one variable"),
}


@pytest.mark.parametrize("bad", BAD_FILES)
def test_bad_files_are_named(tmp_path, bad):
    change, words = BAD_FILES[bad]
    good = xr.load_dataarray(stored(tmp_path / "good.nc", ball, 0.05))
    change(good).to_netcdf(tmp_path / "bad.nc", engine="h5netcdf")
    with pytest.raises(InputError, match=r"bad\.nc: .*expected") as error:
        read_mask(tmp_path / "bad.nc", GRID)
    assert words in str(error.value)


def test_a_file_that_is_no_netcdf_is_named(tmp_path):
    (tmp_path / "mask.nc").write_text("no mask")
    with pytest.raises(InputError, match="expected a NetCDF file"):
        read_mask(tmp_path / "mask.nc", GRID)


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
def test_a_file_with_a_damaged_beginning_is_named_without_a_traceback_beside_it(tmp_path):
    path = stored(tmp_path / "mask.nc", ball, 0.05)
    content = path.read_bytes()
    path.write_bytes(b"\0" + content[1:])
    with pytest.raises(InputError, match="expected a NetCDF file"):
        read_mask(path, GRID)
    gc.collect()  # h5netcdf complains when half an object is collected


def moving(path, x_mm, *, reach=0.6):
    """Write the mask of a box whose centre is at `x_mm`."""
    path.parent.mkdir(exist_ok=True)
    body = lambda points: (np.abs(points - np.array([x_mm, 0.0, 0.1])) < 0.12).all(-1)  # noqa: E731
    return stored(path, body, 0.03, reach=reach)


@pytest.fixture
def body(tiny_experiment):
    """An experiment of two pairs and a mask of each frame; in the last frame the body has left the volume."""
    for number, x_mm in enumerate((-0.2, -0.1, 0.1, 0.9)):
        moving(tiny_experiment.parent / "mask" / f"{number // 2}{'ab'[number % 2]}.nc", x_mm)
    return add(tiny_experiment, 'mask = "mask/{pair}{frame}.nc"')


def test_each_frame_has_its_own_mask(body):
    experiment = open_experiment(body)
    found = {frame: experiment.solid(frame) for frame in experiment.all_frames()}
    for frame, solid in found.items():
        file = body.parent / "mask" / "{pair}{frame}.nc".format(**frame.fields)
        np.testing.assert_array_equal(solid, read_mask(file, GRID, may_miss=True))
        assert experiment.mask_files([frame]) == [file]
    assert [bool(solid.any()) for solid in found.values()] == [True, True, True, False]
    assert "a file of each frame" in str(experiment)


@pytest.mark.parametrize("pattern", ["mask/{pair:03d}.nc", "mask/{image:03d}.nc", "mask/{frame}.nc"])
def test_frames_may_share_a_mask(tiny_experiment, pattern):
    fields = [{"pair": n // 2, "frame": "ab"[n % 2], "image": n} for n in range(4)]
    for number, name in enumerate(dict.fromkeys(pattern.format(**one) for one in fields)):
        moving(tiny_experiment.parent / name, 0.05 * number)
    experiment = open_experiment(add(tiny_experiment, f'mask = "{pattern}"'))
    names = [
        path.relative_to(tiny_experiment.parent).as_posix() for path in experiment.mask_files(experiment.all_frames())
    ]
    assert names == list(dict.fromkeys(pattern.format(**one) for one in fields))


def test_an_instant_has_one_mask_in_both_its_pairs(tiny_experiment):
    text = tiny_experiment.read_text().replace("{pair:04d}{frame}", "{instant}").replace("pairs = 2", "instants = 4")
    tiny_experiment.write_text(text)
    for number in range(4):
        moving(tiny_experiment.parent / "mask" / f"{number:05d}.nc", 0.05 * number)
    experiment = read_experiment(add(tiny_experiment, 'mask = "mask/{instant:05d}.nc"'))
    assert len(experiment.mask_files(experiment.all_frames())) == 4
    assert experiment.mask_files(experiment.pair_frames(1)[1:]) == experiment.mask_files(experiment.pair_frames(2)[:1])


def cut_short(path):
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def thinner(path):
    moving(path, 0.0, reach=0.5)


def flat(path):
    mask = xr.load_dataarray(path)
    path.unlink()
    mask.isel(z=20, drop=True).to_netcdf(path, engine="h5netcdf")


BAD_FRAMES = {
    "missing": (lambda path: path.unlink(), "no such file"),
    "empty": (lambda path: path.write_bytes(b""), "cannot be read"),
    "cut short": (cut_short, "cannot be read"),
    "another shape": (thinner, "expected the variables and shapes"),
    "two dimensions": (flat, "expected the variables and shapes"),
    "text": (lambda path: path.write_text("no mask"), "expected a NetCDF file"),
}


@pytest.mark.parametrize("bad", BAD_FRAMES)
def test_the_mask_of_one_frame_is_refused_by_name_before_any_work(body, bad):
    damage, words = BAD_FRAMES[bad]
    file = body.parent / "mask" / "1b.nc"
    damage(file)
    with pytest.raises(InputError) as error:
        read_experiment(body)
    assert str(error.value).startswith(f"{file}: ") and words in str(error.value)


@pytest.mark.parametrize(
    "pattern", ["mask/{instant}.nc", "mask/{camera}{pair}.nc", "mask/{pair!r}.nc", "mask/{pair.nc"]
)
def test_a_pattern_that_no_frame_has_is_refused(tiny_experiment, pattern):
    with pytest.raises(InputError, match=r"volume\.mask: expected "):
        read_experiment(add(tiny_experiment, f'mask = "{pattern}"'))


def test_values_of_a_frame_are_checked_when_they_are_read(body):
    file = body.parent / "mask" / "1b.nc"
    mask = xr.load_dataarray(file)
    file.unlink()
    (mask.astype(np.uint8) * 255 + 255).to_netcdf(file, engine="h5netcdf")
    experiment = read_experiment(body)
    with pytest.raises(InputError, match=r"1b\.nc: .*from 0 to 1"):
        experiment.solid(Recording().frame(3))
