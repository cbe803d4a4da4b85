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

from lfpiv.errors import InputError
from lfpiv.geometry.optics import LAYOUTS, LensLattice, Optics, pair
from lfpiv.lightfield.lens_basis import cell_angle_deg, find_basis, find_phase, indices_inside, lattice_pitch
from lfpiv.lightfield.microimage_fit import BLUR_REACH_PX, cut_patches, measure, robust_fit
from lfpiv.warn import Code, Warning, warn

log = logging.getLogger(__name__)

SAMPLE_LENSES = 1500
"""Microimages that fix the lattice before all are measured."""
MIN_LENSES = 12
"""Fewest measured microimages: four values per unknown of the lattice."""
MAX_PASSES = 20
"""Most passes of an iteration that usually ends after three to five."""
PASS_TOLERANCE_PX = 0.01
"""Change of the lattice that ends the first passes [pixel]; the final ones start within it."""
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
        return LensLattice(origin_mm=pair(origin), basis_mm=(pair(basis[0]), pair(basis[1])), layout=self.layout)


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

    Examples
    --------
    A made-up white image: round microimages every 12.3 pixels, one of them centred at column 100, row 80:

    >>> import numpy as np, lfpiv
    >>> row, column = np.mgrid[:160, :200]
    >>> offset = [(axis - start + 6.15) % 12.3 - 6.15 for axis, start in ((column, 100), (row, 80))]
    >>> white = 1000 / (1 + np.exp(3 * (np.hypot(*offset) - 5)))
    >>> array = lfpiv.find_lens_array(white, nominal_pitch_px=12)
    >>> round(array.pitch_px, 2), [round(place) for place in array.origin_px]
    (12.3, [100, 80])
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
        origin_px=pair(origin),
        basis_px=(pair(basis[0]), pair(basis[1])),
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
            "Check pitch and pixel size."
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
        shift, lit, microimage = measure(cut_patches(image, nodes, half), nodes, basis)
        origin, basis, _ = _robust_lattice(index[lit], (nodes + shift)[lit], origin, basis)
        if np.abs(origin + index @ basis - nodes).max() < PASS_TOLERANCE_PX:
            break

    index = _whole_microimages(image.shape, origin, basis, half)
    centres = origin + index @ basis
    for _ in range(2):  # the second time from its own centre, where the linear fit is exact
        shift, lit, _ = measure(cut_patches(image, centres, half), centres, basis, microimage)
        centres = centres + shift
    if lit.mean() < 0.5:
        warn(log, Warning(code=Code.LENSES_UNLIT, figures={"lit": int(lit.sum()), "count": len(lit)}))
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


def _robust_lattice(
    index: np.ndarray, centres: np.ndarray, origin: np.ndarray, basis: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lattice through centres: origin, basis and which centres counted."""
    _check_count(index, basis)
    design = np.column_stack([np.ones(len(index)), index])
    change, kept = robust_fit(design, centres - origin - index @ basis)
    return origin + change[0], basis + change[1:], kept


def _warn_of_distortion(places: np.ndarray, residual: np.ndarray) -> None:
    """Log a warning where a cubic field through the residuals is both certain and large."""
    x, y = (places / np.abs(places).max()).T
    terms = np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=1)
    smooth = terms @ np.linalg.lstsq(terms, residual, rcond=None)[0]
    rms, rest = (math.sqrt((part**2).sum(1).mean()) for part in (smooth, residual - smooth))
    chance = rest * math.sqrt(terms.shape[1] / len(places))
    if rms > max(DISTORTION_PX, 3 * chance):
        figures = {"rms_px": rms, "largest_px": float(np.hypot(*smooth.T).max())}
        warn(log, Warning(code=Code.LENSES_DISTORTED, figures=figures))
