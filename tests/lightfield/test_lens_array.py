"""Lens array found in white images, against the true lattice of rendered arrays."""

import logging

import numpy as np
import pytest
from scipy import ndimage

from lfpiv.errors import InputError
from lfpiv.geometry.optics import Optics
from lfpiv.lightfield.lens_array import find_lens_array

TOLERANCE_CLEAN = 0.015  # [px] without noise, at the worst corner; 6 x 6 samples a pixel render a disc to 0.005 px
TOLERANCE_INTEGER = 0.02  # [px] the same where all microimages have one phase, so that errors do not average out
TOLERANCE_VIGNETTED = 0.02  # [px] brightness falls to a third within twelve lenses, six times a camera's vignetting
TOLERANCE_NOISY = 0.06  # [px] corner of a lattice through >= 90 centres of 0.15 px each: 0.15 / sqrt(90) * 3.5
TOLERANCE_SAME = 0.01  # [px] two views of the same noise: only interpolation and the lenses at the border differ
TOLERANCE_PITCH = 4e-3  # relative, of the real arrays' published pitch


def basis_of(pitch, rotation_deg, layout):
    angle = np.radians([rotation_deg, rotation_deg + (60 if layout == "hexagonal" else 90)])
    return pitch * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def nodes_near(shape, origin, basis, margin):
    """Return the true centres within `margin` pixels of the sensor."""
    reach = int(2 * max(shape) / np.hypot(*basis[0])) + 2
    j, i = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    centres = np.asarray(origin) + np.stack([i.ravel(), j.ravel()], 1) @ basis
    high = np.array(shape[::-1]) - 0.5 + margin
    return centres[((centres >= -0.5 - margin) & (centres < high)).all(1)]


def render(shape, origin, basis, diameter, *, soft=0.0, square=False, brightness=None, bend=None):
    """Render microimages, integrated over the pixels by 6 x 6 samples. The middle of an average one is 1."""
    half = int(np.ceil(diameter / 2 * (1.5 if square else 1) + 4 * soft)) + 1
    centres = nodes_near(shape, origin, basis, half)
    centres = centres if bend is None else centres + bend(centres)
    amplitude = np.ones(len(centres)) if brightness is None else brightness(centres)
    image = np.zeros((shape[0] + 4 * half, shape[1] + 4 * half))
    sample = (np.arange(-half * 6, (half + 1) * 6) + 0.5) / 6 - 0.5
    along, across = basis[0] / np.hypot(*basis[0]), np.array([-basis[0, 1], basis[0, 0]]) / np.hypot(*basis[0])
    for centre, light in zip(centres, amplitude, strict=True):
        column, row = np.rint(centre).astype(int)
        dx, dy = (column + sample - centre[0])[None], (row + sample - centre[1])[:, None]
        if square:
            distance = np.maximum(np.abs(dx * along[0] + dy * along[1]), np.abs(dx * across[0] + dy * across[1]))
        else:
            distance = np.hypot(dx, dy)
        inside = diameter / 2 - distance
        disc = (inside > 0) * 1.0 if soft == 0 else 1 / (1 + np.exp(-np.clip(inside / soft, -50, 50)))
        window = np.s_[row + half : row + 3 * half + 1, column + half : column + 3 * half + 1]
        image[window] += light * disc.reshape(2 * half + 1, 6, 2 * half + 1, 6).mean((1, 3))
    return image[2 * half : 2 * half + shape[0], 2 * half : 2 * half + shape[1]]


def expose(image, rng, *, peak=3000, offset=100, bits=12):
    """Return the counts of a camera with shot noise, read noise of two counts, offset and full scale."""
    counts = rng.poisson(np.maximum(image, 0) * peak) + rng.normal(offset, 2, image.shape)
    return np.clip(np.rint(counts), 0, 2**bits - 1).astype(np.uint8 if bits == 8 else np.uint16)


