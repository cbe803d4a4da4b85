"""Refine positions and light of particles on the raw images: damped least squares on all particles at once.

Every particle has a position and its light in each camera, because scattered light differs from camera to camera. The
light of the cameras is held together by their scatter over all particles. Residuals are weighted by the noise of the
pixels, and large ones count less, so that light without a particle does not pull at its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from lfpiv.tracking.particle_images import ParticleImages
from lfpiv_kernels.reconstruction.particle_normal import pair_blocks
from lfpiv_kernels.weights.gaussian import ImageLists

CHI2_MEDIAN = 0.4549
"""Median of a squared standard normal variable."""
ROBUST_SIGMA = 4.0
"""Residual at which a pixel counts half [standard deviation]."""
LARGEST_STEP_VOXEL = 0.5
"""Largest change of a position in an iteration along an axis [voxel]."""
DAMPING = 1e-3
"""Levenberg-Marquardt damping relative to the diagonal."""
CG_STEPS, CG_TOLERANCE = 60, 1e-4
"""Largest number of steps and relative residual of the linear solver."""
COUPLING = 0.05
"""Least correlation of two particles' parameters for one to enter the other's standard error."""
MOST_COUPLED = 12
"""Largest number of particles that enter the standard error of one."""
SCATTER_RANGE = (0.05, 2.0)
"""Limits of the relative scatter of a particle's light between the cameras."""


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """Particles of one instant."""

    positions_mm: np.ndarray
    """Positions (x, y, z) [mm], shape (particle, 3)."""
    light: np.ndarray
    """Light of each particle in each camera [counts], shape (particle, camera)."""

    def __len__(self) -> int:
        return len(self.positions_mm)

    def __getitem__(self, chosen: np.ndarray) -> Cloud:
        return Cloud(positions_mm=self.positions_mm[chosen], light=self.light[chosen])

    def joined(self, other: Cloud) -> Cloud:
        """Return these particles and others."""
        return Cloud(
            positions_mm=np.concatenate([self.positions_mm, other.positions_mm]),
            light=np.concatenate([self.light, other.light]),
        )


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Images of one instant as one vector over the pixels of all cameras, and their noise."""

    counts: np.ndarray
    """Images without background [counts], shape (pixel,), float32."""
    read_variance: np.ndarray
    """Variance of the background [counts^2], shape (pixel,), float32."""
    clipped: np.ndarray | None = None
    """Pixels at the end of the sensor's range, which show the least light only, shape (pixel,), bool; None for none."""
    counts_per_photon: float = 0.0
    """Variance over mean of light, model errors included [counts]."""

    def variance(self, model: np.ndarray) -> np.ndarray:
        """Return the variance of each pixel for a model of the images [counts^2]."""
        return self.read_variance + np.float32(self.counts_per_photon) * np.maximum(model, 0)

    def residual(self, model: np.ndarray) -> np.ndarray:
        """Return what a model of the images leaves [counts]; a clipped pixel agrees with any more light."""
        left: np.ndarray = self.counts - model
        if self.clipped is not None:
            left[self.clipped & (left < 0)] = 0
        return left

    def known(self, model: np.ndarray) -> np.ndarray:
        """Return the pixels that tell how much light there is, bool: not clipped ones where a model has more."""
        return np.ones(model.shape, bool) if self.clipped is None else ~(self.clipped & (model > self.counts))

    def calibrated(self, model: np.ndarray) -> Scene:
        """Return the scene with the variance over mean that the residuals of lit pixels show."""
        lit = (model > 3 * np.sqrt(self.read_variance)) & self.known(model)
        if not lit.any():
            return self
        excess = np.square(self.counts[lit] - model[lit]) / CHI2_MEDIAN - self.read_variance[lit]
        return replace(self, counts_per_photon=max(float(np.median(excess / model[lit])), 0.0))


@dataclass(frozen=True, kw_only=True)
class Normal:
    """Linearised equations of all particles at their present place."""

    matrix: sparse.bsr_array
    """Normal matrix; a block per pair of particles: x, y, z [voxel], then light in each camera [counts]."""
    right: np.ndarray
    """Right-hand side, shape (particle, parameter)."""
    model: np.ndarray
    """Images of the particles [counts], shape (pixel,)."""
    light: np.ndarray
    """Light of the particles at which the equations hold [counts], shape (particle, camera)."""


