"""Decoder against single traced rays and scenes of known light."""

import numpy as np
import pytest

from lfpiv.errors import InputError
from lfpiv.geometry.optics import LensLattice, Optics
from lfpiv.lightfield.decoder import LightFieldDecoder

WHITE_COUNTS = 1000.0
DARK_LEVEL = 40.0  # counts
READ_NOISE = 2.0  # counts
WHOLE = 1 / np.sqrt(12)  # noise of whole counts
HALF_COUNT = 0.5  # error of a median of whole counts

HALF_PIXEL = 0.5 + 1e-3  # a ray lands within half a pixel of its pixel's centre, plus float32 rounding
SAMPLED_AREA = 0.012  # error of areas by 20 x 20 points per pixel: a quarter of one row of points
VIEW_ERROR = 0.02  # noise of 0.2 % in four pixels of image and white, and their interpolation


def make_optics(layout="square", f_number=4.0):
    return Optics(
        focal_length_mm=80.0,
        magnification=-0.8,
        f_number=f_number,
        microlens_pitch_mm=0.11,
        microlens_focal_length_mm=0.75,
        pixel_mm=0.006,
        sensor_shape=(210, 260),
        layout=layout,
    )


def make_lattice(layout="square", roll_deg=1.3):
    angle = np.radians(roll_deg) + np.radians([0, 60 if layout == "hexagonal" else 90])
    basis = 0.1103 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return LensLattice(origin_mm=(0.02, -0.013), basis_mm=tuple(map(tuple, basis)), layout=layout)


def sampled_coverage(optics, lattice, points=20):
    """Return the part of each pixel inside the discs of all lenses, by counting points."""
    rows, columns = optics.sensor_shape
    steps = (np.arange(points) + 0.5) / points - 0.5
    row = (np.arange(rows)[:, None] + steps).ravel()
    col = (np.arange(columns)[:, None] + steps).ravel()
    total = np.zeros((rows * points, columns * points), np.float32)
    index = np.stack(np.mgrid[-20:21, -20:21], -1).reshape(-1, 2)
    centres = optics.sensor_px(lattice.centres_mm(index) * (1 + optics.sensor_per_pupil))
    radius = optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm
    for x, y in centres:
        i, j = (np.abs(row - y) < radius).nonzero()[0], (np.abs(col - x) < radius).nonzero()[0]
        if len(i) and len(j):
            inside = (row[i, None] - y) ** 2 + (col[None, j] - x) ** 2 < radius**2
            total[i[0] : i[-1] + 1, j[0] : j[-1] + 1] += inside
    return total.reshape(rows, points, columns, points).mean((1, 3))


def white_image(optics, lattice, seed=0, response=1.0):
    random = np.random.default_rng(seed)
    light = WHITE_COUNTS * sampled_coverage(optics, lattice) * response
    return DARK_LEVEL + light + random.normal(0, READ_NOISE, light.shape)


@pytest.fixture(scope="module", params=["square", "hexagonal"])
def camera(request):
    optics, lattice = make_optics(request.param), make_lattice(request.param)
    return LightFieldDecoder.from_white(optics, lattice, white_image(optics, lattice))


def test_pixels_see_the_pupil_points_their_rays_come_from(camera):
    """Rays traced through lens centres meet pixels that decode to the rays' pupil points."""
    optics, random = camera.optics, np.random.default_rng(1)
    index = random.integers(-5, 6, size=(3000, 2))
    angle, radius = 2 * np.pi * random.random(3000), 0.9 * optics.pupil_radius_mm * np.sqrt(random.random(3000))
    pupil = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    lens = camera.lattice.centres_mm(index)
    slope = (lens - pupil) / optics.image_distance_mm  # a lens does not bend a ray through its centre
    position = optics.sensor_px(lens + optics.microlens_focal_length_mm * slope)
    col, row = np.rint(position).astype(int).T
    inside = (row >= 0) & (row < optics.sensor_shape[0]) & (col >= 0) & (col < optics.sensor_shape[1])
    at = row[inside], col[inside]
    assert inside.sum() > 1000
    assert np.array_equal(camera.lens_index[at], index[inside])
    off = (camera.pupil_mm[at] - pupil[inside]) / optics.pupil_pixel_mm
    assert np.abs(off).max() <= HALF_PIXEL


@pytest.mark.parametrize("f_number", [4.0, 3.4])
def test_coverage_is_the_area_inside_the_microimages(f_number):
    """The microimages touch at f/4 and overlap at f/3.4."""
    optics, lattice = make_optics(f_number=f_number), make_lattice()
    decoder = LightFieldDecoder.from_white(optics, lattice, white_image(optics, lattice))
    reference = sampled_coverage(optics, lattice)
    inner = (slice(1, -1), slice(1, -1))
    assert np.abs(decoder.coverage - reference)[inner].max() < SAMPLED_AREA * 4
    assert abs(decoder.coverage.sum() / reference.sum() - 1) < 1e-3  # errors of single edge pixels cancel
    assert not decoder.gaps[reference > 0].any()


