"""Measure the centre of each microimage of a white image by a fit of the mean microimage.

The model of one microimage is brightness * T(x - shift) * (1 + slope . x) + background, where T is the mean microimage,
symmetric about its middle. Linear least squares give the shift, which is the centre, and the slope. Vignetting acts on
pixels or on whole lenses. It tilts a microimage, or makes overlapping neighbours differ. A slope that varies smoothly
over the sensor describes both, so that neither moves the centres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lfpiv.geometry.optics import NEIGHBOURS
from lfpiv.lightfield.lens_basis import indices_inside

BLUR_PX = 0.9
"""Standard deviation of the Gaussian blur of the microimages before the fit [pixel]. It prevents pixel locking."""
BLUR_REACH_PX = 3
"""Half width of the blur [pixel]."""
SHIFT_DIFFERENCE = np.array([1, -8, 0, 8, -1]) / 12
"""Negative first derivative to fourth order, as convolution weights: the change of T per pixel of shift."""
PATCH_BLOCK = 512
"""Microimages cut out at a time. They fit the processor's cache."""
LONGEST_HALF_CELL = 0.71
"""Upper limit of a patch's half width [pitch], half the diagonal of a square cell."""
TEMPLATE_LENSES = 500
"""Number of microimages whose median is T."""
TEMPLATE_BRIGHTNESS = 0.5
"""Least brightness of these microimages, relative to the brightest decile."""
LEAST_BRIGHTNESS = 0.1
"""Lower limit of a microimage's brightness, relative to the brightest decile."""
LIT_FRACTION = 0.1
"""Contrast of a lit microimage, relative to the brightest decile. Others are dead or dark."""
CORE_PITCHES = 0.3
"""Radius around its centre in which a microimage does not overlap others [pitch]."""
LARGEST_SHIFT = 0.25
"""Upper limit of the measured shift [root of the cell's area]."""
OUTLIER_SCALES = 4.685
"""Tukey's biweight constant [standard deviations], 95 % efficient for normal errors."""
MEDIAN_DISTANCE = {1: 0.6745, 2: math.sqrt(2 * math.log(2))}
"""Median distance of normal errors from their mean in one and two dimensions [standard deviations]."""
FIT_PASSES = 20
"""Largest number of passes of a robust fit."""


@dataclass(frozen=True, eq=False)
class MicroimageFit:
    """Result of `measure_microimages`."""

    shift_px: np.ndarray
    """Shift of each microimage from the middle of its patch, (column, row) [pixel], shape (lens, 2)."""
    lit: np.ndarray
    """Whether each microimage is lit, shape (lens,), bool."""
    mean_microimage: np.ndarray
    """T, shape (patch, patch)."""


def patch_half_px(basis: np.ndarray, pitch: float) -> int:
    """Return the half width of the square patch around one lattice cell [pixel]."""
    half_cell = 0.5 * float(np.abs(basis).sum(0).max())
    return math.ceil(pitch * min(half_cell / pitch, LONGEST_HALF_CELL))


def whole_microimages(shape: tuple[int, ...], origin: np.ndarray, basis: np.ndarray, half: int) -> np.ndarray:
    """Return the indices (i, j) of the microimages whose patch and its blur lie inside the image, shape (lens, 2)."""
    margin = half + BLUR_REACH_PX + 1
    return indices_inside(origin, basis, (margin, margin), (shape[1] - 1 - margin, shape[0] - 1 - margin))