def worst_error(array, origin, basis):
    """Return the largest distance of a found centre from the true lattice [px]. No centre is missing or surplus."""
    rows, columns = array.sensor_shape
    index = (array.centres_px - origin) @ np.linalg.inv(basis)
    assert len(np.unique(np.rint(index), axis=0)) == len(index)
    assert len(nodes_near((rows, columns), origin, basis, -0.2)) <= len(index)
    assert len(index) <= len(nodes_near((rows, columns), origin, basis, 0.2))
    return np.hypot(*((index - np.rint(index)) @ basis).T).max()


@pytest.mark.parametrize(
    ("pitch", "rotation", "layout", "fill"),
    [
        (18.25, 0.05, "square", 1.0),
        (15.4, 2.0, "square", 0.7),
        (10.31, -9.0, "square", 1.08),
        (7.3, 0.4, "square", 0.9),
        (31.7, 9.5, "square", 1.0),
        (14.6, 1.3, "square", 1.3),  # gaps between four lenses are brighter than lenses
        (16.9, -3.0, "square", 1.55),  # and the microimages leave no gaps
        (18.25, 0.05, "hexagonal", 1.0),
        (12.6, 30.2, "hexagonal", 0.8),
        (20.4, 17.0, "hexagonal", 1.06),
    ],
)
def test_centres_follow_the_lattice_at_every_pixel_phase(pitch, rotation, layout, fill):
    shape = (11 * int(pitch), 13 * int(pitch))
    basis = basis_of(pitch, rotation, layout)
    rng = np.random.default_rng(int(100 * pitch))
    for _ in range(2):
        origin = np.array(shape[::-1]) / 2 + rng.uniform(-pitch, pitch, 2)
        array = find_lens_array(render(shape, origin, basis, fill * pitch), layout=layout)
        assert worst_error(array, origin, basis) < TOLERANCE_CLEAN
        assert array.pitch_px == pytest.approx(pitch, rel=1e-4)
        assert array.rotation_deg == pytest.approx(rotation, abs=5e-3)


@pytest.mark.parametrize("dark_known", [True, False])
@pytest.mark.parametrize(("pitch", "rotation"), [(9.7, 1.3), (20.0, 0.0), (41.3, -7.0)])
@pytest.mark.parametrize("diameter_px", [1.6, 3.0, 5.5])
def test_spots_of_a_small_aperture_are_centred_on_their_light(pitch, rotation, diameter_px, dark_known):
    shape, basis, rng = (260, 300), basis_of(pitch, rotation, "square"), np.random.default_rng(int(10 * pitch))
    origin = np.array(shape[::-1]) / 2 + rng.uniform(-pitch, pitch, 2)
    white = expose(render(shape, origin, basis, diameter_px, soft=0.3), rng)
    dark = expose(np.zeros(shape), rng) if dark_known else None
    array = find_lens_array(white, dark, nominal_pitch_px=pitch)
    assert worst_error(array, origin, basis) < TOLERANCE_NOISY


def test_light_that_fits_centres_and_gaps_alike_is_refused():
    """Blurred overlaps on an unknown level look like spots in the gaps."""
    basis = basis_of(12.4, 0.3, "square")
    white = 1000 * (2 + ndimage.gaussian_filter(render((200, 220), np.array([100.0, 90.0]), basis, 1.4 * 12.4), 2))
    with pytest.raises(InputError, match=r"tells the centres of the microimages from the gaps .* dark gaps"):
        find_lens_array(white, nominal_pitch_px=12.4)


@pytest.mark.parametrize("square", [False, True])
def test_integer_pitch_without_rotation_is_not_locked_to_pixels(square):
    basis = basis_of(16, 0, "square")
    for phase in (0.0, 0.21, 0.37, 0.5):
        origin = np.array([80 + phase, 80 - phase / 2])
        white = render((170, 180), origin, basis, 13.3, soft=0.3 if square else 0.0, square=square)
        assert worst_error(find_lens_array(white), origin, basis) < TOLERANCE_INTEGER


