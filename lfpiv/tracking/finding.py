"""`find_particles`: positions and light of the particles of one instant, refined on its raw images.

Iterative particle reconstruction [1]_: peaks of a SMART volume are candidates. Their positions and light are fitted to
the images, all together. Candidates that a camera does not confirm are removed, and the light that is left gives new
ones.

.. [1] B. Wieneke, "Iterative reconstruction of volumetric particle distribution", Meas. Sci. Technol. 24 (2013) 024008,
   doi:10.1088/0957-0233/24/2/024008.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from lfpiv.experiment.settings import Tracking
from lfpiv.geometry.grid import Grid
from lfpiv.geometry.volume import is_finite, lies_in
from lfpiv.reconstruction.particle_size import ParticleSizer
from lfpiv.reconstruction.recording import checked_images
from lfpiv.tracking import candidates
from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Cloud, Normal, Scene, diagonal_blocks, light_scatter, overlaps, refine, rendered
from lfpiv.weights.operator import Weights

DEFAULTS = Tracking()
"""Settings of the search where none are stated."""
SIGNIFICANCE = 5.0
"""Least light of a particle in each camera that sees it [standard error]."""
MERGED_VOXEL = 0.8
"""Distance below which two candidates are one particle [voxel]."""
MERGED_OVERLAP = 0.75
"""Overlap of their images in all cameras above which two candidates are one particle."""
MERGED_SIGMA = 3.0
"""The same [standard error of their distance]."""
MARGIN_VOXEL = 12.0
"""How far outside the grid of the weights particles may lie that only explain light [voxel]."""
FOUND_MARGIN_VOXEL = 0.5
"""How far outside the grid of the weights found particles may lie [voxel]."""
SEEN = 0.3
"""Least root of a camera's information about a particle's light, relative to the largest one, for the camera to see
it."""
FIRST_STEPS, STEPS, LAST_STEPS = 4, 4, 4
"""Iterations of the first round, of the later rounds, and after the last one."""
EARLY = 0.5
"""Part of the limits of light that applies after the very first iteration."""
LEFT_SHARE = 0.03
"""Least light of a candidate in the residual images, as a share of the typical particle's: one of two particles that
were found as one leaves little there."""
SIZED_ROUNDS = 2
"""Rounds after which the particles' size is fitted."""
OUTLIER_SIGMA = 5.0
"""Largest residual of a pixel that tells sizes apart [standard deviation]."""
START_SCATTER = 0.5
"""Relative scatter of light between cameras that is assumed at first."""
USUAL_SIGMA_VOXEL = 0.7
"""Size of particles where the images do not show it [voxel]."""
SIZE_STEP = 1.25
"""Ratio of the sizes that are compared."""
CLEAR_OVERLAP = 0.3
"""Overlap of a particle's image with another one above which it does not tell the size."""
LEAST_CLEAR, MOST_CLEAR = 8, 100
"""Least and largest number of particles that tell the size."""
LARGEST_RATIO = 1.15
"""Largest size of the particles over that which the autocovariance of the images shows, before particles are found.
Particles that are not told apart look larger."""
SIZE_FITS = 4
"""Largest number of comparisons of sizes in a round."""


