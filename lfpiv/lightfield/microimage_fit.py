"""Each microimage of a white image measured: its centre from a fit with the mean microimage, moved and tilted."""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

BLUR_PX = 0.9
"""Gaussian blur of the microimages before the fit [pixel]: removes what the pixels alias, so no locking to pixels."""
BLUR_REACH_PX = 3
"""Reach of the blur [pixel], over three standard deviations."""
SHIFT_DIFFERENCE = np.array([1, -8, 0, 8, -1]) / 12
"""What a shift adds, per pixel: the negative first derivative to fourth order, as convolution weights."""
PATCH_BLOCK = 512
"""Microimages cut out at a time, so that they stay in the processor's cache."""
TEMPLATE_LENSES = 500
"""Microimages whose median is the mean microimage."""
LIT_FRACTION = 0.1
"""A microimage with less than this part of the brightest decile's contrast is dead or dark."""
OUTLIER_SCALES = 4.685
"""Tukey's biweight constant [standard deviations]: 95 % efficiency on normal errors."""
MEDIAN_DISTANCE = {1: 0.6745, 2: math.sqrt(2 * math.log(2))}
"""Median distance of normal errors from their mean in one and two dimensions [standard deviations]."""
FIT_PASSES = 20
"""Most passes of a robust fit that usually ends after three to five."""


def cut_patches(image: np.ndarray, centres: np.ndarray, half: int) -> np.ndarray:
    """Blurred image at whole pixels from each centre, shape (lens, 2 half + 1, 2 half + 1).

    The blur is sampled about the sub-pixel centre, so it interpolates as well; every microimage is seen alike.
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


def measure(
    patches: np.ndarray, places: np.ndarray, basis: np.ndarray, microimage: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shift of each microimage from its patch's middle [pixel], shape (lens, 2), which are lit, the mean microimage T.

    Least squares of brightness * T(x - shift) * (1 + slope . x) + background, linear in shift and slope. T is made
    symmetric about its middle: that defines the centre. Vignetting may act on pixels, so that brightness slopes within
    a microimage, or on whole lenses, so that neighbours that overlap it differ; the slope, a smooth field over the
    sensor, is their share, and keeps either from moving the centres.
    """
    half = patches.shape[1] // 2
    row, column = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    window = _cell_window(column, row, basis)
    brightness = np.tensordot(patches, window.astype(np.float32), 2) / window.sum()
    usual = max(np.percentile(brightness, 90), 1e-30)  # a part of the sensor may be dark
    brightness = np.maximum(brightness / usual, 0.1)
    patches = patches / (usual * brightness)[:, None, None].astype(np.float32)
    if microimage is None:
        bright = np.flatnonzero(brightness >= 0.5)
        microimage = np.median(patches[bright[:: math.ceil(len(bright) / TEMPLATE_LENSES)]], axis=0)
        microimage = (microimage + microimage[::-1, ::-1]) / 2

    moved = [ndimage.convolve1d(microimage, SHIFT_DIFFERENCE, axis=axis, mode="nearest") for axis in (1, 0)]
    overlap = _neighbours_light(microimage, column, row, basis)
    terms = [microimage, np.ones_like(row), *moved, column * microimage - overlap[0], row * microimage - overlap[1]]
    design = np.stack([term.ravel() for term in terms], axis=1)
    weighted = design * window.reshape(-1, 1)
    normal, moments = weighted.T @ design, patches.reshape(len(patches), -1) @ weighted.astype(np.float32)

    size = np.ptp(places, axis=0).max()
    x, y = ((places - places.mean(0)) / size).T
    field = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    c = robust_fit(field, np.log(brightness)[:, None])[0][:, 0]
    gradient = np.stack([c[1] + 2 * c[3] * x + c[4] * y, c[2] + c[4] * x + 2 * c[5] * y], axis=1) / size
    moments = moments - gradient @ (overlap.reshape(2, -1) @ weighted)

    free = moments @ np.linalg.pinv(normal)
    slopes = free[:, 4:] / np.maximum(free[:, :1], 0.1)
    coefficients, kept = robust_fit(field, slopes)
    smooth = field @ coefficients
    noise = ((slopes - smooth)[kept] ** 2).mean() * field.shape[1] / len(field)
    signal = (gradient**2).mean()  # bounds the slope where blurred microimages hardly tell it from a shift
    moments = moments - smooth * (signal / max(signal + noise, 1e-30)) @ normal[4:]
    solution = moments[:, :4] @ np.linalg.pinv(normal[:4, :4])
    limit = 0.25 * math.sqrt(abs(np.linalg.det(basis)))
    shift = np.clip(solution[:, 2:] / np.maximum(solution[:, :1], 0.1), -limit, limit)
    contrast = brightness * solution[:, 0]
    lit = contrast > LIT_FRACTION * np.percentile(contrast, 90)
    return shift, lit, microimage


def _neighbours_light(microimage: np.ndarray, column: np.ndarray, row: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Light of the nearest neighbour where microimages overlap, times the neighbour's offset [pixel], shape (2, ...).

    One microimage alone is nowhere brighter than at its heart; what is brighter overlaps.
    """
    heart = np.hypot(column, row) < 0.3 * np.hypot(*basis[0])
    light = np.where(heart, 0, np.maximum(microimage - microimage[heart].max(), 0))
    offsets = np.array([i * basis[0] + j * basis[1] for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)])
    distance = (column - offsets[:, 0, None, None]) ** 2 + (row - offsets[:, 1, None, None]) ** 2
    weighted: np.ndarray = light * offsets[distance.argmin(0)].transpose(2, 0, 1)
    return weighted


def _cell_window(column: np.ndarray, row: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Part of each pixel that is nearest to the middle's lattice node."""
    inside = np.full(column.shape, np.inf)
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):
        neighbour = i * basis[0] + j * basis[1]
        distance = np.hypot(*neighbour)
        inside = np.minimum(inside, distance / 2 - np.abs(column * neighbour[0] + row * neighbour[1]) / distance)
    return np.clip(inside + 0.5, 0, 1)


def robust_fit(design: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit values (row, axis) by iterated least squares with Tukey's weights: solution and which rows counted."""
    solution = np.zeros((design.shape[1], values.shape[1]))
    offset = np.median(values, axis=0)
    residual = values - offset
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
