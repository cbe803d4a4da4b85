"""Particles of a simulated scene: places, motion, size and brightness."""

from __future__ import annotations

import logging
from typing import NamedTuple

import numpy as np

from lfpiv.errors import InputError
from lfpiv.simulation.flows import Tracers
from lfpiv.simulation.light import Brightness, pair_light
from lfpiv.simulation.scene import Scene

log = logging.getLogger(__name__)

LEAST_INTENSITY = 0.3
"""Lower limit of a particle's intensity relative to the mean, before `Brightness` scatters it."""


class PlacedParticles(NamedTuple):
    """Particles of one image pair."""

    position_mm: np.ndarray
    """Positions midway between the frames (x, y, z) [mm], shape (particle, 3)."""
    displacement_mm: np.ndarray
    """Displacements from the first to the second frame [mm], shape (particle, 3)."""
    intensity: np.ndarray
    """Intensities relative to the mean, shape (particle,)."""
    diameter: np.ndarray
    """Diameters relative to the median, shape (particle,)."""
    camera_factor: np.ndarray
    """Factor of the intensity in each camera, shape (camera, particle)."""

    def at_frame(self, frame: str) -> np.ndarray:
        """Return the positions in frame "a" or "b", shape (particle, 3) [mm]."""
        return self.position_mm + (-0.5 if frame == "a" else 0.5) * self.displacement_mm


class LitParticles(NamedTuple):
    """Particles of one image pair and their light."""

    placed: PlacedParticles
    """The particles."""
    power: np.ndarray
    """Power of both pulses relative to the stated one, shape (2,)."""
    brightness: np.ndarray
    """Light of each particle in each camera and frame, relative to the mean, shape (camera, 2, particle)."""


def place_particles(scene: Scene, pair: int) -> PlacedParticles:
    """Place the particles of one image pair.

    Parameters
    ----------
    pair : int
        Number of the pair, from 0. Each pair has its own particles.

    Raises
    ------
    InputError
        If the scene has less than one particle, or its walls leave none.
    ValueError
        If the scene is a time series.
    """
    if scene.particles.instants is not None:
        raise ValueError("scene: expected a scene with pairs, got one with particles.instants. Call place_series.")
    rng = np.random.default_rng([scene.seed, 1, pair])
    size, count = seeded_size_mm(scene), seeded_count(scene)
    if isinstance(scene.flow, Tracers) and scene.flow.as_given:
        position, displacement = scene.flow.tracers()
        inside = np.flatnonzero((np.abs(position - scene.volume.centre_mm) <= size / 2).all(1))
        if len(inside) < count:
            log.warning("pair %d: %d particles wanted, the tracer file has %d in the volume", pair, count, len(inside))
        chosen = rng.permutation(inside)[:count]
        position, displacement = position[chosen], displacement[chosen]
    else:
        position = np.asarray(scene.volume.centre_mm) + rng.uniform(-0.5, 0.5, (count, 3)) * size
        displacement = scene.flow_of(pair)(position)
    intensity = np.maximum(LEAST_INTENSITY, 1 + scene.particles.intensity_sd * rng.standard_normal(len(position)))
    scatter = scene.brightness or Brightness()
    diameter = scatter.diameters(len(position), np.random.default_rng([scene.seed, 21, pair]))
    factor = scatter.camera_factors(len(scene.camera), len(position), np.random.default_rng([scene.seed, 22, pair]))
    intensity = intensity * scatter.intensity_of(diameter)
    if scene.wall is None:
        return PlacedParticles(position, displacement, intensity, diameter, factor)
    # a particle must not be in a wall in either frame, nor midway
    fluid = ~np.any([scene.solid(position + part * displacement) for part in (-0.5, 0.0, 0.5)], axis=0)
    if not fluid.any():
        raise InputError(
            f"wall: expected fluid in the volume, found that the walls leave no particle of pair {pair}. Move or "
            "shrink them."
        )
    return PlacedParticles(position[fluid], displacement[fluid], intensity[fluid], diameter[fluid], factor[:, fluid])


def seeded_size_mm(scene: Scene) -> np.ndarray:
    """Return the size of the seeded region (x, y, z) [mm]; its centre is the volume's."""
    size = scene.particles.fill * np.asarray(scene.volume.size_mm)
    margin = scene.particles.margin_mm
    return size if margin is None else size + 2 * np.asarray(margin)


def seeded_count(scene: Scene) -> int:
    """Return the number of particles in the seeded region, before those in walls are removed."""
    particles = scene.particles
    if particles.count is not None:
        return particles.count
    first, size = scene.camera[0], particles.fill * np.asarray(scene.volume.size_mm)
    cell = abs(np.linalg.det(first.lattice.basis_mm)) / first.magnification**2  # area of a microlens in the volume
    count: int = round(particles.per_microlens * size[0] * size[1] / cell)
    if particles.margin_mm is not None:
        count = round(count * float(np.prod(seeded_size_mm(scene) / size)))
    if count < 1:
        raise InputError(
            f"particles.per_microlens: expected at least one particle, found {particles.per_microlens:g}, which "
            "gives none in this volume. Raise it, or give particles.count."
        )
    return count


def lit_particles(scene: Scene, pair: int) -> LitParticles:
    """Return the particles of one image pair with the light of its two pulses; parameters as of `place_particles`."""
    placed = place_particles(scene, pair)
    rng = np.random.default_rng([scene.seed, 23, pair])
    light = pair_light(
        scene.sheet, placed.intensity * placed.camera_factor, (placed.at_frame("a"), placed.at_frame("b")), rng
    )
    return LitParticles(placed, light.power, light.brightness)
