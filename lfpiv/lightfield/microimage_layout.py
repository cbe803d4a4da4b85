"""Where a camera's microimages lie on its sensor, as the projector takes them."""

from __future__ import annotations

import math

import numpy as np

from lfpiv.geometry.optics import LensLattice, Optics
from lfpiv_kernels.weights import microimages
from lfpiv_kernels.weights.microimages import Microimages
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH


def microimage_edge(optics: Optics) -> int:
    """Pixels along each side of the square around a microimage, wherever its centre lies in a pixel."""
    return math.floor(2 * optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm) + 2


def microimage_centres(optics: Optics, lattice: LensLattice, margin_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres of the microimages on the sensor (Eq. 9), of all lenses whose nodes may lie on it.

    Parameters
    ----------
    optics : Optics
        The camera.
    lattice : LensLattice
        Its microlenses.
    margin_px : float
        How far beyond the sensor's edges centres are wanted, too [pixel].

    Returns
    -------
    first : ndarray, shape (2,), int
        Lattice indices (i, j) of the first lens.
    centre : ndarray, shape (lenses along j, lenses along i, 2)
        (column, row) [pixel]; pixel n spans n to n + 1.
    """
    widening = (1 + optics.sensor_per_pupil) / optics.pixel_mm
    rows, columns = optics.sensor_shape
    half = np.array([columns, rows]) / 2
    reach = (half + margin_px) / widening
    corners = (np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)]) * reach - lattice.origin_mm) @ np.linalg.inv(
        np.asarray(lattice.basis_mm)
    )
    first, last = np.floor(corners.min(0)).astype(int), np.ceil(corners.max(0)).astype(int)
    index = np.stack(
        np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(first, last, strict=True))), axis=-1
    )  # (j, i, 2)
    return first, lattice.centres_mm(index) * widening + half


def lay_out(optics: Optics, lattice: LensLattice) -> Microimages:
    """Lay a sensor's pixels out as the rays of its lenses.

    The microimage of the lens at s_l is centred at s_l (1 + f_m/s_i) on the sensor (Eq. 9) and as wide as the pupil's
    image; every lens whose microimage meets the sensor has a block. A pixel at the edge shows the part of its cell
    inside the pupil, whose middle lies inwards of its own: so a lens has more versions of its block, with shares for
    weights that fall or rise outwards.
    """
    radius = optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm
    first, centre = microimage_centres(optics, lattice, radius + 1)
    rays: Microimages = microimages.lens_rays(
        (int(first[0]), int(first[1])), centre, radius, microimage_edge(optics), optics.sensor_shape
    )
    return rays


def plain(sensor_shape: tuple[int, int]) -> Microimages:
    """Every pixel as one ray, in rows padded by BLOCK_WIDTH: for weights that were counted pixel by pixel."""
    rows, columns = sensor_shape
    pixel = np.full((rows, columns + BLOCK_WIDTH), -1, np.int32)
    pixel[:, :columns] = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    return Microimages(
        first_lens=(0, 0),
        corner=np.zeros((1, 1, 2), np.int32),
        edge=columns + BLOCK_WIDTH,
        pixel=pixel.ravel(),
        share=(pixel.ravel() >= 0).astype(np.float32),
        sensor_shape=(rows, columns),
    )
