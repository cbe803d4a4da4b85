"""Fit of one calibration dot to all its raw pixels: a local ray model, and the dot integrated over the microlenses.

The rays of a dot follow a local ray model on the plane of the array, at most quadratic in the pupil point u:
s(u) = Phi(u) theta, with slope K = ds/du. A ray leaving the dot at d from its centre lands at s(u) + A(u) d, where A is
d(s, t)/d(x, y) of the board, linear in u where the board is tilted. The pixel at X under the lens s_l sees the pupil point u_i = -(X - X_c) s_i / f_m through
the lens's centre (see `lfpiv.lightfield`). Its rays obey X = s_l + (f_m/s_i)(s - u) (Eq. 9), hence they land at

    s - s_l = g + (I - K)^-1 (A d + K h),      g = (I - K)^-1 (s(u_i) - s_l),

with d anywhere in the dot and h anywhere in the pixel's square on the pupil. Rays of the lens l are those with s - s_l
inside the lens's cell, so the light of the pixel is

    level + response (base + amplitude F(g)),      F = cell * ellipse of the dot * parallelogram of the pixel,

where * is convolution. F is the only place where the lens lattice enters, so square and hexagonal, rolled and sheared
arrays are all alike. It is tabulated per dot by the product of the three transforms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft, special

from lfpiv.lightfield import LightFieldDecoder

TERMS = 6
"""Terms of the ray model per coordinate: 1, u, v, u^2, u v, v^2, with (u, v) in pupil radii."""

FEWEST_PIXELS = 60
"""Pixels a dot must light to be fitted."""

_TABLE = 96  # elements per side of the tabulated F
_RASTER = 8  # supersampling of the lens cell
_SIZE_STEP = 0.15  # tables come in sizes this far apart on a log scale
_TABLE_AGE = 0.02  # F is tabulated anew when the pixels' blur changes by this part of a lens
_ROBUST_SIGMA = 4.0  # residuals beyond this count linearly (Huber)
_ITERATIONS = 25
_STEP_SIGMA = 0.02  # converged when no parameter moves by more of its standard error
_MODEL_ERROR = 0.01  # part of the light that white image and dot shape leave unexplained
_SEEN_SHARE = 0.05  # a pixel sees the dot when at least this part of its rays come from it
_PHASE = np.linspace(1e-6, 400, 40_001)
_DISC = 2 * special.j1(_PHASE) / _PHASE  # transform of a disc of unit radius, and its derivative over the argument
_DISC_CHANGE = -2 * special.jv(2, _PHASE) / _PHASE**2


@dataclass(frozen=True, eq=False)
class DotPixels:
    """The raw pixels around one dot, as flat arrays."""

    signal: np.ndarray
    """Counts above the dark level, (n,)."""
    response: np.ndarray
    """Counts of the white image above the dark level, (n,)."""
    pupil_mm: np.ndarray
    """Pupil points seen through the lens centres [mm], (n, 2)."""
    lens_mm: np.ndarray
    """Lens centres (s, t) [mm], (n, 2)."""


@dataclass(frozen=True, eq=False)
class DotFit:
    """One fitted dot."""

    coefficients: np.ndarray
    """Ray model theta [mm], shape (TERMS, 2)."""
    covariance: np.ndarray
    """Covariance of theta.T.ravel() [mm^2], prior included, shape (12, 12)."""
    information: np.ndarray
    """What the pixels alone say: inverse covariance of theta.T.ravel(), base and amplitude eliminated, (12, 12)."""
    base: float
    """Light of the board beside the dot, 1 as bright as the white image."""
    amplitude: float
    """Light of a fully seen dot over the board's; negative for dark dots."""
    reduced_chi2: float
    """Mean squared weighted residual, hot pixels capped."""
    relative_misfit: float
    """Root mean square of the residuals over the light of a fully seen dot."""
    converged: bool
    """False when the iteration limit was reached."""
    pupil_mm: np.ndarray
    """Pupil points of the pixels in which the dot was seen [mm], (m, 2), float32."""
    share: np.ndarray
    """Fitted F of each pixel, (n,), float32."""
    misfit: np.ndarray
    """Signal minus fit of each pixel [counts], (n,), float32."""


