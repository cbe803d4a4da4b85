"""Whether images that are right in form can be what they are said to be: their own camera's, and not saturated.

A wrong image is no wrong file: swapped cameras, a lens that was moved after the white image was taken, or particles
brighter than the sensor's range all give volumes and vectors that agree with their neighbours.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping

import numpy as np
from scipy import ndimage

from lfpiv.errors import InputError
from lfpiv.geometry.optics import Optics
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.particle_signal import EMPTY, NOISE
from lfpiv.warn import Code, Warning

GAP_LIGHT = 0.1
"""Light between the microimages, over that inside them, above which an image hardly belongs to the white image and the
stated optics. Simulated images have 0.001, real ones 0.01; a shift by a tenth of a microimage or an f-number wrong by
15 % gives 0.1, an arbitrary shift up to 1."""
NO_PLACE = 0.5
"""The same, above which it certainly does not."""
APERTURE = 0.05
"""Relative difference of the microimages' diameter from the stated one that is worth a look. Rendered ones, blurred and
touching, are told to 0.02."""
OTHER_APERTURE = 0.2
"""The same, above which the stated optics are certainly not those of the white image."""
SATURATED = 0.02
"""Of the pixels brighter than half the sensor's range, the part at its end above which an image is saturated."""
UNEVEN = 4.0
"""Ratio of the light in a part of the sensor, between the frames of a pair, that no flow explains."""

_BAND_ROWS = 512  # looked at, over the whole width: enough pixels, and quick on the largest sensors
_CORE_COVERAGE = 0.99  # pixels wholly inside a microimage
_EVEN_PITCHES = 3.0  # half width of the local mean of the gaps, which is left out: ambient light, reflections
_BRIGHTEST = 99.9  # percentile at which pixels are clipped, so that no hot ones outweigh the rest
_SIGNIFICANT = 5.0  # standard deviations of a covariance between pixels of independent noise
_FEWEST_PIXELS = 500  # pairs of pixels between, and inside, microimages that tell anything
_FEWEST_SATURATED = 20
_TILE_PX = 1024  # of the white image's middle; further out other stops may cut the pupil
_HEART_PITCHES = 0.15  # within this of its centre a microimage is evenly bright
_LIT_LENS = 0.3  # of a typical lens's light: others are dead or dark
_WHOLE_LENS = 0.8  # of a typical lens's pixels: others are cut by the edge
_RING_PX = 0.25  # width of the rings of a microimage's profile
_CLEAR_PX = {
    True: 0.5,
    False: 2.0,
}  # what lies beyond a microimage's edge: without a dark image it tells the dark level
_MEDIAN_SAMPLES = 100_000  # pixels whose median is taken for the background
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