def cut_patches(image: np.ndarray, centres: np.ndarray, half: int) -> np.ndarray:
    """Sample the blurred image at whole pixels from each centre, shape (lens, 2 half + 1, 2 half + 1), float32.

    The blur is centred on the sub-pixel centre, so that it interpolates, too.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        White image [counts].
    centres : ndarray, shape (lens, 2)
        Expected centres (column, row) [pixel].
    half : int
        Half width of a patch [pixel].
    """
    tap = np.arange(-BLUR_REACH_PX, BLUR_REACH_PX + 1)
    nearest = np.rint(centres).astype(int)
    distance = tap - (centres - nearest)[:, :, None]  # (lens, axis, tap)
    weight = np.exp(-0.5 * (distance / BLUR_PX) ** 2)
    weight = (weight / weight.sum(-1, keepdims=True)).astype(np.float32)[..., None, None]
    span = np.arange(-half - BLUR_REACH_PX, half + BLUR_REACH_PX + 1)
    width = 2 * half + 1
    patches = np.empty((len(centres), width, width), np.float32)
    for first in range(0, len(centres), PATCH_BLOCK):
        part = slice(first, first + PATCH_BLOCK)
        column, row = nearest[part, 0, None, None] + span, nearest[part, 1, None, None] + span[:, None]
        block = image[np.clip(row, 0, image.shape[0] - 1), np.clip(column, 0, image.shape[1] - 1)]
        block = sum(weight[part, 1, k] * block[:, k : k + width] for k in range(len(tap)))
        patches[part] = sum(weight[part, 0, k] * block[:, :, k : k + width] for k in range(len(tap)))
    return patches


def measure_microimages(
    patches: np.ndarray, centres: np.ndarray, basis: np.ndarray, mean_microimage: np.ndarray | None = None
) -> MicroimageFit:
    """Measure the shift of each microimage from the middle of its patch.

    Parameters
    ----------
    patches : ndarray, shape (lens, patch, patch), float32
        From `cut_patches`.
    centres : ndarray, shape (lens, 2)
        Centres of the patches (column, row) [pixel].
    basis : ndarray, shape (2, 2)
        Lattice vectors (column, row) [pixel].
    mean_microimage : ndarray, shape (patch, patch), optional
        T. Default: the symmetric median of the bright patches.
    """
    half = patches.shape[1] // 2
    row, column = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    window = _cell_window(column, row, basis)
    patches, brightness = _normalised(patches, window)
    if mean_microimage is None:
        mean_microimage = _symmetric_median(patches, brightness)

    overlap = _neighbours_light(mean_microimage, column, row, basis)
    derivatives = [ndimage.convolve1d(mean_microimage, SHIFT_DIFFERENCE, axis=axis, mode="nearest") for axis in (1, 0)]
    slopes = [column * mean_microimage - overlap[0], row * mean_microimage - overlap[1]]
    terms = np.stack([t.ravel() for t in (mean_microimage, np.ones_like(row), *derivatives, *slopes)], axis=1)
    weighted = terms * window.reshape(-1, 1)
    normal, moments = weighted.T @ terms, patches.reshape(len(patches), -1) @ weighted.astype(np.float32)

    field, gradient = _brightness_gradient(centres, brightness)
    moments = moments - gradient @ (overlap.reshape(2, -1) @ weighted)
    moments = moments - _smooth_slopes(moments, normal, field, gradient) @ normal[4:]
    solution = moments[:, :4] @ np.linalg.pinv(normal[:4, :4])
    limit = LARGEST_SHIFT * math.sqrt(abs(np.linalg.det(basis)))
    shift = np.clip(solution[:, 2:] / np.maximum(solution[:, :1], LEAST_BRIGHTNESS), -limit, limit)
    contrast = brightness * solution[:, 0]
    return MicroimageFit(shift, contrast > LIT_FRACTION * np.percentile(contrast, 90), mean_microimage)


