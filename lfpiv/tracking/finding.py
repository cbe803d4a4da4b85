"""`find_particles`: positions and light of the particles of one instant, refined on its raw images.

Iterative particle reconstruction [1]_: peaks of a SMART volume are candidates. Their positions and light are fitted to
the images, all together. Candidates that a camera does not confirm are removed, and the light that is left gives new
ones.

.. [1] B. Wieneke, "Iterative reconstruction of volumetric particle distribution", Meas. Sci. Technol. 24 (2013) 024008,
   doi:10.1088/0957-0233/24/2/024008.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import Grid
from lfpiv.geometry.volume import is_finite, lies_in
from lfpiv.reconstruction.dark_noise import dark_noise
from lfpiv.reconstruction.image_preparation import checked_images
from lfpiv.reconstruction.particle_size import ParticleSizer
from lfpiv.settings.processing import Tracking
from lfpiv.tracking import candidates, confirmation
from lfpiv.tracking.fit import Fit, faint_light, scene_of
from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.lines_of_sight import REFINED, follow_lines
from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Cloud, Scene, light_scatter
from lfpiv.tracking.size_fit import LARGEST_RATIO, USUAL_SIGMA_VOXEL, fit_size
from lfpiv.tracking.splitting import split
from lfpiv.tracking.surroundings import whole_pixels
from lfpiv.weights.operator import Weights

DEFAULTS = Tracking()
"""Settings of the search where none are stated."""
MARGIN_VOXEL = 12.0
"""How far outside the grid of the weights particles may lie that only explain light [voxel]."""
FOUND_MARGIN_VOXEL = 0.5
"""How far outside the grid of the weights found particles may lie [voxel]."""
STEPS, LAST_STEPS = 4, 4
"""Iterations of a round, and after the last one."""
EARLY = 0.5
"""Part of the limits of light that applies after the first iteration of a round."""
CANDIDATE = 0.3
"""Least light of a candidate, relative to that of a particle that is just significant: a volume spreads light."""
LEAST_GAIN = confirmation.SIGNIFICANCE**2
"""Least fall of the weighted squares of the residuals in a round without more particles for another round to follow:
that of a significant particle."""
SIZED_ROUNDS = 2
"""Rounds after which the particles' size is fitted."""


