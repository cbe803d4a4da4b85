"""Microlens array from a white image: sub-pixel lattice of the microimages' centres.

The white image's autocorrelation gives the lattice's vectors, the symmetry of its mean cell the phase. Each microimage
is then fitted with the mean microimage, moved, scaled and tilted in brightness; the result is an affine lattice through
the fitted centres, robust against dead lenses and dust.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lfpiv.errors import InputError
from lfpiv.lensbasis import cell_angle_deg, find_basis, find_phase, indices_inside, lattice_pitch
from lfpiv.rig import LAYOUTS, LensLattice, Optics

log = logging.getLogger(__name__)

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
SAMPLE_LENSES = 1500
"""Microimages that fix the lattice before all are measured."""
MIN_LENSES = 12
"""Fewest measured microimages: four values per unknown of the lattice."""
MAX_PASSES = 20
"""Most passes of an iteration that usually ends after three to five."""
PASS_TOLERANCE_PX = 0.01
"""Change of the lattice that ends the first passes [pixel]; the final ones start within it."""
LIT_FRACTION = 0.1
"""A microimage with less than this part of the brightest decile's contrast is dead or dark."""
OUTLIER_SCALES = 4.685
"""Tukey's biweight constant [standard deviations]: 95 % efficiency on normal errors."""
MEDIAN_DISTANCE = {1: 0.6745, 2: math.sqrt(2 * math.log(2))}
"""Median distance of normal errors from their mean in one and two dimensions [standard deviations]."""
DISTORTION_PX = 0.05
"""Smooth distortion worth a warning [pixel, rms]: what would move a pupil coordinate by a twentieth of a pixel."""


@dataclass(frozen=True, kw_only=True)
class LensArray:
    """Microimage centres of one camera as a lattice on the sensor: centre = origin + i basis[0] + j basis[1].

    Positions are (column, row) in pixels, integer at a pixel's centre. Microimage (0, 0) is the one nearest the
    sensor's centre.
    """

    centres_px: np.ndarray
    """Centres of all microimages whose centre lies on the sensor, cut ones included [pixel], shape (lens, 2)."""
    index: np.ndarray
    """Their lattice indices (i, j), shape (lens, 2), integer; i runs fastest."""
    origin_px: tuple[float, float]
    """Centre of microimage (0, 0) [pixel]."""
    basis_px: tuple[tuple[float, float], tuple[float, float]]
    """Vectors to the microimages (1, 0) and (0, 1) [pixel], the first -45 to 45 (hexagonal: -15 to 45) degrees from
    +column, the second 90 (60) degrees further towards +row."""
    layout: str
    """"square" or "hexagonal"."""
    rms_px: float
    """Root mean square distance between measured centres and lattice, outliers left out [pixel]."""
    measured: int
    """Number of microimages that the lattice rests on."""
    sensor_shape: tuple[int, int]
    """Shape of the white image [pixel], order (rows, columns)."""

    @property
    def pitch_px(self) -> float:
        """Distance between neighbouring centres, from the area of the lattice's cell [pixel]."""
        return lattice_pitch(np.asarray(self.basis_px), self.layout)

    @property
    def rotation_deg(self) -> float:
        """Angle from +column towards +row of basis[0], mean over both lattice vectors [degree]."""
        first, second = (math.degrees(math.atan2(row, column)) for column, row in self.basis_px)
        return (first + second - cell_angle_deg(self.layout)) / 2

    def lattice(self, optics: Optics) -> LensLattice:
        """Lens centres in the microlens plane, s_l = X_c / (1 + f_m/s_i), the optical axis at the sensor's centre.

        Raises
        ------
        ValueError
            If `optics` has another layout or sensor than the white image.
        """
        if optics.layout != self.layout:
            raise ValueError(f"optics.layout: expected {self.layout!r} as in the lens array, got {optics.layout!r}.")
        if tuple(optics.sensor_shape) != self.sensor_shape:
            raise ValueError(
                f"optics.sensor_shape: expected {self.sensor_shape} as in the white image, got {optics.sensor_shape}."
            )
        scale = 1 + optics.sensor_per_pupil
        origin = optics.sensor_mm(np.asarray(self.origin_px)) / scale
        basis = np.asarray(self.basis_px) * optics.pixel_mm / scale
        return LensLattice(
            origin_mm=tuple(origin.tolist()), basis_mm=tuple(map(tuple, basis.tolist())), layout=self.layout
        )


