"""Measure the distance of microimages from the lattice of a calibration, over the sensor.

A white image and the lattice of the microlenses go in; mean and rms distance by cell of the sensor come out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv.geometry.optics import LensLattice, Optics
from lfpiv.lightfield.microimage_fit import (
    cut_patches,
    measure_microimages,
    patch_half_px,
    robust_fit,
    whole_microimages,
)

MOST_LENSES = 6000
"""Largest number of microimages measured, drawn at random."""
CELLS = 10
"""Number of cells of the map along the longer side of the sensor."""
LEAST_IN_CELL = 3
"""Smallest number of microimages for which a cell shows mean and rms."""


@dataclass(frozen=True, kw_only=True)
class LensMap:
    """Distance of measured microimage centres from the lattice, by cell of the sensor."""

    column_px: np.ndarray
    """Centres of the cells along the columns [pixel], shape (columns,)."""
    row_px: np.ndarray
    """Centres of the cells along the rows [pixel], shape (rows,)."""
    count: np.ndarray
    """Microimages in each cell, shape (rows, columns)."""
    mean_px: np.ndarray
    """Mean of measured minus lattice (column, row) [pixel], nan where few microimages are, shape (rows, columns, 2)."""
    rms_px: np.ndarray
    """Root mean square distance [pixel], shape (rows, columns)."""
    total_rms_px: float
    """Root mean square distance over the whole sensor [pixel]."""
    left_out: int
    """Number of microimages left out as dark, dead or far off."""
    measured: int
    """Number of microimages measured."""


def lens_map(white: np.ndarray, dark: np.ndarray | None, optics: Optics, lattice: LensLattice) -> LensMap:
    """Measure microimage centres as `find_lens_array` does and compare them with a lattice.

    Parameters
    ----------
    white : ndarray, shape (rows, columns)
        White image [counts].
    dark : ndarray, shape (rows, columns), or None
        Dark frame [counts].
    optics : Optics
        Nominal optics.
    lattice : LensLattice
        Lattice of the microlenses in their plane [mm].
    """
    image = np.asarray(white, np.float32) - (0 if dark is None else np.asarray(dark, np.float32))
    origin, basis = lattice_px(optics, lattice)
    half = patch_half_px(basis, lattice.pitch_mm * (1 + optics.sensor_per_pupil) / optics.pixel_mm)
    index = whole_microimages(image.shape, origin, basis, half)
    if len(index) > MOST_LENSES:
        index = index[np.sort(np.random.default_rng(0).choice(len(index), MOST_LENSES, replace=False))]
    nodes = origin + index @ basis
    fit = measure_microimages(cut_patches(image, nodes, half), nodes, basis)
    centres = nodes + fit.shift_px  # the second pass starts from the measured centre, where the linear fit is exact
    fit = measure_microimages(cut_patches(image, centres, half), centres, basis, fit.mean_microimage)
    lit, shift = fit.lit, (centres + fit.shift_px - nodes)[fit.lit]
    nodes = nodes[lit]
    inlier = robust_fit(np.column_stack([np.ones(len(nodes)), nodes / max(image.shape)]), shift)[1]
    return _in_cells(nodes[inlier], shift[inlier], image.shape, int(len(lit) - inlier.sum()))


def lattice_px(optics: Optics, lattice: LensLattice) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre of microimage (0, 0) and the lattice vectors on the sensor (column, row) [pixel].

    A microlens at s_l has its microimage at X = s_l (1 + f_m / s_i).
    """
    widening = 1 + optics.sensor_per_pupil
    origin = optics.sensor_px(np.asarray(lattice.origin_mm) * widening)
    return origin, np.asarray(lattice.basis_mm) * widening / optics.pixel_mm


def _in_cells(nodes: np.ndarray, shift: np.ndarray, shape: tuple[int, int], left_out: int) -> LensMap:
    """Average the distances in cells of the sensor."""
    rows, columns = shape
    edge = max(rows, columns) / CELLS
    size = max(round(rows / edge), 1), max(round(columns / edge), 1)
    at = np.clip(((nodes[:, ::-1] + 0.5) / (np.array(shape) / size)).astype(int), 0, np.array(size) - 1)
    cell, cells = at[:, 0] * size[1] + at[:, 1], size[0] * size[1]
    count = np.bincount(cell, minlength=cells)
    few = count < LEAST_IN_CELL
    sums = [np.bincount(cell, values, cells) for values in (shift[:, 0], shift[:, 1], (shift**2).sum(1))]
    mean_x, mean_y, square = (np.where(few, np.nan, total / np.maximum(count, 1)) for total in sums)
    return LensMap(
        column_px=(np.arange(size[1]) + 0.5) * columns / size[1] - 0.5,
        row_px=(np.arange(size[0]) + 0.5) * rows / size[0] - 0.5,
        count=count.reshape(size),
        mean_px=np.stack([mean_x, mean_y], axis=1).reshape(*size, 2),
        rms_px=np.sqrt(square).reshape(size),
        total_rms_px=float(np.sqrt((shift**2).sum(1).mean())),
        left_out=left_out,
        measured=len(nodes),
    )