@pytest.mark.slow(but="1.0-True")
@pytest.mark.parametrize("layout", ["square", "hexagonal"])
@pytest.mark.parametrize("whole_lenses", [True, False])
@pytest.mark.parametrize("fill", [0.8, 1.0, 1.06])
def test_vignetting_moves_no_centre(layout, whole_lenses, fill):
    shape, basis, origin = (420, 480), basis_of(20.3, 1.2, layout), np.array([241.3, 208.8])

    def fall(position):
        return 1 / (1 + (((position - [150, 180]) / 240) ** 2).sum(-1))

    white = render(shape, origin, basis, fill * 20.3, soft=0.3, brightness=fall if whole_lenses else None)
    if not whole_lenses:
        white *= fall(np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), -1))
    assert worst_error(find_lens_array(white, layout=layout), origin, basis) < TOLERANCE_VIGNETTED


@pytest.mark.parametrize("seed", range(14))
def test_random_array_with_dead_lenses_dust_vignetting_and_noise(seed):
    rng = np.random.default_rng(seed)
    layout = ("square", "hexagonal")[seed % 2]
    pitch = float(np.exp(rng.uniform(np.log(9), np.log(30))))
    basis = basis_of(pitch, rng.uniform(-10, 10) if layout == "square" else rng.uniform(-14, 44), layout)
    side = max(230, int(14 * pitch))
    shape = (side, side + 50)
    origin = np.array(shape[::-1]) / 2 + rng.uniform(-pitch, pitch, 2)
    bits = (8, 12, 16)[seed % 3]

    def brightness(centres):
        light = 1 + rng.uniform(0, 0.15) * rng.standard_normal(len(centres))
        light[rng.random(len(centres)) < 0.05] = 0.03  # dead lenses
        return np.maximum(light, 0) / (1 + 0.2 * (((centres / shape[::-1]) - rng.uniform(0.3, 0.7, 2)) ** 2).sum(1))

    square = layout == "square" and seed % 4 == 0
    fill = rng.uniform(0.65, 0.9 if square else 1.05)
    white = render(shape, origin, basis, fill * pitch, soft=rng.uniform(0, 0.6), square=square, brightness=brightness)
    row, column = np.ogrid[: shape[0], : shape[1]]
    for _ in range(12):  # dust
        y, x, radius = rng.uniform(0, shape[0]), rng.uniform(0, shape[1]), rng.uniform(1, 0.25 * pitch)
        white[(row - y) ** 2 + (column - x) ** 2 < radius**2] *= 0.4
    peak, offset = {8: (170, 12), 12: (2800, 100), 16: (20000, 900)}[bits]
    image = expose(white, rng, peak=peak, offset=offset, bits=bits)
    dark = expose(np.zeros(shape), rng, offset=offset, bits=bits) if seed % 4 < 2 else None
    nominal = pitch * rng.uniform(0.9, 1.1) if seed % 3 else None

    array = find_lens_array(image, dark, nominal, layout)
    assert worst_error(array, origin, basis) < TOLERANCE_NOISY


@pytest.fixture(scope="module")
def hexagonal_case():
    origin, basis = np.array([131.4, 118.1]), basis_of(14.37, 28.9, "hexagonal")
    return expose(render((230, 260), origin, basis, 14.37), np.random.default_rng(3)), origin, basis


def test_lattice_is_consistent_and_in_standard_order(hexagonal_case):
    image = hexagonal_case[0]
    array = find_lens_array(image, layout="hexagonal")
    np.testing.assert_allclose(array.centres_px, array.origin_px + array.index @ array.basis_px, atol=1e-9)
    distance = np.hypot(*(array.centres_px - (129.5, 114.5)).T)
    assert tuple(array.index[distance.argmin()]) == (0, 0)
    first, second = np.degrees(np.arctan2(*np.array(array.basis_px).T[::-1]))
    assert -15 <= first < 45
    assert second - first == pytest.approx(60, abs=0.05)
    assert array.measured < len(array.index)  # microimages cut by the border are listed but not measured
    assert array.rms_px < 0.1