def find_particles(
    weights: Weights,
    images: Mapping[str, np.ndarray],
    volume: xr.DataArray | None = None,
    *,
    noise: float | Mapping[str, float] | None = None,
    clipped: Mapping[str, np.ndarray] | None = None,
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
        Standard deviation of the background [counts]. Default: that of an image's dark pixels.
    clipped : mapping of str to ndarray, optional
        Camera name -> pixels at the end of the sensor's range, shape (rows, columns), bool. They only tell that light
        is not less. Default: none.
    sigma_voxel : float, optional
        Standard deviation of the particles [voxel]. Default: it is fitted to the images.
    rounds : int
        Rounds of fitting, removing and adding particles, >= 1.
    weakest : float
        Least light of a particle, as a share of the typical one, 0 to 1.

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
    return search.find(images, volume, noise=noise, clipped=clipped)


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
        self._whole: dict[str, np.ndarray] = {}
        self._standing: dict[str, np.ndarray] = {}
        for name, camera in self.weights.cameras.items():
            self._whole[name] = whole_pixels(camera.optics, camera.lattice)
            if (standing := getattr(camera, "standing", None)) is not None:
                self._standing[name] = np.where(standing.region, np.maximum(*standing.light), 0)

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
        clipped: Mapping[str, np.ndarray] | None = None,
    ) -> FoundParticles:
        """Find the particles of one instant; arguments and exceptions as of `find_particles`."""
        return self.particles(self.fit(images, volume, noise=noise, clipped=clipped))

    def fit(
        self,
        images: Mapping[str, np.ndarray],
        volume: xr.DataArray | None = None,
        *,
        noise: float | Mapping[str, float] | None = None,
        clipped: Mapping[str, np.ndarray] | None = None,
    ) -> Fit:
        """Fit particles to the images of one instant; arguments and exceptions as of `find_particles`."""
        images = checked_images(self.weights, images)
        return self._fitted(self._start(images, volume, _noise(images, noise), _clipped(images, clipped)))

    def _fitted(self, fit: Fit) -> Fit:
        """Refine and confirm candidates, and add those that the light they leave shows."""
        for number in range(self.rounds):
            new = self._new(fit) if number else self._nothing
            if number and not len(new):
                break
            before, count = fit.residual if number else None, len(fit.cloud)
            fit.cloud = fit.cloud.joined(new)
            if not self._round(fit, number):
                break
            if before is not None and len(fit.cloud) <= count and fit.gain(before) < LEAST_GAIN:
                break
        if len(fit.cloud) and self.sigma_voxel is None:
            fit_size(fit)
        self._settle(fit)
        return fit

    def look(
        self,
        images: Mapping[str, np.ndarray],
        cloud: Cloud,
        *,
        noise: Mapping[str, float],
        clipped: Mapping[str, np.ndarray] | None = None,
    ) -> FoundParticles:
        """Return the candidates that the images of one instant confirm, and particles in the light that they leave.

        The size of the particles must be known; arguments and exceptions as of `find_particles`.
        """
        images = checked_images(self.weights, images)
        scene = scene_of(images, noise, _clipped(images, clipped), self._whole, self._standing)
        return self.particles(self._fitted(self._fit(self.images, scene, cloud, images, noise)))

    def add(self, fit: Fit, cloud: Cloud, replaced: np.ndarray) -> None:
        """Fit further particles to the images, in place of some of those that are there.

        Parameters
        ----------
        fit : Fit
            From `fit`; it is changed.
        cloud : Cloud
            Further particles.
        replaced : ndarray, shape (particle,), bool
            Particles of the fit that are left out.
        """
        fit.cloud = fit.cloud[~replaced].joined(cloud)
        if len(fit.cloud):
            fit.refine(STEPS)
            fit.cloud = self._kept(fit)
        self._settle(fit)

    def particles(self, fit: Fit) -> FoundParticles:
        """Return the particles of a fit that all cameras which see them confirm, with standard errors and figures."""
        return FoundParticles.from_fit(self.weights.cameras, self._grid, fit)[self.reported(fit)]

    def reported(self, fit: Fit) -> np.ndarray:
        """Return the numbers of the particles of a fit that `particles` returns."""
        if not len(fit.cloud):
            return np.zeros(0, int)
        inside = lies_in(fit.cloud.positions_mm, self.weights.grid, FOUND_MARGIN_VOXEL)
        return np.flatnonzero(self._confirmed(fit) & inside)

    def _settle(self, fit: Fit) -> None:
        """Refine the particles until they stay."""
        if len(fit.cloud):
            fit.refine(LAST_STEPS)
            fit.cloud = self._kept(fit)
        if len(fit.cloud):
            fit.refine(2)

    def _start(
        self,
        images: Mapping[str, np.ndarray],
        volume: xr.DataArray | None,
        noise: Mapping[str, float],
        clipped: np.ndarray | None,
    ) -> Fit:
        """Return the first candidates: peaks of the volume, or of one that is reconstructed."""
        scene = scene_of(images, noise, clipped, self._whole, self._standing)
        model = self.images if self.sigma_voxel is not None else self.images.of_size(self._first_size(images))
        if volume is None:
            dark = self._by_camera(scene.counts)
            volume = candidates.reconstructed(self.weights, dark, noise, candidates.FIRST_ITERATIONS)
        cloud = self._nothing if volume is None else candidates.volume_peaks(self.weights, volume)
        cloud = cloud[cloud.light[:, 0] > CANDIDATE * faint_light(model, scene, cloud)]
        return self._fit(model, scene, cloud, images, noise)

    def _fit(
        self,
        model: ParticleImages,
        scene: Scene,
        cloud: Cloud,
        images: Mapping[str, np.ndarray],
        noise: Mapping[str, float],
    ) -> Fit:
        return Fit(
            model=model,
            scene=scene,
            cloud=cloud,
            images=images,
            noise=noise,
            whole=self._whole,
            standing=self._standing,
            largest_voxel=LARGEST_RATIO * model.sigma_voxel,
        )

    def _round(self, fit: Fit, number: int) -> bool:
        """Refine and confirm the particles once; return whether any are left."""
        if not len(fit.cloud):
            return False
        fit.refine(1)
        fit.cloud = self._kept(fit, EARLY, fits=False)
        if not len(fit.cloud):
            return False
        fit.surround()
        fit.refine(STEPS - 1)
        fit.cloud = self._kept(fit, splits=True)
        if not len(fit.cloud):
            return False
        fit.refine(1)
        fit.scatter = light_scatter(fit.normal, fit.cloud.light, fit.scatter)
        if self.sigma_voxel is None and number < SIZED_ROUNDS:
            fit_size(fit)
        fit.surround()
        fit.refine(1)
        self._follow_lines(fit)
        return True

    def _follow_lines(self, fit: Fit) -> None:
        """Move particles that a camera does not confirm along the line of sight of one that shows them."""
        alone = ~self._confirmed(fit)
        if alone.any():
            fit.cloud = follow_lines(fit.model, fit.scene, fit.cloud, fit.normal, alone)
            fit.refine(REFINED)

    def _first_size(self, images: Mapping[str, np.ndarray]) -> float:
        self._sizer = self._sizer or ParticleSizer(self.weights)
        found = self._sizer.size(self._sizer.fluctuations(images))
        return found * self.weights.grid.voxel_mm / self._grid.voxel_mm if found else USUAL_SIGMA_VOXEL

    def _by_camera(self, counts: np.ndarray) -> dict[str, np.ndarray]:
        """Return a vector over the pixels of all cameras as images."""
        first = self.images.first_pixel
        return {
            name: counts[first[number] : first[number + 1]].reshape(camera.optics.sensor_shape)
            for number, (name, camera) in enumerate(self.weights.cameras.items())
        }

    def _new(self, fit: Fit) -> Cloud:
        """Return candidates from the light that the particles leave."""
        left = self._by_camera(fit.scene.residual(fit.normal.model))
        volume = candidates.reconstructed(self.weights, left, fit.noise, candidates.RESIDUAL_ITERATIONS)
        if volume is None:
            return self._nothing
        faint = faint_light(fit.model, fit.scene, fit.cloud)
        least = max(CANDIDATE * faint, self.weakest * candidates.typical(fit.cloud.light.mean(1)))
        return candidates.volume_peaks(self.weights, volume, least)

    def _kept(self, fit: Fit, part: float = 1.0, *, fits: bool = True, splits: bool = False) -> Cloud:
        """Return the particles that a camera shows, those closer than one particle's size merged.

        One that only some of the cameras show explains light there, and keeps others from moving to it. `part` is the
        part of the limits of light that applies. With `fits`, particles whose images the model does not fit are
        removed, so that their light may give others. With `splits`, two take the place of one where that explains more.
        """
        cloud, normal = fit.cloud, fit.normal
        found = confirmation.signals(normal, fit.scatter)
        misfit, lacking = confirmation.misfits(fit.model, fit.scene, cloud, normal)
        fit.error = confirmation.model_error(misfit, found)
        good = lies_in(cloud.positions_mm, self.weights.grid, MARGIN_VOXEL)
        good &= (confirmation.shown(normal, found, fit.error, self._least(cloud), part) & found.seen).any(1)
        fitting = confirmation.fitting(lacking, fit.error, found) if fits else np.ones(len(cloud), bool)
        kept = confirmation.merged(normal, cloud, good & fitting, found.position_error, fit.model.voxel_mm)
        if splits and (good & ~fitting).any():
            kept = kept.joined(split(fit.model, fit.scene, cloud, normal, good & ~fitting))
        return kept

    def _confirmed(self, fit: Fit) -> np.ndarray:
        """Return the particles that all cameras which see them show, shape (particle,), bool."""
        found = confirmation.signals(fit.normal, fit.scatter)
        shown = confirmation.shown(fit.normal, found, fit.error, self._least(fit.cloud))
        return (shown | ~found.seen).all(1)

    def _least(self, cloud: Cloud) -> float:
        """Return the least light of a particle [counts]."""
        return self.weakest * candidates.typical(cloud.light.mean(1))


def _noise(images: Mapping[str, np.ndarray], noise: float | Mapping[str, float] | None) -> dict[str, float]:
    """Return the standard deviation of each image's background [counts]."""
    if noise is None:
        return {name: dark_noise(image) or 1.0 for name, image in images.items()}
    given = noise if isinstance(noise, Mapping) else dict.fromkeys(images, noise)
    if not all(name in given and is_finite(given[name]) and given[name] >= 0 for name in images):
        raise ValueError(f"noise: expected a number >= 0, or one for each camera, got {noise!r}.")
    return {name: float(given[name]) for name in images}


def _clipped(images: Mapping[str, np.ndarray], clipped: Mapping[str, np.ndarray] | None) -> np.ndarray | None:
    """Return the clipped pixels of all cameras as one vector."""
    if clipped is None:
        return None
    for name, image in images.items():
        if name not in clipped or np.shape(clipped[name]) != image.shape or np.asarray(clipped[name]).dtype != bool:
            raise ValueError(f"clipped: expected a mask of the image's shape {image.shape} for camera {name!r}.")
    return np.concatenate([np.asarray(clipped[name]).reshape(-1) for name in images])
