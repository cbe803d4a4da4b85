"""`measure_damping`: what ghosts take from a flow's fluctuations, measured in simulated pairs of the same rig and flow.

A parametric bootstrap: random particles as many, as large and as bright as the recorded ones are moved by a measured
field, imaged through the calibrated mappings with noise, and measured with the same settings. What the measurement
leaves of the imposed displacement is the damping (`lfpiv.velocity.damping`).

A measured field has errors, and its fluctuations are damped already. So the simulated flow has the amplitudes with
which simulated vectors have the power of the recorded ones (`LikelyFlow`). A pilot pair, moved by the measured field,
makes the start.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import xarray as xr

from lfpiv.damping.likely_flow import LikelyFlow
from lfpiv.damping.particle_light import LightField
from lfpiv.damping.synthetic_pair import RecordedImages, RecordedParticles, SyntheticPair
from lfpiv.progress import StepProgress
from lfpiv.reconstruction.dark_noise import dark_noise
from lfpiv.velocity.damping import Damping, displacement
from lfpiv.velocity.damping_estimate import Simulated, estimate_damping
from lfpiv.velocity.imposed_field import ImposedField
from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

Images = Mapping[str, np.ndarray]
Measure = Callable[[Sequence[Images], Sequence[Mapping[str, float]]], xr.Dataset]
"""Takes the images of both frames and the noise of their background, and returns the vectors, as of recorded images."""

SEED = 20_260
"""Seed of all draws. Those of each pair also depend on its number alone."""
PILOTED = 2
"""Number of simulated pairs whose flow is made with the pilot, whose flow is the least alike."""


def measure_damping(
    weights: Weights,
    vectors: Sequence[xr.Dataset],
    images: Sequence[Images],
    measure: Measure,
    *,
    pairs: int = 3,
    noise: Mapping[str, float] | None = None,
    volume: np.ndarray | None = None,
    progress: StepProgress | None = None,
) -> Damping:
    """Measure the damping of fluctuations and the offset of each displacement component in simulated pairs.

    Parameters
    ----------
    weights : Weights
        The operator of the reconstruction.
    vectors : sequence of Datasets
        Vectors of recorded pairs of one flow, from `measure` or a run; the more, the better is the flow told from
        errors. The flows of as many as are simulated are imitated, evenly spread.
    images : sequence of mappings of str to ndarray
        Images of some recorded frames, background subtracted: their particles are imitated.
    measure : callable
        ``measure(frames, noise)`` returns the vectors of the images of both frames, measured with the same settings as
        `vectors`. `noise` has the noise of each frame's background for `reconstruct_pair`'s `floor`.
    pairs : int
        Number of simulated pairs, >= 1. A pilot pair comes before them.
    noise : mapping of str to float, optional
        Noise of each camera's background [counts]; default: that of the dark pixels.
    volume : ndarray, shape (z, y, x), optional
        Volume of a recorded frame on the grid of the weights, whose smoothed intensity is the light of the particles;
        default: particles are equally bright in the whole grid.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    Damping
        ``damping.unbiased(vectors)`` takes it off vectors.

    Raises
    ------
    ValueError
        If an argument is out of its range, images show no particles, or hardly any simulated vector is valid.

    References
    ----------
    .. [1] B. Efron, R. J. Tibshirani, "An Introduction to the Bootstrap", Chapman & Hall, 1993, section 6.5.
    """
    if not (isinstance(pairs, (int, np.integer)) and pairs >= 1):
        raise ValueError(f"pairs: expected a whole number >= 1, got {pairs!r}.")
    usable = [one for one in vectors if one["valid"].values.any()]
    if not usable or not images:
        raise ValueError("vectors, images: expected those of at least one pair with valid vectors, got none.")
    recorded = RecordedImages(weights, LightField(weights.grid, volume))
    particles = recorded.particles(images, _noise(images) if noise is None else noise)
    text = (
        "damping by ghosts: pairs are simulated with particles like the recorded ones, %.2g per voxel, %.2f voxel wide"
    )
    log.info(text, particles.density, particles.sigma_voxel)
    return _Bootstrap(recorded, particles, measure, usable).run(int(pairs), progress or (lambda fraction: None))


class _Bootstrap:
    """Simulated pairs one after the other."""

    def __init__(
        self,
        recorded: RecordedImages,
        particles: RecordedParticles,
        measure: Measure,
        vectors: Sequence[xr.Dataset],
    ):
        self._pair = SyntheticPair(recorded, particles)
        self._noise = particles.noise
        self._measure = measure
        self._vectors = vectors
        self._fields = [displacement(one) for one in vectors]
        self._flow = LikelyFlow(self._fields)

    def run(self, pairs: int, progress: StepProgress) -> Damping:
        """Simulate the pilot and the pairs; return the damping of the pairs."""
        progress(0.0)
        imitated = evenly_spread(range(len(self._fields)), pairs)
        simulated = [self._simulate(0, imitated[0], [])]
        for number in range(1, pairs + 1):
            progress(number / (pairs + 1))
            alike = simulated[1:] if number > PILOTED else simulated
            simulated.append(self._simulate(number, imitated[(number - 1) % len(imitated)], alike))
        progress(1.0)
        return estimate_damping(simulated[1:], self._vectors)

    def _simulate(self, number: int, imitated: int, alike: Sequence[Simulated]) -> Simulated:
        """Simulate and measure one pair with the flow of a recorded one, made with simulated pairs so far."""
        flow = ImposedField(self._vectors[imitated], self._flow(imitated, alike))
        frames = self._pair.images(flow, np.random.default_rng([SEED, number]))
        found = self._measure(frames, (self._noise, self._noise))
        return Simulated(vectors=found, imposed=flow.window_means)


def evenly_spread(pairs: Sequence[int], count: int) -> list[int]:
    """Return evenly spread pairs, or all if there are no more."""
    count = min(count, len(pairs))
    return [pairs[(2 * number + 1) * len(pairs) // (2 * count)] for number in range(count)]


def _noise(images: Sequence[Images]) -> dict[str, float]:
    """Return the root mean square over the frames of each camera's noise [counts]."""
    return {name: float(np.sqrt(np.mean([dark_noise(one[name]) ** 2 for one in images]))) for name in images[0]}