def find_particles(
    weights: Weights,
    images: Mapping[str, np.ndarray],
    volume: xr.DataArray | None = None,
    *,
    noise: float | Mapping[str, float] | None = None,
    sigma_voxel: float | None = None,
    rounds: int = DEFAULTS.rounds,
    weakest: float = DEFAULTS.weakest,
) -> FoundParticles:
    """Find the particles of one instant: candidates from SMART, refined on the raw images.

    Suited to seeding thin enough that particles can be told apart; `FoundParticles.crowding` tells.

    Parameters
    ----------
    weights : Weights
        The operator, from `build_weights`. Its grid should extend at least a voxel beyond the particles.
    images : mapping of str to ndarray
        Camera name -> image, shape (rows, columns) [counts], background subtracted. Negative counts count.
    volume : DataArray, shape (z, y, x), optional
        SMART volume of the same images, whose peaks are the first candidates. Default: it is reconstructed.
    noise : float or mapping of str to float, optional
        Standard deviation of the background [counts]. Default: root mean square of an image's negative counts.
    sigma_voxel : float, optional
        Standard deviation of the particles [voxel]. Default: it is fitted to the images.
    rounds : int
        Rounds of fitting, removing and adding particles, >= 1.
    weakest : float
        Least light of a particle, as a share of the typical one, 0 to 1.

    Returns
    -------
    FoundParticles

    Raises
    ------
    ValueError
        If an argument is out of its range, or an image is missing, has the wrong shape or is not finite.
    """
    if isinstance(rounds, bool) or not isinstance(rounds, (int, np.integer)) or rounds < 1:
        raise ValueError(f"rounds: expected a whole number >= 1, got {rounds!r}.")
    if not (is_finite(weakest) and 0 <= weakest < 1):
        raise ValueError(f"weakest: expected a number from 0 to below 1, got {weakest!r}.")
    if sigma_voxel is not None and not (is_finite(sigma_voxel) and sigma_voxel > 0):
        raise ValueError(f"sigma_voxel: expected a size > 0 [voxel], got {sigma_voxel!r}.")
    search = ParticleSearch(weights, sigma_voxel=sigma_voxel, rounds=rounds, weakest=weakest)
    return search.find(images, volume, noise=noise)


@dataclass
class _State:
    """Particles that are being refined."""

    model: ParticleImages
    scene: Scene
    cloud: Cloud
    scatter: float
    largest_voxel: float
    """Largest size of the particles [voxel]."""
    normal: Normal | None = None

    def refine(self, steps: int) -> None:
        """Refine positions and light, and with each step the noise of the pixels."""
        for _ in range(steps):
            self.cloud, self.normal = refine(self.model, self.scene, self.cloud, iterations=1, scatter=self.scatter)
            self.scene = self.scene.calibrated(self.normal.model)