def test_gain_recovers_vignetting_pixel_response_and_dead_lenses():
    optics, lattice = make_optics(), make_lattice()
    random = np.random.default_rng(3)
    rows, columns = np.mgrid[: optics.sensor_shape[0], : optics.sensor_shape[1]]
    vignetting = 1 - 0.3 * (((rows - 105) / 150) ** 2 + ((columns - 130) / 150) ** 2)
    pixels = 1 + 0.05 * random.standard_normal(rows.shape)
    plain = LightFieldDecoder.from_white(optics, lattice, white_image(optics, lattice))
    dead = (plain.lens_index == (2, -1)).all(-1)
    white = white_image(optics, lattice, response=vignetting * pixels * ~dead)
    decoder = LightFieldDecoder.from_white(optics, lattice, white)

    assert (decoder.gain[dead] == 0).all() and (decoder.smooth_gain[dead] == 0).all()
    core = (decoder.coverage > 0.99) & ~dead
    scale = np.median((vignetting * pixels)[core])
    noise = 4 * READ_NOISE / WHITE_COUNTS + 0.01  # four standard deviations, and the error of the coverage
    assert np.percentile(np.abs(decoder.gain * scale - vignetting * pixels)[core], 99) < noise
    smooth_error = (decoder.smooth_gain * scale / vignetting - 1)[core]
    assert smooth_error.std() < 0.05 / 3  # about 30 pixels per bin of the mean pattern
    assert np.allclose(decoder.shrunk_gain(1.0), decoder.gain, atol=1e-6)
    assert decoder.gain.min() >= 0 and decoder.gain.max() <= 2


def test_background_is_read_between_the_microimages(camera):
    """It needs neither a dark image nor a dark frame."""
    level, sigma = camera.background(white_image(camera.optics, camera.lattice, seed=9))
    count = camera.gaps.sum()
    assert abs(level - DARK_LEVEL) < 5 * 1.2533 * READ_NOISE / np.sqrt(count) + 0.05  # errors of median and rounding
    assert abs(sigma / READ_NOISE - 1) < 0.15


@pytest.mark.parametrize("offset", [0.0, 0.2, DARK_LEVEL])
@pytest.mark.parametrize("noise", [3.0, 8.0, 60.0])
def test_the_noise_of_a_camera_that_stores_no_negative_counts_is_known(camera, offset, noise):
    """Without an offset half of the gap pixels have no counts at all."""
    random, light = np.random.default_rng(10), WHITE_COUNTS * camera.coverage
    stored = np.rint(light + noise * (offset + random.standard_normal(light.shape))).clip(0)
    level, sigma = camera.background(stored.astype(np.uint16))
    assert abs(sigma / np.hypot(noise, WHOLE) - 1) < 0.15 + 1.4826 * HALF_COUNT / noise
    assert abs(level / noise - offset) < 5 * 1.2533 / np.sqrt(camera.gaps.sum()) + HALF_COUNT / noise


def test_sub_aperture_images_are_the_scene_at_the_lens_centres(camera):
    """The scene varies over array and pupil, and the white image is uneven."""
    optics, lattice = camera.optics, camera.lattice
    columns = np.arange(optics.sensor_shape[1])
    uneven = np.broadcast_to(1 - 0.2 * (columns / 260) ** 2, optics.sensor_shape)
    decoder = LightFieldDecoder.from_white(optics, lattice, white_image(optics, lattice, response=uneven))
    lens = lattice.centres_mm(decoder.lens_index)

    def scene(array_mm, pupil_mm):
        return 1 + 0.4 * array_mm[..., 0] - 0.3 * array_mm[..., 1] + 0.02 * pupil_mm[..., 0] + 0.01 * pupil_mm[..., 1]

    light = scene(lens, decoder.pupil_mm) * (white_image(optics, lattice, response=uneven) - DARK_LEVEL)
    for pupil in [(0.0, 0.0), (3.3, -5.1), (-6.0, 2.0)]:
        values, centres = decoder.sub_aperture(DARK_LEVEL + light, pupil)
        inside = (np.abs(centres) < 0.5).all(-1)
        expected = scene(centres, np.array(pupil))
        ratio = (values / expected)[inside]
        assert np.isfinite(ratio).all() and inside.sum() > 60
        assert np.abs(ratio - 1).max() < VIEW_ERROR


def test_sub_aperture_images_end_at_the_pupil(camera):
    values, _ = camera.sub_aperture(np.full(camera.optics.sensor_shape, 99.0), (1.3 * camera.optics.pupil_radius_mm, 0))
    assert np.isnan(values).mean() > 0.95


def test_bad_images_are_refused():
    optics, lattice = make_optics(), make_lattice()
    with pytest.raises(InputError, match="white: expected microimages brighter"):
        LightFieldDecoder.from_white(optics, lattice, np.full(optics.sensor_shape, 37, np.uint16))
    with pytest.raises(
        InputError, match=r"white: expected one grey image of shape .* = \(210, 260\), got \(210, 260, 3\)"
    ):
        LightFieldDecoder.from_white(optics, lattice, np.zeros((210, 260, 3), np.uint8))
    with pytest.raises(InputError, match=r"dark: expected .* got \(2, 2\)"):
        LightFieldDecoder.from_white(optics, lattice, white_image(optics, lattice), np.zeros((2, 2)))