def ray_terms(pupil_mm: np.ndarray, pupil_radius_mm: float) -> np.ndarray:
    """Terms Phi of the ray model at pupil points (u, v) [mm], shape (n, TERMS)."""
    u, v = (np.asarray(pupil_mm) / pupil_radius_mm).T
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)


class LensIntegral:
    """The dot model of one camera: holds what does not change from dot to dot."""

    def __init__(self, decoder: LightFieldDecoder, diameter_mm: float, noise: float, counts_per_photon: float):
        self.pupil_radius_mm = decoder.optics.pupil_radius_mm
        self._pixel_on_pupil = decoder.optics.pupil_pixel_mm
        self._noise_variance = noise**2
        self._counts_per_photon = counts_per_photon
        self._radius = diameter_mm / 2
        self._basis = np.asarray(decoder.lattice.basis_mm)
        self._reach = np.abs(_cell_corners(self._basis)).max(0)  # half extent of the cell along (s, t)
        self._cells: dict[int, np.ndarray] = {}

    def support_mm(self, board_jacobian: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Half extent (s, t) of F [mm]: beyond it the dot sends no light through a lens, shape (2,)."""
        ellipse, pixel = self._blur(board_jacobian, slope)
        return self._reach + np.hypot(*ellipse.T) + np.abs(pixel).sum(1) / 2

    def table(self, board_jacobian: np.ndarray, tilt: np.ndarray, slope: np.ndarray) -> LensTable:
        """Tabulate F and its derivatives for one dot."""
        ellipse, pixel = self._blur(board_jacobian, slope)
        inverse = np.linalg.inv(np.eye(2) - slope)
        change = [inverse @ tilt[:, :, axis] * self._radius for axis in (0, 1)]
        size = int(np.ceil(np.log(self.support_mm(board_jacobian, slope).max()) / _SIZE_STEP))
        step = 2.2 * np.exp(size * _SIZE_STEP) / _TABLE  # the rest of the period stays dark
        if size not in self._cells:
            self._cells[size] = _cell_spectrum(self._basis, step)
        return LensTable(self._cells[size], step, ellipse, pixel, change)

    def _blur(self, board_jacobian, slope):
        """Half axes of the dot's image, and the sides of a pupil pixel's image, as columns [mm]."""
        inverse = np.linalg.inv(np.eye(2) - slope)
        return inverse @ board_jacobian * self._radius, inverse @ slope * self._pixel_on_pupil

    def fit(
        self,
        pixels: DotPixels,
        board_jacobian: np.ndarray,
        tilt: np.ndarray,
        prior_mean: np.ndarray,
        prior_information: np.ndarray,
        sign: int,
        start: np.ndarray | None = None,
    ) -> DotFit | None:
        """Levenberg-Marquardt fit of one dot, shot-noise weights, Huber loss.

        Parameters
        ----------
        pixels : DotPixels
            Pixels around the dot.
        board_jacobian : ndarray, shape (2, 2)
            A = d(s, t)/d(x, y) at the dot, through the pupil's centre.
        tilt : ndarray, shape (2, 2, 2)
            Change of A from the pupil's centre to its edge along u and v (last axis).
        prior_mean : ndarray, shape (TERMS, 2)
            Mean of the prior on the ray model [mm].
        prior_information : ndarray, shape (12, 12)
            Its inverse covariance, of theta.T.ravel() [1/mm^2].
        sign : int
            +1 for dots brighter than the board, -1 for darker ones.
        start : ndarray, shape (TERMS, 2), optional
            Where to start; default: the prior's mean.

        Returns
        -------
        DotFit or None
            None where no light of the dot would reach the pixels.
        """
        terms = ray_terms(pixels.pupil_mm, self.pupil_radius_mm)
        theta = prior_mean if start is None else start
        slope = slope_of(theta, self.pupil_radius_mm)
        table = self.table(board_jacobian, tilt, slope)
        state = self._state(pixels, terms, theta, table, None, sign)
        damping, converged = 1e-3, False
        for _ in range(_ITERATIONS):
            if np.count_nonzero(state.share > _SEEN_SHARE) < FEWEST_PIXELS:
                return None  # no dot's light in these pixels, or the fit wandered off them
            moved = np.abs(slope_of(state.theta, self.pupil_radius_mm) - slope).max() * self._pixel_on_pupil
            if moved > _TABLE_AGE * self._reach.min():  # the pixels' blur has changed
                slope = slope_of(state.theta, self.pupil_radius_mm)
                table = self.table(board_jacobian, tilt, slope)
                state = self._state(pixels, terms, state.theta, table, state.linear, sign)
            weight = 1 / self._variance(pixels, state)
            miss = (state.theta - prior_mean).T.ravel()
            cost = state.cost(weight) + miss @ prior_information @ miss
            normal, gradient = state.normal_equations(weight)
            normal[:12, :12] += prior_information
            gradient[:12] -= prior_information @ miss
            diagonal = np.diag(normal)
            spread = 1 / np.sqrt(diagonal)
            while True:
                step = np.linalg.solve(normal + np.diag(damping * diagonal), gradient)
                theta = state.theta + step[:12].reshape(2, TERMS).T
                trial = self._state(pixels, terms, theta, table, state.linear + step[12:], sign)
                miss = (theta - prior_mean).T.ravel()
                small = bool(np.all(np.abs(step) < _STEP_SIGMA * spread))
                if trial.cost(weight) + miss @ prior_information @ miss <= cost:
                    state, damping = trial, max(damping / 10, 1e-9)
                    break
                if small or damping > 1e8:
                    small = True
                    break
                damping *= 10
            if small:
                converged = True
                break
        return self._summary(pixels, state, prior_information, converged)

    def _variance(self, pixels, state):
        """Variance of each pixel: read noise, shot noise, the model's own error."""
        shot = self._counts_per_photon * np.maximum(pixels.signal - state.misfit, 0)
        shape = (_MODEL_ERROR * state.linear[1] * pixels.response) ** 2 * np.clip(state.share, 0, 1)
        return self._noise_variance + shot + shape

    def _state(self, pixels, terms, theta, table, linear, sign) -> _State:
        offset, inverse = lens_offset_mm(terms, theta, pixels.lens_mm, self.pupil_radius_mm)
        share, gradient = table(offset, terms[:, 1:3])
        if linear is None:
            linear = self._linear_start(pixels, share, sign)
        along = [gradient[:, 0] * inverse[0, b] + gradient[:, 1] * inverse[1, b] for b in (0, 1)]  # dF / d s(u)
        misfit = pixels.signal - pixels.response * (linear[0] + linear[1] * share)
        return _State(theta, linear, terms, pixels.response, share, along, misfit)

    def _linear_start(self, pixels, share, sign):
        """Find base and amplitude by weighted least squares; the amplitude keeps its sign."""
        weight = 1 / (self._noise_variance + self._counts_per_photon * np.maximum(pixels.signal, 0))
        design = pixels.response[:, None] * np.stack([np.ones_like(share), share], 1)
        normal = design.T @ (design * weight[:, None]) + 1e-9 * np.eye(2)
        base, amplitude = np.linalg.solve(normal, design.T @ (weight * pixels.signal))
        return np.array([base, amplitude if sign * amplitude > 0 else 0.1 * sign])

    def _summary(self, pixels, state, prior_information, converged) -> DotFit:
        weight = 1 / self._variance(pixels, state)
        normal, _ = state.normal_equations(weight)
        rays, light = slice(0, 12), slice(12, 14)
        shared = normal[rays, light] @ np.linalg.solve(normal[light, light], normal[light, rays])
        lit = state.share > _SEEN_SHARE
        relative = state.misfit / np.maximum(np.abs(state.linear[1]) * pixels.response, 1e-12)
        return DotFit(
            coefficients=state.theta,
            covariance=np.linalg.inv(normal[rays, rays] - shared + prior_information),
            information=normal[rays, rays] - shared,
            base=float(state.linear[0]),
            amplitude=float(state.linear[1]),
            reduced_chi2=float(np.mean(np.minimum(state.misfit**2 * weight, _ROBUST_SIGMA**2))),
            relative_misfit=float(np.sqrt(np.mean(np.minimum(relative**2, 1)))),
            converged=converged,
            pupil_mm=pixels.pupil_mm[lit].astype(np.float32),
            share=state.share.astype(np.float32),
            misfit=state.misfit.astype(np.float32),
        )


@dataclass(frozen=True, eq=False)
class _State:
    """The model evaluated at one set of parameters."""

    theta: np.ndarray
    linear: np.ndarray
    terms: np.ndarray
    response: np.ndarray
    share: np.ndarray
    along: list[np.ndarray]
    misfit: np.ndarray

    def cost(self, weight: np.ndarray) -> float:
        """Huber cost for inverse variances `weight`."""
        size = np.abs(self.misfit) * np.sqrt(weight)
        return float((size**2 - np.maximum(size - _ROBUST_SIGMA, 0) ** 2).sum())

    def normal_equations(self, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton matrix and right-hand side for the 12 ray coefficients, base and amplitude."""
        jacobian = np.empty((len(self.share), 14))
        strength = self.linear[1] * self.response
        jacobian[:, :6] = (strength * self.along[0])[:, None] * self.terms
        jacobian[:, 6:12] = (strength * self.along[1])[:, None] * self.terms
        jacobian[:, 12], jacobian[:, 13] = self.response, self.response * self.share
        size = np.abs(self.misfit) * np.sqrt(weight)
        weighted = jacobian * (weight * _ROBUST_SIGMA / np.maximum(size, _ROBUST_SIGMA))[:, None]
        return weighted.T @ jacobian, weighted.T @ self.misfit


class LensTable:
    """F on a grid of lens offsets, with its gradient and its change over the pupil, read by linear interpolation."""

    def __init__(
        self, cell: np.ndarray, step_mm: float, ellipse: np.ndarray, pixel: np.ndarray, change: list[np.ndarray]
    ):
        frequency = [fft.fftfreq(_TABLE, step_mm)[:, None], fft.rfftfreq(_TABLE, step_mm)[None]]

        def along(vector):
            return vector[0] * frequency[0] + vector[1] * frequency[1]

        axes = [2 * np.pi * along(ellipse[:, axis]) for axis in (0, 1)]
        phase = np.hypot(*axes)
        window = cell * np.sinc(along(pixel[:, 0])) * np.sinc(along(pixel[:, 1]))
        spectrum = window * np.interp(phase, _PHASE, _DISC)
        spectra = [spectrum, *(2j * np.pi * f * spectrum for f in frequency)]
        window *= np.interp(phase, _PHASE, _DISC_CHANGE)
        spectra += [window * sum(a * 2 * np.pi * along(c[:, k]) for k, a in enumerate(axes)) for c in change]
        table = fft.fftshift(fft.irfft2(np.stack(spectra), s=(_TABLE, _TABLE)), axes=(1, 2))
        self._table = np.ascontiguousarray(np.moveaxis(table, 0, -1).reshape(_TABLE * _TABLE, -1))
        self._step = step_mm

    def __call__(self, offset_mm: np.ndarray, pupil: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F, (n,), and dF/dg [1/mm], (n, 2), at offsets g [mm], (n, 2), and pupil points [pupil radii], (n, 2)."""
        place = offset_mm / self._step + _TABLE / 2
        inside = ((place >= 0) & (place < _TABLE - 1.001)).all(1)
        place = np.where(inside[:, None], place, 0)
        corner = place.astype(np.intp)
        x, y = (place - corner).T[..., None]
        first = corner[:, 0] * _TABLE + corner[:, 1]
        table = self._table
        values = (1 - x) * ((1 - y) * table[first] + y * table[first + 1])
        values += x * ((1 - y) * table[first + _TABLE] + y * table[first + _TABLE + 1])
        values *= inside[:, None]  # F vanishes outside its table
        return values[:, 0] + (values[:, 3:] * pupil).sum(1), values[:, 1:3]


def _cell_spectrum(basis: np.ndarray, step_mm: float) -> np.ndarray:
    """Transform of the part of each table element that lies in the Voronoi cell of a lens at the table's origin."""
    fine = (np.arange(_TABLE * _RASTER) + 0.5 - (_TABLE + 1) * _RASTER / 2) * step_mm / _RASTER
    inside = np.ones((fine.size, fine.size), bool)
    for vector in _voronoi_neighbours(basis):
        inside &= fine[:, None] * vector[0] + fine[None] * vector[1] < vector @ vector / 2
    return fft.rfft2(fft.ifftshift(inside.reshape(_TABLE, _RASTER, _TABLE, _RASTER).mean((1, 3))))


def lens_offset_mm(
    terms: np.ndarray, theta: np.ndarray, lens_mm: np.ndarray, pupil_radius_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where the central ray of each pixel lands from its lens's centre, g = (I - K)^-1 (s(u_i) - s_l), and (I - K)^-1.

    Parameters
    ----------
    terms : ndarray, shape (n, TERMS)
        `ray_terms` at the pupil points u_i.
    theta : ndarray, shape (TERMS, 2)
        Ray model [mm].
    lens_mm : ndarray, shape (n, 2)
        Lens centres s_l [mm].
    pupil_radius_mm : float
        Radius of the pupil [mm].

    Returns
    -------
    offset : ndarray, shape (n, 2)
        g [mm].
    inverse : ndarray, shape (2, 2, n)
        (I - K)^-1 with K = ds/du at u_i.
    """
    u, v = terms[:, 1], terms[:, 2]
    per_u = (theta[1] + 2 * np.outer(u, theta[3]) + np.outer(v, theta[4])) / pupil_radius_mm
    per_v = (theta[2] + np.outer(u, theta[4]) + 2 * np.outer(v, theta[5])) / pupil_radius_mm
    a, b, c, d = 1 - per_u[:, 0], -per_v[:, 0], -per_u[:, 1], 1 - per_v[:, 1]
    inverse = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
    miss = terms @ theta - lens_mm
    return np.stack(
        [
            inverse[0, 0] * miss[:, 0] + inverse[0, 1] * miss[:, 1],
            inverse[1, 0] * miss[:, 0] + inverse[1, 1] * miss[:, 1],
        ],
        axis=1,
    ), inverse


def spread_over_pupil(radius_mm: float) -> np.ndarray:
    """Pupil points spread evenly: a centre and rings of 6, 12, 18, shape (37, 2) [mm]."""
    rings = [np.zeros((1, 2))]
    for ring in (1, 2, 3):
        angle = (np.arange(6 * ring) + 0.5 * (ring % 2)) * np.pi / (3 * ring)
        rings.append(ring / 3 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return radius_mm * np.concatenate(rings)


def slope_of(theta: np.ndarray, pupil_radius_mm: float) -> np.ndarray:
    """Slope K = d(s, t)/d(u, v) of a ray model at the pupil's centre, shape (2, 2)."""
    return theta[1:3].T / pupil_radius_mm


def _voronoi_neighbours(basis: np.ndarray) -> np.ndarray:
    steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)], float)
    return steps @ basis


def _cell_corners(basis: np.ndarray) -> np.ndarray:
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
