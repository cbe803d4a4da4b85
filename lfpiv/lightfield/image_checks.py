"""Check whether images fit their camera's white image and are not saturated or dark.

A wrong image can be correct in form: swapped cameras, a lens moved after the white image, or particles brighter than
the sensor's range all give volumes, and vectors that agree with their neighbours. The checks compare the light between
and inside the microimages, and count pixels at the end of the sensor's range.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from scipy import ndimage, special

from lfpiv.geometry.optics import Optics
from lfpiv.lightfield.decoder import CORE_COVERAGE, LightFieldDecoder
from lfpiv.lightfield.lattice_fit import disagreement
from lfpiv.lightfield.particle_signal import EMPTY, NOISE
from lfpiv.lightfield.saturation import SATURATED, saturated_share
from lfpiv.lightfield.tone_curve import CURVED, tone_exponent
from lfpiv.warn import Code, Warning

GAP_LIGHT = 0.1
"""Light between the microimages, relative to that inside them, above which a warning is due."""
NO_PLACE = 0.5
"""The same ratio, above which an image certainly belongs to another white image."""
APERTURE = 0.05
"""Relative difference of the microimages' diameter from the stated one above which a warning is due."""
OTHER_APERTURE = 0.2
"""The same difference, above which the stated optics are certainly wrong."""

_BAND_ROWS = 512  # rows evaluated, in the middle of the sensor
_MEAN_REACH_PITCHES = 3.0  # half width of the local mean that is subtracted: ambient light, reflections
_CLIP_PERCENTILE = 99.9  # percentile at which pixels are clipped
_SIGNIFICANT = 5.0  # least covariance [standard deviations of that of independent pixels]
_LEAST_PIXELS = 500  # least number of pairs of pixels in the gaps, and inside the microimages
_TILE_PX = 1024  # side of the white image's middle part; further out other stops may cut the pupil
_CORE_PITCHES = 0.15  # radius in which a microimage is evenly bright
_LIT_LENS = 0.3  # least light of a lit lens, relative to the median
_WHOLE_LENS = 0.8  # least number of pixels of a whole microimage, relative to the median
_RING_PX = 0.25  # width of the rings of a microimage's profile
_OUTERMOST = 100  # without a dark image the outermost hundredth of the pixels of microimages gives the dark level
_DISC_REACH_PX, _DISCS = 2.0, 60  # reach and number of the radii of discs tried, below the half width of the profile
_LEAST_BLUR_PX, _LARGEST_BLUR_PX, _BLURS = 0.3, 1.5, 10  # standard deviations of the blur tried; a pixel's own is 0.29
_MODEL_ERROR = 0.01  # of the profile of a blurred disc, relative to its core, root mean square
_CLEAR_PX, _CLEAR_WITHOUT_DARK_PX = 0.5, 2.0  # width of the gap beyond a microimage's edge


