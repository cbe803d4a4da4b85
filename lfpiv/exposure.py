"""Whether images that are right in form can be what they are said to be: their own camera's, and not saturated.

A wrong image is no wrong file: swapped cameras, a lens that was moved after the white image was taken, or particles
brighter than the sensor's range all give volumes and vectors that agree with their neighbours.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from lfpiv.errors import InputError
from lfpiv.experiment import Experiment
from lfpiv.lightfield import LightFieldDecoder

if TYPE_CHECKING:
    from lfpiv.camera import Calibration

GAP_LIGHT = 0.1
"""Light between the microimages, over that inside them, above which an image hardly belongs to the white image and the
stated optics. Simulated images have 0.001, real ones 0.01; a shift by a tenth of a microimage or an f-number wrong by
15 % gives 0.1, an arbitrary shift up to 1."""
NO_PLACE = 0.5
"""The same, above which it certainly does not."""
SATURATED = 0.02
"""Of the pixels brighter than half the sensor's range, the part at its end above which an image is saturated."""
UNEVEN = 4.0
"""Ratio of the light in a part of the sensor, between the frames of a pair, that no flow explains."""

MISPLACED = (
    "light falls between the microimages of the white image. Is it of the same camera, focus, zoom and aperture, and "
    "are f_number and microlens_focal_length_mm right?"
)
"""What such light means."""

_BAND_ROWS = 512  # looked at, over the whole width: enough pixels, and quick on the largest sensors
_CORE_COVERAGE = 0.99  # pixels wholly inside a microimage
_EVEN_PITCHES = 3.0  # half width of the local mean of the gaps, which is left out: ambient light, reflections
_BRIGHTEST = 99.9  # percentile at which pixels are clipped, so that no hot ones outweigh the rest
_SIGNIFICANT = 5.0  # standard deviations of a covariance between pixels of independent noise
_FEWEST_PIXELS = 500  # pairs of pixels between, and inside, microimages that tell anything
_FEWEST_SATURATED = 20
_LIT_SHARE = 0.04  # of all light in a ninth of the sensor; in darker ones single particles count
_RANGES = {(1 << bits) - 1 << shift for bits in range(8, 17) for shift in (0, 16 - bits)}  # right- and left-justified


def gap_light(image: np.ndarray, decoder: LightFieldDecoder) -> float:
    """Light between the microimages over that inside them, of what varies from place to place.

    Told from covariances of neighbouring pixels, to which independent noise adds nothing.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Raw image, or one without its dark level [counts].
    decoder : LightFieldDecoder
        The camera's decoder, made from its white image.

    Returns
    -------
    float
        About 0 where the light falls into the microimages of the white image, up to about 1 where it falls anywhere; 0
        where the image has no light or the microimages leave too few gaps to tell.
    """
    first = max((len(image) - _BAND_ROWS) // 2, 0)
    band = slice(first, first + _BAND_ROWS)
    image, gaps, core = image[band], decoder.gaps[band], decoder.coverage[band] > _CORE_COVERAGE
    if np.count_nonzero(gaps) < _FEWEST_PIXELS or not core.any():
        return 0.0
    image = np.minimum(image, np.percentile(image, _BRIGHTEST)).astype(np.float32)
    image -= np.float32(np.median(image[gaps]))
    reach = int(_EVEN_PITCHES * decoder.optics.microimage_pitch_px)
    parts = gaps.astype(np.float32), np.where(gaps, image, np.float32(0))
    share, mean = (ndimage.uniform_filter(part, 2 * reach + 1) for part in parts)
    image -= mean / np.maximum(share, np.float32(1e-6))
    inner = slice(reach, -reach), slice(reach, -reach)  # means at the sensor's edges are one-sided
    between, inside = (_covariance(image[inner], chosen[inner]) for chosen in (gaps, core))
    return max(between, 0.0) / inside if inside > 0 else 0.0


def _covariance(image: np.ndarray, chosen: np.ndarray) -> float:
    """Covariance of chosen pixels with chosen ones beside them; 0 where that is no more than noise has by chance."""
    pair = chosen[:, 1:] & chosen[:, :-1]
    count = np.count_nonzero(pair)
    if count < _FEWEST_PIXELS:
        return 0.0
    a, b = image[:, 1:][pair], image[:, :-1][pair]
    found = float(np.mean((a - a.mean()) * (b - b.mean())))
    return found if found > _SIGNIFICANT * float(a.std() * b.std()) / count**0.5 else 0.0


def saturated_share(image: np.ndarray) -> float:
    """Of the pixels brighter than half the largest value, the part that has it, where that is the end of a range.

    Ranges are those of 8 to 16 bits, in the lower or upper ones of 16; 0 for an image that ends anywhere else.
    """
    top = float(image.max())
    if not (top.is_integer() and int(top) in _RANGES):
        return 0.0
    count = np.count_nonzero(image == top)
    return count / np.count_nonzero(image > top / 2) if count >= _FEWEST_SATURATED else 0.0


def dark_blocks(first: np.ndarray, second: np.ndarray) -> int:
    """Blocks, of three by three over the sensor, that are lit in one of two frames and hardly in the other.

    Parameters
    ----------
    first, second : ndarray, shape (rows, columns)
        Both frames of a camera [counts].
    """
    light = []
    for frame in (first, second):
        above = np.maximum(frame - np.median(frame), 0)
        light.append([block.sum() for band in np.array_split(above, 3, 0) for block in np.array_split(band, 3, 1)])
    low, high = np.sort(light, axis=0)
    return int(np.count_nonzero((high > _LIT_SHARE * high.sum()) & (high > UNEVEN * low)))


def pair_warnings(experiment: Experiment, calibration: Calibration, pair: int) -> list[str]:
    """Say what is suspicious about the images of a pair; nothing where they cannot be read.

    Parameters
    ----------
    experiment : Experiment
        Its particle images are looked at.
    calibration : Calibration
        The microimages of its cameras.
    pair : int
        Number of the pair.
    """
    texts: list[str] = []
    seen: dict[bytes, str] = {}
    with contextlib.suppress(InputError):
        for camera in experiment.cameras:
            frames = [experiment.particle_image(camera.name, pair, frame) for frame in experiment.frames]
            for frame, image in zip(experiment.frames, frames, strict=True):
                where = f"{camera.name}, pair {pair}, frame {frame}"
                same = seen.setdefault(hashlib.blake2b(image.tobytes()).digest(), where)
                if same != where:
                    texts.append(f"{where}: the same image as {same}; check particles.images, and what was copied")
                texts += [f"{where}: {text}" for text in _image_warnings(image, calibration, camera.name)]
            dark = dark_blocks(*frames)
            if dark:
                texts.append(
                    f"{camera.name}, pair {pair}: {dark} of 9 parts of the sensor are {UNEVEN:g} times and more as "
                    "bright in one frame as in the other; check the laser's pulses and the shutter"
                )
    return texts


def _image_warnings(image: np.ndarray, calibration: Calibration, name: str) -> Iterator[str]:
    if gap_light(image, calibration.cameras[name].decoder) > GAP_LIGHT:
        yield MISPLACED
    share = saturated_share(image)
    if share > SATURATED:
        yield (
            f"{100 * share:.0f} % of the bright pixels are saturated; clipped particles make ghosts, lower the laser's "
            "power or the camera's gain"
        )
