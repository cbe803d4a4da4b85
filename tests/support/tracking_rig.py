"""A small rig of ideal cameras, and images of particles in it that rays of the simulator render."""

import numpy as np
from support.ideal_rig import IdealCamera, IdealRig, lattice, optics, rotation

from lfpiv.geometry.grid import Grid
from lfpiv.tracking.refinement import Scene, rendered
from lfpiv.weights.operator import build_weights
from lfpiv_kernels.rendering import render

VOXEL_MM = 0.1
SIGMA_VOXEL = 0.7
LIGHT = 300.0
"""Level of a pixel of a microimage that one particle lights alone [counts]."""
READ_NOISE = 3.0
PER_COUNT = 2.5
"""Electrons per count."""


class TrackingRig:
    """Cameras about a volume of 12 x 16 x 16 voxels and a voxel more at each face."""

    def __init__(self, angles=(45.0, -45.0), layout="square"):
        seen = optics(220, 260, layout, pixel_mm=0.011)
        self.cameras = {
            f"cam{number}": IdealCamera(f"cam{number}", rotation(angle, 0.2), seen, lattice(layout, 0.1 * number))
            for number, angle in enumerate(angles)
        }
        self.grid = Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.6, 1.6, 1.2), voxel_mm=VOXEL_MM)
        self.weights = build_weights(IdealRig(self.cameras), self.grid.padded(((1, 1),) * 3))

    def random(self, count, seed):
        """Return random positions in the volume, shape (count, 3) [mm]."""
        return np.random.default_rng(seed).uniform(-0.5, 0.5, (count, 3)) * (1.6, 1.6, 1.2)

    def images(self, positions_mm, seed, *, cameras=None, noise=True):
        """Render particles, only in some `cameras` if they are named, with shot noise and read noise or without."""
        rays, images = render.ray_table(16384, "gaussian", 0), {}
        for number, (name, camera) in enumerate(self.cameras.items()):
            rng = np.random.default_rng([seed, number])
            eye = _eye(camera)
            lit = positions_mm if cameras is None or name in cameras else positions_mm[:0]
            light = np.zeros(camera.optics.sensor_shape)
            if len(lit):
                counts = np.full(len(lit), LIGHT * eye.microimage_px)
                light = render.render_sources(eye, lit, counts, SIGMA_VOXEL * VOXEL_MM, rays, rng=rng)
            if not noise:
                images[name] = light
                continue
            shot = rng.poisson(light * PER_COUNT) / PER_COUNT
            images[name] = (shot + READ_NOISE * rng.standard_normal(shot.shape)).astype(np.float32)
        return images


def _eye(camera):
    """Return the simulator's form of an ideal camera."""
    optics = camera.optics
    return render.RenderCamera(
        object_distance_mm=optics.object_distance_mm,
        image_distance_mm=optics.image_distance_mm,
        pupil_radius_mm=optics.pupil_radius_mm,
        sensor_per_pupil=optics.sensor_per_pupil,
        pixel_mm=optics.pixel_mm,
        sensor_shape=optics.sensor_shape,
        rotation=camera.pose,
        offset_mm=np.zeros(3),
        origin_mm=np.asarray(camera.lattice.origin_mm),
        basis_mm=np.asarray(camera.lattice.basis_mm),
        hexagonal=camera.lattice.layout != "square",
        lens_gain=np.ones((80, 80), np.float32),
        first_lens=(-40, -40),
    )


def noisy_scene(images, places_mm, light):
    """Return the noisy images of particles."""
    true = rendered(images, images.lists(places_mm), light)
    noise = READ_NOISE * np.random.default_rng(0).standard_normal(true.shape)
    return Scene(counts=(true + noise).astype(np.float32), read_variance=np.full_like(true, READ_NOISE**2))
