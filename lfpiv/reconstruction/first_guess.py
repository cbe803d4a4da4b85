"""First guess of SMART: the multiplicative first guess from the images, or a volume of the caller."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lfpiv.geometry.volume import in_order
from lfpiv.reconstruction.ordered_subsets import Subset
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.first_guess import add_logarithms, exponentiate, scale_to_images
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.update import Comparison
from lfpiv_kernels.transfer import DeviceArray, zeros

LEAST_FLOOR_SHARE = 1e-3
"""Least floor in the first guess, as a share of the brightest counts."""
FAINTEST = 1e-6
"""Least light of a voxel in the first guess, as a share of the brightest one. SMART can raise it; it cannot raise 0."""


def multiplicative_guess(
    comparisons: Sequence[Comparison],
    peaks: Sequence[float],
    column_sum: DeviceArray,
    lit: DeviceArray,
    shown: Sequence[DeviceArray],
    *,
    subset: Subset | None,
    sums: DeviceArray | None,
) -> DeviceArray:
    """Return exp(sum_i w log(1 + I / b) / sum_i w) - 1, scaled so that its projections have the images' light.

    Parameters
    ----------
    comparisons : sequence of Comparison
        Images I, floors b and weights w.
    peaks : sequence of float
        Brightest counts of each image.
    column_sum : array, shape (voxel,), float32
        sum_i w, on the device.
    lit : array, shape (voxel,), float32
        1 for voxels that some camera sees, on the device. The others are zero.
    shown : sequence of array, shape (lit pixel,), float32
        1 for pixels that such a voxel lights, else 0, of each image, on the device.
    subset : Subset or None
        Rays of all cameras, over whose pixels i both sums of the quotient are taken. None: all rays.
    sums : array, shape (voxel,), float32, or None
        sum_i w over the subset, above 0 where voxels are lit, on the device. None: `column_sum`.

    Returns
    -------
    array, shape (voxel,), float32
        On the device.
    """
    logarithm = zeros(column_sum.size)
    for number, (comparison, peak) in enumerate(zip(comparisons, peaks, strict=True)):
        sets = [ALL] if subset is None else subset.sets_of(number)
        add_logarithms(comparison, max(comparison.floor, LEAST_FLOOR_SHARE * peak), logarithm, sets)
    guess = exponentiate(logarithm, column_sum if sums is None else sums, lit, FAINTEST)
    scale_to_images(guess, column_sum, comparisons, shown)
    return guess


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
