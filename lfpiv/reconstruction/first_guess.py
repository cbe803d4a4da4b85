"""First guess of SMART: the multiplicative first guess from the images, or a volume of the caller."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lfpiv.geometry.volume import in_order
from lfpiv.reconstruction.smart import CameraEquation
from lfpiv.weights.stored_grid import StoredGrid

LEAST_FLOOR_SHARE = 1e-3
"""Least floor in the first guess, as a share of the brightest counts."""
FAINTEST = 1e-6
"""Least light of a voxel in the first guess, as a share of the brightest one. SMART can raise it; it cannot raise 0."""


def multiplicative_guess(
    cameras: Sequence[CameraEquation], peaks: Sequence[float], column_sum: np.ndarray, lit: np.ndarray
) -> np.ndarray:
    """Return exp(sum_i w log(1 + I / b) / sum_i w) - 1, scaled so that its projections have the images' light.

    Parameters
    ----------
    cameras : sequence of CameraEquation
        Images I, floors b and weights w.
    peaks : sequence of float
        Brightest counts of each image.
    column_sum : ndarray, shape (voxel,), float32
        sum_i w.
    lit : ndarray, shape (voxel,), bool
        Voxels that some camera sees. The others are zero.

    Returns
    -------
    ndarray, shape (voxel,), float32
    """
    logarithm = np.zeros_like(column_sum)
    for camera, peak in zip(cameras, peaks, strict=True):
        floor = max(camera.floor, LEAST_FLOOR_SHARE * peak)
        camera.projector.back_project(camera.gain * np.log1p(camera.image / floor), logarithm)
    guess = np.expm1(np.divide(logarithm, column_sum, out=np.zeros_like(column_sum), where=lit))
    guess = np.where(lit, np.maximum(guess, FAINTEST * guess.max()), 0.0).astype(np.float32)
    seen = light = 0.0
    for camera in cameras:
        modelled = camera.gain * camera.projector.project(guess, np.empty_like(camera.image))
        seen += float(camera.image[modelled > 0].sum(dtype=np.float64))
        light += float(modelled.sum(dtype=np.float64))
    return (guess * (seen / light)).astype(np.float32)


def checked_guess(first: np.ndarray, stored: StoredGrid) -> np.ndarray:
    """Return the caller's first guess (z, y, x) in stored order.

    Raises
    ------
    ValueError
        If its shape is wrong or its values are not finite, negative or all zero.
    """
    values = np.asarray(in_order(first, "first"))
    if values.shape != stored.grid.shape:
        raise ValueError(f"first: expected shape {stored.grid.shape} (z, y, x), got {values.shape}.")
    if not np.isfinite(values).all() or values.min() < 0 or not values.any():
        raise ValueError("first: expected finite values >= 0, some above 0, got NaN, infinite, negative or only zeros.")
    return stored.store(values)
