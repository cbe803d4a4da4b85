"""Fit the dot model to the raw pixels around each dot, by Levenberg and Marquardt's method with Huber's loss.

A dot has 14 unknowns: 12 coefficients theta of its ray model, the light `base` of the board beside it and the
`amplitude` of the dot over the board. Pixels are weighted by their read noise, shot noise and model error.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from lfpiv.calibration.board.dot_model import TERMS, ZONES, LensIntegral, LensTable, slope_of, zone_of
from lfpiv.calibration.board.dots import ExpectedDot
from lfpiv.calibration.board.planes import Signals
from lfpiv.lightfield.decoder import LightFieldDecoder, disc_fraction

FEWEST_PIXELS = 16
"""Least number of pixels that a fitted dot must light; a dot has 14 unknowns."""

_FEWEST_SHARE, _ENOUGH = 0.5, 60  # a dot must also light this share of a microimage, or this many pixels
_FIT_COVERAGE = 0.9  # least share of a fitted pixel inside its own microimage
_BESIDE_COVERAGE = 0.01  # largest share of a fitted pixel inside the next microimage
_SEEN_SHARE = 0.05  # least share of a pixel's rays from the dot for the pixel to see the dot
_TABLE_AGE = 0.02  # F is tabulated again when the pixels' images change by this share of a lens
_ROBUST_SIGMA = 4.0  # residuals beyond this count linearly [standard deviations]
_MODEL_ERROR = 0.01  # share of the light that white image and dot shape leave unexplained
_ITERATIONS = 25
_STEP_SIGMA = 0.02  # a fit has converged when no parameter moves by more [standard errors]
_CYCLE_SIGMA = 0.5  # a fit that still moves by less after all iterations swings between two weightings; it is kept
_LARGEST_DAMPING = 1e8

_RAYS = 2 * TERMS  # ray coefficients of a dot
_OWN = _RAYS + 2  # unknowns of a dot


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardPixels:
    """Pixels of a camera's board images, with their response and noise. Made by `from_decoder`."""

    signals: Signals
    """Images of the planes."""
    sign: int
    """+1 for dots brighter than the board, -1 for darker ones."""
    decoder: LightFieldDecoder
    """Lens and pupil point of each pixel."""
    usable: np.ndarray
    """Pixels inside one microimage and free of the light of the next, shape (rows, columns), bool."""
    response: np.ndarray
    """Counts of the white image above the dark level, shape (rows, columns)."""
    response_share: float
    """Share of the white image's scatter from pixel to pixel that is pixel response."""
    counts_per_photon: float
    """Shot noise: variance over mean [counts]."""

    @classmethod
    def from_decoder(cls, signals: Signals, sign: int, decoder: LightFieldDecoder) -> BoardPixels:
        """Choose the usable pixels, and take all scatter of the white image as noise."""
        optics = decoder.optics
        to_px = optics.sensor_per_pupil / optics.pixel_mm
        own, _ = disc_fraction(decoder.pupil_mm * np.float32(to_px), optics.pupil_radius_mm * to_px)
        beside = ndimage.maximum_filter(decoder.coverage - own, 3)  # blur takes light one pixel further
        return cls(
            signals=signals,
            sign=sign,
            decoder=decoder,
            usable=(own > _FIT_COVERAGE) & (beside < _BESIDE_COVERAGE) & (decoder.gain > 0),
            response=_response(decoder, 0.0),
            response_share=0.0,
            counts_per_photon=decoder.counts_per_photon,
        )

    def measured(self, response_share: float, counts_per_photon: float) -> BoardPixels:
        """Return the same pixels with measured response and shot noise."""
        response = _response(self.decoder, response_share)
        return replace(self, response=response, response_share=response_share, counts_per_photon=counts_per_photon)


def _response(decoder: LightFieldDecoder, share: float) -> np.ndarray:
    response: np.ndarray = decoder.coverage * decoder.shrunk_gain(share) * np.float32(decoder.white_counts)
    return response