def linearise(images: ParticleImages, scene: Scene, cloud: Cloud, scatter: float) -> Normal:
    """Linearise the residuals of all pixels in the parameters of all particles."""
    count, cameras = cloud.light.shape
    size = 3 + cameras
    lists = images.lists(cloud.positions_mm)
    model = rendered(images, lists, cloud.light)
    residual = scene.residual(model)
    variance = scene.variance(model)
    weight = scene.known(model) / (variance + np.square(residual) / ROBUST_SIGMA**2)
    held, pull = prior(cloud.light, scatter)
    right = np.zeros((count, size))
    right[:, 3:] = pull
    diagonal = np.arange(count)
    matrix = sparse.bsr_array((held, diagonal, np.arange(count + 1)), shape=(count * size, count * size))
    for camera, own in enumerate(lists):
        span = slice(*images.first_pixel[camera : camera + 2])
        pairs = pair_blocks(own, weight[span], residual[span])
        light = cloud.light[:, camera]
        scale_row, scale_column = (np.ones((len(pairs.row), 4)) for _ in range(2))
        scale_row[:, :3], scale_column[:, :3] = light[pairs.row, None], light[pairs.column, None]
        blocks = np.zeros((len(pairs.row), size, size))
        place = [0, 1, 2, 3 + camera]
        blocks[np.ix_(range(len(pairs.row)), place, place)] = (
            pairs.block * scale_row[:, :, None] * scale_column[:, None, :]
        )
        first = np.searchsorted(pairs.row, np.arange(count + 1))
        matrix = matrix + sparse.bsr_array((blocks, pairs.column, first), shape=matrix.shape)
        right[:, :3] += pairs.right[:, :3] * light[:, None]
        right[:, 3 + camera] += pairs.right[:, 3]
    matrix = sparse.bsr_array(matrix)
    matrix.sum_duplicates()
    return Normal(matrix=matrix, right=right, model=model, light=cloud.light)


def rendered(images: ParticleImages, lists: list[ImageLists], light: np.ndarray) -> np.ndarray:
    """Return the images of particles, shape (pixel,), float32."""
    parts = []
    for camera, own in enumerate(lists):
        share = np.repeat(light[:, camera], np.diff(own.first)) * own.values[:, 3]
        parts.append(np.bincount(own.pixel, share, minlength=int(np.diff(images.first_pixel)[camera])))
    return np.concatenate(parts).astype(np.float32)


