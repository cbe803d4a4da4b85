"""Images of random particles that resemble recorded ones: as many, as large and as bright, moved by a given field.

`RecordedParticles.of` measures number, size and light of the particles in recorded images. `SyntheticPair` draws
particles at random, moves them and images them with the noise of the recorded images.

The number follows from the covariance of sub-aperture images (`lfpiv.reconstruction.particle_size.SubApertures`), which
noise does not enter: of n equal particles at random places it is n k b^2 and the mean light n m b, with k and m
properties of the rig. Their ratio gives n. Images of a known number of particles give k / m^2. Of particles of unlike
brightness it is the number of equal ones with the same mean and variance of light, n <b>^2 / <b^2>.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lfpiv.damping.particle_images import ParticleImager
from lfpiv.geometry.grid import Grid
from lfpiv.reconstruction.particle_size import LIT_SHARE, SubApertures, is_above_noise
from lfpiv.weights.operator import Images, Weights

Displacement = Callable[[np.ndarray], np.ndarray]
"""Takes points (particle, 3) midway in time and returns the displacements (x, y, z) of particles there [mm]."""
Light = Callable[[np.ndarray], np.ndarray]
"""Takes points (particle, 3) [mm] and returns the relative light of a particle there."""

SIGMAS_VOXEL = (0.0, 0.4, 0.55, 0.7, 1.0, 1.5)
"""Standard deviations of the known particles that are compared with the recorded particles [voxel]."""
DRAWS = 7
"""Seed of the draws of known particles."""
REFERENCES = 3
"""Draws of known particles of each size."""
REFERENCE_LENSES = 0.05
"""Number of particles of a draw, per microlens that sees the volume: few, so that they hardly overlap."""
REFERENCE_COUNTS = (60, 2000)
"""Least and largest number of particles of a draw."""


@dataclass(frozen=True, kw_only=True)
class RecordedParticles:
    """Particles of a rig, as its images show them."""

    density: float
    """Number of equally bright particles per voxel."""
    sigma_voxel: float
    """Standard deviation of the Gaussian particles [voxel]."""
    light: Mapping[str, float]
    """Camera name -> sum of its image over the pixels that see the volume [counts]."""
    noise: Mapping[str, float]
    """Camera name -> standard deviation of the background [counts]."""
    full: Mapping[str, float]
    """Camera name -> brightest count; synthetic images are limited to it."""


class RecordedImages:
    """Estimator of the particles of one rig.

    Parameters
    ----------
    light : callable
        Relative light of a particle at a place.
    """

    def __init__(self, weights: Weights, light: Light):
        self.weights, self.light = weights, light
        even = weights(np.ones(weights.grid.shape, np.float32))
        self._sub_apertures = {name: SubApertures(camera, even[name]) for name, camera in weights.cameras.items()}
        self._seen = {name: image > LIT_SHARE * image.max() for name, image in even.items()}

    def particles(self, images: Sequence[Mapping[str, np.ndarray]], noise: Mapping[str, float]) -> RecordedParticles:
        """Measure the particles of some frames; `noise` is the noise of their background [counts].

        Raises
        ------
        ValueError
            If the images show no particles.
        """
        recorded = {name: np.mean([self.ratios(name, one[name]) for one in images], axis=0) for name in self._seen}
        shown = {name: ratios.sum(1) for name, ratios in recorded.items() if is_above_noise(ratios[0])}
        if not shown:
            raise ValueError("images: expected particles, found only noise.")
        known, sigmas = self.references, []
        for name, (same, beside) in shown.items():
            width = np.maximum.accumulate(known[name][:, 1] / known[name][:, 0])
            sigmas.append(np.interp(beside / same, width, SIGMAS_VOXEL))
        sigma = float(np.sqrt(np.mean(np.square(sigmas))))
        shares = [
            ratios.sum() / np.exp(np.interp(sigma, SIGMAS_VOXEL, np.log(known[name].sum(1))))
            for name, ratios in shown.items()
        ]
        return RecordedParticles(
            density=1 / (float(np.mean(shares)) * self.weights.grid.size),
            sigma_voxel=sigma,
            light={name: float(np.mean([self._light(name, one[name]) for one in images])) for name in self._seen},
            noise=dict(noise),
            full={name: float(max(one[name].max() for one in images)) for name in self._seen},
        )

    @cached_property
    def references(self) -> dict[str, np.ndarray]:
        """Camera name -> `ratios` of one particle in the grid, for each of `SIGMAS_VOXEL`, shape (size, 2)."""
        grid, found = self.weights.grid, {name: np.zeros((len(SIGMAS_VOXEL), 2)) for name in self._seen}
        pitches = {name: camera.optics.microimage_pitch_px for name, camera in self.weights.cameras.items()}
        lenses = min(seen.sum() / pitches[name] ** 2 for name, seen in self._seen.items())
        count = int(np.clip(REFERENCE_LENSES * lenses, *REFERENCE_COUNTS))
        for size, sigma in enumerate(SIGMAS_VOXEL):
            imager = ParticleImager(self.weights, sigma)
            for number in range(REFERENCES):
                places = random_places(grid, count, np.random.default_rng([DRAWS, number]))
                for name, image in imager(places, self.light(places)).items():
                    found[name][size] += count * self.ratios(name, image).sum(1) / REFERENCES
        return found

    def ratios(self, name: str, image: np.ndarray) -> np.ndarray:
        """Return the covariances at the same lens and one away over the square of the light, shape (2, sub-aperture).

        They are not numbers where there is no light.
        """
        covariances = self._sub_apertures[name].fluctuations(image).covariances
        return covariances / (self._light(name, image) ** 2 or np.nan)

    def _light(self, name: str, image: np.ndarray) -> float:
        return float(image[self._seen[name]].sum(dtype=np.float64))

    def seen(self, name: str) -> np.ndarray:
        """Return the pixels of a camera that see the volume, shape (rows, columns)."""
        return self._seen[name]


def random_places(grid: Grid, count: float, rng: np.random.Generator) -> np.ndarray:
    """Return random places (x, y, z) [mm] in a grid, shape (round(count), 3)."""
    edges_mm = np.array(grid.shape[::-1]) * grid.voxel_mm
    return grid.centre_mm + rng.uniform(-0.5, 0.5, (round(count), 3)) * edges_mm


class SyntheticPair:
    """Images of both frames of random particles, moved by a field."""

    def __init__(self, recorded: RecordedImages, particles: RecordedParticles):
        self.recorded, self.particles = recorded, particles
        self.imager = ParticleImager(recorded.weights, particles.sigma_voxel)

    def images(self, displacement: Displacement, rng: np.random.Generator) -> tuple[Images, Images]:
        """Return the images of both frames, with noise.

        Particles are in the grid midway in time and have the same light in both frames, also where they leave it.

        Parameters
        ----------
        displacement : callable
            Displacement (x, y, z) of particles at points midway in time [mm].
        rng : Generator
            Determines places and noise.
        """
        grid = self.recorded.weights.grid
        middle = random_places(grid, self.particles.density * grid.size, rng)
        moved, light = displacement(middle), self.recorded.light(middle)
        first, second = (self.imager(middle + sign * moved / 2, light) for sign in (-1, 1))
        scale = {name: 2 * total / self._sum(name, first, second) for name, total in self.particles.light.items()}
        return self._noisy(first, scale, rng), self._noisy(second, scale, rng)

    def _sum(self, name: str, *frames: Images) -> float:
        return float(sum(image[name][self.recorded.seen(name)].sum(dtype=np.float64) for image in frames))

    def _noisy(self, frame: Images, scale: Mapping[str, float], rng: np.random.Generator) -> Images:
        noisy = {}
        for name, image in frame.items():
            noise = self.particles.noise[name] * rng.standard_normal(image.shape, np.float32)
            noisy[name] = np.minimum(image * np.float32(scale[name]) + noise, np.float32(self.particles.full[name]))
        return noisy