def microimage_px(white: np.ndarray, dark: np.ndarray | None, decoder: LightFieldDecoder) -> float | None:
    """Diameter of the microimages as the white image shows it, whatever is stated [pixel].

    It is told twice, and what is nearer to the stated diameter is taken: by the distance at which the mean microimage
    is half as bright as in its heart, which uneven light hardly moves, and by all light over that of the hearts, to
    which blur and overlap do nothing.

    Parameters
    ----------
    white, dark : ndarray, shape (rows, columns)
        White and dark image [counts]; without the latter the darkest pixels give the dark level.
    decoder : LightFieldDecoder
        The camera's decoder.

    Returns
    -------
    float or None
        None where too little is dark between the microimages, or too few of them are lit, to tell.
    """
    optics, pitch = decoder.optics, decoder.optics.microimage_pitch_px
    middle = tuple(slice((n - size) // 2, (n + size) // 2) for n in white.shape for size in [min(n // 2, _TILE_PX)])
    light = (white[middle] - (np.percentile(white, 1) if dark is None else dark[middle])).ravel().astype(float)
    away = np.linalg.norm(decoder.pupil_mm[middle], axis=-1).ravel() / optics.pupil_pixel_mm
    lens = np.unique(decoder.lens_index[middle].reshape(-1, 2) @ [1 << 16, 1], return_inverse=True)[1]
    pixels = np.bincount(lens)
    mean = np.bincount(lens, light) / pixels
    whole = pixels > _WHOLE_LENS * np.median(pixels)
    lit = (whole & (mean > _LIT_LENS * np.median(mean[whole])))[lens]
    if np.count_nonzero(lit) < _FEWEST_PIXELS:
        return None
    order = np.argsort(away[lit])
    light, away = (light[lit] / mean[lens[lit]])[order], away[lit][order]
    heart = max(float(np.median(light[away < max(_HEART_PITCHES * pitch, 1.0)])), 1e-9)
    rings = np.split(np.arange(len(away)), np.flatnonzero(np.diff(away // _RING_PX)) + 1)
    radius, profile = np.array([(away[ring].mean(), np.median(light[ring]) / heart) for ring in rings]).T
    edge = int(np.flatnonzero(profile >= 0.5).max(initial=0))
    cell = pitch**2 * (3**0.5 / 2 if optics.layout == "hexagonal" else 1)
    told = [2 * (float(light.mean() / heart) * cell / np.pi) ** 0.5]
    if radius[-1] - radius[edge] > _CLEAR_PX[dark is not None]:
        told.append(2 * float(np.interp(0.5, profile[[edge + 1, edge]], radius[[edge + 1, edge]])))
    elif dark is None:
        return None
    return float(min(told, key=lambda diameter: abs(diameter - stated_px(optics))))


def stated_px(optics: Optics) -> float:
    """Diameter of the microimages by the stated optics, 2 R f_m/s_i [pixel]."""
    return 2 * optics.pupil_radius_mm / optics.pupil_pixel_mm


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
        above = np.maximum(frame - np.median(frame.ravel()[:: 1 + frame.size // _MEDIAN_SAMPLES]), 0)
        light.append([block.sum() for band in np.array_split(above, 3, 0) for block in np.array_split(band, 3, 1)])
    low, high = np.sort(light, axis=0)
    return int(np.count_nonzero((high > _LIT_SHARE * high.sum()) & (high > UNEVEN * low)))


def image_warnings(
    raw: np.ndarray, light: np.ndarray, decoder: LightFieldDecoder, camera: str, frame: str
) -> list[Warning]:
    """Warn of misplaced or saturated light in one image.

    Parameters
    ----------
    raw, light : ndarray, shape (rows, columns)
        The image as recorded, and without its dark level [counts].
    decoder : LightFieldDecoder
        The camera's decoder.
    camera, frame : str
        Their names.
    """
    subject = f"{camera}, frame {frame}"
    found = []
    if (between := gap_light(light, decoder)) > GAP_LIGHT:
        found.append(Warning(code=Code.MISPLACED, subject=subject, figures={"gap_light": between}))
    if (share := saturated_share(raw)) > SATURATED:
        found.append(Warning(code=Code.SATURATED, subject=subject, figures={"share": share}))
    return found


def uneven_warnings(first: np.ndarray, second: np.ndarray, camera: str) -> list[Warning]:
    """Warn where the light of a camera's two frames differs, images of shape (rows, columns) [counts]."""
    parts = dark_blocks(first, second)
    figures = {"parts": parts, "ratio": UNEVEN}
    return [Warning(code=Code.UNEVEN, subject=camera, figures=figures)] if parts else []


def signal_warnings(structure: Mapping[str, float], frame: str) -> list[Warning]:
    """Warn of images of a frame that show few particles or none, by their structure per camera."""
    return [
        Warning(
            code=Code.EMPTY if value < EMPTY else Code.DIM,
            subject=f"{camera}, frame {frame}",
            figures={"structure": max(float(value), 0.0)},
        )
        for camera, value in structure.items()
        if value < NOISE
    ]


def unmeasured(frames: Iterable[Iterable[Warning]], cameras: int) -> bool:
    """Whether in some frame of a pair fewer than two of several cameras saw particles, by the warnings per frame."""
    empty = [sum(warning.code is Code.EMPTY for warning in warnings) for warnings in frames]
    return any(empty) and cameras - max(empty) < min(cameras, 2)


def require_different(images: Iterable[tuple[str, bytes]]) -> None:
    """Refuse a pair of which two images are the same, pixel by pixel: no camera records that, one was copied.

    Parameters
    ----------
    images : iterable of (str, bytes)
        Where each image is from, and its `fingerprint`.

    Raises
    ------
    InputError
        Names both.
    """
    seen: dict[bytes, str] = {}
    for where, mark in images:
        other = seen.setdefault(mark, where)
        if other != where:
            raise InputError(
                f"{where}: expected an image of its own, found the same image as {other}. Check particles.images, and "
                "what was copied."
            )


def fingerprint(image: np.ndarray) -> bytes:
    """Hash of an image's pixels."""
    return hashlib.blake2b(image.tobytes(), digest_size=16).digest()
