"""Find the microlens array in a white image: the lattice of the microimages' centres, to a fraction of a pixel.

The autocorrelation of the image gives the lattice vectors, and the symmetry of its mean cell gives the phase
(`lfpiv.lightfield.lens_basis`). Then the centre of each microimage is measured (`lfpiv.lightfield.microimage_fit`), and
a robust fit of centre = origin + i basis[0] + j basis[1] leaves out dead lenses and dust.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from lfpiv.errors import InputError
from lfpiv.geometry.optics import LAYOUTS, LensLattice, Optics, float_pair
from lfpiv.lightfield.lens_basis import cell_angle_deg, find_basis, find_phase, indices_inside, lattice_pitch
from lfpiv.lightfield.microimage_fit import (
    cut_patches,
    measure_microimages,
    patch_half_px,
    robust_fit,
    whole_microimages,
)
from lfpiv.prompt import Card, Shown, count, times
from lfpiv.warn import Code, Warning, warn

log = logging.getLogger(__name__)

SAMPLE_LENSES = 1500
"""Number of microimages in the first passes."""
MIN_LENSES = 12
"""Least number of measured microimages: four values for each unknown of the lattice."""
MAX_PASSES = 20
"""Largest number of first passes."""
PASS_TOLERANCE_PX = 0.01
"""Change of the lattice that ends the first passes [pixel]."""
LEAST_LIT = 0.5
"""Part of the microimages that is lit below which a warning is due."""
LEAST_AGREEING, LARGEST_RMS_PITCH = 0.5, 0.1
"""Least part of the lit microimages on the lattice, and their largest distance from it [pitch, rms]."""
DISTORTION_PX = 0.05
"""Smooth distortion above which a warning is due [pixel, rms]."""


@dataclass(frozen=True, kw_only=True, repr=False)
class LensArray(Shown):
    """Microimage centres of one camera as a lattice on the sensor: centre = origin + i basis[0] + j basis[1].

    Positions are (column, row) in pixels, integer at a pixel's centre. Microimage (0, 0) is nearest to the sensor's
    centre.
    """

    centres_px: np.ndarray
    """Centres of all microimages whose centre lies on the sensor [pixel], shape (lens, 2)."""
    index: np.ndarray
    """Their lattice indices (i, j), shape (lens, 2). i runs fastest."""
    origin_px: tuple[float, float]
    """Centre of microimage (0, 0) [pixel]."""
    basis_px: tuple[tuple[float, float], tuple[float, float]]
    """Vectors to the microimages (1, 0) and (0, 1) [pixel]. The first lies at -45 to 45 (hexagonal: -15 to 45) degrees
    from +column, the second 90 (60) degrees further towards +row."""
    layout: str
    """"square" or "hexagonal"."""
    rms_px: float
    """Root mean square distance between measured centres and lattice, without outliers [pixel]."""
    measured: int
    """Number of microimages that the lattice was fitted to."""
    sensor_shape: tuple[int, int]
    """Shape of the white image [pixel], order (rows, columns)."""

    def card(self) -> Card:
        """Return what matters of the lattice, for people."""
        facts = (
            ("sensor", f"{times(self.sensor_shape)} pixels (rows, columns)"),
            ("pitch", f"{self.pitch_px:.4f} pixel"),
            ("rotation", f"{self.rotation_deg:.4f} degree"),
            ("middle", f"({self.origin_px[0]:.2f}, {self.origin_px[1]:.2f}) pixel (column, row)"),
            ("fit", f"{self.rms_px:.4f} pixel rms over {count(self.measured, 'microimage')}"),
        )
        return Card(f"Lens array of {count(len(self.centres_px), 'microimage')}, {self.layout}", facts)

    @property
    def pitch_px(self) -> float:
        """Distance of neighbouring centres [pixel], from the area of the lattice's cell."""
        return lattice_pitch(np.asarray(self.basis_px), self.layout)

    @property
    def rotation_deg(self) -> float:
        """Rotation of the lattice from +column towards +row [degree], mean over both lattice vectors."""
        first, second = (math.degrees(math.atan2(row, column)) for column, row in self.basis_px)
        return (first + second - cell_angle_deg(self.layout)) / 2

    def lattice(self, optics: Optics) -> LensLattice:
        """Return the lens centres in the plane of the microlenses, s_l = X_c / (1 + f_m/s_i).

        The optical axis is taken to meet the sensor at its centre.

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
            origin_mm=float_pair(origin), basis_mm=(float_pair(basis[0]), float_pair(basis[1])), layout=self.layout
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
        Expected distance of neighbouring microimages [pixel], correct to 10 %. Default: found from the image.
    layout : {"square", "hexagonal"}
        Arrangement of the lenses. A hexagonal array may have any orientation.

    Raises
    ------
    InputError
        If an argument is not of the kind above, or the image shows no such array of microimages.

    Examples
    --------
    A synthetic white image: round microimages every 12.3 pixels, one of them centred at column 100, row 80:

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
    lattice, rms, measured = _fit_lattice(image, _Lattice(find_phase(image, basis, layout), basis), layout)
    rows, columns = image.shape
    index = indices_inside(lattice.origin, lattice.basis, (-0.5, -0.5), (columns - 0.5, rows - 0.5))
    centres = lattice.nodes(index)
    middle = np.argmin(((centres - ((columns - 1) / 2, (rows - 1) / 2)) ** 2).sum(1))
    origin, index = centres[middle], index - index[middle]
    array = LensArray(
        centres_px=centres,
        index=index,
        origin_px=float_pair(origin),
        basis_px=(float_pair(lattice.basis[0]), float_pair(lattice.basis[1])),
        layout=layout,
        rms_px=rms,
        measured=measured,
        sensor_shape=image.shape,
    )
    log.info(
        "white image: %d of %d microimages measured, %.4f px apart on a %s lattice turned by %.3f degrees; they lie "
        "%.2g px (rms) off it",
        measured, len(index), array.pitch_px, layout, array.rotation_deg, rms,
    )  # fmt: skip
    return array


def _checked_image(white: np.ndarray, dark: np.ndarray | None) -> np.ndarray:
    """Check white and dark image, and return their difference as float32."""
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


@dataclass(frozen=True, eq=False)
class _Lattice:
    origin: np.ndarray
    """Centre of the microimage (0, 0), (column, row) [pixel]."""
    basis: np.ndarray
    """Lattice vectors, rows (column, row) [pixel]."""

    def nodes(self, index: np.ndarray) -> np.ndarray:
        return self.origin + index @ self.basis


def _fit_lattice(image: np.ndarray, start: _Lattice, layout: str) -> tuple[_Lattice, float, int]:
    """Measure the microimages and fit a lattice. Return it, its rms residual [pixel] and the number of centres."""
    pitch = lattice_pitch(start.basis, layout)
    half = patch_half_px(start.basis, pitch)
    lattice, mean_microimage = _fit_sample(image, start, half)

    index = whole_microimages(image.shape, lattice.origin, lattice.basis, half)
    _check_count(index, lattice.basis)
    centres = lattice.nodes(index)
    for _ in range(2):  # the second pass starts from the measured centre, where the linear fit is exact
        fit = measure_microimages(cut_patches(image, centres, half), centres, lattice.basis, mean_microimage)
        centres = centres + fit.shift_px
    if fit.lit.mean() < LEAST_LIT:
        warn(log, Warning(code=Code.LENSES_UNLIT, figures={"lit": int(fit.lit.sum()), "count": len(fit.lit)}))
    index, centres = index[fit.lit], centres[fit.lit]
    lattice, inliers = _robust_lattice(index, centres, lattice)
    residual = centres - lattice.origin - index @ lattice.basis
    rms = math.sqrt((residual[inliers] ** 2).sum(1).mean())
    if inliers.mean() < LEAST_AGREEING or rms > LARGEST_RMS_PITCH * pitch:
        raise InputError(
            f"white: no regular array of microimages found: {inliers.sum()} of {len(inliers)} lit places on a {layout} "
            f"lattice of pitch {pitch:.2f} px agree with it, to {rms:.2f} px. Expected most of them, to a tenth of the "
            "pitch. Check the file, the layout and the exposure."
        )
    _warn_of_distortion(index[inliers] @ lattice.basis, residual[inliers])
    return lattice, rms, int(inliers.sum())


def _fit_sample(image: np.ndarray, lattice: _Lattice, half: int) -> tuple[_Lattice, np.ndarray]:
    """Improve a lattice by a sample of the microimages. Return it and the mean microimage."""
    for _ in range(MAX_PASSES):
        index = whole_microimages(image.shape, lattice.origin, lattice.basis, half)
        _check_count(index, lattice.basis)
        index = index[:: math.ceil(len(index) / SAMPLE_LENSES)]
        nodes = lattice.nodes(index)
        fit = measure_microimages(cut_patches(image, nodes, half), nodes, lattice.basis)
        lattice, _ = _robust_lattice(index[fit.lit], (nodes + fit.shift_px)[fit.lit], lattice)
        if np.abs(lattice.nodes(index) - nodes).max() < PASS_TOLERANCE_PX:
            break
    return lattice, fit.mean_microimage


def _check_count(index: np.ndarray, basis: np.ndarray) -> None:
    if len(index) < MIN_LENSES or (np.ptp(index, axis=0) < 2).any():
        raise InputError(
            f"white: expected at least {MIN_LENSES} whole and lit microimages, three along each direction, got "
            f"{len(index)} at a pitch of about {np.hypot(*basis[0]):.1f} px. Use an uncropped, evenly lit image."
        )


def _robust_lattice(index: np.ndarray, centres: np.ndarray, near: _Lattice) -> tuple[_Lattice, np.ndarray]:
    """Fit a lattice to centres, starting from one near them. Return it and the inliers, bool."""
    _check_count(index, near.basis)
    design = np.column_stack([np.ones(len(index)), index])
    change, inliers = robust_fit(design, centres - near.origin - index @ near.basis)
    return _Lattice(near.origin + change[0], near.basis + change[1:]), inliers


def _warn_of_distortion(places: np.ndarray, residual: np.ndarray) -> None:
    """Warn where a cubic field through the residuals is both significant and larger than `DISTORTION_PX`."""
    x, y = (places / np.abs(places).max()).T
    terms = np.stack([x**a * y**b for a in range(4) for b in range(4 - a)], axis=1)
    smooth = terms @ np.linalg.lstsq(terms, residual, rcond=None)[0]
    rms, rest = (math.sqrt((part**2).sum(1).mean()) for part in (smooth, residual - smooth))
    chance = rest * math.sqrt(terms.shape[1] / len(places))
    if rms > max(DISTORTION_PX, 3 * chance):
        figures = {"rms_px": rms, "largest_px": float(np.hypot(*smooth.T).max())}
        warn(log, Warning(code=Code.LENSES_DISTORTED, figures=figures))