@dataclass
class ParticleSearch:
    """Search for the particles of many instants with one rig; `find_particles` describes the settings.

    `grid` is the volume whose voxels are the unit of lengths; default: the grid of the weights.
    """

    weights: Weights
    grid: Grid | None = None
    sigma_voxel: float | None = None
    rounds: int = DEFAULTS.rounds
    weakest: float = DEFAULTS.weakest

    def __post_init__(self) -> None:
        self.images = ParticleImages(
            cameras=self.weights.cameras,
            voxel_mm=self._grid.voxel_mm,
            sigma_voxel=self.sigma_voxel or USUAL_SIGMA_VOXEL,
        )
        self._sizer: ParticleSizer | None = None

    @property
    def _nothing(self) -> Cloud:
        return Cloud(positions_mm=np.zeros((0, 3)), light=np.zeros((0, len(self.weights.cameras))))

    @property
    def _grid(self) -> Grid:
        return self.weights.grid if self.grid is None else self.grid

    def find(
        self,
        images: Mapping[str, np.ndarray],
        volume: xr.DataArray | None = None,
        *,
        noise: float | Mapping[str, float] | None = None,
    ) -> FoundParticles:
        """Find the particles of one instant; arguments and exceptions as of `find_particles`."""
        images = checked_images(self.weights, images)
        deviation = _noise(images, noise)
        scene = _scene(images, deviation)
        model = self.images if self.sigma_voxel is not None else self.images.of_size(self._first_size(images))
        if volume is None:
            volume = candidates.reconstructed(self.weights, images, deviation, candidates.FIRST_ITERATIONS)
        cloud = self._nothing if volume is None else candidates.volume_peaks(self.weights, volume)
        state = _State(model, scene, cloud, START_SCATTER, LARGEST_RATIO * model.sigma_voxel)
        for number in range(self.rounds):
            before = len(state.cloud)
            if number:
                state.cloud = state.cloud.joined(self._new(state, deviation))
                if len(state.cloud) == before:
                    break
            if not len(state.cloud):
                break
            state.refine(1)
            if number == 0:
                state.cloud = self._pruned(state, EARLY)
            if len(state.cloud):
                state.refine(FIRST_STEPS - 1 if number == 0 else STEPS - 1)
                state.cloud = self._pruned(state)
            if not len(state.cloud):
                break
            state.refine(1)
            assert state.normal is not None
            state.scatter = light_scatter(state.normal, state.cloud.light, state.scatter)
            if self.sigma_voxel is None and number < SIZED_ROUNDS:
                _fit_size(state)
            state.refine(1)
            if number and len(state.cloud) == before:
                break
        if len(state.cloud):
            if self.sigma_voxel is None:
                _fit_size(state)
            state.refine(LAST_STEPS)
            state.cloud = self._pruned(state)
        if len(state.cloud):
            state.refine(2)
        every = FoundParticles.of(self.weights.cameras, self._grid, state.model, state.scene, state.cloud, state.normal)
        return every[lies_in(every.positions_mm, self.weights.grid, FOUND_MARGIN_VOXEL)]

    def _first_size(self, images: Mapping[str, np.ndarray]) -> float:
        self._sizer = self._sizer or ParticleSizer(self.weights)
        found = self._sizer.size(images)
        return found * self.weights.grid.voxel_mm / self._grid.voxel_mm if found else USUAL_SIGMA_VOXEL

    def _new(self, state: _State, noise: Mapping[str, float]) -> Cloud:
        """Return candidates from the light that the particles leave."""
        cloud, first = state.cloud, self.images.first_pixel
        left = state.scene.counts - (0 if state.normal is None else state.normal.model)
        images = {
            name: left[first[number] : first[number + 1]].reshape(camera.optics.sensor_shape)
            for number, (name, camera) in enumerate(self.weights.cameras.items())
        }
        volume = candidates.reconstructed(self.weights, images, noise, candidates.RESIDUAL_ITERATIONS)
        if volume is None:
            return self._nothing
        return candidates.volume_peaks(self.weights, volume, LEFT_SHARE * candidates.typical(cloud.light.mean(1)))

    def _pruned(self, state: _State, part: float = 1.0) -> Cloud:
        """Return the particles that all cameras which see them confirm, those closer than one particle's size merged.

        `part` is the part of the limits that applies.
        """
        cloud, normal = state.cloud, state.normal
        assert normal is not None
        good = lies_in(cloud.positions_mm, self.weights.grid, MARGIN_VOXEL)
        own = diagonal_blocks(normal.matrix, normal.right.shape)
        size = np.sqrt(np.maximum(np.einsum("pii->pi", own), 1e-30))
        inverse = np.linalg.pinv(own / size[:, :, None] / size[:, None, :], hermitian=True)
        error = np.sqrt(np.maximum(np.einsum("pii->pi", inverse), 0)) / size
        least = self.weakest * candidates.typical(cloud.light[good].mean(1)) if good.any() else 0.0
        seen = size[:, 3:] > SEEN * np.maximum(size[:, 3:].max(1), 1e-30)[:, None]
        good &= ((cloud.light > part * np.maximum(SIGNIFICANCE * error[:, 3:], least)) | ~seen).all(1)
        first, second, overlap = overlaps(normal)
        same = (overlap > MERGED_OVERLAP).all(1) & good[first] & good[second]
        apart = (cloud.positions_mm[first] - cloud.positions_mm[second]) / state.model.voxel_mm
        variance = np.square(error[first, :3]) + np.square(error[second, :3])
        same |= (np.square(apart) / (MERGED_VOXEL**2 + MERGED_SIGMA**2 * variance)).sum(1) < 1
        return _merged(cloud, np.stack([first, second], axis=1)[same], good)


