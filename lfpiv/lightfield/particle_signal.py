"""Whether an image shows particles or nothing but noise, told from the images alone.

A particle's light fills many neighbouring pixels of a microimage; noise, of the read-out or of photons, is independent
from pixel to pixel. So near pixels under one microlens tell the two apart at any brightness: what correlates
between them is light with a structure. SMART and the correlation do not notice: they make a volume, and vectors that
agree with their neighbours, of noise too.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from lfpiv.lightfield.decoder import LightFieldDecoder

NOISE = 0.05
"""Structure below which light hardly rises above noise. Clear images of particles have 0.2 and more; of simulated pairs
with 0.04, from 0.02 to 1 particle per microlens, displacements were drawn towards zero by a fifth."""
EMPTY = 0.01
"""Structure below which an image is taken for noise alone, which has up to 0.005. Of simulated pairs with less none was
measured better than to 0.4 of its displacement."""
CLIP = 5.0
"""Robust standard deviations at which pixels are clipped, so that no hot ones outweigh the rest."""

_CORE_COVERAGE = 0.99  # pixels wholly inside a microimage
_LEAST_GAIN = 0.2  # pixels under dead lenses or in dark corners are left out
_EVEN_PITCHES = 3.0  # half width of the local mean, which is left out: reflections, ambient light
_LAG = 0.2  # of a microimage between the two pixels: further than a sensor's own blur, nearer than a particle's light
_SMALLEST_COUNT = 0.3  # [counts]: noise of rounding alone
_FEWEST_PAIRS = 1000  # pairs of neighbours that tell anything


def structure(light: np.ndarray, decoder: LightFieldDecoder, *, clip: float = CLIP) -> float:
    """Correlation of near pixels under the same microlens, from -1 to 1: about 0 for noise.

    Parameters
    ----------
    light : ndarray, shape (rows, columns)
        Image without its dark level [counts].
    decoder : LightFieldDecoder
        The camera's decoder.
    clip : float
        Robust standard deviations at which pixels are clipped, so that no hot ones outweigh the rest.

    Returns
    -------
    float
        The lower of the correlations along both diagonals, so that neither stripes along rows nor along columns count;
        1 where an image has too few pixels inside microimages to tell.
    """
    core = (decoder.coverage > _CORE_COVERAGE) & (decoder.gain > _LEAST_GAIN)
    if not core.any():
        return 1.0
    even = np.divide(light, decoder.gain, out=np.zeros(light.shape, np.float32), where=core)
    even = np.where(core, _clipped(even, core, clip), 0)
    pitch = decoder.optics.microimage_pitch_px
    reach = int(_EVEN_PITCHES * pitch)
    share, mean = (ndimage.uniform_filter(part.astype(np.float32), 2 * reach + 1) for part in (core, even))
    even = _clipped(even - mean / np.maximum(share, 1e-6), core, clip)
    core[:reach], core[-reach:], core[:, :reach], core[:, -reach:] = False, False, False, False  # one-sided means
    lag = max(1, round(_LAG * pitch))
    lens = np.ascontiguousarray(decoder.lens_index, np.int16).view(np.int32)[..., 0]  # both indices as one number
    return min(_correlation(even, core, lens, lag, side) for side in (lag, -lag))


def seen_structure(light: np.ndarray, decoder: LightFieldDecoder) -> float:
    """Return the structure of an image as its particles show it, few and bright or many and dim; see `structure`.

    Where clipping leaves next to nothing, as of a few bright particles on a large sensor, the whole light is asked.
    """
    found = structure(light, decoder)
    return max(found, structure(light, decoder, clip=math.inf)) if found < NOISE else found


def _clipped(values: np.ndarray, core: np.ndarray, clip: float) -> np.ndarray:
    """Clip to a few robust standard deviations about the median, so that no hot pixels outweigh the rest."""
    median = float(np.median(values[core]))
    reach = clip * max(1.4826 * float(np.median(np.abs(values[core] - median))), _SMALLEST_COUNT)
    clipped: np.ndarray = np.clip(values, median - reach, median + reach)
    return clipped


def _correlation(values: np.ndarray, core: np.ndarray, lens: np.ndarray, down: int, aside: int) -> float:
    """Correlation of pixels of one lens with those `down` rows and `aside` columns away."""
    rows, columns = values.shape
    first = slice(0, rows - down), slice(max(-aside, 0), columns - max(aside, 0))
    second = slice(down, rows), slice(max(aside, 0), columns + min(aside, 0))
    pair = core[first] & core[second] & (lens[first] == lens[second])
    if np.count_nonzero(pair) < _FEWEST_PAIRS:
        return 1.0
    a, b = (part[pair].astype(float) for part in (values[first], values[second]))
    a, b = a - a.mean(), b - b.mean()
    power = float((a * a).sum() * (b * b).sum())
    return float((a * b).sum()) / power**0.5 if power > 0 else 0.0
