"""Light that a pixel receives from one dot: a local ray model, and the dot integrated over microlens and pixel.

On the plane of the array the rays of a dot follow s(u) = Phi(u) theta + Psi(u) b, with slope K = ds/du at the pupil
point u. Phi holds the powers of u up to the second; each dot has its own coefficients theta. Psi holds the powers from
the third to the order that the lens needs; all dots of a camera share their coefficients b, the bend. A ray that
leaves the dot at d from its centre lands at
s(u) + A(u) d, where A is d(s, t)/d(x, y) of the board, linear in u where the board is tilted. The pixel at X under the
lens s_l sees the pupil point u_i = -(X - X_c) s_i / f_m through the lens's centre (see `lfpiv.lightfield.decoder`). Its
rays obey X = s_l + (f_m/s_i)(s - u) (Eq. 9), so they land at

    s - s_l = g + (I - K)^-1 (A d + K h),      g = (I - K)^-1 (s(u_i) - s_l),

with d in the dot and h in the pixel's square on the pupil, blurred by sensor and microlens. The rays with s - s_l
inside the lens's cell pass the lens, so the pixel receives

    level + response (base + amplitude F(g)),      F = cell * ellipse of the dot * image of the pixel,

where * is convolution. Only F depends on the lens lattice, so square, hexagonal, rolled and sheared arrays need no
formulas of their own. F is tabulated per dot by the product of the three Fourier transforms, for a pixel typical of the
pupil. Where K changes over the pupil, the second moments of each pixel's own image correct F.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft, special
from scipy.spatial import Voronoi

from lfpiv.geometry.optics import NEIGHBOURS, LensLattice, Optics, float_pair, spread_over_pupil

BEND_ORDERS = (3, 5)
"""Orders of a bend that are tried in turn: uneven, as the aberrations of a centred lens in the middle of its field."""

_POWERS = [(order - j, j) for order in range(BEND_ORDERS[-1] + 1) for j in range(order + 1)]  # of (u, v)

Basis = tuple[tuple[float, float], ...]
"""Two lattice vectors (s, t) [mm]."""

TERMS = 6
"""Terms of a dot's own ray model per coordinate: 1, u, v, u^2, u v, v^2, with (u, v) in pupil radii."""

_RINGS, _SECTORS = (0.35, 0.6, 0.8, 0.9), 8  # radii between rings of zones, zones of all but the inner one
ZONES = 1 + len(_RINGS) * _SECTORS
"""Zones of the pupil in which rays are judged: a disc and rings of eight sectors."""

TABLE = 96
"""Elements per side of a table of F."""

_SIZE_STEP = 0.15  # difference between two sizes of tables, logarithm
_TABLE_SUPPORTS = 2.2  # width of a table in half extents of F; the rest of the period stays dark
_RASTER = 8  # samples of the lens cell per table element and axis
_PHASE = np.linspace(1e-6, 400, 40_001)
_DISC = 2 * special.j1(_PHASE) / _PHASE  # transform of a disc of unit radius
_DISC_CHANGE = -2 * special.jv(2, _PHASE) / _PHASE**2  # its derivative over the argument


@dataclass(frozen=True, eq=False, kw_only=True)
class SharedParameters:
    """Parameters that all dots of one camera share."""

    diameter_mm: float
    """Diameter of the dots as the images show it [mm]."""
    blur_px: float
    """Blur of sensor and microlenses, standard deviation [pixel]."""
    bend_mm: np.ndarray
    """Coefficients b of the ray model, of third order and higher [mm], shape (`bends`, 2)."""

    @property
    def order(self) -> int:
        """Order of the bend."""
        return order_of(self.bend_mm)

    def of_order(self, order: int) -> SharedParameters:
        """Return the same parameters with a bend of another order; terms that it lacks are zero."""
        bend = np.zeros((bends(order), 2))
        common = min(len(bend), len(self.bend_mm))
        bend[:common] = self.bend_mm[:common]
        return replace(self, bend_mm=bend)


