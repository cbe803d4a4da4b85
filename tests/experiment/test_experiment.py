"""The experiment file and its images: accepted forms, and messages for refused ones."""

import numpy as np
import pytest
import tifffile
from scipy import ndimage

from lfpiv.errors import InputError
from lfpiv.experiment import axes, images
from lfpiv.experiment.opening import open_experiment
from lfpiv.geometry.orientation import Orientation
from lfpiv.settings.experiment import ExperimentTable
from lfpiv.settings.processing import Compute, Correlation, Network, Smart, Tracking


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
    assert len(experiment.calibration_images()) == 3 + 4 and len(experiment.pair_images(1)) == 4


@pytest.mark.sample_data
def test_sample_experiment_is_accepted(sample_data):
    experiment = open_experiment(sample_data / "ring-vortex-2cam" / "experiment.toml")
    assert experiment.grid.shape == (30, 60, 60)
    assert experiment.camera("cam1").optics.sensor_shape == (1280, 1600)


def test_particles_of_a_single_camera_are_tracked_without_a_table(tiny_experiment):
    assert open_experiment(tiny_experiment).tracking is None
    head, left, right = tiny_experiment.read_text().split("[[camera]]")
    tiny_experiment.write_text(f"{head}[[camera]]{left}{right[right.index('[board]') :]}")
    alone = open_experiment(tiny_experiment)
    assert [camera.name for camera in alone.cameras] == ["left"]
    assert alone.tracking == Tracking() and alone.by_links
    edit(tiny_experiment, "[board]", '[tracking]\nvectors = "correlation"\n\n[board]')
    assert not open_experiment(tiny_experiment).by_links


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


def test_left_handed_axes_are_read_from_pictures_that_lie_as_stated(tiny_experiment):
    edit(tiny_experiment, 'name = "left"', 'name = "left"\nimage_flip = "horizontal"')
    ordinary = open_experiment(tiny_experiment)
    edit(tiny_experiment, "[board]", '[board]\naxes = "left-handed"')
    left_handed = open_experiment(tiny_experiment)
    np.testing.assert_array_equal(left_handed.white("left"), np.fliplr(ordinary.white("left")))
    assert "x points right and y up for 'left'" in axes.directions(ordinary)
    assert "left-handed, as board.axes says" in axes.handedness(left_handed)
    assert "not stated for 'right'" in axes.handedness(ordinary)


def test_a_byte_order_mark_is_no_part_of_the_file(tiny_experiment):
    plain = open_experiment(tiny_experiment)
    tiny_experiment.write_bytes(b"\xef\xbb\xbf" + tiny_experiment.read_bytes())
    assert open_experiment(tiny_experiment) == plain


