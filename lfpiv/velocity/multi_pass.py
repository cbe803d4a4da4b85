"""Multi-pass correlation of two prepared volumes with window deformation.

Each pass deforms both volumes by half of the field of the pass before, one backward and one forward, correlates their
windows, and validates the peaks. Fields are displacements averaged over a window, shape (z, y, x, 3) [voxel].
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lfpiv.velocity import validation
from lfpiv.velocity.continuation import continued
from lfpiv.velocity.coverage import Coverage, Voxels
from lfpiv.velocity.peak_width import peak_reach, refine_search
from lfpiv.velocity.predictor import Predictor
from lfpiv.velocity.settings import CorrelationSettings, Triple, triple
from lfpiv.velocity.windows import Windows
from lfpiv_kernels.correlation import deform
from lfpiv_kernels.correlation.correlate import PEAK_REACH, WindowPeaks, correlate_windows
from lfpiv_kernels.correlation.fluid import as_numbers, common_fluid, inverted, levelled
from lfpiv_kernels.correlation.memory import on_device
from lfpiv_kernels.correlation.uncertainty import displacement_deviation
from lfpiv_kernels.transfer import Values

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
    volumes: tuple[Values, Values]
    """The two volumes, deformed onto each other in all passes but the first, with a mask less their local mean."""
    fluid: Values | None = None
    """True for voxels that hold fluid in both volumes, shape (z, y, x); None without a mask."""
    reach: int = PEAK_REACH
    """Lags around the highest coefficient that belong to its peak."""
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
    """Part of the vectors that are valid, of those that are not masked."""
    median_correlation: float
    """Median of the coefficients at the highest peaks where the vectors are not masked."""
    median_step_voxel: float | None
    """Median change of the valid vectors against the pass before [voxel]; None if no vector is valid."""


@dataclass(frozen=True, kw_only=True)
class Pass:
    """Input and result of one pass."""

    given: PassInput
    peaks: WindowPeaks
    field: np.ndarray
    """Displacement, replaced where not valid, also where masked, shape (z, y, x, 3) [voxel]."""
    valid: np.ndarray
    """True where the displacement was measured and passed validation, shape (z, y, x)."""
    coverage: Coverage
    """Contents of the windows."""

    @property
    def figures(self) -> PassFigures:
        """Figures for the attribute ``passes``."""
        predicted = 0 if self.given.predicted is None else self.given.predicted
        steps = np.linalg.norm((self.field - predicted)[self.valid], axis=-1)
        return PassFigures(
            window=self.given.windows.window,
            search=self.given.search,
            vectors=self.valid.size,
            valid=round(self.valid_fraction, 4),
            median_correlation=round(float(np.median(self.peaks.correlation[self._open])), 4),
            median_step_voxel=round(float(np.median(steps)), 4) if steps.size else None,
        )

    @property
    def valid_fraction(self) -> float:
        """Part of the vectors that are valid, of those that are not masked."""
        return self.fraction(self.valid)

    def fraction(self, flags: np.ndarray) -> float:
        """Return the part of the vectors that are flagged, of those that are not masked."""
        return float(flags[self._open].mean())

    @property
    def _open(self) -> np.ndarray:
        """True where a vector is not masked; everywhere if all are, so that medians have values."""
        masked = self.coverage.masked
        return np.ones_like(masked) if masked.all() else ~masked

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
    first: Values, second: Values, settings: CorrelationSettings, voxels: Voxels
) -> tuple[Pass, tuple[PassFigures, ...]]:
    """Correlate two volumes in one pass per window of the settings.

    Parameters
    ----------
    first, second : array, shape (z, y, x), float32
        Volumes without background, 0 where there is no fluid. They are brought to the device once, unless they are
        there, and what is made of them stays there.
    settings : CorrelationSettings
        Windows, overlap and largest displacement.
    voxels : Voxels
        Voxels that two cameras see, that hold no fluid, that hold no particles. Windows of the last pass with too few
        usable voxels are not valid.

    Returns
    -------
    last : Pass
        The last pass.
    figures : tuple of PassFigures
        Figures of every pass.
    """
    shape, last = triple(first.shape), len(settings.windows) - 1
    pair = UndeformedPair((on_device(first), on_device(second)), voxels.solid_on_device)
    reach = peak_reach(*pair.volumes, settings.windows[-1])
    coarse = max(settings.overlap, COARSE_OVERLAP)
    overlaps = [coarse] * last + [settings.overlap]
    windows = Windows.overlapping(shape, settings.windows[0], overlaps[0])
    volumes, fluid = pair.given(windows.window)
    given = PassInput(
        windows=windows,
        overlap=overlaps[0],
        centres=windows.centres,
        search=settings.first_search(shape),
        volumes=volumes,
        fluid=fluid,
        reach=reach,
    )
    coverage = voxels.coverage(windows, settings.windows[-1], predicts=last > 0)
    result = _correlate_pass(given, coverage, symmetric=last > 0)
    figures = [result.figures]
    for number in range(1, last + 1):
        given = _deform(pair, result, settings.windows[number], overlaps[number])
        coverage = voxels.coverage(given.windows, settings.windows[-1], predicts=number < last)
        result = _correlate_pass(given, coverage, symmetric=True)
        figures.append(result.figures)
    log.debug("correlation passes: %s", figures)
    return result, tuple(figures)


def correlate_known(
    first: Values, second: Values, settings: CorrelationSettings, voxels: Voxels, known: Predictor
) -> Pass:
    """Correlate two volumes in one pass in the last window of the settings, near a displacement that is known.

    Parameters
    ----------
    first, second, settings, voxels
        As of `correlate_passes`. The overlap is that of the last pass.
    known : Predictor
        Displacement by which the volumes are deformed. Lags up to `refine_search` around it are searched.

    Returns
    -------
    Pass
        The only pass.
    """
    window = settings.windows[-1]
    pair = UndeformedPair((on_device(first), on_device(second)), voxels.solid_on_device)
    given = _deform_by(known, pair, window, settings.overlap, peak_reach(*pair.volumes, window))
    return _correlate_pass(given, voxels.coverage(given.windows, window, predicts=False), symmetric=True)


@dataclass(frozen=True)
class UndeformedPair:
    """The two volumes before any deformation, and the voxels that hold no fluid."""

    volumes: tuple[Values, Values]
    """Volumes without background, shape (z, y, x), float32."""
    solid: Values | None
    """True for voxels without fluid, shape (z, y, x); None without a mask."""

    def given(self, window: Triple) -> tuple[tuple[Values, Values], Values | None]:
        """Return the volumes of the first pass and their fluid."""
        if self.solid is None:
            return self.volumes, None
        fluid = inverted(self.solid)
        return levelled(*self.volumes, fluid, window), fluid

    def deformed(self, predictor: Predictor, window: Triple) -> tuple[tuple[Values, Values], Values | None]:
        """Return the volumes of a later pass, deformed onto each other by the predicted field, and their fluid."""
        first, second = self._splines
        volumes = deform.deform_pair(first, second, predictor.control, predictor.spacing)
        if self._solid_spline is None:
            return volumes, None
        solids = deform.deform_pair(self._solid_spline, self._solid_spline, predictor.control, predictor.spacing)
        fluid = common_fluid(*solids)
        return levelled(*volumes, fluid, window), fluid

    @cached_property
    def _splines(self) -> tuple[Values, Values]:
        first, second = self.volumes
        return deform.spline_coefficients(on_device(first)), deform.spline_coefficients(on_device(second))

    @cached_property
    def _solid_spline(self) -> Values | None:
        return None if self.solid is None else deform.spline_coefficients(on_device(as_numbers(self.solid)))


def _deform(pair: UndeformedPair, before: Pass, window: Triple, overlap: float) -> PassInput:
    """Deform both volumes by the field of the pass before, and lay out the windows of the next one."""
    shape = triple(before.given.volumes[0].shape)
    predictor = Predictor.between(before.given.centres, before.next_guess, shape)
    return _deform_by(predictor, pair, window, overlap, before.given.reach)


def _deform_by(predictor: Predictor, pair: UndeformedPair, window: Triple, overlap: float, reach: int) -> PassInput:
    """Deform both volumes by a predicted field, and lay out the windows of the next pass."""
    windows = Windows.overlapping(predictor.shape, window, overlap)
    volumes, fluid = pair.deformed(predictor, window)
    return PassInput(
        windows=windows,
        overlap=overlap,
        centres=[centre + deform.OFFSET for centre in windows.centres],
        search=refine_search(reach),
        volumes=volumes,
        fluid=fluid,
        reach=reach,
        predicted=predictor.window_means(windows),
    )


def _correlate_pass(given: PassInput, coverage: Coverage, *, symmetric: bool) -> Pass:
    """Correlate the windows of two volumes and validate the peaks."""
    grid, predicted = given.windows, given.predicted
    peaks = correlate_windows(
        *given.volumes,
        window=grid.window,
        step=grid.step,
        search=given.search,
        symmetric=symmetric,
        reach=given.reach,
    )
    offset = np.zeros(3) if predicted is None else predicted
    field, valid = validation.validate(
        peaks.displacement + offset,
        peaks.second_displacement + offset,
        peaks.measured,
        given.search,
        seen=coverage.measurable,
        predicted=predicted if given.overlap < COARSE_OVERLAP else None,
        peak_ratio=peak_ratio(peaks),
    )
    if given.fluid is not None:
        field = continued(field, offset, valid, given.fluid, grid)
    return Pass(given=given, peaks=peaks, field=field, valid=valid, coverage=coverage)


def peak_ratio(peaks: WindowPeaks) -> np.ndarray:
    """Return the highest coefficient of each window over its rival; NaN where no coefficient is positive."""
    ratio = peaks.correlation / np.maximum(peaks.rival, LOWEST_RIVAL)
    return np.where(peaks.correlation > 0, ratio, np.nan)
