"""Ideal cameras by the protocol that docs/contribute.md states, particles in front of them, and SMART in NumPy."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse

import lfpiv

PITCH_MM = 0.1


def rotation(yaw_deg, pitch_deg=0.0):
    """Return the matrix from world axes to those of a camera (Eqs. 1-3)."""
    a, b = np.radians([yaw_deg, pitch_deg])
    about_y = [[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]]
    about_x = [[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]]
    return np.array(about_x) @ about_y


@dataclass
class Camera:
    """A thin lens; `coma` adds terms of second order in the pupil [mm at its edge]."""

    name: str
    yaw_deg: float
    layout: str = "square"
    roll_deg: float = 0.0
    coma: float = 0.0
    light: float = 1.0
    """Brightness of its images relative to those of others."""
    optics: lfpiv.Optics = field(init=False)
    lattice: lfpiv.LensLattice = field(init=False)
    gain: np.ndarray = field(init=False)

    def __post_init__(self):
        self.optics = lfpiv.Optics(
            focal_length_mm=100.0,
            magnification=-1.0,
            f_number=4.0,
            microlens_pitch_mm=PITCH_MM,
            microlens_focal_length_mm=0.8,
            pixel_mm=0.011,
            sensor_shape=(200, 240),
            layout=self.layout,
        )
        a = np.radians(self.roll_deg)
        second = (0.0, 1.0) if self.layout == "square" else (0.5, np.sqrt(3) / 2)
        turn = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
        basis = PITCH_MM * np.array([(1.0, 0.0), second]) @ turn
        self.lattice = lfpiv.LensLattice(
            origin_mm=(0.031, -0.022), basis_mm=tuple(map(tuple, basis)), layout=self.layout
        )
        rows, columns = np.indices(self.optics.sensor_shape)
        self.gain = (1 - 0.1 * np.hypot(rows / 200 - 0.5, columns / 240 - 0.5)).astype(np.float32)

    def map(self, points, pupil):
        """Return where rays from points (n, 3) through the pupil (n, 2) meet the array [mm], shape (n, 2)."""
        seen = np.asarray(points, float) @ rotation(self.yaw_deg, 0.3).T
        pupil = np.asarray(pupil, float)
        image_mm, f = 200.0, self.optics.focal_length_mm
        m = image_mm / (200.0 - seen[:, 2:])
        met = (1 - image_mm / f + m) * pupil - m * seen[:, :2]
        u, v = (pupil / 12.5).T  # the radius of the pupil [mm]
        return met + self.coma * np.stack([u**2 + v**2 / 3, 2 * u * v / 3], axis=1)

    def map_fan(self, points, pupil):
        """Return where each point's rays through each place of the pupil meet the array, shape (n, k, 2)."""
        every = np.repeat(points, len(pupil), axis=0), np.tile(pupil, (len(points), 1))
        return self.map(*every).reshape(len(points), len(pupil), 2).astype(np.float32)


@dataclass
class Rig:
    """Cameras about a volume, and what they record of particles in it."""

    cameras: tuple[Camera, ...]
    shape: tuple[int, int, int] = (8, 12, 12)
    options: dict = field(default_factory=dict)
    """Further arguments of `lfpiv.build_weights`."""
    voxel_mm: float = 0.1
    particles: int = 12

    @cached_property
    def weights(self):
        size_mm = tuple(count * self.voxel_mm for count in self.shape[::-1])
        grid = lfpiv.Grid.from_extent(centre_mm=(0.0, 0.0, 0.0), size_mm=size_mm, voxel_mm=self.voxel_mm)
        calibration = lfpiv.Calibration({camera.name: camera for camera in self.cameras})
        return lfpiv.build_weights(calibration, grid, **self.options)

    def blobs(self, seed, *, sigma_voxel=0.8, moved_voxel=(0.0, 0.0, 0.0)):
        """Return a volume of Gaussian particles, moved by (x, y, z)."""
        rng = np.random.default_rng(seed)
        places = rng.uniform(1.5, np.array(self.shape) - 2.5, (self.particles, 3)) + np.array(moved_voxel)[::-1]
        axes = [
            np.exp(-0.5 * ((np.arange(n) - at[:, None]) / sigma_voxel) ** 2)
            for n, at in zip(self.shape, places.T, strict=True)
        ]
        return 1000 * np.einsum("pz,py,px->zyx", *axes).astype(np.float32)

    def cloud(self, seed):
        """Return a volume whose voxels all hold light, unlike in brightness."""
        return np.random.default_rng(seed).lognormal(3, 1, self.shape).astype(np.float32)

    def images(self, volume, *, noise=0.0, seed=0):
        """Return the images of a volume, with noise [counts]."""
        rng = np.random.default_rng(seed)
        light = {camera.name: camera.light for camera in self.cameras}
        return {
            name: (light[name] * image + noise * rng.standard_normal(image.shape)).astype(np.float32)
            for name, image in self.weights(volume).items()
        }


def pair_of_cameras(**more):
    """Return cameras at 45 degrees to both sides."""
    return Camera("left", 44.6, **more), Camera("right", -45.4, **more)


def pixels(images):
    """Return the pixels of all cameras one after the other, shape (pixel,)."""
    return np.concatenate([np.asarray(image, float).ravel() for image in images.values()])


def matrix(weights):
    """Return the explicit matrix: a row for each pixel of all cameras, a column for each voxel in order (z, y, x)."""
    columns, unit = [], np.zeros(weights.grid.shape, np.float32)
    for voxel in np.ndindex(unit.shape):
        unit[voxel] = 1
        columns.append(scipy.sparse.csr_array(pixels(weights(unit))[None]))
        unit[voxel] = 0
    return scipy.sparse.vstack(columns).T.tocsr()


def plain_smart(matrix, pixels, volume, floor, iterations):
    """Return volume and misfits of SMART as `lfpiv.reconstruct` states it, on an explicit matrix."""
    misfits, sums = [], matrix.sum(axis=0)
    for iteration in range(iterations + 1):
        seen = matrix @ volume + floor
        misfits.append((seen * np.log(seen / (pixels + floor)) - seen + pixels + floor).sum())
        if iteration < iterations:
            volume = volume * np.exp(matrix.T @ np.log((pixels + floor) / seen) / sums)
    return volume, np.array(misfits)
