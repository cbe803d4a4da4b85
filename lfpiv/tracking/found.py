"""`FoundParticles`: the particles of one instant with standard errors and figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.geometry.grid import Grid
from lfpiv.geometry.volume import lies_in
from lfpiv.tracking.confirmation import signals
from lfpiv.tracking.fit import Fit
from lfpiv.tracking.refinement import Normal, covariances, overlaps

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera


@dataclass(frozen=True, kw_only=True)
class FoundParticles:
    """Particles of one instant, in no particular order."""

    positions_mm: np.ndarray
    """Positions (x, y, z) [mm], shape (particle, 3)."""
    errors_mm: np.ndarray
    """Standard errors of the positions along (x, y, z) [mm], shape (particle, 3). They contain noise and what the
    particles leave unexplained, but no errors of the calibration."""
    light: np.ndarray
    """Light of each particle, mean of the cameras [counts, summed over pixels], shape (particle,)."""
    residual: np.ndarray
    """Root mean square of each particle's weighted residuals; 1 where noise alone explains them, shape (particle,)."""
    sigma_voxel: float
    """Standard deviation of the particles [voxel]."""
    voxel_mm: float
    """Edge of a voxel [mm]."""
    explained: float
    """Share of the images' squared light, noise subtracted, that the particles explain."""
    crowding: float
    """Mean number of particles whose images overlap the image of one by half or more."""
    hidden: float
    """Share of the particles that fewer than two cameras (with one camera: none) see without another particle's image
    over half of theirs or more."""
    per_microlens: float
    """Particles per microlens of the volume's x-y face."""
    signal_to_noise: np.ndarray
    """Light over its standard error in the camera where this is least, of those that see a particle; shape
    (particle,)."""

    def __len__(self) -> int:
        return len(self.positions_mm)

    def __getitem__(self, chosen: np.ndarray) -> FoundParticles:
        """Return some of the particles, with the figures of all."""
        names = ("positions_mm", "errors_mm", "light", "residual", "signal_to_noise")
        arrays = {name: getattr(self, name)[chosen] for name in names}
        return replace(self, **arrays)

    @classmethod
    def from_fit(cls, cameras: Mapping[str, CalibratedCamera], grid: Grid, fit: Fit) -> FoundParticles:
        """Return the particles of a fit with their figures; `grid` is the volume that their density refers to."""
        model, scene, cloud = fit.model, fit.scene, fit.cloud
        if not len(cloud):
            empty = np.zeros((0, 3))
            return cls(
                positions_mm=empty,
                errors_mm=empty,
                light=np.zeros(0),
                residual=np.zeros(0),
                sigma_voxel=model.sigma_voxel,
                voxel_mm=grid.voxel_mm,
                explained=0.0,
                crowding=0.0,
                hidden=0.0,
                per_microlens=0.0,
                signal_to_noise=np.zeros(0),
            )
        normal = fit.normal
        errors = np.sqrt(np.maximum(np.einsum("pii->pi", covariances(normal))[:, :3], 0)) * grid.voxel_mm
        residual = _residuals(fit)
        noise = float(scene.variance(normal.model).sum(dtype=np.float64))
        whole = float(np.square(scene.counts, dtype=np.float64).sum()) - noise
        explained = 1 - (float(np.square(fit.residual, dtype=np.float64).sum()) - noise) / whole if whole > 0 else 0.0
        return cls(
            positions_mm=cloud.positions_mm,
            errors_mm=errors * np.maximum(residual, 1)[:, None],
            light=cloud.light.mean(1),
            residual=residual,
            sigma_voxel=model.sigma_voxel,
            voxel_mm=grid.voxel_mm,
            explained=float(np.clip(explained, 0, 1)),
            crowding=_crowding(normal),
            hidden=_hidden(normal),
            per_microlens=int(lies_in(cloud.positions_mm, grid).sum()) / _microlenses(cameras, grid),
            signal_to_noise=signals(normal, fit.scatter).ratio,
        )


def _residuals(fit: Fit) -> np.ndarray:
    model, cloud = fit.model, fit.cloud
    square = np.square(fit.residual) / fit.scene.variance(fit.normal.model)
    above, below = np.zeros(len(cloud)), np.zeros(len(cloud))
    for camera, own in enumerate(model.lists(cloud.positions_mm)):
        particle = np.repeat(np.arange(len(cloud)), np.diff(own.first))
        share = own.values[:, 3]
        above += np.bincount(particle, share * square[own.pixel + model.first_pixel[camera]], minlength=len(cloud))
        below += np.bincount(particle, share, minlength=len(cloud))
    return np.sqrt(above / np.maximum(below, 1e-12))


def _crowding(normal: Normal) -> float:
    """Return the mean number of other particles whose images overlap a particle's by half or more, in any camera."""
    _, _, overlap = overlaps(normal)
    return float(2 * (overlap > 0.5).any(1).sum() / max(len(normal.right), 1))


def _hidden(normal: Normal) -> float:
    """Return the share of particles that too few cameras see without another one's image over half of theirs."""
    first, second, overlap = overlaps(normal)
    count, cameras = normal.light.shape
    free = np.ones((count, cameras), bool)
    for one in (first, second):
        particle, camera = np.nonzero(overlap > 0.5)
        free[one[particle], camera] = False
    return float((free.sum(1) < min(2, cameras)).mean())


def _microlenses(cameras: Mapping[str, CalibratedCamera], grid: Grid) -> float:
    """Return the number of microlenses that the volume's x-y face covers in a camera, mean of the cameras."""
    face = grid.shape[1] * grid.shape[2] * grid.voxel_mm**2
    every = [camera.optics for camera in cameras.values()]
    return float(np.mean([face * (one.magnification / one.microlens_pitch_mm) ** 2 for one in every]))