def find_lens_array(
    white: np.ndarray,
    dark: np.ndarray | None = None,
    nominal_pitch_px: float | None = None,
    layout: str = "square",
) -> LensArray:
    """Find the microimages of a white image.

    Parameters
    ----------
    white : ndarray, shape (rows, columns)
        White image [counts], any real dtype.
    dark : ndarray, shape (rows, columns), optional
        Dark frame [counts], subtracted from `white`.
    nominal_pitch_px : float, optional
        Expected distance of neighbouring microimages [pixel], good to 10 %; found from the image where missing.
    layout : {"square", "hexagonal"}
        Arrangement of the lenses; a hexagonal array may lie in any orientation.

    Raises
    ------
    InputError
        If an argument is not of the kind above, or the image shows no such array of microimages.
    """
    image = _checked_image(white, dark)
    if layout not in LAYOUTS:
        raise InputError(f"layout: expected one of {LAYOUTS}, got {layout!r}.")
    nominal = _checked_pitch(nominal_pitch_px, image.shape)

    basis = find_basis(image, nominal, layout)
    origin = find_phase(image, basis, layout)
    origin, basis, rms, measured = _fit_lattice(image, origin, basis, layout)

    rows, columns = image.shape
    index = indices_inside(origin, basis, (-0.5, -0.5), (columns - 0.5, rows - 0.5))
    centres = origin + index @ basis
    middle = np.argmin(((centres - ((columns - 1) / 2, (rows - 1) / 2)) ** 2).sum(1))
    origin, index = centres[middle], index - index[middle]
    array = LensArray(
        centres_px=centres,
        index=index,
        origin_px=tuple(origin.tolist()),
        basis_px=tuple(map(tuple, basis.tolist())),
        layout=layout,
        rms_px=rms,
        measured=measured,
        sensor_shape=image.shape,
    )
    log.info(
        "%s lens array: %d microimages, pitch %.4f px, rotation %.4f degrees, %d measured, rms %.4f px",
        layout, len(index), array.pitch_px, array.rotation_deg, measured, rms,
    )  # fmt: skip
    return array


# Input ---------------------------------------------------------------------------------------------------------------


def _checked_image(white: np.ndarray, dark: np.ndarray | None) -> np.ndarray:
    """White image less the dark frame as float32, after all checks."""
    white = _checked_frame("white", white)
    image = white.astype(np.float32)
    if dark is not None:
        dark = _checked_frame("dark", dark)
        if dark.shape != white.shape:
            raise InputError(
                f"dark: expected shape {white.shape} as the white image, got {dark.shape}. "
                "Use a dark frame of the same camera, uncropped."
            )
        image = image - dark.astype(np.float32)
    if not image.max() > 0:
        raise InputError("white: expected light, got an image without any value above the dark level. Check exposure.")
    if image.max() == image.min():
        raise InputError("white: expected microimages, got the same value in every pixel. Check the file.")
    return image


def _checked_frame(name: str, frame: np.ndarray) -> np.ndarray:
    frame = np.asarray(frame)
    if frame.ndim != 2:
        hint = " Convert colour images to one channel first." if frame.ndim == 3 else ""
        raise InputError(f"{name}: expected a grey image of shape (rows, columns), got shape {frame.shape}.{hint}")
    if frame.dtype.kind not in "uif":
        raise InputError(f"{name}: expected integer or float counts, got dtype {frame.dtype}.")
    if min(frame.shape) < 16:
        raise InputError(f"{name}: expected at least 16 x 16 pixels, got {frame.shape}.")
    if frame.dtype.kind == "f" and not np.isfinite(frame).all():
        raise InputError(
            f"{name}: expected finite counts, got NaN or infinity in {(~np.isfinite(frame)).sum()} pixels."
        )
    return frame


def _checked_pitch(nominal_pitch_px: float | None, shape: tuple[int, int]) -> float | None:
    if nominal_pitch_px is None:
        return None
    try:
        nominal = float(nominal_pitch_px)
    except (TypeError, ValueError):
        nominal = math.nan
    longest = min(shape) / 3
    if not 3 <= nominal <= longest:
        raise InputError(
            f"nominal_pitch_px: expected 3 to {longest:g} pixels (a third of the image), got {nominal_pitch_px!r}. "
            "Check pitch and pixel size, or leave it out."
        )
    return nominal


# Centres and lattice -------------------------------------------------------------------------------------------------


