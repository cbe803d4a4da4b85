"""Measure whether an image shows particles or only noise.

A particle lights many neighbouring pixels of a microimage. Read-out and photon noise is independent from pixel to
pixel. So the correlation of near pixels under one microlens, the structure of the image, separates particles from noise
at any brightness. SMART and the correlation of volumes do not notice noise: from noise, too, they give a volume, and
vectors that agree with their neighbours.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from lfpiv.lightfield.decoder import CORE_COVERAGE, NORMAL_MAD, LightFieldDecoder

NOISE = 0.05
"""Structure below which the particles hardly rise above the noise."""
EMPTY = 0.01
"""Structure below which an image shows no particles."""
CLIP = 5.0
"""Distance from the median at which pixels are clipped [robust standard deviations]."""

_LEAST_GAIN = 0.2  # least gain of a pixel that counts
_MEAN_REACH_PITCHES = 3.0  # half width of the local mean that is subtracted
_LAG = 0.2  # distance of the two pixels [pitch]: beyond a sensor's blur, within the light of a particle
_LEAST_DEVIATION = 0.3  # lower limit of the robust standard deviation [counts]: noise of rounding
_LEAST_PAIRS = 1000  # least number of pairs of pixels


def near_pixel_correlation(light: np.ndarray, decoder: LightFieldDecoder, *, clip: float = CLIP) -> float:
    """Return the correlation of near pixels under the same microlens, from -1 to 1. It is about 0 for noise.

    Parameters
    ----------
    light : ndarray, shape (rows, columns)
        Image without its dark level [counts].
    decoder : LightFieldDecoder
        The camera's decoder.
    clip : float
        Distance from the median at which pixels are clipped [robust standard deviations].

    Returns
    -------
    float
        Of the correlations along both diagonals the lower, so that stripes along rows or columns do not count. 1 if too
        few pixels lie inside microimages.
    """
    core = (decoder.coverage > CORE_COVERAGE) & (decoder.gain > _LEAST_GAIN)
    if not core.any():
        return 1.0
    flat = np.divide(light, decoder.gain, out=np.zeros(light.shape, np.float32), where=core)
    flat = np.where(core, _clipped(flat, core, clip), 0)
    pitch = decoder.optics.microimage_pitch_px
    reach = int(_MEAN_REACH_PITCHES * pitch)
    share, mean = (ndimage.uniform_filter(part.astype(np.float32), 2 * reach + 1) for part in (core, flat))
    flat = _clipped(flat - mean / np.maximum(share, 1e-6), core, clip)
    inner = np.zeros_like(core)  # the local mean is one-sided at the edges
    inner[reach:-reach, reach:-reach] = core[reach:-reach, reach:-reach]
    lag = max(1, round(_LAG * pitch))
    lens = np.ascontiguousarray(decoder.lens_index, np.int16).view(np.int32)[..., 0]  # both indices in one number
    return min(_correlation(flat, inner, lens, lag, side) for side in (lag, -lag))


def measure_structure(light: np.ndarray, decoder: LightFieldDecoder) -> float:
    """Return the structure of an image without its dark level (rows, columns) [counts], from -1 to 1.

    Clipping removes a few bright particles on a large sensor. So a low structure is measured again without clipping.
    """
    found = near_pixel_correlation(light, decoder)
    return max(found, near_pixel_correlation(light, decoder, clip=math.inf)) if found < NOISE else found


def _clipped(values: np.ndarray, core: np.ndarray, clip: float) -> np.ndarray:
    """Clip values to `clip` robust standard deviations about the median, which limits the weight of hot pixels."""
    median = float(np.median(values[core]))
    reach = clip * max(NORMAL_MAD * float(np.median(np.abs(values[core] - median))), _LEAST_DEVIATION)
    return np.clip(values, median - reach, median + reach)


def _correlation(values: np.ndarray, core: np.ndarray, lens: np.ndarray, down: int, aside: int) -> float:
    """Return the correlation of pixels with the pixels of the same lens `down` rows and `aside` columns away."""
    rows, columns = values.shape
    first = slice(0, rows - down), slice(max(-aside, 0), columns - max(aside, 0))
    second = slice(down, rows), slice(max(aside, 0), columns + min(aside, 0))
    both = core[first] & core[second] & (lens[first] == lens[second])
    if np.count_nonzero(both) < _LEAST_PAIRS:
        return 1.0
    a, b = (part[both].astype(float) for part in (values[first], values[second]))
    a, b = a - a.mean(), b - b.mean()
    power = float((a * a).sum() * (b * b).sum())
    return float((a * b).sum()) / power**0.5 if power > 0 else 0.0
