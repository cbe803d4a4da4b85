"""Particles of one instant while they are fitted to its images: model, background, noise and scatter of light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from lfpiv.tracking import confirmation
from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Cloud, Normal, Scene, refine
from lfpiv.tracking.surroundings import surroundings

DARK_SHARE = 0.3
"""Largest light of particles in a pixel that shows the background [noise]."""
START_SCATTER = 0.5
"""Relative scatter of light between cameras that is assumed at first."""
PROBES = 30
"""Number of candidates that tell how much light is significant."""


@dataclass(kw_only=True)
class Fit:
    """Particles that are being refined."""

    model: ParticleImages
    scene: Scene
    cloud: Cloud
    images: Mapping[str, np.ndarray]
    """Images as they were given [counts]."""
    noise: Mapping[str, float]
    """Noise of the images where they do not show it [counts]."""
    whole: Mapping[str, np.ndarray]
    """Pixels of each camera inside a microimage, shape (rows, columns), bool."""
    standing: Mapping[str, np.ndarray]
    """Standing light that was subtracted from the images of some cameras [counts], 0 where none stands."""
    largest_voxel: float
    """Largest size of the particles [voxel]."""
    scatter: float = START_SCATTER
    """Relative scatter of light between the cameras."""
    error: float = 0.0
    """Relative error of the model of a particle's image."""
    normal: Normal = field(init=False, repr=False)
    """Equations of the particles, linearised by `refine`."""

    @property
    def residual(self) -> np.ndarray:
        """What the particles leave of the images [counts], shape (pixel,)."""
        return self.scene.residual(self.normal.model)

    def gain(self, before: np.ndarray) -> float:
        """Return how far the squares of the residuals, in units of noise, have fallen from `before`."""
        fallen = np.square(before) - np.square(self.residual)
        return float((fallen / self.scene.variance(self.normal.model)).sum(dtype=np.float64))

    def refine(self, steps: int) -> None:
        """Refine positions and light, and with each step the noise of the pixels."""
        for _ in range(steps):
            self.cloud, self.normal = refine(self.model, self.scene, self.cloud, iterations=1, scatter=self.scatter)
            self.scene = self.scene.calibrated(self.normal.model)

    def surround(self) -> None:
        """Measure the background again, where the model of the particles is dark."""
        counts, variance = [], []
        for number, (name, image) in enumerate(self.images.items()):
            span = slice(*self.model.first_pixel[number : number + 2])
            model = self.normal.model[span].reshape(image.shape)
            dark = model < DARK_SHARE * np.sqrt(self.scene.read_variance[span]).reshape(image.shape)
            unlit = self.whole[name] & dark
            level, deviation = surroundings(image - model, self.noise[name], unlit, self.standing.get(name))
            counts.append((image - level).reshape(-1))
            variance.append(np.square(deviation).reshape(-1))
        self.scene = replace(self.scene, counts=np.concatenate(counts), read_variance=np.concatenate(variance))


def scene_of(
    images: Mapping[str, np.ndarray],
    noise: Mapping[str, float],
    clipped: np.ndarray | None,
    whole: Mapping[str, np.ndarray],
    standing: Mapping[str, np.ndarray],
) -> Scene:
    """Return the scene above the background that images without a model of their particles show."""
    found = {name: surroundings(image, noise[name], whole[name], standing.get(name)) for name, image in images.items()}
    counts = np.concatenate([(image - found[name][0]).reshape(-1) for name, image in images.items()])
    variance = np.concatenate([np.square(deviation).reshape(-1) for _, deviation in found.values()])
    return Scene(counts=counts, read_variance=variance, clipped=clipped)


def faint_light(model: ParticleImages, scene: Scene, cloud: Cloud) -> float:
    """Return the light of a particle that is just significant above the background [counts]."""
    some = cloud.positions_mm[np.linspace(0, len(cloud) - 1, PROBES).astype(int)] if len(cloud) else cloud.positions_mm
    errors = []
    for camera, own in enumerate(model.lists(some)):
        variance = scene.read_variance[own.pixel + model.first_pixel[camera]]
        particle = np.repeat(np.arange(len(some)), np.diff(own.first))
        information = np.bincount(particle, np.square(own.values[:, 3]) / variance, minlength=len(some))
        errors.append(1 / np.sqrt(np.maximum(information, 1e-30)))
    return confirmation.SIGNIFICANCE * float(np.median(np.min(errors, axis=0))) if len(some) else 0.0
