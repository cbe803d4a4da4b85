"""Light of a dot through one microlens as a table: the convolution of lens cell, dot and pixel, by transforms."""

from __future__ import annotations

import numpy as np
from scipy import fft, special

TABLE = 96
"""Elements per side of a table."""

_RASTER = 8  # supersampling of the lens cell

_PHASE = np.linspace(1e-6, 400, 40_001)
_DISC = 2 * special.j1(_PHASE) / _PHASE  # transform of a disc of unit radius, and its derivative over the argument
_DISC_CHANGE = -2 * special.jv(2, _PHASE) / _PHASE**2


class LensTable:
    """F on a grid of lens offsets, with its derivatives and its change over the pupil, read by linear interpolation."""

    def __init__(
        self,
        cell: np.ndarray,
        step_mm: float,
        ellipse: np.ndarray,
        pixel: np.ndarray,
        blur_px: float,
        change: list[np.ndarray],
    ):
        frequency = [fft.fftfreq(TABLE, step_mm)[:, None], fft.rfftfreq(TABLE, step_mm)[None]]

        def along(vector: np.ndarray) -> np.ndarray:
            product: np.ndarray = vector[0] * frequency[0] + vector[1] * frequency[1]
            return product

        axes = [2 * np.pi * along(ellipse[:, axis]) for axis in (0, 1)]
        phase = np.hypot(*axes)
        blurring = 2 * np.pi**2 * (along(pixel[:, 0]) ** 2 + along(pixel[:, 1]) ** 2)  # of a Gaussian one pixel wide
        window = cell * np.sinc(along(pixel[:, 0])) * np.sinc(along(pixel[:, 1])) * np.exp(-blurring * blur_px**2)
        spectrum = window * np.interp(phase, _PHASE, _DISC)
        s, t = frequency
        variance = 1 / 12 + blur_px**2  # of a pixel, in sides
        growth = window * np.interp(phase, _PHASE, _DISC_CHANGE)
        spectra = [spectrum, *(2j * np.pi * f * spectrum for f in frequency)]
        spectra += [growth * sum(a * 2 * np.pi * along(c[:, k]) for k, a in enumerate(axes)) for c in change]
        spectra += [-2 * np.pi**2 * variance * f * spectrum for f in (s * s, 2 * s * t, t * t)]
        spectra += [growth * phase**2, -blurring * spectrum]
        table = fft.fftshift(fft.irfft2(np.stack(spectra).astype(np.complex64), s=(TABLE, TABLE)), axes=(1, 2))
        self._table = np.ascontiguousarray(np.moveaxis(table, 0, -1).reshape(TABLE * TABLE, -1))
        self._step = step_mm
        self.pixel_mm2 = (pixel @ pixel.T)[[0, 0, 1], [0, 1, 1]]

    def __call__(
        self, offset_mm: np.ndarray, pupil: np.ndarray, pixel_mm2: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Read F, dF/dg [1/mm] and F's change with the dot's diameter and the pixels' blur.

        Parameters
        ----------
        offset_mm : ndarray, shape (n, 2)
            Offsets g from a lens centre [mm].
        pupil : ndarray, shape (n, 2)
            Pupil points [pupil radii].
        pixel_mm2 : ndarray, shape (n, 3)
            Sides of each pixel's image on the array, P P^T (ss, st, tt) [mm^2]. The table holds one pixel's; what the
            others' second moments differ by enters by the second derivatives of F.

        Returns
        -------
        share : ndarray, shape (n,)
            F.
        gradient : ndarray, shape (n, 2)
            dF/dg [1/mm].
        growth : ndarray, shape (n, 2)
            dF / d log(diameter) and dF / d blur^2 [1/pixel^2].
        """
        s, t = (offset_mm.T + TABLE / 2 * self._step) / self._step
        inside = np.flatnonzero((s >= 0) & (t >= 0) & (s < TABLE - 1.001) & (t < TABLE - 1.001))  # F vanishes elsewhere
        s, t = s[inside], t[inside]
        row, column = s.astype(np.intp), t.astype(np.intp)
        x, y = (s - row).astype(np.float32)[:, None], (t - column).astype(np.float32)[:, None]
        first = row * TABLE + column
        low = (1 - y) * self._table.take(first, 0) + y * self._table.take(first + 1, 0)
        high = (1 - y) * self._table.take(first + TABLE, 0) + y * self._table.take(first + TABLE + 1, 0)
        low += x * (high - low)
        low[:, 0] += (low[:, 3:5] * pupil[inside]).sum(1) + (low[:, 5:8] * (pixel_mm2[inside] - self.pixel_mm2)).sum(1)
        values = np.zeros((len(offset_mm), 5))
        values[inside] = low[:, [0, 1, 2, 8, 9]]
        return values[:, 0], values[:, 1:3], values[:, 3:]


def cell_spectrum(basis: np.ndarray, step_mm: float) -> np.ndarray:
    """Transform of the part of each table element that lies in the Voronoi cell of a lens at the table's origin."""
    fine = (np.arange(TABLE * _RASTER) + 0.5 - (TABLE + 1) * _RASTER / 2) * step_mm / _RASTER
    inside = np.ones((fine.size, fine.size), bool)
    for vector in _voronoi_neighbours(basis):
        inside &= fine[:, None] * vector[0] + fine[None] * vector[1] < vector @ vector / 2
    share = inside.reshape(TABLE, _RASTER, TABLE, _RASTER).mean((1, 3))
    spectrum: np.ndarray = fft.rfft2(fft.ifftshift(share))
    return spectrum


def _voronoi_neighbours(basis: np.ndarray) -> np.ndarray:
    steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)], float)
    neighbours: np.ndarray = steps @ basis
    return neighbours


def cell_corners(basis: np.ndarray) -> np.ndarray:
    """Corners of the Voronoi cell of the lattice: points equally far from the origin and two neighbours."""
    neighbours = _voronoi_neighbours(basis)
    corners = []
    for a in range(len(neighbours)):
        for b in range(a):
            pair = neighbours[[a, b]]
            if abs(np.linalg.det(pair)) > 1e-9:
                point = np.linalg.solve(pair, (pair**2).sum(1) / 2)
                if np.all(neighbours @ point <= (neighbours**2).sum(1) / 2 * (1 + 1e-9)):
                    corners.append(point)
    return np.array(corners)
