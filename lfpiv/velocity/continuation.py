"""Vectors of windows that are partly masked, moved from the middle of their fluid to the window's centre.

A window whose fluid fills one side measures the mean over that side. Where the flow has a gradient this is not the
value at the window's centre. A linear fit to the valid neighbours gives the gradient, and continues the field into
masked windows, which the deformation of the next pass needs.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lfpiv.velocity import validation
from lfpiv.velocity.windows import Windows
from lfpiv_kernels.transfer import Values

REACH = 2
"""Neighbours on either side of a window that enter a fit."""
FLATTEST = 0.05
"""Least extent of the neighbours along a direction for a gradient there, as a share of their largest variance."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Linear functions fitted to the neighbours of some windows."""

    mean: np.ndarray
    """Mean of the neighbours' values, shape (window, component); NaN without neighbours."""
    place: np.ndarray
    """Mean of the neighbours' places relative to the window's centre, shape (window, 3) [voxel]."""
    gradient: np.ndarray
    """Change of each component along z, y, x, shape (window, 3, component) [1 / voxel]; 0 where it is not known."""

    @property
    def at_centre(self) -> np.ndarray:
        """Values at the windows' centres, shape (window, component)."""
        return self.mean - np.einsum("wa,wac->wc", self.place, self.gradient)


def fluid_centroids(fluid: Values, windows: Windows) -> np.ndarray:
    """Return the middle of each window's fluid relative to the window's centre, shape (z, y, x, 3) [voxel].

    `fluid` is true for voxels with fluid, shape (z, y, x). The result is 0 for windows without fluid.
    """
    offsets = windows.middles(fluid) - np.stack(np.meshgrid(*windows.centres, indexing="ij"), -1)
    return np.nan_to_num(offsets, nan=0.0)


def fit_neighbours(
    field: np.ndarray, valid: np.ndarray, offsets: np.ndarray, windows: Windows, chosen: np.ndarray
) -> Fit:
    """Fit linear functions to the valid vectors around some windows, the window itself included.

    Parameters
    ----------
    field : ndarray, shape (z, y, x, component)
        Values.
    valid : ndarray of bool, shape (z, y, x)
        Windows whose values enter.
    offsets : ndarray, shape (z, y, x, 3)
        Place of each value relative to the centre of its window [voxel].
    chosen : ndarray of bool, shape (z, y, x)
        Windows for which a function is fitted.
    """
    at = np.argwhere(chosen)
    count = np.zeros(len(at))
    place, square = np.zeros((len(at), 3)), np.zeros((len(at), 3, 3))
    value, product = np.zeros((len(at), field.shape[-1])), np.zeros((len(at), 3, field.shape[-1]))
    for steps in itertools.product(range(-REACH, REACH + 1), repeat=3):
        near = at + steps
        index = tuple(np.clip(near, 0, np.array(valid.shape) - 1).T)
        weight = np.where((near == np.stack(index, 1)).all(1) & valid[index], np.exp(-0.5 * np.dot(steps, steps)), 0.0)
        x = offsets[index] + np.multiply(steps, windows.step)
        v = np.where(weight[:, None] > 0, field[index], 0.0)
        count += weight
        place += weight[:, None] * x
        value += weight[:, None] * v
        square += weight[:, None, None] * x[:, :, None] * x[:, None, :]
        product += weight[:, None, None] * x[:, :, None] * v[:, None, :]
    with np.errstate(invalid="ignore", divide="ignore"):
        place, value = place / count[:, None], value / count[:, None]
        spread = square / count[:, None, None] - place[:, :, None] * place[:, None, :]
        product = product / count[:, None, None] - place[:, :, None] * value[:, None, :]
    known = count > 0
    gradient = np.zeros_like(product)
    gradient[known] = np.linalg.pinv(spread[known], rcond=FLATTEST, hermitian=True) @ product[known]
    return Fit(mean=value, place=np.where(known[:, None], place, 0), gradient=gradient)


def continued(
    field: np.ndarray, predicted: np.ndarray | float, valid: np.ndarray, fluid: Values, windows: Windows
) -> np.ndarray:
    """Return a field whose vectors belong to the windows' centres, continued where nothing was measured.

    Parameters
    ----------
    field : ndarray, shape (z, y, x, 3)
        Displacement: mean of the prediction over the window, and what was measured in its fluid [voxel].
    predicted : ndarray or float
        The prediction.
    valid : ndarray of bool, shape (z, y, x)
        Windows that were measured.
    fluid : array of bool
        Voxels with fluid, of the volume's shape.
    """
    share, result = windows.means(fluid), field.copy()
    offsets = fluid_centroids(fluid, windows)
    partial = valid & (share < 1)
    steps = fit_neighbours(field - predicted, valid, offsets, windows, partial)
    result[partial] -= np.einsum("wa,wac->wc", offsets[partial], steps.gradient)
    known = valid | (share == 1)
    if not valid.any():
        return result
    for _ in range(max(math.ceil(edge / step) for edge, step in zip(windows.window, windows.step, strict=True))):
        rim = ~known & ndimage.binary_dilation(known, np.ones((3, 3, 3)))
        result[rim] = fit_neighbours(result, known, np.zeros_like(offsets), windows, rim).at_centre
        known |= rim
    return validation.fill(result, known)