def prior(light: np.ndarray, scatter: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the blocks and the right-hand side that hold the light of the cameras together."""
    count, cameras = light.shape
    blocks = np.zeros((count, 3 + cameras, 3 + cameras))
    mean = light.mean(1)
    strength = 1 / np.maximum(scatter * mean, 1e-9) ** 2
    blocks[:, 3:, 3:] = strength[:, None, None] * (np.eye(cameras) - 1 / cameras)
    return blocks, -strength[:, None] * (light - mean[:, None])


def solve(normal: Normal, damping: float) -> np.ndarray:
    """Solve the damped equations by conjugate gradients; return the steps, shape (particle, parameter)."""
    matrix, shape = normal.matrix, normal.right.shape
    diagonal = matrix.diagonal().reshape(shape)
    diagonal = np.maximum(diagonal, 1e-9 * diagonal.max(initial=1e-30))
    blocks = diagonal_blocks(matrix, shape)
    blocks = blocks + np.eye(shape[1]) * (damping * diagonal)[:, :, None]
    inverse = np.linalg.inv(blocks)

    def apply(vector: np.ndarray) -> np.ndarray:
        return matrix @ vector + damping * diagonal.reshape(-1) * vector

    def precondition(vector: np.ndarray) -> np.ndarray:
        return np.einsum("pij,pj->pi", inverse, vector.reshape(shape)).reshape(-1)

    size = normal.right.size
    operator, inner = (LinearOperator((size, size), matvec=call, dtype=float) for call in (apply, precondition))
    steps, _ = cg(operator, normal.right.reshape(-1), rtol=CG_TOLERANCE, maxiter=CG_STEPS, M=inner)
    return steps.reshape(shape)


def diagonal_blocks(matrix: sparse.bsr_array, shape: tuple[int, int]) -> np.ndarray:
    """Return the blocks of single particles, shape (particle, parameter, parameter)."""
    rows = np.repeat(np.arange(shape[0]), np.diff(matrix.indptr))
    blocks = np.zeros((shape[0], shape[1], shape[1]))
    own = rows == matrix.indices
    blocks[rows[own]] = matrix.data[own]
    return blocks


def refine(
    images: ParticleImages, scene: Scene, cloud: Cloud, *, iterations: int, scatter: float
) -> tuple[Cloud, Normal]:
    """Refine positions and light of all particles; return them and the equations at the last place but one."""
    for _ in range(iterations):
        normal = linearise(images, scene, cloud, scatter)
        steps = solve(normal, DAMPING)
        moved = np.clip(steps[:, :3], -LARGEST_STEP_VOXEL, LARGEST_STEP_VOXEL)
        light = np.maximum(cloud.light + steps[:, 3:], 0.1 * cloud.light)
        cloud = Cloud(positions_mm=cloud.positions_mm + moved * images.voxel_mm, light=light)
    return cloud, normal


def overlaps(normal: Normal) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pairs of particles that light the same pixels and how far their images overlap.

    Returns
    -------
    first, second : ndarray, shape (pair,)
        Particles, the first before the second.
    overlap : ndarray, shape (pair, camera)
        Cosine between the images, 0 for disjoint and 1 for equal ones.
    """
    matrix, (count, _) = normal.matrix, normal.right.shape
    rows = np.repeat(np.arange(count), np.diff(matrix.indptr))
    light = np.einsum("pii->pi", matrix.data[:, 3:, 3:])
    own = np.zeros((count, light.shape[1]))
    diagonal = rows == matrix.indices
    own[rows[diagonal]] = light[diagonal]
    upper = rows < matrix.indices
    first, second = rows[upper], matrix.indices[upper]
    return first, second, light[upper] / np.sqrt(np.maximum(own[first] * own[second], 1e-30))


def light_scatter(normal: Normal, light: np.ndarray, scatter: float) -> float:
    """Return the relative scatter of particles' light between the cameras, robustly over all particles.

    The scatter that was assumed before holds the light of the cameras together. Its pull is undone, and the variance of
    noise is subtracted.

    Parameters
    ----------
    normal : Normal
        Equations whose solution the light is.
    light : ndarray, shape (particle, camera)
        Light of each particle [counts].
    scatter : float
        Scatter that the equations assume.
    """
    mean, cameras = light.mean(1), light.shape[1]
    strength = 1 / np.maximum(scatter * mean, 1e-9) ** 2
    own = np.einsum("pii->pi", diagonal_blocks(normal.matrix, normal.right.shape))[:, 3:]
    known = own - strength[:, None] * (1 - 1 / cameras)
    usable = (mean > 0) & (known > 1e-3 * own).all(1)
    if cameras < 2 or usable.sum() < 3:
        return SCATTER_RANGE[1]
    known, mean = known[usable], mean[usable, None]
    free = (light[usable] - mean) * (1 + strength[usable, None] / known)
    square = (np.square(free).sum(1) / (cameras - 1) - (1 / known).mean(1)) / mean[:, 0] ** 2
    return float(np.clip(np.sqrt(max(np.median(square), 0) / CHI2_MEDIAN), *SCATTER_RANGE))


def covariances(normal: Normal) -> np.ndarray:
    """Return the covariance of each particle's parameters, its overlapping neighbours being unknown as well.

    Returns
    -------
    ndarray, shape (particle, parameter, parameter)
        In voxel for the position and counts for the light.
    """
    matrix, shape = normal.matrix, normal.right.shape
    count, parameters = shape
    own = diagonal_blocks(matrix, shape)
    scale = 1 / np.sqrt(np.maximum(np.einsum("pii->pi", own), 1e-30))
    found = np.zeros_like(own)
    for particle in range(count):
        span = slice(matrix.indptr[particle], matrix.indptr[particle + 1])
        near, blocks = matrix.indices[span], matrix.data[span]
        strength = np.abs(blocks * scale[particle][None, :, None] * scale[near][:, None, :]).max((1, 2))
        strength[near == particle] = np.inf
        chosen = np.argsort(-strength)[:MOST_COUPLED]
        group = near[chosen[strength[chosen] > COUPLING]]
        joint = _group_matrix(matrix, group, parameters)
        size = np.sqrt(np.maximum(np.diag(joint), 1e-30))
        inverse = np.linalg.pinv(joint / size / size[:, None], hermitian=True) / size / size[:, None]
        found[particle] = inverse[:parameters, :parameters]
    return found


def _group_matrix(matrix: sparse.bsr_array, group: np.ndarray, parameters: int) -> np.ndarray:
    """Return the dense normal matrix of a few particles."""
    joint = np.zeros((len(group) * parameters,) * 2)
    for row, particle in enumerate(group):
        span = slice(matrix.indptr[particle], matrix.indptr[particle + 1])
        where = {int(other): place for place, other in enumerate(matrix.indices[span])}
        for column, other in enumerate(group):
            if int(other) in where:
                block = matrix.data[span][where[int(other)]]
                joint[row * parameters : (row + 1) * parameters, column * parameters : (column + 1) * parameters] = (
                    block
                )
    return joint