def test_crop_moves_and_transpose_swaps_the_centres(hexagonal_case):
    image = hexagonal_case[0]
    array = find_lens_array(image, layout="hexagonal")
    cropped = find_lens_array(image[5:, 8:], layout="hexagonal")
    swapped = find_lens_array(image.T, layout="hexagonal")
    basis = np.array(array.basis_px)
    assert worst_error(cropped, np.array(array.origin_px) - (8, 5), basis) < TOLERANCE_SAME
    assert worst_error(swapped, np.array(array.origin_px)[::-1], basis[:, ::-1]) < TOLERANCE_SAME


def test_dark_frame_is_subtracted(hexagonal_case):
    image = hexagonal_case[0].astype(float)
    pattern = np.random.default_rng(0).uniform(0, 2000, image.shape)
    with_dark = find_lens_array(image + pattern, pattern, layout="hexagonal")
    np.testing.assert_allclose(
        with_dark.centres_px, find_lens_array(image, layout="hexagonal").centres_px, atol=TOLERANCE_SAME
    )


def test_lens_plane_lattice_undoes_the_parallax():
    optics = Optics(
        focal_length_mm=100, magnification=-1, f_number=4, microlens_pitch_mm=0.1, microlens_focal_length_mm=0.8,
        pixel_mm=0.0055, sensor_shape=(280, 330),
    )  # fmt: skip
    offset_mm, roll = np.array([0.013, -0.021]), 0.4
    basis = basis_of(optics.microimage_pitch_px, roll, "square")
    origin = optics.sensor_px(offset_mm * (1 + optics.sensor_per_pupil))
    array = find_lens_array(render(optics.sensor_shape, origin, basis, 18.2))
    lattice = array.lattice(optics)
    tolerance_mm = TOLERANCE_CLEAN * optics.pixel_mm
    np.testing.assert_allclose(lattice.origin_mm, offset_mm, atol=tolerance_mm)
    np.testing.assert_allclose(lattice.basis_mm, basis_of(0.1, roll, "square"), atol=tolerance_mm)
    x = optics.sensor_mm(array.centres_px) / (1 + optics.sensor_per_pupil)
    np.testing.assert_array_equal(lattice.nearest(x), array.index)
    with pytest.raises(ValueError, match="sensor_shape"):
        array.lattice(Optics(**{**vars(optics), "sensor_shape": (330, 280)}))
    with pytest.raises(ValueError, match="layout"):
        array.lattice(Optics(**{**vars(optics), "layout": "hexagonal"}))


def test_dark_part_of_the_sensor_is_extrapolated_with_a_warning(caplog):
    origin, basis = np.array([151.2, 118.7]), basis_of(14.6, 0.6, "square")
    white = render((230, 300), origin, basis, 14)
    white[:, :180] = 0
    array = find_lens_array(expose(white, np.random.default_rng(5)))
    assert worst_error(array, origin, basis) < TOLERANCE_NOISY
    assert "lit" in caplog.text


def test_distortion_is_reported_with_its_size(caplog):
    def bend(centres):
        offset = (centres - [150, 130]) / 150
        return 0.6 * offset * (offset**2).sum(1, keepdims=True)

    origin, basis, rng = np.array([148.9, 131.3]), basis_of(14.6, 0.6, "square"), np.random.default_rng(2)
    with caplog.at_level(logging.WARNING):
        find_lens_array(expose(render((260, 300), origin, basis, 14), rng))
        assert not caplog.text
        find_lens_array(expose(render((260, 300), origin, basis, 14, bend=bend), rng))
    assert "distortion of 0." in caplog.text


def noise(shape):
    return np.random.default_rng(0).poisson(1000, shape)


