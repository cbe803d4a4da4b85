"""Fit of one calibration dot to all its raw pixels: a local ray model, and the dot integrated over the microlenses.

The rays of a dot follow a local ray model on the plane of the array, s(u) = Phi(u) theta + Psi(u) b, with slope
K = ds/du at the pupil point u. Phi holds the powers of u up to the second; their coefficients theta are the dot's own.
Psi holds the third powers; their coefficients b, the bend, are the camera's (`lfpiv.calibration.board.dot_shared`). A ray leaving the dot
at d from its centre lands at s(u) + A(u) d, where A is d(s, t)/d(x, y) of the board, linear in u where the board is
tilted. The pixel at X under the lens s_l sees the pupil point u_i = -(X - X_c) s_i / f_m through the lens's centre (see
`lfpiv.lightfield.decoder`). Its rays obey X = s_l + (f_m/s_i)(s - u) (Eq. 9), hence they land at

    s - s_l = g + (I - K)^-1 (A d + K h),      g = (I - K)^-1 (s(u_i) - s_l),

with d anywhere in the dot and h anywhere in the pixel's square on the pupil, which sensor and microlens blur. Rays of
the lens l are those with s - s_l inside the lens's cell, so the light of the pixel is

    level + response (base + amplitude F(g)),      F = cell * ellipse of the dot * image of the pixel,

where * is convolution. F is the only place where the lens lattice enters, so square and hexagonal, rolled and sheared
arrays are all alike. It is tabulated per dot by the product of the three transforms, for a pixel typical of the pupil;
where K changes over it, a pixel's own image enters by its second moments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv.calibration.board.dot_table import TABLE, LensTable, cell_corners, cell_spectrum
from lfpiv.lightfield.decoder import LightFieldDecoder

_BEND_ORDER = 3
_POWERS = [(order - j, j) for order in range(_BEND_ORDER + 1) for j in range(order + 1)]  # of (u, v)

TERMS = 6
"""Terms of a dot's own ray model per coordinate: 1, u, v, u^2, u v, v^2, with (u, v) in pupil radii."""

BENDS = len(_POWERS) - TERMS
"""Terms of the bend per coordinate: u^3, u^2 v, u v^2, v^3."""

FEWEST_PIXELS = 16
"""Pixels a dot must light to be fitted: more than it has unknowns,"""

_FEWEST_SHARE, _ENOUGH = 0.5, 60  # and half a microimage's or so many, lest dots cut by the sensor's edge come in
_SIZE_STEP = 0.15  # tables come in sizes this far apart on a log scale
_TABLE_AGE = 0.02  # F is tabulated anew when the pixels' blur changes by this part of a lens
_ROBUST_SIGMA = 4.0  # residuals beyond this count linearly (Huber)
_ITERATIONS = 25
_STEP_SIGMA = 0.02  # converged when no parameter moves by more of its standard error
_MODEL_ERROR = 0.01  # part of the light that white image and dot shape leave unexplained
_SEEN_SHARE = 0.05  # a pixel sees the dot when at least this part of its rays come from it


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
    pull: np.ndarray
    """Slope of the fit's log-likelihood over what all dots share, all else fitted along: log(diameter), blur^2
    [pixel^2] and bend.T.ravel() [mm], shape (2 + 2 BENDS,)."""
    pull_information: np.ndarray
    """What the dot says about those: their inverse covariance, shape (2 + 2 BENDS, 2 + 2 BENDS)."""
    following: np.ndarray
    """Change of theta.T.ravel() with them, all fitted along, shape (12, 2 + 2 BENDS)."""
    base: float
    """Light of the board beside the dot, 1 as bright as the white image."""
    amplitude: float
    """Light of a fully seen dot over the board's; negative for dark dots."""
    reduced_chi2: float
    """Mean squared weighted residual, hot pixels capped."""
    relative_misfit: float
    """Root mean square of the residuals over the light of a fully seen dot."""
    converged: bool
    """False when the iteration limit was reached, or too few pixels were left."""
    pupil_mm: np.ndarray
    """Pupil points of the pixels in which the dot was seen [mm], (m, 2), float32."""
    share: np.ndarray
    """Fitted F of each pixel, (n,), float32."""
    misfit: np.ndarray
    """Signal minus fit of each pixel [counts], (n,), float32."""