def _noise(images: Mapping[str, np.ndarray], noise: float | Mapping[str, float] | None) -> dict[str, float]:
    """Return the standard deviation of each image's background [counts]."""
    if noise is None:
        found = {name: image[image < 0] for name, image in images.items()}
        return {name: float(np.sqrt(np.mean(below**2))) if below.size else 1.0 for name, below in found.items()}
    given = noise if isinstance(noise, Mapping) else dict.fromkeys(images, noise)
    if not all(name in given and is_finite(given[name]) and given[name] >= 0 for name in images):
        raise ValueError(f"noise: expected a number >= 0, or one for each camera, got {noise!r}.")
    return {name: float(given[name]) for name in images}


def _scene(images: Mapping[str, np.ndarray], noise: Mapping[str, float]) -> Scene:
    counts = np.concatenate([image.reshape(-1) for image in images.values()])
    variance = [np.full(image.size, max(noise[name], 0.3) ** 2, np.float32) for name, image in images.items()]
    return Scene(counts=counts, read_variance=np.concatenate(variance))


def _merged(cloud: Cloud, pairs: np.ndarray, good: np.ndarray) -> Cloud:
    """Replace pairs of candidates that cannot be told apart by one at the middle of their light; keep the good ones."""
    light, positions, kept = cloud.light.copy(), cloud.positions_mm.copy(), good.copy()
    for a, b in pairs[np.argsort(-light[pairs].mean(2).max(1), kind="stable")] if len(pairs) else ():
        if kept[a] and kept[b]:
            bright, dark = (a, b) if light[a].mean() >= light[b].mean() else (b, a)
            share = light[dark].mean() / (light[dark] + light[bright]).mean()
            positions[bright] += share * (positions[dark] - positions[bright])
            light[bright] += light[dark]
            kept[dark] = False
    return Cloud(positions_mm=positions, light=light)[kept]


def _fit_size(state: _State) -> None:
    """Change the size of the particles to the one that explains the images best."""
    for _ in range(SIZE_FITS):
        before, state.model = state.model, _better_size(state)
        state.refine(1)
        if abs(np.log(state.model.sigma_voxel / before.sigma_voxel)) < np.log(SIZE_STEP) / 2:
            break


def _better_size(state: _State) -> ParticleImages:
    """Return the model with the size that explains the images of clear particles best, from three sizes."""
    assert state.normal is not None
    cloud = state.cloud[_clear(state.normal, state.cloud.light)]
    own = rendered(state.model, state.model.lists(cloud.positions_mm), cloud.light)
    scene = replace(state.scene, counts=state.scene.counts - (state.normal.model - own))
    variance, lit = state.scene.variance(state.normal.model), own > 0
    chi2 = []
    for power in (-1, 0, 1):
        other = state.model.of_size(state.model.sigma_voxel * SIZE_STEP**power)
        moved, _ = refine(other, scene, cloud, iterations=1, scatter=state.scatter)
        left = scene.counts - rendered(other, other.lists(moved.positions_mm), moved.light)
        chi2.append(float(np.minimum(np.square(left) / variance, OUTLIER_SIGMA**2)[lit].sum(dtype=np.float64)))
    below, here, above = chi2
    curvature, slope = below - 2 * here + above, (below - above) / 2
    change = float(np.clip(slope / curvature, -2, 2)) if curvature > 0 else 2 * float(np.sign(slope))
    return state.model.of_size(min(state.model.sigma_voxel * SIZE_STEP**change, state.largest_voxel))


def _clear(normal: Normal, light: np.ndarray) -> np.ndarray:
    """Return particles of typical light whose images hardly overlap others; of all particles if few do not."""
    first, second, overlap = overlaps(normal)
    mixed = np.zeros(len(light), bool)
    close = (overlap > CLEAR_OVERLAP).any(1)
    mixed[first[close]], mixed[second[close]] = True, True
    clear = np.flatnonzero(~mixed) if (~mixed).sum() >= LEAST_CLEAR else np.arange(len(light))
    mean = np.maximum(light[clear].mean(1), 1e-9)
    unlike = np.abs(np.log(mean / max(candidates.typical(mean), 1e-9)))
    usual: np.ndarray = clear[np.argsort(unlike, kind="stable")[:MOST_CLEAR]]
    return usual