@dataclass(frozen=True, eq=False, kw_only=True)
class DotFit:
    """One fitted dot."""

    coefficients: np.ndarray
    """Ray model theta [mm], shape (TERMS, 2)."""
    covariance: np.ndarray
    """Covariance of theta.T.ravel() [mm^2], prior included, shape (12, 12)."""
    pull: np.ndarray
    """Slope of the fit's log-likelihood over the shared parameters, with the dot's own fitted along: log(diameter),
    blur^2 [pixel^2] and bend.T.ravel() [mm], shape (2 + 2 bends,)."""
    pull_information: np.ndarray
    """Inverse covariance of the shared parameters from this dot, shape (2 + 2 bends, 2 + 2 bends)."""
    following: np.ndarray
    """Derivative of theta.T.ravel() over the shared parameters, shape (12, 2 + 2 bends)."""
    zone_pull: np.ndarray
    """Slope of the fit's log-likelihood over displacements (s, then t) of the rays in the zones of the pupil, with the
    dot's own unknowns fitted along [1/mm], shape (2 ZONES,), float32."""
    zone_information: np.ndarray
    """Inverse covariance of these displacements from this dot, shape (2 ZONES, 2 ZONES), float32."""
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
    seen_pupil_mm: np.ndarray
    """Pupil points of the pixels that see the dot [mm], shape (m, 2), float32."""
    pixel: np.ndarray
    """Row and column of each fitted pixel, shape (n, 2)."""
    share: np.ndarray
    """F of each fitted pixel, shape (n,), float32."""
    misfit: np.ndarray
    """Signal minus fit of each fitted pixel [counts], shape (n,), float32."""


def fit_dots(
    model: LensIntegral,
    pixels: BoardPixels,
    expected: Sequence[ExpectedDot],
    margin_mm: float,
    before: Sequence[DotFit | None] | None = None,
) -> list[DotFit | None]:
    """Fit dots, sorted by plane, each to the pixels that its light may reach. None where a dot lights too few pixels.

    The pixels reach `margin_mm` beyond the expected light. `before` are fits of the same dots with other shared
    parameters; a fit starts from the one before it if that converged. Default: from the expected rays.
    """
    starts = iter(before if before is not None else [None] * len(expected))
    return [
        _fit_dot(_Problem.from_dot(model, pixels, dot, signal, margin_mm), next(starts))
        for plane, dots in itertools.groupby(expected, lambda dot: dot.plane)
        for signal in [pixels.signals.of_plane(plane)]
        for dot in dots
    ]


@dataclass(frozen=True, eq=False)
class _State:
    """The model evaluated at one set of parameters."""

    theta: np.ndarray
    linear: np.ndarray  # base and amplitude
    share: np.ndarray  # F of each pixel
    growth: np.ndarray  # dF / d log(diameter), d blur^2
    along: list[np.ndarray]  # dF / d s(u), d t(u)
    misfit: np.ndarray  # signal minus fit