def ray_terms(pupil_mm: np.ndarray, pupil_radius_mm: float) -> np.ndarray:
    """Terms Phi, then Psi, of the ray model at pupil points (u, v) [mm], shape (n, TERMS + BENDS)."""
    u, v = (np.asarray(pupil_mm) / pupil_radius_mm).T
    terms = np.ones((len(u), len(_POWERS)))
    for column, (i, j) in enumerate(_POWERS[1:], 1):
        lower = _POWERS.index((i - 1, j) if i else (i, j - 1))
        terms[:, column] = terms[:, lower] * (u if i else v)
    return terms


def _derivative(axis: int) -> np.ndarray:
    """Matrix of d/du or d/dv: coefficients of the terms -> coefficients of the terms up to one order less."""
    matrix = np.zeros((len(_POWERS) - _BEND_ORDER - 1, len(_POWERS)))
    for column, power in enumerate(_POWERS):
        if power[axis]:
            lower = (power[0] - 1, power[1]) if axis == 0 else (power[0], power[1] - 1)
            matrix[_POWERS.index(lower), column] = power[axis]
    return matrix


_PER_U, _PER_V = _derivative(0), _derivative(1)


class LensIntegral:
    """The dot model of one camera: holds what does not change from dot to dot."""

    def __init__(
        self,
        decoder: LightFieldDecoder,
        diameter_mm: float,
        blur_px: float,
        bend_mm: np.ndarray,
        noise: float,
        counts_per_photon: float,
    ):
        self.bend_mm = bend_mm  # (BENDS, 2)
        self.pupil_radius_mm = decoder.optics.pupil_radius_mm
        self._pixel_on_pupil = decoder.optics.pupil_pixel_mm
        half = _FEWEST_SHARE * np.pi * (self.pupil_radius_mm / self._pixel_on_pupil) ** 2
        self._fewest = int(np.clip(half, FEWEST_PIXELS, _ENOUGH))
        self._noise_variance, self._counts_per_photon = noise**2, counts_per_photon
        self._radius = diameter_mm / 2
        self._blur_px = blur_px
        self._basis = np.asarray(decoder.lattice.basis_mm)
        self._reach = np.abs(cell_corners(self._basis)).max(0)  # half extent of the cell along (s, t)
        self._cells: dict[int, np.ndarray] = {}
        self._views = ray_terms(spread_over_pupil(self.pupil_radius_mm), self.pupil_radius_mm)

    def support_mm(self, board_jacobian: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Half extent (s, t) of F [mm]: beyond it the dot sends no light through a lens, shape (2,)."""
        ellipse, pixel = self._ellipse(board_jacobian, theta), self._pixel(theta)
        extent: np.ndarray = self._reach + np.hypot(*ellipse.T) + np.abs(pixel).sum(1) * (0.5 + 2 * self._blur_px)
        return extent

    def table(self, board_jacobian: np.ndarray, tilt: np.ndarray, theta: np.ndarray) -> LensTable:
        """Tabulate F and its derivatives for one dot of ray model theta, for a pixel typical of the pupil."""
        ellipse = self._ellipse(board_jacobian, theta)
        inverse = np.linalg.inv(np.eye(2) - slope_of(theta, self.pupil_radius_mm))
        change = [inverse @ tilt[:, :, axis] * self._radius for axis in (0, 1)]
        size = int(np.ceil(np.log(self.support_mm(board_jacobian, theta).max()) / _SIZE_STEP))
        step = 2.2 * np.exp(size * _SIZE_STEP) / TABLE  # the rest of the period stays dark
        if size not in self._cells:
            self._cells[size] = cell_spectrum(self._basis, step)
        return LensTable(self._cells[size], step, ellipse, self._pixel(theta), self._blur_px, change)

    def _ellipse(self, board_jacobian: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Half axes of the dot's image, as columns [mm]."""
        magnified = np.eye(2) - slope_of(theta, self.pupil_radius_mm)
        ellipse: np.ndarray = np.linalg.solve(magnified, board_jacobian * self._radius)
        return ellipse

    def _pixel(self, theta: np.ndarray) -> np.ndarray:
        """Sides of a pixel's image on the array, as columns [mm]: mean square over the pupil."""
        inverse = lens_view(self._views, np.vstack([theta, self.bend_mm]), self.pupil_radius_mm)
        sides = np.moveaxis(inverse, -1, 0) - np.eye(2)  # (I - K)^-1 K
        spread, axes = np.linalg.eigh(np.einsum("nab,ncb->ac", sides, sides) / len(sides))
        size = axes * np.sqrt(np.maximum(spread, 0)) @ axes.T
        left, _, right = np.linalg.svd(sides[0])
        pixel: np.ndarray = size @ left @ right * self._pixel_on_pupil  # turned as the pixel in the middle is
        return pixel

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
        table = self.table(board_jacobian, tilt, theta)
        state = self._state(pixels, terms, theta, table, None, sign)
        damping, converged = 1e-3, False
        for _ in range(_ITERATIONS):
            if np.count_nonzero(state.share > _SEEN_SHARE) < self._fewest:
                return None  # no dot's light in these pixels, or the fit wandered off them
            moved = np.abs(slope_of(state.theta, self.pupil_radius_mm) - slope).max() * self._pixel_on_pupil
            if moved > _TABLE_AGE * self._reach.min():  # the pixels' blur has changed
                slope = slope_of(state.theta, self.pupil_radius_mm)
                table = self.table(board_jacobian, tilt, state.theta)
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
        converged &= int(np.count_nonzero(state.share > _SEEN_SHARE)) >= self._fewest
        return self._summary(pixels, state, prior_mean, prior_information, converged)

    def _variance(self, pixels: DotPixels, state: _State) -> np.ndarray:
        """Variance of each pixel: read noise, shot noise, the model's own error."""
        shot = self._counts_per_photon * np.maximum(pixels.signal - state.misfit, 0)
        shape = (_MODEL_ERROR * state.linear[1] * pixels.response) ** 2 * np.clip(state.share, 0, 1)
        variance: np.ndarray = self._noise_variance + shot + shape
        return variance

    def _state(
        self,
        pixels: DotPixels,
        terms: np.ndarray,
        theta: np.ndarray,
        table: LensTable,
        linear: np.ndarray | None,
        sign: int,
    ) -> _State:
        bent = np.vstack([theta, self.bend_mm])
        offset, inverse = lens_offset_mm(terms, bent, pixels.lens_mm, self.pupil_radius_mm)
        image = (inverse - np.eye(2)[..., None]) * self._pixel_on_pupil  # of each pixel on the array, (I - K)^-1 K
        (a, b), (c, d) = image
        pixel_mm2 = np.stack([a * a + b * b, a * c + b * d, c * c + d * d], axis=1)
        share, gradient, growth = table(offset, terms[:, 1:3], pixel_mm2)
        if linear is None:
            linear = self._linear_start(pixels, share, sign)
        along = [gradient[:, 0] * inverse[0, b] + gradient[:, 1] * inverse[1, b] for b in (0, 1)]  # dF / d s(u)
        misfit = pixels.signal - pixels.response * (linear[0] + linear[1] * share)
        return _State(theta, linear, terms, pixels.response, share, growth, along, misfit)

    def _linear_start(self, pixels: DotPixels, share: np.ndarray, sign: int) -> np.ndarray:
        """Find base and amplitude by weighted least squares; the amplitude keeps its sign."""
        weight = 1 / (self._noise_variance + self._counts_per_photon * np.maximum(pixels.signal, 0))
        design = pixels.response[:, None] * np.stack([np.ones_like(share), share], 1)
        normal = design.T @ (design * weight[:, None]) + 1e-9 * np.eye(2)
        base, amplitude = np.linalg.solve(normal, design.T @ (weight * pixels.signal))
        return np.array([base, amplitude if sign * amplitude > 0 else 0.1 * sign])

    def _summary(
        self, pixels: DotPixels, state: _State, prior_mean: np.ndarray, prior: np.ndarray, converged: bool
    ) -> DotFit:
        weight = 1 / self._variance(pixels, state)
        normal, gradient = state.normal_equations(weight, shared=True)
        normal[:12, :12] += prior
        gradient[:12] -= prior @ (state.theta - prior_mean).T.ravel()
        inverse = np.linalg.inv(normal[:14, :14])
        hidden = normal[14:, :14] @ inverse
        lit = state.share > _SEEN_SHARE
        relative = state.misfit / np.maximum(np.abs(state.linear[1]) * pixels.response, 1e-12)
        return DotFit(
            coefficients=state.theta,
            covariance=inverse[:12, :12],
            pull=gradient[14:] - hidden @ gradient[:14],
            pull_information=normal[14:, 14:] - hidden @ normal[:14, 14:],
            following=-hidden[:, :12].T,
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
    growth: np.ndarray
    along: list[np.ndarray]
    misfit: np.ndarray

    def cost(self, weight: np.ndarray) -> float:
        """Huber cost for inverse variances `weight`."""
        size = np.abs(self.misfit) * np.sqrt(weight)
        return float((size**2 - np.maximum(size - _ROBUST_SIGMA, 0) ** 2).sum())

    def normal_equations(self, weight: np.ndarray, shared: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton matrix and right-hand side for 12 ray coefficients, base, amplitude, then what dots share."""
        strength = self.linear[1] * self.response
        along = [(strength * along)[:, None] for along in self.along]
        own, bend = self.terms[:, :TERMS], self.terms[:, TERMS:]
        columns = [along[0] * own, along[1] * own, self.response[:, None], (self.response * self.share)[:, None]]
        if shared:
            columns += [strength[:, None] * self.growth, along[0] * bend, along[1] * bend]
        jacobian = np.hstack(columns)
        size = np.abs(self.misfit) * np.sqrt(weight)
        weighted = jacobian * (weight * _ROBUST_SIGMA / np.maximum(size, _ROBUST_SIGMA))[:, None]
        return weighted.T @ jacobian, weighted.T @ self.misfit


def lens_offset_mm(
    terms: np.ndarray, theta: np.ndarray, lens_mm: np.ndarray, pupil_radius_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where the central ray of each pixel lands from its lens's centre, g = (I - K)^-1 (s(u_i) - s_l), and (I - K)^-1.

    Parameters
    ----------
    terms : ndarray, shape (n, TERMS + BENDS)
        `ray_terms` at the pupil points u_i.
    theta : ndarray, shape (TERMS + BENDS, 2)
        Ray model and bend [mm].
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
    inverse = lens_view(terms, theta, pupil_radius_mm)
    miss = terms @ theta - lens_mm
    offset = [row[0] * miss[:, 0] + row[1] * miss[:, 1] for row in inverse]
    return np.stack(offset, axis=1), inverse


def lens_view(terms: np.ndarray, theta: np.ndarray, pupil_radius_mm: float) -> np.ndarray:
    """(I - K)^-1 at pupil points, K = ds/du; arguments as of `lens_offset_mm`, shape (2, 2, n)."""
    slope = (terms[:, : len(_PER_U)] @ np.hstack([_PER_U @ theta, _PER_V @ theta])).T / pupil_radius_mm
    a, b, c, d = 1 - slope[0], -slope[2], -slope[1], 1 - slope[3]
    inverse: np.ndarray = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
    return inverse


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
