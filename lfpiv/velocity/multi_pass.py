"""Multi-pass correlation of two prepared volumes with window deformation.

Each pass deforms both volumes by half of the field of the pass before, one backward and one forward, correlates their
windows, and validates the peaks. Fields are displacements averaged over a window, shape (z, y, x, 3) [voxel].
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from lfpiv.velocity import validation
from lfpiv.velocity.predictor import Predictor
from lfpiv.velocity.settings import REFINE_SEARCH, CorrelationSettings, Triple, triple
from lfpiv.velocity.windows import Windows
from lfpiv_kernels.correlation import deform
from lfpiv_kernels.correlation.correlate import WindowPeaks, correlate_windows
from lfpiv_kernels.correlation.uncertainty import displacement_deviation

log = logging.getLogger(__name__)

COARSE_OVERLAP = 0.75
"""Smallest overlap of all passes but the last."""
LOWEST_RIVAL = 0.01
"""Lower limit of the rival coefficient in a peak ratio."""


@dataclass(frozen=True, kw_only=True)
class PassInput:
    """Volumes of one pass and where their windows lie."""

    windows: Windows
    overlap: float
    """Part of a window that its neighbour shares."""
    centres: list[np.ndarray]
    """Positions of the vectors along each axis of the given volumes [voxel]."""
    search: Triple
    """Largest lag (z, y, x) [voxel]."""
    volumes: tuple[np.ndarray, np.ndarray]
    """The two volumes, deformed onto each other in all passes but the first."""
    predicted: np.ndarray | None = None
    """Displacement removed by the deformation, as window means, shape (z, y, x, 3) [voxel]; None in the first pass."""


@dataclass(frozen=True, kw_only=True)
class PassFigures:
    """Figures of one pass, stored in the attribute ``passes``."""

    window: Triple
    """Edges of a window (z, y, x) [voxel]."""
    search: Triple
    """Largest lag (z, y, x) [voxel]."""
    vectors: int
    """Number of vectors."""
    valid: float
    """Part of the vectors that are valid."""
    median_correlation: float
    """Median of the coefficients at the highest peaks."""
    median_step_voxel: float | None
    """Median change of the valid vectors against the pass before [voxel]; None if no vector is valid."""


@dataclass(frozen=True, kw_only=True)
class Pass:
    """Input and result of one pass."""

    given: PassInput
    peaks: WindowPeaks
    field: np.ndarray
    """Displacement, replaced where not valid, shape (z, y, x, 3) [voxel]."""
    valid: np.ndarray
    """True where the displacement was measured and passed validation, shape (z, y, x)."""
    seen: np.ndarray
    """True where two cameras see the window, shape (z, y, x)."""

    @property
    def figures(self) -> PassFigures:
        """Figures for the attribute ``passes``."""
        predicted = 0 if self.given.predicted is None else self.given.predicted
        steps = np.linalg.norm((self.field - predicted)[self.valid], axis=-1)
        return PassFigures(
            window=self.given.windows.window,
            search=self.given.search,
            vectors=self.valid.size,
            valid=round(float(self.valid.mean()), 4),
            median_correlation=round(float(np.median(self.peaks.correlation)), 4),
            median_step_voxel=round(float(np.median(steps)), 4) if steps.size else None,
        )

    @property
    def next_guess(self) -> np.ndarray:
        """Field by which the next pass deforms: the prediction of this pass if no vector is valid."""
        if self.valid.any():
            return self.field
        return np.zeros_like(self.field) if self.given.predicted is None else self.given.predicted

    def without(self, rejected: np.ndarray) -> Pass:
        """Return the pass with some vectors replaced by predictions from their neighbours, flags (z, y, x)."""
        valid = self.valid & ~rejected
        return replace(self, field=validation.fill(self.field, valid), valid=valid)

    def deviation(self) -> np.ndarray:
        """Return the standard deviation of the displacement, shape (z, y, x, 3) [voxel].

        It is NaN where a vector is not valid, and everywhere in the first pass: the statistics need volumes that were
        deformed onto each other.
        """
        if self.given.predicted is None:
            return np.full(self.field.shape, np.nan)
        grid = self.given.windows
        deviation: np.ndarray = displacement_deviation(
            *self.given.volumes, window=grid.window, origin=grid.origin, step=grid.step, count=grid.count
        )
        deviation[~self.valid] = np.nan
        return deviation


def correlate_passes(
    first: np.ndarray, second: np.ndarray, settings: CorrelationSettings, *, seen: np.ndarray | None = None
) -> tuple[Pass, tuple[PassFigures, ...]]:
    """Correlate two volumes in one pass per window of the settings.

    Parameters
    ----------
    first, second : ndarray, shape (z, y, x), float32
        Volumes without background.
    settings : CorrelationSettings
        Windows, overlap and largest displacement.
    seen : ndarray of bool, shape (z, y, x), optional
        Voxels that two cameras see. Windows of the last pass that hold too few of them are not valid.

    Returns
    -------
    last : Pass
        The last pass.
    figures : tuple of PassFigures
        Figures of every pass.
    """
    shape, last = triple(first.shape), len(settings.windows) - 1
    coarse = max(settings.overlap, COARSE_OVERLAP)
    overlaps = [coarse] * last + [settings.overlap]
    windows = _cover(shape, settings.windows[0], overlaps[0])
    given = PassInput(
        windows=windows,
        overlap=overlaps[0],
        centres=windows.centres,
        search=settings.first_search(shape),
        volumes=(first, second),
    )
    result = _correlate_pass(given, seen if last == 0 else None, symmetric=last > 0)
    figures = [result.figures]
    if last > 0:
        splines = deform.spline_coefficients(first), deform.spline_coefficients(second)
        for number in range(1, last + 1):
            given = _deform(splines, result, settings.windows[number], overlaps[number])
            result = _correlate_pass(given, seen if number == last else None, symmetric=True)
            figures.append(result.figures)
    log.debug("correlation passes: %s", figures)
    return result, tuple(figures)


def _cover(shape: Triple, window: Triple, overlap: float) -> Windows:
    """Return the windows that cover a volume with a given overlap."""
    return Windows.covering(shape, window, triple(max(1, round(edge * (1 - overlap))) for edge in window))


def _deform(splines: tuple[np.ndarray, np.ndarray], before: Pass, window: Triple, overlap: float) -> PassInput:
    """Deform both volumes by the field of the pass before, and lay out the windows of the next one."""
    shape = triple(before.given.volumes[0].shape)
    windows = _cover(shape, window, overlap)
    predictor = Predictor.between(before.given.centres, before.next_guess, shape)
    return PassInput(
        windows=windows,
        overlap=overlap,
        centres=[centre + deform.OFFSET for centre in windows.centres],
        search=(REFINE_SEARCH,) * 3,
        volumes=deform.deform_pair(*splines, predictor.field, predictor.spacing),
        predicted=predictor.window_means(windows),
    )


def _correlate_pass(given: PassInput, seen: np.ndarray | None, *, symmetric: bool) -> Pass:
    """Correlate the windows of two volumes and validate the peaks."""
    grid, predicted = given.windows, given.predicted
    peaks = correlate_windows(
        *given.volumes, window=grid.window, step=grid.step, search=given.search, symmetric=symmetric
    )
    windows_seen = np.ones(grid.count, bool)
    if seen is not None:
        windows_seen = validation.seen_windows(seen, grid)
    offset = np.zeros(3) if predicted is None else predicted
    field, valid = validation.validate(
        peaks.displacement + offset,
        peaks.second_displacement + offset,
        peaks.measured,
        given.search,
        seen=windows_seen,
        predicted=predicted if given.overlap < COARSE_OVERLAP else None,
        peak_ratio=peak_ratio(peaks),
    )
    return Pass(given=given, peaks=peaks, field=field, valid=valid, seen=windows_seen)


def peak_ratio(peaks: WindowPeaks) -> np.ndarray:
    """Return the highest coefficient of each window over its rival; NaN where no coefficient is positive."""
    ratio = peaks.correlation / np.maximum(peaks.rival, LOWEST_RIVAL)
    return np.where(peaks.correlation > 0, ratio, np.nan)