def gap_light(image: np.ndarray, decoder: LightFieldDecoder) -> float:
    """Return the light between the microimages relative to that inside them.

    Both are covariances of neighbouring pixels, to which independent noise contributes nothing.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
        Raw image, or one without its dark level [counts].
    decoder : LightFieldDecoder
        The camera's decoder, made from its white image.

    Returns
    -------
    float
        About 0 where the light falls into the microimages of the white image, and up to about 1 where it falls
        anywhere. 0 where the image has no light or the microimages leave too few gaps.
    """
    first = max((len(image) - _BAND_ROWS) // 2, 0)
    band = slice(first, first + _BAND_ROWS)
    image, gaps, core = image[band], decoder.gaps[band], decoder.coverage[band] > CORE_COVERAGE
    if np.count_nonzero(gaps) < _LEAST_PIXELS or not core.any():
        return 0.0
    image = np.minimum(image, np.percentile(image, _CLIP_PERCENTILE)).astype(np.float32)
    image -= np.float32(np.median(image[gaps]))
    reach = int(_MEAN_REACH_PITCHES * decoder.optics.microimage_pitch_px)
    parts = gaps.astype(np.float32), np.where(gaps, image, np.float32(0))
    share, mean = (ndimage.uniform_filter(part, 2 * reach + 1) for part in parts)
    image -= mean / np.maximum(share, np.float32(1e-6))
    inner = slice(reach, -reach), slice(reach, -reach)  # the local mean is one-sided at the sensor's edges
    between, inside = (_covariance(image[inner], chosen[inner]) for chosen in (gaps, core))
    return max(between, 0.0) / inside if inside > 0 else 0.0


def microimage_px(white: np.ndarray, dark: np.ndarray | None, decoder: LightFieldDecoder) -> float | None:
    """Measure the diameter of the microimages in the white image [pixel].

    One estimate is a blurred disc, fitted to the mean microimage. Uneven light hardly changes it. The other is the
    ratio of all light to that of the cores. Blur and overlap do not change it. The estimate nearer to the stated
    diameter is returned, and of the discs that fit alike the nearest.

    Parameters
    ----------
    white, dark : ndarray, shape (rows, columns)
        White and dark image [counts]. Without a dark image the darkest pixels give the dark level.
    decoder : LightFieldDecoder
        The camera's decoder.

    Returns
    -------
    float or None
        None where the gaps between the microimages are too narrow, or too few microimages are lit.
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
    if np.count_nonzero(lit) < _LEAST_PIXELS:
        return None
    order = np.argsort(away[lit])
    light, away = (light[lit] / mean[lens[lit]])[order], away[lit][order]
    if dark is None:
        light -= np.median(light[-len(light) // _OUTERMOST :])
    core = max(float(np.median(light[away < max(_CORE_PITCHES * pitch, 1.0)])), 1e-9)
    rings = np.split(np.arange(len(away)), np.flatnonzero(np.diff(away // _RING_PX)) + 1)
    radius, profile = np.array([(away[ring].mean(), np.median(light[ring]) / core) for ring in rings]).T
    edge = int(np.flatnonzero(profile >= 0.5).max(initial=0))
    cell = pitch**2 * (3**0.5 / 2 if optics.layout == "hexagonal" else 1)
    plateau, discs = 1.0, []
    if radius[-1] - radius[edge] > (_CLEAR_WITHOUT_DARK_PX if dark is None else _CLEAR_PX):
        inner = radius < max(pitch / 2, radius[edge] + 1)
        plateau, smallest, largest = _fitted_discs(radius[inner], profile[inner], float(radius[edge]))
        discs = [float(np.clip(stated_px(optics), 2 * smallest, 2 * largest))]
    elif dark is None:
        return None
    estimates = [2 * (float(light.mean() / core / plateau) * cell / np.pi) ** 0.5, *discs]
    return float(min(estimates, key=lambda diameter: abs(diameter - stated_px(optics))))


def _fitted_discs(radius: np.ndarray, profile: np.ndarray, near: float) -> tuple[float, float, float]:
    """Fit discs under a Gaussian blur to the profile of a microimage.

    Return the brightness of the best disc, and the smallest and the largest radius of discs that fit as well within the
    model's own error [pixel]. Of microimages of few pixels blur and radius are hardly told apart.

    `near` is the radius at which the profile falls below a half.
    """
    radii = np.linspace(max(0.4 * near, near - _DISC_REACH_PX), 1.05 * near + 0.5, _DISCS)[:, None, None]
    blur = np.geomspace(_LEAST_BLUR_PX, max(_LARGEST_BLUR_PX, near / 4), _BLURS)[:, None]
    shapes = special.chndtr((radii / blur) ** 2, 2, (radius / blur) ** 2)  # (disc, blur, ring)
    weight = radius  # a ring's pixels
    brightness = (shapes * profile) @ weight / np.maximum(shapes**2 @ weight, 1e-9)
    rest = np.sqrt((brightness[..., None] * shapes - profile) ** 2 @ weight / weight.sum())
    best = rest.min(1)
    chosen = int(best.argmin())
    fits = radii[best <= np.hypot(best[chosen], _MODEL_ERROR)]
    return float(brightness[chosen, rest[chosen].argmin()]), float(fits.min()), float(fits.max())


def stated_px(optics: Optics) -> float:
    """Return the diameter of the microimages for the stated optics, 2 R f_m/s_i [pixel]."""
    return 2 * optics.pupil_radius_mm / optics.pupil_pixel_mm


def _covariance(image: np.ndarray, chosen: np.ndarray) -> float:
    """Return the covariance of chosen pixels with chosen neighbours along the rows, 0 where it is not significant."""
    both = chosen[:, 1:] & chosen[:, :-1]
    count = np.count_nonzero(both)
    if count < _LEAST_PIXELS:
        return 0.0
    a, b = image[:, 1:][both], image[:, :-1][both]
    found = float(np.mean((a - a.mean()) * (b - b.mean())))
    return found if found > _SIGNIFICANT * float(a.std() * b.std()) / count**0.5 else 0.0


def image_warnings(
    raw: np.ndarray,
    light: np.ndarray,
    decoder: LightFieldDecoder,
    camera: str,
    frame: str | None,
    white_level: float | None = None,
    others: Mapping[str, LightFieldDecoder] | None = None,
) -> list[Warning]:
    """Warn of light in one image that is misplaced, saturated, or not proportional to the counts.

    Parameters
    ----------
    raw, light : ndarray, shape (rows, columns)
        The image as recorded, and without its dark level [counts].
    decoder : LightFieldDecoder
        The camera's decoder.
    camera : str
        Name of the camera, for the warnings.
    frame : str, optional
        Name of the frame in its pair; None for an instant of a series.
    white_level : float, optional
        Value from which on pixels are saturated, where it is known [counts].
    others : mapping of str to LightFieldDecoder, optional
        Decoders of the other cameras, whose images this one may be.
    """
    subject = _subject(camera, frame)
    found = []
    between = gap_light(light, decoder)
    if (figures := disagreement(light, decoder, others, misplaced=between > NO_PLACE)) is not None:
        code = Code.SHIFTED if "shift_px" in figures else Code.OTHER_LATTICE
        found.append(Warning(code=code, subject=subject, figures=figures))
    elif between > GAP_LIGHT:
        found.append(Warning(code=Code.MISPLACED, subject=subject, figures={"gap_light": between}))
    if (share := saturated_share(raw, white_level)) > SATURATED:
        found.append(Warning(code=Code.SATURATED, subject=subject, figures={"share": share}))
    if (exponent := tone_exponent(raw)) > CURVED:
        found.append(Warning(code=Code.TONE_CURVE, subject=subject, figures={"exponent": exponent}))
    return found


def signal_warnings(structure: Mapping[str, float], frame: str | None) -> list[Warning]:
    """Warn of images of one frame with weak particles or none, by the structure per camera.

    `frame` is the name of the frame in its pair; None for an instant of a series.
    """
    return [
        Warning(
            code=Code.EMPTY if value < EMPTY else Code.DIM,
            subject=_subject(camera, frame),
            figures={"structure": max(float(value), 0.0)},
        )
        for camera, value in structure.items()
        if value < NOISE
    ]


def _subject(camera: str, frame: str | None) -> str:
    return camera if frame is None else f"{camera}, frame {frame}"


def misplaced(frames: Iterable[Iterable[Warning]]) -> bool:
    """Return whether an image certainly does not belong to its camera's white image, by the warnings per frame."""
    return any(
        warning.code in (Code.SHIFTED, Code.OTHER_LATTICE)
        or (warning.code is Code.MISPLACED and float(str(warning.figures.get("gap_light", 0))) > NO_PLACE)
        for warnings in frames
        for warning in warnings
    )


def unmeasured(frames: Iterable[Iterable[Warning]], cameras: int) -> bool:
    """Return whether fewer than two of several cameras show particles in some frame, by the warnings per frame."""
    empty = [sum(warning.code is Code.EMPTY for warning in warnings) for warnings in frames]
    return any(empty) and cameras - max(empty) < min(cameras, 2)