def _fit_lattice(
    image: np.ndarray, origin: np.ndarray, basis: np.ndarray, layout: str
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Measure the microimages and put a lattice through their centres: origin, basis, rms [pixel], number measured."""
    pitch = lattice_pitch(basis, layout)
    half = math.ceil(pitch * min(0.5 * np.abs(basis).sum(0).max() / pitch, 0.71))  # of a square that holds a cell
    for _ in range(MAX_PASSES):
        index = _whole_microimages(image.shape, origin, basis, half)
        index = index[:: math.ceil(len(index) / SAMPLE_LENSES)]
        nodes = origin + index @ basis
        shift, lit, microimage = _measure(_patches(image, nodes, half), nodes, basis)
        origin, basis, _ = _robust_lattice(index[lit], (nodes + shift)[lit], origin, basis)
        if np.abs(origin + index @ basis - nodes).max() < PASS_TOLERANCE_PX:
            break

    index = _whole_microimages(image.shape, origin, basis, half)
    centres = origin + index @ basis
    for _ in range(2):  # the second time from its own centre, where the linear fit is exact
        shift, lit, _ = _measure(_patches(image, centres, half), centres, basis, microimage)
        centres = centres + shift
    if lit.mean() < 0.5:
        log.warning("lens array: only %d of %d microimages are lit; the others are extrapolated.", lit.sum(), len(lit))
    index, centres = index[lit], centres[lit]
    origin, basis, kept = _robust_lattice(index, centres, origin, basis)
    residual = centres - origin - index @ basis
    rms = math.sqrt((residual[kept] ** 2).sum(1).mean())
    if kept.mean() < 0.5 or rms > 0.1 * pitch:
        raise InputError(
            f"white: no regular array of microimages found: {kept.sum()} of {len(kept)} lit places on a {layout} "
            f"lattice of pitch {pitch:.2f} px agree with it, to {rms:.2f} px. Expected most of them, to a tenth of the "
            "pitch. Check the file, the layout and the exposure."
        )
    _warn_of_distortion(index[kept] @ basis, residual[kept])
    return origin, basis, rms, int(kept.sum())


def _whole_microimages(shape: tuple[int, int], origin: np.ndarray, basis: np.ndarray, half: int) -> np.ndarray:
    """List the indices (i, j) of the microimages whose patch lies in the image, the blur's reach included."""
    margin = half + BLUR_REACH_PX + 1
    index = indices_inside(origin, basis, (margin, margin), (shape[1] - 1 - margin, shape[0] - 1 - margin))
    _check_count(index, basis)
    return index


def _check_count(index: np.ndarray, basis: np.ndarray) -> None:
    if len(index) < MIN_LENSES or (np.ptp(index, axis=0) < 2).any():
        raise InputError(
            f"white: expected at least {MIN_LENSES} whole and lit microimages, three along each direction, got "
            f"{len(index)} at a pitch of about {np.hypot(*basis[0]):.1f} px. Use an uncropped, evenly lit image."
        )


def _patches(image: np.ndarray, centres: np.ndarray, half: int) -> np.ndarray:
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


def _measure(
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
    c = _robust_fit(field, np.log(brightness)[:, None])[0][:, 0]
    gradient = np.stack([c[1] + 2 * c[3] * x + c[4] * y, c[2] + c[4] * x + 2 * c[5] * y], axis=1) / size
    moments = moments - gradient @ (overlap.reshape(2, -1) @ weighted)

    free = moments @ np.linalg.pinv(normal)
    slopes = free[:, 4:] / np.maximum(free[:, :1], 0.1)
    coefficients, kept = _robust_fit(field, slopes)
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
    return light * offsets[distance.argmin(0)].transpose(2, 0, 1)


def _cell_window(column: np.ndarray, row: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Part of each pixel that is nearest to the middle's lattice node."""
    inside = np.full(column.shape, np.inf)
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1)):
        neighbour = i * basis[0] + j * basis[1]
        distance = np.hypot(*neighbour)
        inside = np.minimum(inside, distance / 2 - np.abs(column * neighbour[0] + row * neighbour[1]) / distance)
    return np.clip(inside + 0.5, 0, 1)


def _robust_lattice(
    index: np.ndarray, centres: np.ndarray, origin: np.ndarray, basis: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lattice through centres: origin, basis and which centres counted."""
    _check_count(index, basis)
    design = np.column_stack([np.ones(len(index)), index])
    change, kept = _robust_fit(design, centres - origin - index @ basis)
    return origin + change[0], basis + change[1:], kept


def _robust_fit(design: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit values (row, axis) by iterated least squares with Tukey's weights: solution and which rows counted."""
    solution = np.zeros((design.shape[1], values.shape[1]))
    offset = np.median(values, axis=0)
    residual = values - offset
    median = MEDIAN_DISTANCE[values.shape[1]]
    for _ in range(MAX_PASSES):
        distance = np.sqrt((residual**2).sum(1))
        scale = max(np.median(distance) / median, 1e-9)
        reduced = distance / (OUTLIER_SCALES * scale)
        root = np.where(reduced < 1, 1 - reduced**2, 0)[:, None]  # square root of the biweight
        last, solution = solution, np.linalg.lstsq(root * design, root * values, rcond=None)[0]
        residual = values - design @ solution
        if np.abs(design @ (solution - last)).max() <= 1e-3 * scale:
            break
    return solution, reduced < 1


def _warn_of_distortion(places: np.ndarray, residual: np.ndarray) -> None:
    """Log a warning where a cubic field through the residuals is both certain and large."""
    x, y = (places / np.abs(places).max()).T
    terms = np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=1)
    smooth = terms @ np.linalg.lstsq(terms, residual, rcond=None)[0]
    rms, rest = (math.sqrt((part**2).sum(1).mean()) for part in (smooth, residual - smooth))
    chance = rest * math.sqrt(terms.shape[1] / len(places))
    if rms > max(DISTORTION_PX, 3 * chance):
        log.warning(
            "lens array: the microimages leave their lattice by a smooth distortion of %.3f px rms, %.3f px at most; "
            "centres follow the lattice.",
            rms,
            np.hypot(*smooth.T).max(),
        )
