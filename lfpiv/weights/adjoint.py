"""Images of the operator `Weights`, checked, and its adjoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.geometry.grid import Grid
    from lfpiv.weights.stored_grid import StoredGrid
    from lfpiv_kernels.reconstruction.ray_projector import RayProjector


class Forward(Protocol):
    """What the adjoint needs of the operator."""

    cameras: dict[str, CalibratedCamera]
    stored: StoredGrid

    @property
    def grid(self) -> Grid:
        """The voxels."""

    def projector(self, name: str) -> RayProjector:
        """Return one camera's weights."""

    def __call__(self, volume: np.ndarray, out: dict[str, np.ndarray] | None = None) -> dict[str, np.ndarray]:
        """Project a volume."""


class Adjoint:
    """The adjoint of `Weights`. Its attribute ``T`` is the operator itself."""

    def __init__(self, weights: Forward):
        self.T = weights

    def __call__(self, images: Mapping[str, np.ndarray], out: np.ndarray | None = None) -> np.ndarray:
        """Back-project images: volume[voxel] = sum over cameras and pixels of weight * image.

        Parameters
        ----------
        images : mapping of str to ndarray
            Camera name -> image, shape (rows, columns); every camera of the operator.
        out : ndarray, shape (z, y, x), float32, optional
            Volume to overwrite.

        Returns
        -------
        ndarray, shape (z, y, x), float32

        Raises
        ------
        ValueError
            If a camera is missing or a shape does not fit.
        """
        weights = self.T
        flat = np.zeros(weights.grid.size, np.float32)
        for name, camera in weights.cameras.items():
            image = np.multiply(checked_image(images, name, camera), camera.gain, dtype=np.float32)
            weights.projector(name).back_project(image.reshape(-1), flat)
        volume = weights.stored.restore(flat)
        if out is None:
            return volume
        if out.shape != volume.shape:
            raise ValueError(f"out: expected shape {volume.shape} (z, y, x), got {out.shape}.")
        out[:] = volume
        return out


def checked_image(images: Mapping[str, np.ndarray], name: str, camera: CalibratedCamera) -> np.ndarray:
    """Return a camera's image; raise ValueError if it is missing or has another shape."""
    if name not in images:
        raise ValueError(f"images: camera {name!r} is missing; found {', '.join(images) or 'none'}.")
    image = np.asarray(images[name])
    if image.shape != camera.optics.sensor_shape:
        raise ValueError(f"images[{name!r}]: expected shape {camera.optics.sensor_shape}, got {image.shape}.")
    return image


def checked_out(images: Mapping[str, np.ndarray], name: str, camera: CalibratedCamera) -> np.ndarray:
    """Return a camera's image to write into; raise ValueError unless it is a C-contiguous float32 array that fits."""
    image = checked_image(images, name, camera)
    if image is not images[name] or image.dtype != np.float32 or not image.flags.c_contiguous:
        raise ValueError(f"out[{name!r}]: expected a C-contiguous float32 array to write into.")
    return image