@pytest.mark.parametrize("centre", [(1.2, 0.0, 0.0), (0.0, -1.2, 0.0), (0.0, 0.0, 3.0)])
def test_a_volume_that_a_misaligned_camera_may_see_is_accepted(tiny_experiment, centre):
    """Two fields of view beside the axis are accepted, because the nominal rig may be wrong by as much."""
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
    "big edge": (
        "pairs = 2",
        "pairs = 2\n[correlation]\nwindows = [14, 8]",
        ["correlation.windows", "14", "along z", "State [8, 12, 14]"],
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
    "no TOML": ("pairs = 2", "pairs = = 2", ["line", "`pairs = = 2`", "expected"]),
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
    else:  # the byte order mark and line ends of Windows are accepted
        assert open_experiment(tiny_experiment).name == "tiny"


@pytest.mark.parametrize("model", [ExperimentTable, Smart, Correlation, Network, Compute])
def test_every_misspelt_key_finds_its_own(tiny_experiment, model):
    """The message suggests the right key for a key without its last letter, in every table."""
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


def smooth_light(shape):
    """Light that neighbours share, of 12 bits, with noise."""
    rng = np.random.default_rng(0)
    spots = ndimage.gaussian_filter(rng.exponential(1, shape) ** 3, 2)
    return np.clip(40 + 200 * spots + rng.normal(0, 3, shape), 0, 4095).round().astype(np.uint16)


def picture(pixels, **options):
    """Return a function that writes an image."""
    return lambda path: tifffile.imwrite(path, pixels, **options)


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
        picture(np.ones((48, 63), np.uint16)),
        ["(48, 64)", "(48, 63)", "white"],
    ),
    "other dtype": ("board/left/plane_00.tif", picture(np.ones((48, 64), np.complex64)), ["uint16", "complex64"]),
    "colour": (
        "board/left/plane_00.tif",
        picture(np.ones((48, 64, 3), np.uint8), photometric="rgb"),
        ["single-channel", "colour"],
    ),
    "two pages": (
        "particles/right/0000a.tif",
        picture(np.ones((2, 56, 40), np.uint8), photometric="minisblack"),
        ["one", "2 pages"],
    ),
    "black white image": (
        "white/right.tif",
        picture(np.zeros((56, 40), np.uint16)),
        ["white_image of camera 'right'", "all black"],
    ),
    "black board": ("board/left/plane_01.tif", picture(np.zeros((48, 64), np.uint16)), ["plane 1", "all black"]),
    "black particles": ("particles/left/0001b.tif", picture(np.zeros((48, 64), np.uint16)), ["pair 1", "all black"]),
    "dark brighter than white": (
        "dark/right.tif",
        picture(np.full((56, 40), 5000, np.uint16)),
        ["white", "brighter than the dark"],
    ),
    "infinite counts": ("white/left.tif", picture(np.full((48, 64), np.inf, np.float32)), ["finite"]),
    "scaled white": (
        "white/left.tif",
        picture(np.random.default_rng(0).random((48, 64), np.float32)),
        ["counts", "0 to 1"],
    ),
    "exchanged bytes": (
        "particles/left/0001b.tif",
        picture(smooth_light((48, 64)).byteswap()),
        ["pair 1", "two bytes are exchanged", "byte order"],
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
    """An image cut after any of its bytes is refused by its header or when decoded."""
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


def test_an_unknown_camera_is_answered_with_the_known_ones(tiny_experiment):
    with pytest.raises(ValueError, match="camera: expected one of left, right, got 'middle'"):
        open_experiment(tiny_experiment).white("middle")


def changed(path, *pairs):
    text = path.read_text("utf-8")
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, "utf-8")
    return path


def test_a_camera_is_oriented_by_a_direction_and_a_roll(tiny_experiment):
    left = "nominal_angle_deg = 30.0"
    experiment = open_experiment(
        changed(tiny_experiment, (left, "nominal_direction = [0, 2, 2]\nnominal_roll_deg = 90.0"))
    )
    above, other = (camera.orientation for camera in experiment.cameras)
    assert (above.pitch_deg, above.roll_deg) == (pytest.approx(45.0), 90.0)
    assert other == Orientation(-30.0) and experiment.cameras[1].nominal_angle_deg == -30.0


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ("", "camera 'left': expected nominal_angle_deg.*or nominal_direction.*found neither"),
        ("nominal_angle_deg = 3\nnominal_direction = [0, 0, 1]", "either nominal_angle_deg or nominal_direction"),
        ("nominal_direction = [0, 0, 0]", "nominal_direction: expected a direction other than"),
        ("nominal_direction = [0, 1, 0]", "camera 'left': expected a camera that sees.*80 degrees.*at 90 degrees"),
        ("nominal_direction = [0, 4, 1]", "board.spacing_mm: expected dots about two microlenses apart.*76 degrees"),
    ],
)
def test_an_orientation_that_cannot_be_is_refused(tiny_experiment, stated, message):
    with pytest.raises(InputError, match=message):
        open_experiment(changed(tiny_experiment, ("nominal_angle_deg = 30.0", stated)))


def test_a_marked_board_needs_no_orientations(tiny_experiment):
    angles = [(f"nominal_angle_deg = {angle}\n", "\n") for angle in ("30.0", "-30.0")]
    marked = changed(tiny_experiment, *angles, ("planes_mm", "mark = [[1, 1], [2, 1], [1, 3]]\nplanes_mm"))
    assert all(camera.orientation is None for camera in open_experiment(marked).cameras)
    for wrong, message in (
        ("[[1, 1], [3, 1], [2, 3]]", "board.mark: expected places that no turn or mirror"),
        ("[[1, 1], [2, 1], [1, 5]]", "a mark of places on the board"),
    ):
        text = marked.read_text("utf-8").replace("[[1, 1], [2, 1], [1, 3]]", wrong)
        other = marked.with_name("wrong.toml")
        other.write_text(text, "utf-8")
        with pytest.raises(InputError, match=message):
            open_experiment(other)