def robust_fit(design: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit values by iterated least squares with Tukey's biweight.

    Parameters
    ----------
    design : ndarray, shape (row, term)
    values : ndarray, shape (row, axis)

    Returns
    -------
    solution : ndarray, shape (term, axis)
    inliers : ndarray, shape (row,), bool
        Rows with a positive weight.
    """
    solution = np.zeros((design.shape[1], values.shape[1]))
    residual = values - np.median(values, axis=0)
    median = MEDIAN_DISTANCE[values.shape[1]]
    for _ in range(FIT_PASSES):
        distance = np.sqrt((residual**2).sum(1))
        scale = max(np.median(distance) / median, 1e-9)
        reduced = distance / (OUTLIER_SCALES * scale)
        root = np.where(reduced < 1, 1 - reduced**2, 0)[:, None]  # square root of the biweight
        last, solution = solution, np.linalg.lstsq(root * design, root * values, rcond=None)[0]
        residual = values - design @ solution
        if np.abs(design @ (solution - last)).max() <= 1e-3 * scale:
            break
    return solution, reduced < 1


def _normalised(patches: np.ndarray, window: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide the patches by their brightness. Return them and their brightness relative to the brightest decile."""
    brightness = np.tensordot(patches, window.astype(np.float32), 2) / window.sum()
    usual = max(np.percentile(brightness, 90), 1e-30)  # a part of the sensor may be dark
    brightness = np.maximum(brightness / usual, LEAST_BRIGHTNESS)
    return patches / (usual * brightness)[:, None, None].astype(np.float32), brightness


def _symmetric_median(patches: np.ndarray, brightness: np.ndarray) -> np.ndarray:
    bright = np.flatnonzero(brightness >= TEMPLATE_BRIGHTNESS)
    median = np.median(patches[bright[:: math.ceil(len(bright) / TEMPLATE_LENSES)]], axis=0)
    return (median + median[::-1, ::-1]) / 2


def _brightness_gradient(centres: np.ndarray, brightness: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the logarithm of the brightness by a quadratic field over the sensor.

    Return the field's terms, shape (lens, 6), and its gradient at each lens [1/pixel], shape (lens, 2).
    """
    size = np.ptp(centres, axis=0).max()
    x, y = ((centres - centres.mean(0)) / size).T
    field = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    c = robust_fit(field, np.log(brightness)[:, None])[0][:, 0]
    return field, np.stack([c[1] + 2 * c[3] * x + c[4] * y, c[2] + c[4] * x + 2 * c[5] * y], axis=1) / size


def _smooth_slopes(moments: np.ndarray, normal: np.ndarray, field: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """Fit the slopes of all microimages by a quadratic field, shrunk by the ratio of signal to noise, shape (lens, 2).

    The signal is the gradient of the brightness. The shrinkage bounds the slope where a blurred microimage hardly
    distinguishes it from a shift.
    """
    free = moments @ np.linalg.pinv(normal)
    slopes = free[:, 4:] / np.maximum(free[:, :1], LEAST_BRIGHTNESS)
    coefficients, inliers = robust_fit(field, slopes)
    smooth = field @ coefficients
    noise = ((slopes - smooth)[inliers] ** 2).mean() * field.shape[1] / len(field)
    signal = (gradient**2).mean()
    return smooth * (signal / max(signal + noise, 1e-30))


def _neighbours_light(microimage: np.ndarray, column: np.ndarray, row: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return the light of the nearest neighbour where microimages overlap, times its offset [pixel], shape (2, ...).

    A single microimage is brightest in its core. Light above that level comes from a neighbour.
    """
    core = np.hypot(column, row) < CORE_PITCHES * np.hypot(*basis[0])
    light = np.where(core, 0, np.maximum(microimage - microimage[core].max(), 0))
    offsets = NEIGHBOURS @ basis
    distance = (column - offsets[:, 0, None, None]) ** 2 + (row - offsets[:, 1, None, None]) ** 2
    return light * offsets[distance.argmin(0)].transpose(2, 0, 1)


def _cell_window(column: np.ndarray, row: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Return the part of each pixel that is nearer to the middle than to any other lattice node."""
    inside = np.full(column.shape, np.inf)
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):
        neighbour = i * basis[0] + j * basis[1]
        distance = np.hypot(*neighbour)
        inside = np.minimum(inside, distance / 2 - np.abs(column * neighbour[0] + row * neighbour[1]) / distance)
    return np.clip(inside + 0.5, 0, 1)
