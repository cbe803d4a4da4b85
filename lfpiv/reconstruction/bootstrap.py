"""`measure_damping`: what ghosts take from a flow's fluctuations, measured in simulated pairs of the same rig and flow.

A parametric bootstrap: random particles as many, as large and as bright as the recorded ones are moved by a measured
field, imaged through the calibrated mappings with noise, and measured with the same settings. What the measurement
leaves of the imposed displacement is the damping (`lfpiv.velocity.damping`).

A measured field is no true flow: it has errors, mostly of short wavelength, and its fluctuations are damped already. A
pilot pair moved by the measured field shows the power spectrum of the errors. All other pairs are moved by the field
that a Wiener filter with this spectrum leaves, its fluctuations divided by the slope that is known so far.
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
from lfpiv.velocity.damping import SLOPES, Damping, Simulated, estimate_damping
from lfpiv.velocity.imposed_field import ImposedField
from lfpiv.velocity.validation import fill
from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

Images = Mapping[str, np.ndarray]
Measure = Callable[[Sequence[Images], Sequence[Mapping[str, float]]], xr.Dataset]
"""Takes the images of both frames and the noise of their background, and returns the vectors, as of recorded images."""

SEED = 20_260
"""Seed of all draws. Those of each pair also depend on its number alone."""
POWER = float(__import__("os").environ.get("LF_POWER", "1"))
SPECTRUM_MODES = 1.0
"""Standard deviation of the Gaussian that smooths power spectra [mode]."""
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
        pilot = self._simulate(0, self._fields[0])
        known, noise = estimate_damping([pilot]), _error_power(pilot)
        simulated: list[Simulated] = []
        for number in range(1, pairs + 1):
            progress(number / (pairs + 1))
            flow = likely_flow(self._fields[(number - 1) % len(self._fields)], noise, known)
            simulated.append(self._simulate(number, flow))
            known = estimate_damping(simulated)
        progress(1.0)
        return known

    def _simulate(self, number: int, displacement: np.ndarray) -> Simulated:
        """Simulate and measure one pair whose window means are to be a displacement (z, y, x, 3) [voxel]."""
        like = self._vectors[max(number - 1, 0) % len(self._vectors)]
        flow = ImposedField(like, displacement)
        frames = self._pair.images(flow, flow.reach_mm, np.random.default_rng([SEED, number]))
        found = self._measure(frames, (self._noise, self._noise))
        return Simulated(vectors=found, imposed=flow.window_means)


def likely_flow(measured: np.ndarray, noise: np.ndarray, damping: Damping) -> np.ndarray:
    """Return the flow that a measured one probably is: without most of its errors, and not damped.

    Parameters
    ----------
    measured : ndarray, shape (z, y, x, 3)
        Displacement along (z, y, x) [voxel].
    noise : ndarray, shape (z, y, x, 3)
        Power of its errors in each mode of the discrete cosine transform [voxel^2].
    damping : Damping
        What is known of the damping.

    Returns
    -------
    ndarray, shape (z, y, x, 3)
        With P the power of a mode, that of its neighbours included, the mode's share max(1 - noise / P, 0) over the
        slope.
    """
    flow = np.empty_like(measured)
    for number, axis in enumerate(AXES):
        mean = measured[..., number].mean()
        modes = fft.dctn(measured[..., number] - mean, norm="ortho")
        power = _smooth(np.square(modes))
        share = np.clip(1 - noise[..., number] / np.maximum(power, np.finfo(float).tiny), 0, 1)
        slope = np.clip(damping.axes[axis].slope, *SLOPES)
        flow[..., number] = mean + fft.idctn(share**POWER * modes, norm="ortho") / slope
    return flow


def _error_power(pair: Simulated) -> np.ndarray:
    """Return the smoothed power of what a simulated pair's regression leaves, in each mode [voxel^2]."""
    found, power = _displacement(pair.vectors), np.empty(pair.imposed.shape)
    damping = estimate_damping([pair])
    for number, axis in enumerate(AXES):
        away = pair.imposed[..., number] - pair.imposed[..., number].mean()
        rest = found[..., number] - found[..., number].mean() - damping.axes[axis].slope * away
        power[..., number] = _smooth(np.square(fft.dctn(rest, norm="ortho")))
    return power


def _smooth(power: np.ndarray) -> np.ndarray:
    smooth: np.ndarray = ndimage.gaussian_filter(power, SPECTRUM_MODES, mode="nearest")
    return smooth


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
