"""`measure_damping`: what ghosts take from a flow's fluctuations, measured in simulated pairs of the same rig and flow.

A parametric bootstrap: random particles as many, as large and as bright as the recorded ones are moved by a measured
field, imaged through the calibrated mappings with noise, and measured with the same settings. What the measurement
leaves of the imposed displacement is the damping (`lfpiv.velocity.damping`).

A measured field is no true flow: it has errors, mostly of short wavelength, and its fluctuations are damped already. So
the simulated flow is the measured one with other amplitudes: those with which simulated vectors have the power of the
recorded ones at each wave number (`shell_gains`). A pilot pair, moved by the measured field, makes the start.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import xarray as xr
from scipy import fft, ndimage

from lfpiv.geometry.grid import AXES, Grid
from lfpiv.progress import StepProgress
from lfpiv.reconstruction.synthetic_pair import RecordedImages, RecordedParticles, SyntheticPair
from lfpiv.velocity.damping import Damping, Simulated, estimate_damping
from lfpiv.velocity.imposed_field import ImposedField
from lfpiv.velocity.validation import fill
from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

Images = Mapping[str, np.ndarray]
Measure = Callable[[Sequence[Images], Sequence[Mapping[str, float]]], xr.Dataset]
"""Takes the images of both frames and the noise of their background, and returns the vectors, as of recorded images."""

SEED = 20_260
"""Seed of all draws. Those of each pair also depend on its number alone."""
SHELL_WIDTH = 0.1
"""Width of the shells of wave numbers in which powers are compared [1 / distance of windows]."""
SHELL_SLOPES = (0.5, 1.2)
"""Limits of the slope of a shell. Few modes do not know it well."""
LIGHT_VOXEL = 6.0
"""Standard deviation of the Gaussian that smooths a volume to the light of its particles [voxel]: several particles are
within its reach."""


class LightField:
    """Relative light of a particle at any place: a smoothed volume of some instant, or the same everywhere.

    Parameters
    ----------
    grid : Grid
        Voxels. Beyond them there is no light.
    volume : ndarray, shape (z, y, x), optional
        Reconstructed intensities.
    """

    def __init__(self, grid: Grid, volume: np.ndarray | None = None):
        self._grid = grid
        self._light = None
        if volume is not None and (total := float(volume.mean(dtype=np.float64))) > 0:
            self._light = ndimage.gaussian_filter(volume.astype(np.float32), LIGHT_VOXEL, mode="nearest") / total

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the light at points (x, y, z) [mm], shape (point,)."""
        places = ((points_mm[:, ::-1] - self._grid.first_centre_mm) / self._grid.voxel_mm).T
        inside = ((places >= -0.5) & (places < np.array(self._grid.shape)[:, None] - 0.5)).all(0)
        if self._light is None:
            return inside.astype(float)
        light: np.ndarray = ndimage.map_coordinates(self._light, places, order=1, mode="nearest") * inside
        return light


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
        Vectors of recorded pairs, from `measure` or a run. Simulated pair k has the flow of the k-th one, and so on
        from the first.
    images : sequence of mappings of str to ndarray
        Images of some recorded instants, background subtracted: their particles are imitated.
    measure : callable
        ``measure(frames, noise)`` returns the vectors of the images of both frames, measured with the same settings as
        `vectors`. `noise` has the noise of each frame's background for `reconstruct_pair`'s `floor`.
    pairs : int
        Number of simulated pairs, >= 1. A pilot pair comes before them.
    noise : mapping of str to float, optional
        Noise of each camera's background [counts]; default: the root mean square of the negative counts.
    volume : ndarray, shape (z, y, x), optional
        Volume of a recorded instant on the grid of the weights, whose smoothed intensity is the light of the particles;
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
    text = "particles like the recorded ones: %.4f per voxel, standard deviation %.2f voxel"
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
        self._fields = [_displacement(one) for one in vectors]

    def run(self, pairs: int, progress: StepProgress) -> Damping:
        """Simulate the pilot and the pairs; return the damping of the pairs."""
        progress(0.0)
        simulated = [self._simulate(0, self._fields[0])]
        for number in range(1, pairs + 1):
            progress(number / (pairs + 1))
            measured = self._fields[(number - 1) % len(self._fields)]
            simulated.append(self._simulate(number, likely_flow(measured, shell_gains(self._fields, simulated))))
        progress(1.0)
        return estimate_damping(simulated[1:])

    def _simulate(self, number: int, displacement: np.ndarray) -> Simulated:
        """Simulate and measure one pair whose window means are to be a displacement (z, y, x, 3) [voxel]."""
        like = self._vectors[max(number - 1, 0) % len(self._vectors)]
        flow = ImposedField(like, displacement)
        frames = self._pair.images(flow, np.random.default_rng([SEED, number]))
        found = self._measure(frames, (self._noise, self._noise))
        return Simulated(vectors=found, imposed=flow.window_means)


