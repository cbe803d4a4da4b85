"""Measure how alike two frames of a camera are: this tells which frames show the same particles.

Light is summed over microlenses. The displacement of particles between exposures moves it as a whole. Frames of a pair
correlate at this displacement, frames of different pairs by chance.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from scipy import fft

from lfpiv.calibration.camera import CalibratedCamera

REACH_LENSES = 8
"""Largest displacement of particles that is sought [microlens pitch]."""
ALIKE = 0.15
"""Least likeness of frames that show the same particles, above the likeness of other frames."""
UNLIKE = 1 / 3
"""Most likeness of the frames of a wrong pair above chance, relative to the frames that belong together."""
OUT_OF_ORDER = 1.8
"""Least ratio of what neighbouring images lack in correlation to what the images on either side of one lack."""


def likeness(
    first: Mapping[str, np.ndarray], second: Mapping[str, np.ndarray], cameras: Mapping[str, CalibratedCamera]
) -> float:
    """Return the highest correlation of two frames over displacements, a mean over the cameras."""
    return float(np.mean([_highest(first[name], second[name], camera) for name, camera in cameras.items()]))


def summed_light(images: Mapping[str, np.ndarray], cameras: Mapping[str, CalibratedCamera]) -> dict[str, np.ndarray]:
    """Return the light of each camera's image, summed over squares of a microlens, for `out_of_order`."""
    return {name: _summed(image, round(cameras[name].optics.microimage_pitch_px)) for name, image in images.items()}


def out_of_order(*images: np.ndarray) -> bool:
    """Return whether the images of a camera before and after one are clearly more like each other than like it.

    Particles that move on are the less alike, the more time is between two images. Where two lasers take turns, all
    neighbours are unlike, so they count beside the nearest ones.

    Parameters
    ----------
    *images : ndarray
        Images one after the other, from `summed_light`: the last but one is judged. Three or more.
    """
    apart = [_unlike(one, other) for one, other in pairwise(images)]
    return max(apart[-2:]) > OUT_OF_ORDER * max(_unlike(images[-3], images[-1]), min(apart))


def _unlike(one: np.ndarray, other: np.ndarray) -> float:
    """Return how far the correlation of two images is below 1, at rest."""
    return 1 - float(np.vdot(one, other)) / _norms(one, other)


def _norms(one: np.ndarray, other: np.ndarray) -> float:
    """Return the product of the norms of two images, at least a number above 0."""
    return max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-30)


def _highest(first: np.ndarray, second: np.ndarray, camera: CalibratedCamera) -> float:
    step = round(camera.optics.microimage_pitch_px)
    one, other = (_summed(image, step) for image in (first, second))
    shape = [2 * count for count in one.shape]
    product = fft.irfft2(fft.rfft2(one, shape).conj() * fft.rfft2(other, shape), shape)
    near = np.roll(product, (REACH_LENSES, REACH_LENSES), (0, 1))[: 2 * REACH_LENSES + 1, : 2 * REACH_LENSES + 1]
    return float(near.max()) / _norms(one, other)


def _summed(image: np.ndarray, step: int) -> np.ndarray:
    """Return the roots of the light in squares of a microlens, less their mean. Few bright particles hardly count."""
    rows, columns = (count // step for count in image.shape)
    roots = np.sqrt(np.maximum(image[: rows * step, : columns * step], 0, dtype=np.float32))
    squares: np.ndarray = roots.reshape(rows, step, columns, step).mean((1, 3))
    squares -= squares.mean()
    return squares