GOOD = render((120, 130), np.array([60.0, 60.0]), basis_of(15.3, 0.5, "square"), 15) * 1000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"white": np.zeros((100, 100), np.uint16)}, "white: expected light"),
        ({"white": np.full((100, 100), 9)}, "white: .* same value"),
        ({"white": np.stack([GOOD] * 3, -1)}, r"white: expected a grey image .* \(120, 130, 3\)"),
        ({"white": np.where(GOOD > 999, np.nan, GOOD)}, "white: expected finite counts"),
        ({"white": GOOD > 500}, "white: .* dtype bool"),
        ({"white": GOOD[:9, :9]}, "white: expected at least 16 x 16 pixels"),
        ({"white": GOOD[:50, :50]}, "white: expected at least .* microimages"),
        ({"white": noise((120, 130))}, "white: no regular array"),
        ({"white": np.add.outer(np.arange(120), np.arange(130))}, "white: no regular array"),
        ({"dark": GOOD[1:]}, r"dark: expected shape \(120, 130\) .* \(119, 130\)"),
        ({"dark": GOOD + 1}, "white: expected light"),
        ({"nominal_pitch_px": -15}, "nominal_pitch_px: expected .* -15"),
        ({"nominal_pitch_px": "wide"}, "nominal_pitch_px: expected .* 'wide'"),
        ({"nominal_pitch_px": np.nan}, "nominal_pitch_px: expected .* nan"),
        ({"nominal_pitch_px": 30.6}, "nominal_pitch_px: .* about 15.*30.6"),
        ({"layout": "hex"}, "layout: expected one of"),
        ({"layout": "hexagonal"}, "layout: .* square with a pitch of about 15"),
    ],
)
def test_bad_input_is_refused_with_one_clear_message(arguments, message):
    with pytest.raises(InputError, match=message):
        find_lens_array(**{"white": GOOD, **arguments})


@pytest.mark.sample_data
@pytest.mark.parametrize(
    ("name", "offset_mm", "roll_deg"), [("cam1", (0.031, -0.022), 0.05), ("cam2", (-0.012, 0.041), -0.08)]
)
def test_sample_rig_is_recovered(sample_data, name, offset_mm, roll_deg):
    tifffile = pytest.importorskip("tifffile")
    white = tifffile.imread(sample_data / "ring-vortex-2cam" / "white" / f"{name}.tif")
    optics = Optics(
        focal_length_mm=100, magnification=-1, f_number=4, microlens_pitch_mm=0.1, microlens_focal_length_mm=0.8,
        pixel_mm=0.0055, sensor_shape=white.shape,
    )  # fmt: skip
    array = find_lens_array(white, nominal_pitch_px=optics.microimage_pitch_px)
    lattice = array.lattice(optics)
    assert np.abs(np.subtract(lattice.origin_mm, offset_mm)).max() < 0.01 * optics.pixel_mm
    assert lattice.pitch_mm == pytest.approx(0.1, rel=1e-5)  # 0.01 px over the half width of 800 px
    assert array.rotation_deg == pytest.approx(roll_deg, abs=5e-4)
    assert array.rms_px < 0.03


@pytest.mark.slow(but="None")
@pytest.mark.sample_data
@pytest.mark.parametrize("error", [None, 0.9, 1.1])
@pytest.mark.parametrize(
    ("folder", "white", "dark", "pitch", "rotation_deg"),
    [
        ("letters", "letters_ULF_M1_white.png", "letters_ULF_M1_dark.png", 48.23, 0.13),
        ("guv", "Radiometry_GUVExperim1.tif", "DarkFrame_GUVExperim1.tif", 15.4, -0.1),
    ],
)
def test_real_array_is_found(sample_data, folder, white, dark, pitch, rotation_deg, error):
    cv2 = pytest.importorskip("cv2")
    images = [
        cv2.imread(str(sample_data / "real-lenslet" / folder / name), cv2.IMREAD_UNCHANGED) for name in (white, dark)
    ]
    array = find_lens_array(*images, nominal_pitch_px=error and error * pitch)
    assert array.pitch_px == pytest.approx(pitch, rel=TOLERANCE_PITCH)
    assert array.rotation_deg == pytest.approx(rotation_deg, abs=0.03)
    assert array.rms_px < 0.06
