"""Board dots against an independent renderer: photons traced one by one through a thin lens and a microlens array."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lfpiv.calibration.board import label
from lfpiv.calibration.board.board import measure_board
from lfpiv.calibration.board.detect import on_lattice, search_radius_mm
from lfpiv.calibration.board.dot_fit import DotFit, converged
from lfpiv.calibration.board.dot_model import (
    BEND_ORDERS,
    TERMS,
    LensIntegral,
    SharedParameters,
    bends,
    ray_terms,
)
from lfpiv.calibration.board.dot_shared import estimate_bend, estimate_diameter, estimate_pixels, follow
from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.edges import MARGIN, find_extents, require_stated
from lfpiv.calibration.board.planes import HELD_BYTES, Planes
from lfpiv.calibration.board.pose import BIN_PITCHES
from lfpiv.errors import InputError
from lfpiv.geometry.optics import LensLattice, Optics
from lfpiv.geometry.orientation import Orientation
from lfpiv.lightfield.decoder import LightFieldDecoder

COUNTS_PER_PHOTON = 6.0
WHITE_PHOTONS = 160  # per pixel
WHITE_EXPOSURE = 0.6  # exposure of the white image over that of the boards
READ_NOISE = 2.0  # counts
DARK_LEVEL = 30.0  # counts

# All in microlens pitches. Gaussian fits are off by 0.04-0.07, and biased by as much within a lens.
MEAN_ERROR = 0.012  # photon noise of 8 % per pixel gives 0.006-0.008 in these scenes
DARK_DOT_ERROR = 0.04  # dark dots have three times the noise, from the bright board's photons
BIAS = 0.006  # mean error in any fifth of a lens: a tenth of the peak locking of Gaussian fits
WRONG_NAME_PITCHES = 2.0  # a dot named wrongly is off by its spacing, at least 4 pitches in these scenes
HONEST = (0.5, 2.0)  # limits of true over stated error; model errors are common to all labels of a dot
DIAMETER_ERROR = 0.04  # 20 % cost 0.03 pitch in the labels, so 4 % cost as much as the noise
SHARE_ERROR = 0.1  # a tenth hardly changes the weights
GRADIENT_ERROR = 0.03  # differences over 2 % of a lens smooth the gradient's kinks
FAINT = 0.25  # largest share of a dot that a pixel of an overexposed one sees
FAINT_NOISE = 0.4  # faint pixels add the read-out noise: 2 counts, where a fifth of a dot has some 30 of shot noise
BENDS = bends(BEND_ORDERS[0])
FALSE_BENDS = 0.03  # 0.001 for many dots of equal information; more for five unequal ones
F_ERROR = 5 * 0.5 / np.sqrt(20_000)  # five standard deviations of a count of 20,000 rays


@dataclass(frozen=True)
class Scene:
    """A true camera and board, and the values that the user states."""

    nominal_angle_deg: float
    yaw_deg: float
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    offset_mm: tuple = (0.0, 0.0, 0.0)
    magnification: float = 1.0  # true; the nominal one is 1
    array_roll_deg: float = 0.0
    array_offset_mm: tuple = (0.0, 0.0)
    layout: str = "square"
    sensor_shape: tuple = (640, 600)
    dots: tuple = (5, 5)
    spacing_mm: float = 0.8
    diameter_mm: float = 0.1
    planes_mm: tuple = (-1.2, 0.1, 0.9)
    visible: tuple = (25, 25, 25)  # dots of each plane with most of their light on the sensor
    dark_dots: bool = False
    missing: tuple = ()  # (plane, column, row)
    false_mm: tuple = ()  # (plane, x, y)
    full_well: float = 65535.0  # counts
    stated_diameter: float = 1.0  # stated over true diameter
    response_sd: float = 0.0  # pixel response
    spherical_pitch: float = 0.0  # displacement of a ray through the pupil's edge
    coma_pitch: float = 0.0  # the same for tangential coma along t, everywhere in the field
    focal_length_mm: float = 60.0
    pixel_mm: float = 0.0065
    seed: int = 1

    @property
    def optics(self):
        return Optics(
            focal_length_mm=self.focal_length_mm,
            magnification=-1.0,
            f_number=4.0,
            microlens_pitch_mm=0.1,
            microlens_focal_length_mm=0.8,
            pixel_mm=self.pixel_mm,
            sensor_shape=self.sensor_shape,
            layout=self.layout,
        )

    @property
    def lattice(self):
        angle = np.radians(self.array_roll_deg) + np.radians([0, 60 if self.layout == "hexagonal" else 90])
        basis = 0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return LensLattice(origin_mm=self.array_offset_mm, basis_mm=tuple(map(tuple, basis)), layout=self.layout)

    @property
    def board(self):
        return DotBoard(
            dots=self.dots, spacing_mm=self.spacing_mm, diameter_mm=self.diameter_mm, planes_mm=self.planes_mm
        )

    def array_position(self, points, pupil):
        """Trace world points through pupil points to the array, ray by ray: straight line, thin lens, straight line."""
        yaw, pitch, roll = np.radians([self.yaw_deg, self.pitch_deg, self.roll_deg])
        turn = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
        tilt = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
        spin = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
        camera = (points - np.array(self.offset_mm)) @ (spin @ tilt @ turn).T
        f = self.optics.focal_length_mm
        image_distance = self.optics.image_distance_mm
        focus = 1 / (1 / f - 1 / image_distance) / self.magnification
        slope = (pupil - camera[:, :2]) / (focus - camera[:, 2])[:, None]
        power = 1 / image_distance + 1 / focus  # the camera is focused there whatever its magnification
        p = pupil / self.optics.pupil_radius_mm
        pp = (p**2).sum(1, keepdims=True)
        aberration = self.spherical_pitch * pp * p + self.coma_pitch / 3 * (pp * [0, 1] + 2 * p[:, 1:] * p)
        return pupil + image_distance * (slope - pupil * power) + self.optics.microlens_pitch_mm * aberration


class Renderer:
    def __init__(self, scene):
        self.scene, self.optics = scene, scene.optics
        self.random = np.random.default_rng(scene.seed)
        index = np.stack(np.mgrid[-60:61, -60:61], -1).reshape(-1, 2)
        self.centres = scene.lattice.centres_mm(index)
        half = np.array(scene.sensor_shape[::-1]) * self.optics.pixel_mm / 2 + 0.2
        self.centres = self.centres[(np.abs(self.centres) < half).all(1)]
        self.tree = cKDTree(self.centres)
        self.response = 1 + scene.response_sd * self.random.standard_normal(scene.sensor_shape)

    def expected_white(self):
        """Return the photons per pixel of an even scene, by the share of 4 x 4 points inside the pupil's images."""
        optics, (rows, columns) = self.optics, self.scene.sensor_shape
        radius = optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm
        steps = np.arange(4 * (int(2 * radius) + 4)) / 4 - 0.375
        padded = np.zeros((rows + 60, columns + 60))
        for x, y in optics.sensor_px(self.centres * (1 + optics.sensor_per_pupil)):
            col, row = round(x - radius - 1.5), round(y - radius - 1.5)
            area = (
                (np.hypot(col + steps - x, (row + steps - y)[:, None]) < radius)
                .reshape(len(steps) // 4, 4, -1, 4)
                .mean((1, 3))
            )
            if -30 <= row < rows + 30 - len(area) and -30 <= col < columns + 30 - len(area):
                padded[row + 30 :, col + 30 :][: len(area), : len(area)] += area
        return WHITE_PHOTONS * padded[30:-30, 30:-30]

    def dot_photons(self, points):
        """Count the photons of dots per pixel; the dots are as bright as the white image."""
        optics, scene = self.optics, self.scene
        cell = abs(np.linalg.det(np.array(scene.lattice.basis_mm)))
        per_lens = WHITE_PHOTONS * np.pi * (optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm) ** 2
        foreshortened = np.cos(np.radians(scene.yaw_deg)) * np.pi * scene.diameter_mm**2 / 4
        count = int(len(points) * per_lens * foreshortened / cell)
        owner = self.random.integers(len(points), size=count)
        radius = np.sqrt(self.random.random((2, count)))
        angle = 2 * np.pi * self.random.random((2, count))
        disc = radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        place = points[owner].copy()
        place[:, :2] += disc[0] * scene.diameter_mm / 2
        pupil = disc[1] * optics.pupil_radius_mm
        array = scene.array_position(place, pupil)
        lens = self.centres[self.tree.query(array)[1]]
        slope = (array - pupil) / optics.image_distance_mm - (array - lens) / optics.microlens_focal_length_mm
        col, row = np.rint(optics.sensor_px(array + optics.microlens_focal_length_mm * slope)).astype(int).T
        rows, columns = scene.sensor_shape
        inside = (row >= 0) & (row < rows) & (col >= 0) & (col < columns)
        return np.bincount(row[inside] * columns + col[inside], minlength=rows * columns).reshape(rows, columns)

    def counts(self, photons):
        noise = self.random.normal(0, READ_NOISE, photons.shape)
        return np.clip(
            np.rint(DARK_LEVEL + COUNTS_PER_PHOTON * photons * self.response + noise), 0, self.scene.full_well
        ).astype(np.uint16)

    def images(self):
        """Return the white image and the images of all planes."""
        scene, white = self.scene, self.expected_white()
        images = []
        for plane in range(len(scene.planes_mm)):
            points = scene.board.points_mm(plane)
            gone = [j * scene.dots[0] + i for p, i, j in scene.missing if p == plane]
            points = np.delete(points, gone, axis=0)
            extra = [(x, y, scene.planes_mm[plane]) for p, x, y in scene.false_mm if p == plane]
            photons = self.dot_photons(np.concatenate([points, np.array(extra).reshape(-1, 3)]))
            if scene.dark_dots:
                photons = np.maximum(self.random.poisson(0.8 * white) - 0.7 * photons, 0)
            images.append(self.counts(photons))
        return self.counts(self.random.poisson(WHITE_EXPOSURE * white)), images


SCENES = {
    "square, rolled camera, wrong angle": Scene(
        nominal_angle_deg=28,
        yaw_deg=20,
        roll_deg=2,
        offset_mm=(0.15, -0.2, 0.3),
        array_roll_deg=-0.4,
        array_offset_mm=(0.02, -0.03),
        stated_diameter=1.2,
        full_well=1000,  # a third of the pixels that see only a dot reach it
        missing=((0, 2, 2), (1, 0, 4), (2, 3, 1)),
        false_mm=((0, 0.4, 0.37), (1, 2.3, 0.1), (2, -1.1, -0.9)),
    ),
    "hexagonal, steep": Scene(
        nominal_angle_deg=-44,
        yaw_deg=-50,
        pitch_deg=1,
        roll_deg=-1,
        offset_mm=(-0.2, 0.1, -0.2),
        magnification=1.06,
        layout="hexagonal",
        array_roll_deg=1.0,
        array_offset_mm=(-0.03, 0.01),
        response_sd=0.08,
        visible=(25, 25, 20),
        seed=2,
    ),
    "aberrated, few dots": Scene(
        nominal_angle_deg=38,
        yaw_deg=41,
        roll_deg=0.7,
        spherical_pitch=0.4,  # labels without the bend would be off by 0.07
        coma_pitch=0.3,
        dots=(4, 4),
        planes_mm=(-0.9, 0.8),
        visible=(16, 16),
        seed=4,
    ),
    "dark dots on a bright board": Scene(
        nominal_angle_deg=38, yaw_deg=35, pitch_deg=-0.8, magnification=0.95, dark_dots=True, seed=3
    ),
}


def measured(scene):
    white, images = Renderer(scene).images()
    decoder = LightFieldDecoder.from_white(scene.optics, scene.lattice, white)
    board = replace(scene.board, diameter_mm=scene.diameter_mm * scene.stated_diameter)
    return measure_board(images, decoder, board, orientation=Orientation(scene.nominal_angle_deg))


def label_errors(scene, dots):
    """Return labels minus true rays [pitch]."""
    return (dots.array_mm - scene.array_position(dots.points_mm, dots.pupil_mm)) / scene.optics.microlens_pitch_mm


def label_sub_lens(scene, dots):
    """Return the position of each label in its lens's cell, along (s, t) [pitch]."""
    lattice = scene.lattice
    return (dots.array_mm - lattice.centres_mm(lattice.nearest(dots.array_mm))) / lattice.pitch_mm


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_labels_follow_the_true_rays(name):
    scene = SCENES[name]
    dots = measured(scene)
    planes = len(scene.planes_mm)
    gone = np.bincount([p for p, _, _ in scene.missing], minlength=planes)
    assert np.array_equal(dots.found + gone, dots.expected)
    assert np.array_equal(dots.expected, scene.visible)
    numbers = [p * np.prod(scene.dots) + j * scene.dots[0] + i for p, i, j in scene.missing]
    assert not np.isin(numbers, dots.measured_dot).any()

    error = label_errors(scene, dots)
    assert np.hypot(*error.T).max() < WRONG_NAME_PITCHES
    assert np.hypot(*error.T).mean() < (DARK_DOT_ERROR if scene.dark_dots else MEAN_ERROR)
    sub_lens = label_sub_lens(scene, dots)
    for axis in (0, 1):
        for low in np.arange(-0.5, 0.5, 0.2):
            here = error[(sub_lens[:, axis] >= low) & (sub_lens[:, axis] < low + 0.2), axis]
            assert abs(here.mean()) < (DARK_DOT_ERROR if scene.dark_dots else BIAS)
    assert HONEST[0] < np.sqrt((error**2).mean()) * 0.1 / np.sqrt((dots.std_mm**2).mean()) < HONEST[1]

    assert abs(dots.diameter_mm / scene.diameter_mm - 1) < DIAMETER_ERROR
    noise = 1 / (WHITE_EXPOSURE * WHITE_PHOTONS)
    share = scene.response_sd**2 / (scene.response_sd**2 + noise)
    assert abs(dots.response_share - share) < SHARE_ERROR


@pytest.mark.slow
def test_noise_is_measured_where_all_bright_pixels_are_saturated(monkeypatch):
    """Of an overexposed dot only pixels are fitted that see little of it."""
    scene, found = SCENES["hexagonal, steep"], []

    def faint(fit):
        kept = fit.share < FAINT
        return replace(fit, pixel=fit.pixel[kept], share=fit.share[kept], misfit=fit.misfit[kept])

    def measure(pixels, fits):
        found.append(estimate_pixels(pixels, [faint(fit) for fit in converged(fits)]))
        return found[0]

    monkeypatch.setattr(label, "estimate_pixels", measure)
    dots = measured(scene)
    assert found[0].counts_per_photon == pytest.approx(COUNTS_PER_PHOTON, rel=FAINT_NOISE)
    assert np.array_equal(dots.found, scene.visible) and np.hypot(*label_errors(scene, dots).T).mean() < MEAN_ERROR


@pytest.mark.slow
def test_gaussian_fits_are_biased_to_lens_centres_and_the_integral_is_not():
    """Gaussian fits have the errors that were measured on other renderings."""
    scene = replace(SCENES["hexagonal, steep"], layout="square")
    white, images = Renderer(scene).images()
    decoder = LightFieldDecoder.from_white(scene.optics, scene.lattice, white)
    mean = {}
    for estimator in ("gaussian", "lens_integral"):
        dots = measure_board(
            images, decoder, scene.board, orientation=Orientation(scene.nominal_angle_deg), estimator=estimator
        )
        assert np.array_equal(dots.found, scene.visible)
        mean[estimator] = np.hypot(*label_errors(scene, dots).T).mean()
    assert 0.03 < mean["gaussian"] < 0.09  # 0.04-0.07 pitch, widened by half for other foci and foreshortening
    assert mean["lens_integral"] < mean["gaussian"] / 4


@pytest.mark.slow
def test_dots_outside_the_field_are_missing_and_overlapping_ones_are_not_biased():
    """Planes far from focus: the light of neighbouring dots overlaps on the sensor, and the board leaves the field."""
    scene = replace(SCENES["square, rolled camera, wrong angle"], planes_mm=(-4.5, 0.0, 4.5), missing=(), false_mm=())
    dots = measured(scene)
    assert dots.found[1] == 25 and (dots.found[[0, 2]] < 25).all() and (dots.found > 10).all()
    assert (dots.expected - dots.found <= 1).all()  # a dot on the edge of the field may be refused
    assert np.hypot(*label_errors(scene, dots).T).mean() < MEAN_ERROR


def slope_at(theta, pupil):
    """Return the derivative of the ray model over pupil points in radii, by differences, shape (n, 2, 2)."""
    steps = 1e-5 * np.eye(2)
    ahead, behind = (
        [ray_terms(pupil + sign * step, 1.0, BEND_ORDERS[0]) @ theta for step in steps] for sign in (1, -1)
    )
    return np.stack([(a - b) / 2e-5 for a, b in zip(ahead, behind, strict=True)], axis=-1)


@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_light_of_a_pixel_against_counted_rays(layout):
    """Compare F with counted rays of a tilted dot towards one pixel behind one lens."""
    random, optics = np.random.default_rng(5), SCENES["hexagonal, steep"].optics
    scene = replace(SCENES["hexagonal, steep"], layout=layout, sensor_shape=(200, 200))
    bend = 1e-3 * random.normal(size=(BENDS, 2))

    def model(diameter, blur):
        shared = SharedParameters(diameter_mm=diameter, blur_px=blur, bend_mm=bend)
        return LensIntegral(scene.optics, scene.lattice, shared)

    jacobian = np.array([[-0.7, 0.02], [0.03, -1.05]])
    tilt = np.zeros((2, 2, 2))
    tilt[0, 0, 0], tilt[1, 0, 1] = 0.06, 0.06
    slope = np.array([[0.02, 0.001], [-0.001, 0.018]])
    theta = 1e-2 * random.normal(size=(TERMS, 2))
    theta[1:3] = slope.T * optics.pupil_radius_mm
    offset = random.uniform(-0.11, 0.11, (60, 2))
    pupil = random.uniform(-0.7, 0.7, (60, 2))
    here = slope_at(np.vstack([theta, bend]), pupil) / optics.pupil_radius_mm
    image = np.linalg.inv(np.eye(2) - here) @ here * optics.pupil_pixel_mm  # of each pixel on the array
    pixel_mm2 = np.stack([(image[:, a] * image[:, b]).sum(1) for a, b in ((0, 0), (0, 1), (1, 1))], axis=1)
    share, gradient, growth = model(0.12, 0.4).table(jacobian, tilt, theta)(offset, pupil, pixel_mm2)

    count = 20_000
    radius, angle = 0.06 * np.sqrt(random.random(count)), 2 * np.pi * random.random(count)
    dot = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    pixel = (random.random((count, 2)) - 0.5 + 0.4 * random.standard_normal((count, 2))) * optics.pupil_pixel_mm
    inverse = np.linalg.inv(np.eye(2) - slope)
    lattice = replace(scene.lattice, origin_mm=(0.0, 0.0))
    for k in range(len(offset)):
        landed = (
            offset[k] + dot @ (jacobian + tilt @ pupil[k]).T @ inverse.T + pixel / optics.pupil_pixel_mm @ image[k].T
        )
        counted = (lattice.nearest(landed) == 0).all(1).mean()
        assert abs(share[k] - counted) < F_ERROR
    table, step = model(0.12, 0.4).table(jacobian, tilt, theta), 2e-3
    same = np.tile(table.pixel_mm2, (len(offset), 1))
    _, gradient, growth = table(offset, 0 * pupil, same)
    for axis in (0, 1):
        ahead, behind = (table(offset + sign * step * np.eye(2)[axis], 0 * pupil, same)[0] for sign in (1, -1))
        miss = (ahead - behind) / (2 * step) - gradient[:, axis]
        assert np.sqrt((miss**2).mean()) < GRADIENT_ERROR * np.abs(gradient).max()
    for column, steps in enumerate([(0.05, 0), (0, 0.05)]):
        up, down = (
            model(0.12 * np.exp(sign * steps[0]), np.sqrt(0.16 + sign * steps[1])).table(jacobian, tilt, theta)(
                offset, 0 * pupil, same
            )[0]
            for sign in (1, -1)
        )
        miss = (up - down) / 0.1 - growth[:, column]
        assert np.sqrt((miss**2).mean()) < GRADIENT_ERROR * np.abs(growth[:, column]).max()


def fits_with_bend(bend, count, scatter, start, random):
    """Return fits by the bend `start` of dots with a common bend, and errors `scatter` times the stated ones."""
    size, fits = 2 * BENDS, []
    following = random.normal(size=(2 * TERMS, size + 2))
    for _ in range(count):
        information = np.cov(random.normal(size=(size + 2, 3 * size)))
        error = scatter * np.linalg.cholesky(information[2:, 2:]) @ random.normal(size=size)
        pull = np.concatenate([random.normal(size=2), information[2:, 2:] @ (bend - start).T.ravel() + error])
        given = {"coefficients": np.zeros((TERMS, 2)), "pull": pull, "pull_information": information}
        given |= {"following": following, "reduced_chi2": 1.0, "converged": True}
        fits.append(DotFit(**{name: given.get(name) for name in DotFit.__dataclass_fields__}))
    return fits, following


@pytest.mark.parametrize("count", [5, 60])
def test_a_bend_is_found_in_all_dots_and_none_is_found_in_noise(count):
    """The error of each dot is as large as the bend, and twice the stated one."""
    random, pitch = np.random.default_rng(7), 30.0  # so large that the prior has no effect
    none = np.zeros((BENDS, 2))
    start = SharedParameters(diameter_mm=0.1, blur_px=0.3, bend_mm=0.5 * random.normal(size=(BENDS, 2)))
    found = [
        estimate_bend(start, [None, *fits_with_bend(none, count, 2.0, start.bend_mm, random)[0]], pitch).bend_mm
        for _ in range(200)
    ]
    assert np.mean([bend.any() for bend in found]) < FALSE_BENDS
    true = 2.5 * random.normal(size=(BENDS, 2))
    fits, following = fits_with_bend(true, count, 2.0, start.bend_mm, random)
    shared = estimate_bend(start, fits, pitch)
    assert (
        np.abs(shared.bend_mm - true).max() < 5 * 2 / np.sqrt(count) * 1.5
    )  # five standard errors, and a half for dots of little information
    moved = follow([None, *fits], start, shared)
    assert moved[0] is None
    change = following[:, 2:] @ (shared.bend_mm - start.bend_mm).T.ravel()
    assert np.allclose(moved[1].coefficients.T.ravel(), change)


def test_the_diameter_of_all_dots_is_their_weighted_mean_and_the_fits_follow_it():
    random = np.random.default_rng(8)
    start = SharedParameters(diameter_mm=0.1, blur_px=0.3, bend_mm=np.zeros((BENDS, 2)))
    fits, following = fits_with_bend(start.bend_mm, 20, 0.0, start.bend_mm, random)
    weight = np.array([fit.pull_information[0, 0] for fit in fits])
    shown = 0.02 * random.normal(size=len(fits))
    fits = [replace(fit, pull=np.append(w * d, fit.pull[1:])) for fit, w, d in zip(fits, weight, shown, strict=True)]
    shared = estimate_diameter(start, [*fits, None])
    assert np.log(shared.diameter_mm / 0.1) == pytest.approx(np.average(shown, weights=weight), rel=1e-6)
    assert shared.blur_px == start.blur_px and not shared.bend_mm.any()
    moved = follow(fits, start, shared)[0].coefficients.T.ravel()
    assert np.allclose(moved, following[:, 0] * np.log(shared.diameter_mm / 0.1))


@pytest.mark.parametrize("spacing_pitches", [3.2, 4.5, 7.0])
def test_fine_boards_in_focus_are_distinguished_from_chance(spacing_pitches):
    """Focused dots scatter by half a lens, chance blobs over the whole search radius."""
    random, pitch = np.random.default_rng(2), 0.1
    board = DotBoard(dots=(7, 7), spacing_mm=spacing_pitches * pitch, diameter_mm=0.1, planes_mm=(0.0,))
    places = board.points_mm(0)[:, :2]
    focused = random.uniform(-pitch / 2, pitch / 2, places.shape)
    angle, radius = 2 * np.pi * random.random(49), search_radius_mm(board) * np.sqrt(random.random(49))
    anywhere = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert on_lattice(focused, places, board, BIN_PITCHES * pitch)
    assert not on_lattice(anywhere, places, board, BIN_PITCHES * pitch)


@pytest.mark.parametrize("dots", [(4, 6), (6, 7), (7, 7)])
def test_misses_that_windows_and_liquids_bend_are_a_board_s(dots):
    """Misses of the order that the number of dots determines: quadratic for 24, cubic for 42 and 49."""
    random = np.random.default_rng(3)
    board = DotBoard(dots=dots, spacing_mm=0.8, diameter_mm=0.1, planes_mm=(0.0,))
    places = board.points_mm(0)[:, :2]
    x, y = (places / np.abs(places).max(0)).T
    bent = np.stack([x * x - y, x * y], axis=1) + (len(x) > 24) * np.stack([x**3, -x * y * y], axis=1)
    bent *= search_radius_mm(board) / np.hypot(*bent.T).max()
    angle, radius = (
        2 * np.pi * random.random(len(places)),
        search_radius_mm(board) * np.sqrt(random.random(len(places))),
    )
    anywhere = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert on_lattice(bent + 0.02 * random.normal(size=bent.shape), places, board, 0.035)
    assert not on_lattice(anywhere, places, board, 0.035)


def test_board_images_are_held_as_far_as_memory_allows():
    rng, asked = np.random.default_rng(0), []
    whole = rng.integers(0, 4096, (12, 6, 7)).astype(np.float32)
    whole[1] += 0.5  # not whole counts

    def read(plane):
        asked.append(plane)
        return whole[plane]

    planes = Planes(read, len(whole))
    for _ in range(3):
        assert all(np.array_equal(image, true) for image, true in zip(planes, whole, strict=True))
    held = HELD_BYTES // 2
    assert [asked.count(plane) for plane in range(12)] == [1, 3, *[1] * (held - 1), *[3] * (11 - held)]


def seen_board(true, stated, view, offset=(0, 0), planes=3, hidden=()):
    """Return the sites found and in view on the lattice of a stated board; `view` and `offset` in its columns and rows.

    The true board's first dot is named `offset`; the camera sees the names `view` = (first, last) of columns and rows.
    """
    rows, columns = stated[1] + 2 * MARGIN, stated[0] + 2 * MARGIN
    row, column = np.mgrid[:rows, :columns] - MARGIN
    inside = (column >= view[0][0]) & (column <= view[0][1]) & (row >= view[1][0]) & (row <= view[1][1])
    there = (column >= offset[0]) & (column < offset[0] + true[0]) & (row >= offset[1]) & (row < offset[1] + true[1])
    found = there & inside & ~np.isin(column, hidden)
    rng = np.random.default_rng(0)
    found = np.stack([(found & (rng.random(found.shape) > 0.1)) | (rng.random(found.shape) < 0.02)] * planes)
    return found, np.stack([inside] * planes)


ALL = ((-9, 20), (-9, 20))


def test_the_outline_names_the_dots():
    """The names follow the edges in view: of a whole board, a board cut on one side, and one cut on both."""
    for offset in ((0, 0), (1, -1), (-2, 0)):
        columns, rows = find_extents(*seen_board((7, 7), (7, 7), ALL, offset), (7, 7))
        assert (columns.shift, rows.shift) == offset and columns.fits and rows.fits
    columns, _ = find_extents(*seen_board((7, 7), (7, 7), ((-9, 4), (-9, 20)), (1, 0)), (7, 7))  # its right side is cut
    assert columns.starts and not columns.ends and columns.shift == 1 and columns.fits
    columns, _ = find_extents(*seen_board((7, 7), (7, 7), ((3, 20), (-9, 20)), (-1, 0)), (7, 7))  # its left side
    assert columns.ends and not columns.starts and columns.shift == -1 and columns.fits
    columns, rows = find_extents(*seen_board((9, 9), (20, 20), ((5, 12), (5, 12)), (4, 4)), (20, 20))
    assert (
        columns.open and rows.open and columns.shift == 0 and columns.fits
    )  # no edge: the nominal axis names the dots


@pytest.mark.parametrize("stated", [(8, 8), (7, 8), (6, 6), (5, 7), (12, 7)])
def test_another_number_of_dots_than_stated_is_refused(stated):
    offset = tuple((n - 7) // 2 for n in stated)
    found, in_view = seen_board((7, 7), stated, ALL, offset)
    extents = find_extents(found, in_view, stated)
    with pytest.raises(InputError, match=r"planes 0-2: 7 x 7.* Set dots = \[7, 7\]"):
        require_stated(extents, found)


def test_a_hidden_edge_is_refused_and_a_hidden_middle_is_not():
    found, in_view = seen_board((7, 7), (7, 7), ALL, hidden=(0,))
    with pytest.raises(InputError, match="6 columns"):
        require_stated(find_extents(found, in_view, (7, 7)), found)
    found, in_view = seen_board((7, 7), (7, 7), ALL, hidden=(3,))
    require_stated(find_extents(found, in_view, (7, 7)), found)
    found, in_view = seen_board((5, 7), (7, 5), ALL, (1, -1))
    with pytest.raises(InputError, match="turn this camera's pictures by 90 degrees"):
        require_stated(find_extents(found, in_view, (7, 5)), found)


def test_bad_boards_are_refused():
    scene = replace(SCENES["square, rolled camera, wrong angle"], sensor_shape=(200, 200))
    renderer = Renderer(scene)
    white = renderer.counts(renderer.expected_white())
    decoder = LightFieldDecoder.from_white(scene.optics, scene.lattice, white)
    empty = [renderer.counts(np.zeros(scene.sensor_shape)) for _ in scene.planes_mm]
    with pytest.raises(InputError, match=r"expected a lattice of 5 x 5 dots, 0.8 mm apart"):
        measure_board(empty, decoder, scene.board, orientation=Orientation(20))
    with pytest.raises(InputError, match="expected one per plane, 3, got 2"):
        measure_board(empty[:2], decoder, scene.board, orientation=Orientation(20))
    with pytest.raises(InputError, match=r"plane 1 of the board: expected an image of shape \(200, 200\)"):
        measure_board([empty[0], np.zeros((3, 3)), empty[2]], decoder, scene.board, orientation=Orientation(20))
    holed = empty[1].astype(float)
    holed[5, 5] = np.nan
    with pytest.raises(InputError, match=r"plane 1 of the board: expected finite counts, got 1 pixels"):
        measure_board([empty[0], holed, empty[2]], decoder, scene.board, orientation=Orientation(20))
    with pytest.raises(ValueError, match="orientation: expected the planned orientation"):
        measure_board(empty, decoder, scene.board)
    with pytest.raises(ValueError, match="estimator: expected one of 'lens_integral', 'gaussian'"):
        measure_board(empty, decoder, scene.board, orientation=Orientation(20), estimator="centroid")