@dataclass(frozen=True, eq=False, kw_only=True)
class _Problem:
    """Pixels of one dot as flat arrays, and the equations of its fit."""

    model: LensIntegral
    dot: ExpectedDot
    sign: int
    noise_variance: float
    counts_per_photon: float
    pixel: np.ndarray  # row and column of each pixel, (n, 2)
    signal: np.ndarray  # counts above the dark level, (n,)
    response: np.ndarray  # counts of the white image above the dark level, (n,)
    pupil_mm: np.ndarray  # pupil points seen through the lens centres, (n, 2)
    lens_mm: np.ndarray  # lens centres (s, t), (n, 2)
    terms: np.ndarray  # `pixel_terms`, (n, TERMS + bends)

    @classmethod
    def from_dot(
        cls,
        model: LensIntegral,
        pixels: BoardPixels,
        dot: ExpectedDot,
        signal: np.ndarray,
        margin_mm: float,
    ) -> _Problem:
        """Take the usable pixels that may see a dot and none of its neighbours."""
        decoder, optics = pixels.decoder, model.optics
        support = model.support_mm(dot.board_jacobian, dot.theta)
        reach = support + margin_mm + model.pupil_reach_mm(dot.theta) + optics.microlens_pitch_mm
        corners = optics.sensor_px((dot.theta[0] + [-reach, reach]) * (1 + optics.sensor_per_pupil))
        low = np.maximum(np.floor(corners[0]), 0).astype(int)
        high = np.maximum(np.ceil(corners[1]) + 1, low).astype(int)
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        pixel = np.argwhere(pixels.usable[part] & ~np.isnan(signal[part])) + low[::-1]
        at = tuple(pixel.T)
        pupil = decoder.pupil_mm[at].astype(float)
        terms, lens = model.pixel_terms(pupil), decoder.lattice.centres_mm(decoder.lens_index[at])
        offset, _ = model.offset_mm(terms, dot.theta, lens)
        take = (np.abs(offset) < support + margin_mm).all(1)
        inverse = np.linalg.inv(np.eye(2) - slope_of(dot.theta, optics.pupil_radius_mm))
        for neighbour in dot.neighbours_mm @ inverse.T:
            if (np.abs(neighbour) < 2 * support + margin_mm).all():
                take &= (np.abs(offset - neighbour) > support).any(1)
        pixel = pixel[take]
        at = tuple(pixel.T)
        return cls(
            model=model,
            dot=dot,
            sign=pixels.sign,
            noise_variance=pixels.signals.noise**2,
            counts_per_photon=pixels.counts_per_photon,
            pixel=pixel,
            signal=signal[at].astype(float),
            response=pixels.response[at].astype(float),
            pupil_mm=pupil[take],
            lens_mm=lens[take],
            terms=terms[take],
        )

    def table(self, theta: np.ndarray) -> LensTable:
        return self.model.table(self.dot.board_jacobian, self.dot.tilt, theta)

    def state(self, theta: np.ndarray, table: LensTable, linear: np.ndarray | None) -> _State:
        """Evaluate the model; find base and amplitude where `linear` does not give them."""
        offset, inverse = self.model.offset_mm(self.terms, theta, self.lens_mm)
        image = (inverse - np.eye(2)[..., None]) * self.model.optics.pupil_pixel_mm  # of a pixel: (I - K)^-1 K
        (a, b), (c, d) = image
        pixel_mm2 = np.stack([a * a + b * b, a * c + b * d, c * c + d * d], axis=1)
        share, gradient, growth = table(offset, self.terms[:, 1:3], pixel_mm2)
        if linear is None:
            linear = self._linear_start(share)
        along = [gradient[:, 0] * inverse[0, b] + gradient[:, 1] * inverse[1, b] for b in (0, 1)]
        misfit = self.signal - self.response * (linear[0] + linear[1] * share)
        return _State(theta, linear, share, growth, along, misfit)

    def _linear_start(self, share: np.ndarray) -> np.ndarray:
        """Find base and amplitude by weighted least squares; the amplitude has the sign of the dots."""
        weight = 1 / (self.noise_variance + self.counts_per_photon * np.maximum(self.signal, 0))
        design = self.response[:, None] * np.stack([np.ones_like(share), share], 1)
        normal = design.T @ (design * weight[:, None]) + 1e-9 * np.eye(2)
        base, amplitude = np.linalg.solve(normal, design.T @ (weight * self.signal))
        return np.array([base, amplitude if self.sign * amplitude > 0 else 0.1 * self.sign])

    def lights_enough(self, state: _State) -> bool:
        """Return whether the dot lights enough pixels for a fit."""
        optics = self.model.optics
        half = _FEWEST_SHARE * np.pi * (optics.pupil_radius_mm / optics.pupil_pixel_mm) ** 2
        return int(np.count_nonzero(state.share > _SEEN_SHARE)) >= int(np.clip(half, FEWEST_PIXELS, _ENOUGH))

    def weight(self, state: _State) -> np.ndarray:
        """Return the inverse variance of each pixel: read noise, shot noise, the model's own error."""
        shot = self.counts_per_photon * np.maximum(self.signal - state.misfit, 0)
        shape = (_MODEL_ERROR * state.linear[1] * self.response) ** 2 * np.clip(state.share, 0, 1)
        weight: np.ndarray = 1 / (self.noise_variance + shot + shape)
        return weight

    def cost(self, state: _State, weight: np.ndarray) -> float:
        """Return Huber's cost of the pixels and the cost of the prior."""
        size = np.abs(state.misfit) * np.sqrt(weight)
        miss = self._miss(state)
        pixels = float((size**2 - np.maximum(size - _ROBUST_SIGMA, 0) ** 2).sum())
        return pixels + float(miss @ self.dot.information @ miss)

    def _linearised(self, state: _State, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return derivatives of the light over the dot's unknowns, (n, 14), and over s and t, (2, n); weights."""
        along = state.linear[1] * self.response * np.stack(state.along)
        own = self.terms[:, :TERMS]
        light = np.stack([self.response, self.response * state.share], axis=1)
        size = np.abs(state.misfit) * np.sqrt(weight)
        robust = weight * _ROBUST_SIGMA / np.maximum(size, _ROBUST_SIGMA)
        return np.hstack([along[0][:, None] * own, along[1][:, None] * own, light]), along, robust

    def normal_equations(
        self, state: _State, weight: np.ndarray, shared: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gauss-Newton matrix and right-hand side of the dot's unknowns, then of the shared parameters."""
        jacobian, along, robust = self._linearised(state, weight)
        if shared:
            growth, bend = (state.linear[1] * self.response)[:, None] * state.growth, self.terms[:, TERMS:]
            jacobian = np.hstack([jacobian, growth, along[0][:, None] * bend, along[1][:, None] * bend])
        weighted = jacobian * robust[:, None]
        normal, gradient = weighted.T @ jacobian, weighted.T @ state.misfit
        normal[:_RAYS, :_RAYS] += self.dot.information
        gradient[:_RAYS] -= self.dot.information @ self._miss(state)
        return normal, gradient

    def zone_equations(
        self, state: _State, weight: np.ndarray, inverse: np.ndarray, gradient: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the right-hand side and the matrix of the displacements in the zones.

        `inverse` of the dot's own normal matrix and their right-hand side `gradient` eliminate the dot's unknowns.
        """
        jacobian, along, robust = self._linearised(state, weight)
        zone, zones = zone_of(self.pupil_mm / self.model.optics.pupil_radius_mm), np.arange(ZONES)
        inside = (zone == zones[:, None]).astype(float)
        columns = np.hstack([jacobian, along.T, state.misfit[:, None]])
        sums = np.stack([inside @ ((robust * one)[:, None] * columns) for one in along])  # (2, ZONES, columns)
        alone = np.zeros((2, ZONES, 2, ZONES))  # no pixel is in two zones
        alone[:, zones, :, zones] = sums[..., _OWN:-1].swapaxes(0, 1)
        mixed = sums[..., :_OWN].reshape(2 * ZONES, _OWN)
        hidden = mixed @ inverse
        return sums[..., -1].ravel() - hidden @ gradient, alone.reshape(2 * ZONES, -1) - hidden @ mixed.T

    def _miss(self, state: _State) -> np.ndarray:
        miss: np.ndarray = (state.theta - self.dot.theta).T.ravel()
        return miss


@dataclass(frozen=True, eq=False)
class _Step:
    state: _State
    damping: float
    moved: float
    """Largest change of a parameter [standard errors]; 0 where no step lowers the cost."""


def _fit_dot(problem: _Problem, before: DotFit | None) -> DotFit | None:
    """Fit one dot; None where its light would not reach enough pixels, or the fit leaves them."""
    if len(problem.signal) < FEWEST_PIXELS:
        return None
    radius, pixel_mm = problem.model.optics.pupil_radius_mm, problem.model.optics.pupil_pixel_mm
    oldest = _TABLE_AGE * problem.model.cell_reach_mm.min()
    first = before.coefficients if before is not None and before.converged else problem.dot.theta
    slope, table = slope_of(first, radius), problem.table(first)
    step = _Step(problem.state(first, table, None), 1e-3, np.inf)
    for _ in range(_ITERATIONS):
        state = step.state
        if not problem.lights_enough(state):
            return None
        if np.abs(slope_of(state.theta, radius) - slope).max() * pixel_mm > oldest:
            slope, table = slope_of(state.theta, radius), problem.table(state.theta)
            state = problem.state(state.theta, table, state.linear)
        step = _improve(problem, state, table, step.damping)
        if step.moved < _STEP_SIGMA:
            break
    return _summarise(problem, step.state, step.moved < _CYCLE_SIGMA and problem.lights_enough(step.state))


def _improve(problem: _Problem, state: _State, table: LensTable, damping: float) -> _Step:
    """Take one step that lowers the cost, with more damping until one does."""
    weight = problem.weight(state)
    cost = problem.cost(state, weight)
    normal, gradient = problem.normal_equations(state, weight)
    diagonal = np.diag(normal)
    while True:
        step = np.linalg.solve(normal + np.diag(damping * diagonal), gradient)
        theta = state.theta + step[:_RAYS].reshape(2, TERMS).T
        trial = problem.state(theta, table, state.linear + step[_RAYS:])
        moved = float((np.abs(step) * np.sqrt(diagonal)).max())
        if problem.cost(trial, weight) <= cost:
            return _Step(trial, max(damping / 10, 1e-9), moved)
        if moved < _STEP_SIGMA or damping > _LARGEST_DAMPING:
            return _Step(state, damping, 0.0)
        damping *= 10


def _summarise(problem: _Problem, state: _State, converged: bool) -> DotFit:
    """Return a fit with its covariance, its own unknowns eliminated from the equations of the shared parameters."""
    weight = problem.weight(state)
    normal, gradient = problem.normal_equations(state, weight, shared=True)
    inverse = np.linalg.inv(normal[:_OWN, :_OWN])
    hidden = normal[_OWN:, :_OWN] @ inverse
    zone_pull, zone_information = problem.zone_equations(state, weight, inverse, gradient[:_OWN])
    relative = state.misfit / np.maximum(np.abs(state.linear[1]) * problem.response, 1e-12)
    return DotFit(
        coefficients=state.theta,
        covariance=inverse[:_RAYS, :_RAYS],
        pull=gradient[_OWN:] - hidden @ gradient[:_OWN],
        pull_information=normal[_OWN:, _OWN:] - hidden @ normal[:_OWN, _OWN:],
        following=-hidden[:, :_RAYS].T,
        zone_pull=zone_pull.astype(np.float32),
        zone_information=zone_information.astype(np.float32),
        base=float(state.linear[0]),
        amplitude=float(state.linear[1]),
        reduced_chi2=float(np.mean(np.minimum(state.misfit**2 * weight, _ROBUST_SIGMA**2))),
        relative_misfit=float(np.sqrt(np.mean(np.minimum(relative**2, 1)))),
        converged=converged,
        seen_pupil_mm=problem.pupil_mm[state.share > _SEEN_SHARE].astype(np.float32),
        pixel=problem.pixel,
        share=state.share.astype(np.float32),
        misfit=state.misfit.astype(np.float32),
    )


def converged(fits: Sequence[DotFit | None]) -> list[DotFit]:
    """Return the fits that converged."""
    return [fit for fit in fits if fit is not None and fit.converged]
