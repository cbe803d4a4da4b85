"""Lay out the pixels of a sensor by microimage, as the projector reads them.

The microimage of the lens at s_l is centred at X_c = s_l (1 + f_m/s_i) on the sensor (Eq. 9).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lfpiv.geometry.optics import LensLattice, Optics
from lfpiv_kernels.weights import microimages
from lfpiv_kernels.weights.microimages import Microimages


def microimage_edge(optics: Optics) -> int:
    """Return the side of the square that holds a microimage at any sub-pixel position [pixel]."""
    return math.floor(2 * optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm) + 2


def microimage_centres(optics: Optics, lattice: LensLattice, margin_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres of the microimages on the sensor (Eq. 9).

    Parameters
    ----------
    margin_px : float
        Margin around the sensor in which centres are returned as well [pixel].

    Returns
    -------
    first : ndarray, shape (2,), int
        Lattice indices (i, j) of the first lens.
    centre : ndarray, shape (lenses along j, lenses along i, 2)
        (column, row) [pixel]. Pixel n spans n to n + 1.
    """
    widening = (1 + optics.sensor_per_pupil) / optics.pixel_mm
    rows, columns = optics.sensor_shape
    half = np.array([columns, rows]) / 2
    reach = (half + margin_px) / widening
    corners = (np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]) * reach - lattice.origin_mm) @ np.linalg.inv(
        np.asarray(lattice.basis_mm)
    )
    first, last = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
    along = (np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
    index = np.stack(np.meshgrid(*along), axis=-1)  # (j, i, 2)
    return first, lattice.centres_mm(index) * widening + half


def microimages_of(optics: Optics, lattice: LensLattice) -> Microimages:
    """Return the blocks of pixels behind the lenses, one block for every lens whose microimage meets the sensor.

    A microimage is as wide as the image of the pupil (Eq. 9). A pixel at its edge sees only the part of its cell inside
    the pupil, and the middle of that part lies nearer to the centre than the pixel's own. Versions of each block hold
    the shares of such pixels for weights that fall or rise outwards.
    """
    radius = optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm
    first, centre = microimage_centres(optics, lattice, radius + 1)
    return microimages.lens_rays(
        (int(first[0]), int(first[1])), centre, radius, microimage_edge(optics), optics.sensor_shape
    )


def whole_microimages(optics: Optics, lattice: LensLattice) -> Microimages:
    """Return the blocks of pixels behind the lenses, each pixel as a whole ray, for counted weights.

    A block holds every pixel that light through the pupil and the lens's cell can reach.
    """
    to_pixels = optics.sensor_per_pupil / optics.pixel_mm
    radius = (optics.pupil_radius_mm + lattice.pitch_mm / math.sqrt(2)) * to_pixels  # a cell reaches that far at most
    first, centre = microimage_centres(optics, lattice, radius + 1)
    edge = math.floor(2 * radius) + 2
    rays: Microimages = microimages.lens_rays((int(first[0]), int(first[1])), centre, radius, edge, optics.sensor_shape)
    return replace(rays, share=(rays.pixel >= 0).astype(np.float32))