@dataclass(frozen=True, eq=False)
class LensIntegral:
    """The dot model of one camera."""

    optics: Optics
    """Nominal optics."""
    lattice: LensLattice
    """Microlens lattice."""
    shared: SharedParameters
    """Diameter, blur and bend of all dots."""

    @property
    def cell_reach_mm(self) -> np.ndarray:
        """Half extent (s, t) of the cell of a lens [mm], shape (2,)."""
        return _cell_reach(self._basis)

    @property
    def _basis(self) -> Basis:
        return tuple(float_pair(vector) for vector in self.lattice.basis_mm)

    def rays_mm(self, terms: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Return s(u) [mm], shape (n, 2), from `ray_terms` and the dot's own coefficients."""
        return terms @ self._bent(theta)

    def pixel_terms(self, pupil_mm: np.ndarray) -> np.ndarray:
        """Return the terms of the ray model in the mean over the rays of each pixel, shape (n, TERMS + bends).

        A pixel and its blur are taken as a Gaussian of their variance, cut off by the edge of the pupil.

        Parameters
        ----------
        pupil_mm : ndarray, shape (n, 2)
            Pupil points seen from the middle of each pixel through the lens's centre [mm].
        """
        radius, order = self.optics.pupil_radius_mm, self.shared.order
        pupil = np.asarray(pupil_mm, float) / radius
        sigma = self.optics.pupil_pixel_mm / radius * np.sqrt(1 / 12 + self.shared.blur_px**2)
        distance = np.maximum(np.linalg.norm(pupil, axis=1), 1e-9)
        along = pupil / distance[:, None]
        inside = (1 - distance) / sigma  # of the edge, which is straight for so small a pixel
        cut = np.exp(-(inside**2) / 2) / np.sqrt(2 * np.pi) / np.maximum(special.ndtr(inside), 1e-9)
        terms = ray_terms(pupil - (sigma * cut)[:, None] * along, 1.0, order)
        per_u, per_v = _derivatives(order)
        lower = len(per_u) - order  # terms of second derivatives
        less = (inside + cut) * cut  # of the variance along the radius
        for first, second, part in (
            (per_u, per_u, 1 - less * along[:, 0] ** 2),
            (per_v, per_v, 1 - less * along[:, 1] ** 2),
            (per_u, per_v, -2 * less * along[:, 0] * along[:, 1]),
        ):
            change = first[:lower, : len(second)] @ second
            terms += (sigma**2 / 2 * part)[:, None] * (terms[:, :lower] @ change)
        return terms

    def offset_mm(self, terms: np.ndarray, theta: np.ndarray, lens_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the central ray of each pixel lands from its lens's centre, g, and the factor (I - K)^-1.

        Parameters
        ----------
        terms : ndarray, shape (n, TERMS + bends)
            `pixel_terms` of the pupil points u_i.
        theta : ndarray, shape (TERMS, 2)
            Ray model of the dot [mm].
        lens_mm : ndarray, shape (n, 2)
            Lens centres s_l [mm].

        Returns
        -------
        offset : ndarray, shape (n, 2)
            g [mm].
        inverse : ndarray, shape (2, 2, n)
            (I - K)^-1 with K = ds/du at u_i.
        """
        inverse = self._inverse(terms, theta)
        miss = self.rays_mm(terms, theta) - lens_mm
        offset = [row[0] * miss[:, 0] + row[1] * miss[:, 1] for row in inverse]
        return np.stack(offset, axis=1), inverse

    def pupil_reach_mm(self, theta: np.ndarray) -> np.ndarray:
        """Return a bound on how far rays move from the chief ray over the pupil along (s, t) [mm], shape (2,)."""
        return np.abs(self._bent(theta)[1:]).sum(0)

    def support_mm(self, board_jacobian: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Return the half extent (s, t) of F [mm]: a lens further away receives no light of the dot, shape (2,)."""
        return self._support_mm(self._ellipse(board_jacobian, theta), self._pixel(theta))

    def _support_mm(self, ellipse: np.ndarray, pixel: np.ndarray) -> np.ndarray:
        blurred = np.abs(pixel).sum(1) * (0.5 + 2 * self.shared.blur_px)
        return self.cell_reach_mm + np.hypot(*ellipse.T) + blurred

    def table(self, board_jacobian: np.ndarray, tilt: np.ndarray, theta: np.ndarray) -> LensTable:
        """Tabulate F and its derivatives for one dot, for a pixel typical of the pupil.

        Parameters
        ----------
        board_jacobian : ndarray, shape (2, 2)
            A = d(s, t)/d(x, y) at the dot, through the pupil's centre.
        tilt : ndarray, shape (2, 2, 2)
            Change of A from the pupil's centre to its edge along u and v (last axis).
        theta : ndarray, shape (TERMS, 2)
            Ray model of the dot [mm].
        """
        inverse = np.linalg.inv(np.eye(2) - slope_of(theta, self.optics.pupil_radius_mm))
        change = [inverse @ tilt[:, :, axis] * (self.shared.diameter_mm / 2) for axis in (0, 1)]
        ellipse, pixel = self._ellipse(board_jacobian, theta), self._pixel(theta)
        size = int(np.ceil(np.log(self._support_mm(ellipse, pixel).max()) / _SIZE_STEP))
        step = _TABLE_SUPPORTS * np.exp(size * _SIZE_STEP) / TABLE
        return LensTable(_cell_spectrum(self._basis, step), step, ellipse, pixel, self.shared.blur_px, change)

    def _bent(self, theta: np.ndarray) -> np.ndarray:
        return np.vstack([theta, self.shared.bend_mm])

    def _inverse(self, terms: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Return (I - K)^-1 with K = ds/du, shape (2, 2, n)."""
        bent, (per_u, per_v) = self._bent(theta), _derivatives(self.shared.order)
        slope = (terms[:, : len(per_u)] @ np.hstack([per_u @ bent, per_v @ bent])).T / self.optics.pupil_radius_mm
        a, b, c, d = 1 - slope[0], -slope[2], -slope[1], 1 - slope[3]
        return np.array([[d, -b], [-c, a]]) / (a * d - b * c)

    def _ellipse(self, board_jacobian: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Return the half axes of the dot's image, as columns [mm]."""
        magnified = np.eye(2) - slope_of(theta, self.optics.pupil_radius_mm)
        return np.linalg.solve(magnified, board_jacobian * (self.shared.diameter_mm / 2))

    def _pixel(self, theta: np.ndarray) -> np.ndarray:
        """Return the sides of a pixel's image on the array, as columns [mm], mean square over the pupil."""
        inverse = self._inverse(_spread_terms(self.optics.pupil_radius_mm, self.shared.order), theta)
        sides = np.moveaxis(inverse, -1, 0) - np.eye(2)  # (I - K)^-1 K
        spread, axes = np.linalg.eigh(np.einsum("nab,ncb->ac", sides, sides) / len(sides))
        size = axes * np.sqrt(np.maximum(spread, 0)) @ axes.T
        left, _, right = np.linalg.svd(sides[0])
        return size @ left @ right * self.optics.pupil_pixel_mm  # orientation of the central pixel


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
            return vector[0] * frequency[0] + vector[1] * frequency[1]

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
            Second moments P P^T (ss, st, tt) of the sides P of each pixel's image on the array [mm^2]. Their difference
            to those of the tabulated pixel enters by the second derivatives of F.

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


def bends(order: int) -> int:
    """Return the number of terms per coordinate of a bend: powers of (u, v) from the third to this order."""
    return (order + 1) * (order + 2) // 2 - TERMS


def order_of(bend: np.ndarray) -> int:
    """Return the order of a bend, shape (bends, 2)."""
    return next(order for order in BEND_ORDERS if bends(order) == len(bend))


def ray_terms(pupil_mm: np.ndarray, pupil_radius_mm: float, order: int) -> np.ndarray:
    """Return the terms Phi, then Psi up to an order, at pupil points (u, v) [mm], shape (n, TERMS + bends)."""
    u, v = (np.asarray(pupil_mm) / pupil_radius_mm).T
    terms = np.ones((len(u), TERMS + bends(order)))
    for column, (i, j) in enumerate(_POWERS[1 : terms.shape[1]], 1):
        lower = _POWERS.index((i - 1, j) if i else (i, j - 1))
        terms[:, column] = terms[:, lower] * (u if i else v)
    return terms


def zone_of(pupil: np.ndarray) -> np.ndarray:
    """Return the zone of pupil points [pupil radii], shape (n,)."""
    ring = np.searchsorted(_RINGS, np.linalg.norm(pupil, axis=1))
    sector = np.floor(np.arctan2(pupil[:, 1], pupil[:, 0]) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
    return np.where(ring == 0, 0, 1 + (ring - 1) * _SECTORS + sector)


def zone_shares() -> np.ndarray:
    """Return the zones' shares of the pupil's area, shape (ZONES,)."""
    rings = np.diff(np.array([0, *_RINGS, 1]) ** 2)
    return np.append(rings[0], np.repeat(rings[1:] / _SECTORS, _SECTORS))


def zone_middles() -> np.ndarray:
    """Return the middles of the zones [pupil radii], shape (ZONES, 2)."""
    edge = np.array([*_RINGS, 1])
    radius = np.append(0, np.repeat((edge[1:] + edge[:-1]) / 2, _SECTORS))
    angle = np.append(0, np.tile((np.arange(_SECTORS) + 0.5) / _SECTORS * 2 * np.pi, len(_RINGS)))
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def slope_of(theta: np.ndarray, pupil_radius_mm: float) -> np.ndarray:
    """Return the slope K = d(s, t)/d(u, v) of a ray model at the pupil's centre, shape (2, 2)."""
    return theta[1:3].T / pupil_radius_mm


@functools.lru_cache(maxsize=8)
def _cell_reach(basis: Basis) -> np.ndarray:
    """Return the half extent (s, t) of the lattice's Voronoi cell [mm], shape (2,)."""
    voronoi = Voronoi(np.vstack([np.zeros(2), _neighbours(basis)]))
    return np.abs(voronoi.vertices[voronoi.regions[voronoi.point_region[0]]]).max(0)


@functools.cache
def _derivatives(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices of d/du and d/dv, from the terms of a ray model to the terms of one order less."""
    matrices = np.zeros((2, TERMS + bends(order) - order - 1, TERMS + bends(order)))
    for column, (i, j) in enumerate(_POWERS[: matrices.shape[2]]):
        if i:
            matrices[0, _POWERS.index((i - 1, j)), column] = i
        if j:
            matrices[1, _POWERS.index((i, j - 1)), column] = j
    return matrices[0], matrices[1]


@functools.lru_cache(maxsize=8)
def _spread_terms(pupil_radius_mm: float, order: int) -> np.ndarray:
    return ray_terms(spread_over_pupil(pupil_radius_mm), pupil_radius_mm, order)


@functools.lru_cache(maxsize=32)
def _cell_spectrum(basis: Basis, step_mm: float) -> np.ndarray:
    """Return the transform of the Voronoi cell of a lens at the table's origin, as linear interpolation wants it.

    The raster takes means over table elements, and reading between elements smooths once more by a triangle. Their
    transforms are divided out.
    """
    fine = (np.arange(TABLE * _RASTER) + 0.5 - (TABLE + 1) * _RASTER / 2) * step_mm / _RASTER
    inside = np.ones((fine.size, fine.size))
    for vector in _neighbours(basis):
        size = np.hypot(*vector)
        beyond = fine[:, None] * vector[0] / size + fine * vector[1] / size - size / 2
        inside *= np.clip(0.5 - beyond * _RASTER / step_mm, 0, 1)  # part of a sample within the cell
    share = inside.reshape(TABLE, _RASTER, TABLE, _RASTER).mean((1, 3))
    smooth = np.sinc(fft.fftfreq(TABLE))[:, None] * np.sinc(fft.rfftfreq(TABLE))
    return fft.rfft2(fft.ifftshift(share)) / smooth**3


def _neighbours(basis: Basis) -> np.ndarray:
    """Return the vectors to the eight lattice neighbours of a lens [mm], shape (8, 2)."""
    return NEIGHBOURS @ np.asarray(basis)
