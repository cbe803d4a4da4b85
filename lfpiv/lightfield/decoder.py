"""Decode raw plenoptic images: find the microlens, the pupil point and the light of every pixel.

The microlens array lies at the distance s_i behind the main lens, and the sensor f_m behind the array. Eq. 9 maps a ray
(u, v) -> (s, t) that meets the microlens centred at s_l to the sensor point ``X = s_l + (f_m / s_i) (s - u)``. So a
pixel at X sees, through the centre of its microlens (s = s_l), the pupil point

    u = s_l - (X - s_l) s_i / f_m = -(X - X_c) s_i / f_m,     X_c = s_l (1 + f_m / s_i),

where X_c is the centre of the microimage. The microimages' pitch on the sensor exceeds the pitch of the lenses by
f_m / s_i and is not a whole number of pixels, so each microimage has its own centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from lfpiv.errors import InputError
from lfpiv.geometry.optics import NEIGHBOURS, LensLattice, Optics

CORE_COVERAGE = 0.99
"""Least coverage of a pixel that lies inside a microimage."""
NORMAL_MAD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

_JUDGED_COVERAGE = 0.5  # least coverage of a pixel whose own response is measured
_GAP_MARGIN_PX = 1.0  # least distance of a gap pixel from every microimage
_GAP_PIXELS = 500  # least number of gap pixels that give the background
_CUT_OFF = 0.8  # half the distance of the quartiles, relative to the upper one, of noise that is cut off at 0, or less
_GOLDEN = 0.6180339887  # step of an even sequence from 0 to 1
_FALLBACK_PERCENTILE = 1.0  # percentile of the image that gives the background without gaps
_LEAST_SIGNAL = 3.0  # least white signal [standard deviations of the background]
_PATTERN_BIN_PX = 0.5  # bin of the mean pattern of a microimage
_DEAD_LENS = 0.2  # light of a dead lens, relative to its neighbours, or less
_TYPICAL_LENSES = 5  # side of the square of lenses that gives the typical light
_GAIN_RANGE = (0.0, 2.0)
_BLOCK_ROWS = 256  # rows of pixels assigned to lenses at once
_EDGE_REACH_PX = 0.75  # distance from the disc's edge within which a pixel is partly covered


@dataclass(frozen=True, eq=False, kw_only=True)
class LightFieldDecoder:
    """Microlens, pupil point and response of every pixel of one plenoptic camera. Made by `from_white`.

    All arrays have the sensor's shape.
    """

    optics: Optics
    """Nominal optics."""
    lattice: LensLattice
    """Microlens centres in the plane of the array [mm]."""
    lens_index: np.ndarray
    """Lattice index (i, j) of the microlens in front of each pixel, shape (rows, columns, 2), int16."""
    pupil_mm: np.ndarray
    """Pupil point (u, v) that each pixel sees through its lens's centre [mm], shape (rows, columns, 2), float32."""
    coverage: np.ndarray
    """Fraction of each pixel inside the nominal images of the pupil, summed over the lenses, float32."""
    gain: np.ndarray
    """White image over coverage, float32: vignetting and pixel response. 1 at a typical pixel, 0 under dead lenses."""
    smooth_gain: np.ndarray
    """Smooth part of `gain`: light of each lens times the mean pattern of a microimage, float32."""
    gaps: np.ndarray
    """Pixels between the microimages that see no light, bool."""
    white_counts: float
    """Signal of a typical pixel in the white image [counts]."""
    counts_per_photon: float
    """Variance over mean of the white image from pixel to pixel [counts]: shot noise and pixel response."""

    @classmethod
    def from_white(
        cls, optics: Optics, lattice: LensLattice, white: np.ndarray, dark: np.ndarray | None = None
    ) -> LightFieldDecoder:
        """Build the decoder of a camera from its white image.

        Parameters
        ----------
        optics : Optics
            Nominal optics.
        lattice : LensLattice
            Microlens lattice of this camera, found in the white image.
        white : ndarray, shape (rows, columns)
            Image of an evenly lit scene [counts].
        dark : ndarray, shape (rows, columns), optional
            Image with the lens capped [counts]. Default: the gaps between the microimages give the dark level.

        Raises
        ------
        InputError
            If an image does not have the sensor's shape or the white image holds no light.
        """
        white = _checked("white", white, optics)
        lens_index, offset_mm = _assign_lenses(optics, lattice)
        coverage, gaps = _cover(optics, lattice, offset_mm)
        if dark is None:
            level, sigma = _background(white, gaps)
            signal = white - np.float32(level)
        else:
            dark = _checked("dark", dark, optics)
            signal, sigma = white - dark, NORMAL_MAD * float(np.median(np.abs(dark - np.median(dark))))
        core = coverage > CORE_COVERAGE
        plateau = float(np.median(signal[core])) if core.any() else 0.0
        if not plateau > _LEAST_SIGNAL * sigma or plateau <= 0:
            raise InputError(
                f"white: expected microimages brighter than the gaps between them, found {plateau:.3g} counts above a "
                f"background with noise {sigma:.3g}. Check that the image was lit and belongs to this camera; then "
                "f_number, microlens_focal_length_mm, and pixel_um together with microlens_pitch_mm: light fills the "
                "gaps if microimages are wider than they imply."
            )
        gain, smooth_gain = _gains(signal / np.float32(plateau), coverage, lens_index, offset_mm, optics)
        return cls(
            optics=optics,
            lattice=lattice,
            lens_index=lens_index,
            pupil_mm=(-offset_mm / optics.sensor_per_pupil).astype(np.float32),
            coverage=coverage,
            gain=gain,
            smooth_gain=smooth_gain,
            gaps=gaps,
            white_counts=plateau,
            counts_per_photon=_counts_per_photon(signal, core),
        )

    def background(self, image: np.ndarray) -> tuple[float, float]:
        """Return level and noise of the pixels that see no light [counts]. Images without a dark frame need them.

        They are the median and the scaled distance of the quartiles of the gaps between the microimages. Of noise cut
        off at 0 the upper quartile alone tells. Without gaps they are a low percentile of the image and the spread
        below it.
        """
        return _background(_checked("image", image, self.optics), self.gaps)

    def shrunk_gain(self, response_share: float) -> np.ndarray:
        """Return the gain with a part of the white image's deviation from its smooth part, float32.

        Parameters
        ----------
        response_share : float
            Part of that deviation that is pixel response, the rest being noise. 1 gives `gain`, 0 gives `smooth_gain`.
            The calibration board gives the best value.
        """
        return self.smooth_gain + np.float32(response_share) * (self.gain - self.smooth_gain)

    def sub_aperture(
        self, image: np.ndarray, pupil_mm: tuple[float, float], *, level: float | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the sub-aperture image of one pupil point: one white-normalised value per microlens.

        See section 3.1 (2) and Fig. 5 of the paper. Image and white response are interpolated at
        X = s_l (1 + f_m/s_i) - u f_m/s_i under every lens, and divided.

        Parameters
        ----------
        image : ndarray, shape (rows, columns)
            Raw image [counts].
        pupil_mm : (float, float)
            Pupil point (u, v) [mm].
        level : float, optional
            Dark level of the image [counts]. Default: `background`.

        Returns
        -------
        values : ndarray, shape (I, J), float32
            Light per lens, 1 where it is as bright as the white scene, nan where the pupil point is not seen.
        centres_mm : ndarray, shape (I, J, 2)
            Lens centres (s, t) [mm]. Axis 0 runs along the lattice's first basis vector.
        """
        image = _checked("image", image, self.optics)
        level = self.background(image)[0] if level is None else level
        index = self.lens_grid()
        return self.sample(image - np.float32(level), index, pupil_mm), self.lattice.centres_mm(index)

    def sample(self, signal: np.ndarray, lens_index: np.ndarray, pupil_mm: ArrayLike) -> np.ndarray:
        """Return the white-normalised light of lenses at pupil points.

        Parameters
        ----------
        signal : ndarray, shape (rows, columns), float32
            Image above its dark level [counts].
        lens_index : ndarray, shape (..., 2)
            Lattice indices (i, j).
        pupil_mm : array_like, shape (..., 2)
            Pupil points (u, v) [mm], broadcast against `lens_index`.

        Returns
        -------
        ndarray, float32
            nan where a pupil point is not seen.
        """
        scale, pupil_mm = self.optics.sensor_per_pupil, np.asarray(pupil_mm, float)
        at = self.lattice.centres_mm(lens_index) * (1 + scale) - pupil_mm * scale
        at = np.moveaxis(self.optics.sensor_px(at), -1, 0)[::-1]
        coverage, response, light = (
            ndimage.map_coordinates(array, at, order=1, cval=0.0, prefilter=False)
            for array in (self.coverage, self.coverage * self.gain, signal)
        )
        values = np.full(response.shape, np.nan, np.float32)
        in_pupil = np.hypot(pupil_mm[..., 0], pupil_mm[..., 1]) < self.optics.pupil_radius_mm
        seen = in_pupil & (coverage > _JUDGED_COVERAGE) & (response > _DEAD_LENS * _JUDGED_COVERAGE * coverage)
        values[seen] = light[seen] / (response[seen] * self.white_counts)
        return values

    def lens_grid(self) -> np.ndarray:
        """Return the lattice indices (i, j) of a rectangle of lenses that covers the sensor, shape (I, J, 2)."""
        low = self.lens_index.min((0, 1)).astype(int)
        high = self.lens_index.max((0, 1)).astype(int)
        along = [np.arange(first, last + 1) for first, last in zip(low, high, strict=True)]
        return np.stack(np.meshgrid(*along, indexing="ij"), axis=-1)


def _checked(name: str, image: np.ndarray, optics: Optics) -> np.ndarray:
    image = np.asarray(image)
    if image.shape != tuple(optics.sensor_shape):
        raise InputError(
            f"{name}: expected one grey image of shape (rows, columns) = {tuple(optics.sensor_shape)}, "
            f"got {image.shape}. All images of a camera must have the size of its white image."
        )
    return image.astype(np.float32)


def _assign_lenses(optics: Optics, lattice: LensLattice) -> tuple[np.ndarray, np.ndarray]:
    """Return the lens of each pixel (int16) and the pixel's offset from its microimage's centre [mm] (float32)."""
    rows, columns = optics.sensor_shape
    widening = 1 + optics.sensor_per_pupil
    inverse = np.linalg.inv(np.asarray(lattice.basis_mm))
    inscribed = np.linalg.norm(_neighbours(lattice), axis=1).min() / 2
    lens_index = np.empty((rows, columns, 2), np.int16)
    offset = np.empty((rows, columns, 2), np.float32)
    column = np.arange(columns)
    for first in range(0, rows, _BLOCK_ROWS):
        row, col = np.meshgrid(np.arange(first, min(first + _BLOCK_ROWS, rows)), column, indexing="ij")
        position = optics.sensor_mm(np.stack([col, row], axis=-1)) / widening
        index = np.rint((position - np.asarray(lattice.origin_mm)) @ inverse).astype(int)
        miss = position - lattice.centres_mm(index)
        doubtful = (miss**2).sum(-1) > inscribed**2  # inside a cell's inscribed circle the lens is certain
        index[doubtful] = lattice.nearest(position[doubtful])
        lens_index[first : first + _BLOCK_ROWS] = index
        offset[first : first + _BLOCK_ROWS] = (position - lattice.centres_mm(index)) * widening
    return lens_index, offset


def _neighbours(lattice: LensLattice) -> np.ndarray:
    """Return the vectors from a lens to its neighbours [mm], shape (n, 2)."""
    vectors = NEIGHBOURS @ np.asarray(lattice.basis_mm)
    return vectors[np.hypot(*vectors.T) < 1.6 * lattice.pitch_mm]  # no far corners


def _cover(optics: Optics, lattice: LensLattice, offset_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the fraction of each pixel inside the pupil images around it, and the pixels in the gaps."""
    radius = optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm
    offset = offset_mm / np.float32(optics.pixel_mm)
    coverage, distance = disc_fraction(offset, radius)
    widening = (1 + optics.sensor_per_pupil) / optics.pixel_mm
    for vector in _neighbours(lattice) * widening:
        if np.hypot(*vector) / 2 < radius + 1:  # the neighbour's microimage reaches pixels of this lens
            near = offset @ vector.astype(np.float32) > np.float32(vector @ vector / 2 - np.hypot(*vector) * 2)
            more, far = disc_fraction(offset[near] - vector.astype(np.float32), radius)
            coverage[near] += more
            distance[near] = np.minimum(distance[near], far)
    return coverage, distance > _GAP_MARGIN_PX


def disc_fraction(offset: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the fraction of pixels inside a disc around 0, and their distance to its edge.

    The edge is taken as straight within a pixel and shifted by its mean curvature. The error is (1/radius)^2 / 50.

    Parameters
    ----------
    offset : ndarray, shape (..., 2), float32
        Centres of the pixels [pixel].
    radius : float
        Radius of the disc [pixel].

    Returns
    -------
    fraction, distance : ndarray, shape (...), float32
        The distance is negative inside the disc [pixel].
    """
    distance = np.hypot(offset[..., 0], offset[..., 1])
    outside = distance - np.float32(radius)
    fraction = (outside < 0).astype(np.float32)
    edge = np.abs(outside) < _EDGE_REACH_PX
    normal = np.maximum(np.abs(offset[edge]) / np.maximum(distance[edge], 1e-6)[:, None], 1e-3)
    reach = -(outside[edge] + 1 / (24 * max(radius, 1.0)))  # the pixel's centre inside the edge
    half_sum, half_gap = (normal[:, 0] + normal[:, 1]) / 2, (normal[:, 0] - normal[:, 1]) / 2

    def ramp(x: np.ndarray) -> np.ndarray:
        return np.maximum(x, 0) ** 2

    share = ramp(reach + half_sum) - ramp(reach + half_gap) - ramp(reach - half_gap) + ramp(reach - half_sum)
    fraction[edge] = np.clip(share / (2 * normal[:, 0] * normal[:, 1]), 0, 1)
    return fraction, outside


def _background(image: np.ndarray, gaps: np.ndarray) -> tuple[float, float]:
    sample = image[gaps]
    if sample.size >= _GAP_PIXELS:
        level = float(np.median(sample))
        low, high = np.percentile(sample + np.arange(sample.size) * _GOLDEN % 1 - 0.5, (25, 75))  # within whole counts
        half, upper = float(high - low) / 2, float(high) - level
        spread = half if half > _CUT_OFF * upper else upper
    else:
        level = float(np.percentile(image, _FALLBACK_PERCENTILE))
        spread = level - float(np.percentile(image, _FALLBACK_PERCENTILE / 4))
    return level, max(NORMAL_MAD * spread, 1 / np.sqrt(12))  # least: the noise of quantisation


def _gains(
    light: np.ndarray, coverage: np.ndarray, lens_index: np.ndarray, offset_mm: np.ndarray, optics: Optics
) -> tuple[np.ndarray, np.ndarray]:
    """Return the response of each pixel relative to a typical one, and its smooth part. Both are 0 at dead lenses.

    The smooth part is the mean response of the pixel's lens times the mean pattern of a microimage. It replaces the
    response of pixels with little coverage.
    """
    judged = coverage > _JUDGED_COVERAGE
    gain = np.divide(light, coverage, out=np.zeros_like(light), where=judged)

    corner = lens_index.min((0, 1)).astype(int)
    lenses = lens_index.max((0, 1)).astype(int) - corner + 1
    lens = (lens_index[..., 0] - corner[0]) * lenses[1] + (lens_index[..., 1] - corner[1])
    size = int(lenses.prod())
    mean = _group_ratio(lens, size, gain, np.ones_like(gain), judged)
    seen = np.where(np.bincount(lens[judged], minlength=size) > 0, mean, np.nan).reshape(lenses)
    typical = ndimage.generic_filter(seen, _nanmedian, size=_TYPICAL_LENSES, mode="nearest").ravel()
    mean[mean < _DEAD_LENS * typical] = 0
    lens_mean = mean[lens]
    alive = judged & (lens_mean > 0)

    cell = np.rint(offset_mm * np.float32(1 / (_PATTERN_BIN_PX * optics.pixel_mm))).astype(np.intp)
    cell -= cell.min((0, 1))
    width = cell.max((0, 1)) + 1
    bins = cell[..., 0] * width[1] + cell[..., 1]
    pattern = _group_ratio(bins, int(width.prod()), gain, lens_mean, alive)
    pattern[pattern <= 0] = 1
    smooth = lens_mean * pattern[bins]
    gain = np.where(judged, gain, smooth)
    gain[lens_mean == 0] = 0
    return np.clip(gain, *_GAIN_RANGE, out=gain), np.clip(smooth, *_GAIN_RANGE, out=smooth)


def _group_ratio(group: np.ndarray, size: int, above: np.ndarray, below: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Return the ratio of two arrays' sums over each group of used pixels, 0 for empty groups, float32."""
    chosen = group[use]
    numerator, denominator = (np.bincount(chosen, values[use], size) for values in (above, below))
    return np.divide(numerator, denominator, out=np.zeros(size), where=denominator > 0).astype(np.float32)


def _nanmedian(values: np.ndarray) -> float:
    values = values[~np.isnan(values)]
    return float(np.median(values)) if values.size else 0.0


def _counts_per_photon(signal: np.ndarray, core: np.ndarray) -> float:
    """Return variance over mean of the white image, from differences of neighbouring pixels of one microimage."""
    both = core[:, 1:] & core[:, :-1]
    step = (signal[:, 1:] - signal[:, :-1])[both]
    variance = (NORMAL_MAD * np.median(np.abs(step))) ** 2 / 2
    return float(variance / np.median(signal[core]))