def shell_gains(measured: Sequence[np.ndarray], simulated: Sequence[Simulated]) -> np.ndarray:
    """Return the factors of a measured field's modes with which simulated vectors have the power of measured ones.

    Simulated pairs show the slope S of a shell of modes and the power N of its errors. A flow of power P is measured
    with the power S^2 P + N. So measured vectors of power Q come from a flow of power (Q - N) / S^2.

    Parameters
    ----------
    measured : sequence of ndarrays, shape (z, y, x, 3)
        Measured displacements along (z, y, x) [voxel].
    simulated : sequence of Simulated

    Returns
    -------
    ndarray, shape (shell, 3)
        ``sqrt(max(Q - N, 0) / Q) / S`` of each shell and component.
    """
    shells = _shells(measured[0].shape[:3])
    recorded = np.mean([_shell_sums(_modes(field), _modes(field), shells) for field in measured], axis=0)
    pairs = [(_modes(one.imposed), _modes(_displacement(one.vectors))) for one in simulated]
    imposed = np.mean([_shell_sums(exact, exact, shells) for exact, _ in pairs], axis=0)
    products = np.mean([_shell_sums(exact, found, shells) for exact, found in pairs], axis=0)
    found = np.mean([_shell_sums(found, found, shells) for _, found in pairs], axis=0)
    tiny = np.finfo(float).tiny
    slope = np.clip(products / np.maximum(imposed, tiny), *SHELL_SLOPES)
    errors = np.maximum(found - 2 * slope * products + slope**2 * imposed, 0)
    gains: np.ndarray = np.sqrt(np.maximum(recorded - errors, 0) / np.maximum(recorded, tiny)) / slope
    return gains


def likely_flow(measured: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return a flow whose measured vectors have the power of measured ones.

    Parameters
    ----------
    measured : ndarray, shape (z, y, x, 3)
        Displacement along (z, y, x) [voxel].
    gains : ndarray, shape (shell, 3)
        From `shell_gains`.

    Returns
    -------
    ndarray, shape (z, y, x, 3)
    """
    modes = gains[_shells(measured.shape[:3])] * _modes(measured)
    flow: np.ndarray = measured.mean((0, 1, 2)) + fft.idctn(modes, axes=(0, 1, 2), norm="ortho")
    return flow


def _modes(field: np.ndarray) -> np.ndarray:
    """Return the discrete cosine transform of the fluctuations of a field (z, y, x, 3)."""
    modes: np.ndarray = fft.dctn(field - field.mean((0, 1, 2)), axes=(0, 1, 2), norm="ortho")
    return modes


def _shells(shape: tuple[int, ...]) -> np.ndarray:
    """Return the number of the shell of each mode, by its wave number."""
    waves = np.meshgrid(*(np.arange(count) / (2 * count) for count in shape), indexing="ij")
    shells: np.ndarray = (np.sqrt(sum(wave**2 for wave in waves)) / SHELL_WIDTH).astype(int)
    return shells


def _shell_sums(first: np.ndarray, second: np.ndarray, shells: np.ndarray) -> np.ndarray:
    """Return the sums of products of modes over each shell, shape (shell, 3)."""
    products = first * second
    return np.stack([np.bincount(shells.ravel(), products[..., k].ravel()) for k in range(3)], axis=1)


def _displacement(vectors: xr.Dataset) -> np.ndarray:
    """Return the displacement along (z, y, x) [voxel], filled where it is masked, shape (z, y, x, 3)."""
    found = np.stack([vectors[f"displacement_{axis}"].values for axis in AXES], axis=-1).astype(float)
    return fill(found, np.isfinite(found).all(-1))


def _noise(images: Sequence[Images]) -> dict[str, float]:
    """Return the root mean square of the negative counts of each camera; 0 without any."""
    noise = {}
    for name in images[0]:
        below = np.concatenate([one[name][one[name] < 0].ravel() for one in images])
        noise[name] = float(np.sqrt(np.mean(np.square(below, dtype=float)))) if below.size else 0.0
    return noise
