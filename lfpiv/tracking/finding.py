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
from lfpiv.tracking import candidates, confirmation
from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Cloud, Normal, Scene, light_scatter, overlaps, refine, rendered
from lfpiv.tracking.surroundings import surroundings, whole_pixels
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
PROBES = 30
"""Number of candidates that tell how much light is significant."""
DARK_SHARE = 0.3
"""Largest light of particles in a pixel that shows the background [noise]."""
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
        Standard deviation of the background [counts]. Default: root mean square of an image's negative counts.
    clipped : mapping of str to ndarray, optional
        Camera name -> pixels at the end of the sensor's range, shape (rows, columns), bool. They only tell that light
        is not less. Default: none.
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
    return search.find(images, volume, noise=noise, clipped=clipped)


@dataclass(kw_only=True)
class _State:
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
    normal: Normal | None = None

    def refine(self, steps: int) -> None:
        """Refine positions and light, and with each step the noise of the pixels."""
        for _ in range(steps):
            self.cloud, self.normal = refine(self.model, self.scene, self.cloud, iterations=1, scatter=self.scatter)
            self.scene = self.scene.calibrated(self.normal.model)

    def surround(self) -> None:
        """Measure the background again, where the model of the particles is dark."""
        assert self.normal is not None
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
        images = checked_images(self.weights, images)
        state = self._start(images, volume, _noise(images, noise), _clipped(images, clipped))
        for number in range(self.rounds):
            before = len(state.cloud)
            if number:
                state.cloud = state.cloud.joined(self._new(state))
                if len(state.cloud) == before:
                    break
            if not self._round(state, number) or (number and len(state.cloud) == before):
                break
        if len(state.cloud):
            if self.sigma_voxel is None:
                _fit_size(state)
            state.refine(LAST_STEPS)
            state.cloud = self._confirmed(state)
        if len(state.cloud):
            state.refine(2)
        every = FoundParticles.of(
            self.weights.cameras, self._grid, state.model, state.scene, state.cloud, state.normal, state.scatter
        )
        return every[lies_in(every.positions_mm, self.weights.grid, FOUND_MARGIN_VOXEL)]

    def _start(
        self,
        images: Mapping[str, np.ndarray],
        volume: xr.DataArray | None,
        noise: Mapping[str, float],
        clipped: np.ndarray | None,
    ) -> _State:
        """Return the first candidates: peaks of the volume, or of one that is reconstructed."""
        scene = _scene(images, noise, clipped, self._whole, self._standing)
        model = self.images if self.sigma_voxel is not None else self.images.of_size(self._first_size(images))
        if volume is None:
            dark = self._by_camera(scene.counts)
            volume = candidates.reconstructed(self.weights, dark, noise, candidates.FIRST_ITERATIONS)
        cloud = self._nothing if volume is None else candidates.volume_peaks(self.weights, volume)
        cloud = cloud[cloud.light[:, 0] > CANDIDATE * _faint(model, scene, cloud)]
        largest = LARGEST_RATIO * model.sigma_voxel
        return _State(
            model=model,
            scene=scene,
            cloud=cloud,
            images=images,
            noise=noise,
            whole=self._whole,
            standing=self._standing,
            largest_voxel=largest,
        )

    def _round(self, state: _State, number: int) -> bool:
        """Refine and confirm the particles once; return whether any are left."""
        if not len(state.cloud):
            return False
        state.refine(1)
        state.cloud = self._confirmed(state, EARLY, fits=False)
        if not len(state.cloud):
            return False
        state.surround()
        state.refine(STEPS - 1)
        state.cloud = self._confirmed(state)
        if not len(state.cloud):
            return False
        state.refine(1)
        assert state.normal is not None
        state.scatter = light_scatter(state.normal, state.cloud.light, state.scatter)
        if self.sigma_voxel is None and number < SIZED_ROUNDS:
            _fit_size(state)
        state.surround()
        state.refine(1)
        return True

    def _first_size(self, images: Mapping[str, np.ndarray]) -> float:
        self._sizer = self._sizer or ParticleSizer(self.weights)
        found = self._sizer.size(images)
        return found * self.weights.grid.voxel_mm / self._grid.voxel_mm if found else USUAL_SIGMA_VOXEL

    def _by_camera(self, counts: np.ndarray) -> dict[str, np.ndarray]:
        """Return a vector over the pixels of all cameras as images."""
        first = self.images.first_pixel
        return {
            name: counts[first[number] : first[number + 1]].reshape(camera.optics.sensor_shape)
            for number, (name, camera) in enumerate(self.weights.cameras.items())
        }

    def _new(self, state: _State) -> Cloud:
        """Return candidates from the light that the particles leave."""
        assert state.normal is not None
        left = self._by_camera(state.scene.residual(state.normal.model))
        volume = candidates.reconstructed(self.weights, left, state.noise, candidates.RESIDUAL_ITERATIONS)
        if volume is None:
            return self._nothing
        faint = _faint(state.model, state.scene, state.cloud)
        least = max(CANDIDATE * faint, self.weakest * candidates.typical(state.cloud.light.mean(1)))
        return candidates.volume_peaks(self.weights, volume, least)

    def _confirmed(self, state: _State, part: float = 1.0, *, fits: bool = True) -> Cloud:
        """Return the particles that all cameras which see them confirm, those closer than one particle's size merged.

        `part` is the part of the limits of light that applies. With `fits`, particles whose images the model does not
        fit are removed, so that their light may give others.
        """
        cloud, normal = state.cloud, state.normal
        assert normal is not None
        good = lies_in(cloud.positions_mm, self.weights.grid, MARGIN_VOXEL)
        found = confirmation.signals(normal, state.scatter)
        misfit, lacking = confirmation.misfits(state.model, state.scene, cloud, normal)
        state.error = confirmation.model_error(misfit, found)
        good &= confirmation.confirmed(normal, found, state.error, part)
        if fits:
            good &= confirmation.fitting(lacking, state.error, found)
        if good.any():
            least = part * self.weakest * candidates.typical(cloud.light[good].mean(1))
            good &= ((cloud.light > least) | ~found.seen).all(1)
        return confirmation.merged(normal, cloud, good, found.position_error, state.model.voxel_mm)


def _noise(images: Mapping[str, np.ndarray], noise: float | Mapping[str, float] | None) -> dict[str, float]:
    """Return the standard deviation of each image's background [counts]."""
    if noise is None:
        found = {name: image[image < 0] for name, image in images.items()}
        return {name: float(np.sqrt(np.mean(below**2))) if below.size else 1.0 for name, below in found.items()}
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


def _scene(
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


def _faint(model: ParticleImages, scene: Scene, cloud: Cloud) -> float:
    """Return the light of a particle that is just significant above the background [counts]."""
    some = cloud.positions_mm[np.linspace(0, len(cloud) - 1, PROBES).astype(int)] if len(cloud) else cloud.positions_mm
    errors = []
    for camera, own in enumerate(model.lists(some)):
        variance = scene.read_variance[own.pixel + model.first_pixel[camera]]
        particle = np.repeat(np.arange(len(some)), np.diff(own.first))
        information = np.bincount(particle, np.square(own.values[:, 3]) / variance, minlength=len(some))
        errors.append(1 / np.sqrt(np.maximum(information, 1e-30)))
    return confirmation.SIGNIFICANCE * float(np.median(np.min(errors, axis=0))) if len(some) else 0.0


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
        left = scene.residual(rendered(other, other.lists(moved.positions_mm), moved.light))
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
