"""Agreement of scattered vectors with the truth: response, uncertainty, and errors over the part that is measured.

All functions take one weight per vector, so that `lfpiv.metrics.confidence` can resample them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

LEAST_DEVIATION = 0.1
"""Least standard deviation of the truth for which its slope is stated [unit of the truth]."""
_MEDIAN_OF_NORMAL = 0.6745  # median of |z| for a normal z


@dataclass(frozen=True, kw_only=True)
class LinearResponse:
    """Straight line through measured against true values; see `linear_response`."""

    slope: float
    """Measured per true change, 1 for a perfect measurement; NaN where the truth hardly varies."""
    offset: float
    """Measured minus true mean."""


@dataclass(frozen=True, kw_only=True)
class UncertaintyCalibration:
    """Agreement of errors with their stated standard deviations; see `uncertainty_calibration`."""

    within_one: float
    """Part of the errors within one stated standard deviation; 0.683 if the errors are normal and well stated."""
    within_two: float
    """Part of the errors within two; 0.954."""
    width: float
    """Root mean square of error over standard deviation, 1; larger where uncertainties are stated too small."""
    robust_width: float
    """Median of the absolute error over the stated standard deviation, relative to that of a normal distribution, 1."""


def linear_response(
    measured: np.ndarray, true: np.ndarray, weight: np.ndarray | None = None, least_deviation: float = LEAST_DEVIATION
) -> LinearResponse:
    """Fit measured = mean(true) + offset + slope (true - mean(true)) by least squares.

    Parameters
    ----------
    measured, true : ndarray, shape (vector,)
        One component of the displacement.
    weight : ndarray, shape (vector,), optional
        Weights >= 0. Default: 1.
    least_deviation : float
        Standard deviation of `true` below which the slope is NaN.

    Examples
    --------
    >>> true = np.array([-1.0, 0.0, 1.0])
    >>> found = linear_response(0.8 * true + 0.1, true)
    >>> round(found.slope, 9), round(found.offset, 9)
    (0.8, 0.1)
    """
    measured, true = _numbers(measured, "measured"), _numbers(true, "true")
    weight = _weights(weight, len(true))
    total = weight.sum()
    if not total:
        return LinearResponse(slope=float("nan"), offset=float("nan"))
    centre, middle = (weight @ true) / total, (weight @ measured) / total
    fluctuation = true - centre
    variance = weight @ fluctuation**2 / total
    slope = float("nan")
    if variance > 0 and variance >= least_deviation**2:
        slope = float(weight @ (fluctuation * (measured - middle)) / total / variance)
    return LinearResponse(slope=slope, offset=float(middle - centre))


def uncertainty_calibration(
    error: np.ndarray, sigma: np.ndarray, weight: np.ndarray | None = None
) -> UncertaintyCalibration:
    """Compare errors with the standard deviations that were stated for them [1]_.

    Parameters
    ----------
    error, sigma : ndarray, shape (value,)
        Errors of single components, and their standard deviations. Where one is not finite, or sigma is not above 0,
        the value is left out.
    weight : ndarray, shape (value,), optional
        Weights >= 0. Default: 1.

    Returns
    -------
    UncertaintyCalibration
        NaN if no value remains.

    References
    ----------
    .. [1] A. Sciacchitano et al., "Collaborative framework for PIV uncertainty quantification: comparative assessment
           of methods", Meas. Sci. Technol. 26 (2015) 074004, doi:10.1088/0957-0233/26/7/074004.
    """
    error, sigma = np.asarray(error, float), np.asarray(sigma, float)
    if error.shape != sigma.shape or error.ndim != 1:
        raise ValueError(f"sigma: expected one per error, shape {error.shape}, got {sigma.shape}.")
    weight = _weights(weight, len(error))
    known = np.isfinite(error) & np.isfinite(sigma) & (sigma > 0) & (weight > 0)
    if not known.any():
        return UncertaintyCalibration(
            within_one=float("nan"), within_two=float("nan"), width=float("nan"), robust_width=float("nan")
        )
    score, weight = np.abs(error[known] / sigma[known]), weight[known]
    total = weight.sum()
    return UncertaintyCalibration(
        within_one=float(weight @ (score <= 1) / total),
        within_two=float(weight @ (score <= 2) / total),
        width=float(np.sqrt(weight @ score**2 / total)),
        robust_width=weighted_quantile(score, 0.5, weight) / _MEDIAN_OF_NORMAL,
    )


def weighted_quantile(values: np.ndarray, part: float, weight: np.ndarray | None = None) -> float:
    """Return the smallest value that at least `part` of the total weight does not exceed; NaN without weight."""
    values = _numbers(values, "values")
    weight = _weights(weight, len(values))
    order = np.argsort(values, kind="stable")
    summed = np.cumsum(weight[order])
    if not len(summed) or not summed[-1]:
        return float("nan")
    return float(values[order][np.searchsorted(summed, part * summed[-1] * (1 - 1e-12))])


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorCurve:
    """Errors over the part of a volume that is measured, from the best vectors to the worst; see `error_curve`."""

    part: np.ndarray
    """Part of the volume that vectors with errors up to `bound` stand for, increasing, shape (vector,)."""
    bound: np.ndarray
    """Length of the error, increasing, shape (vector,)."""
    mean: np.ndarray
    """Mean error of that part, shape (vector,)."""

    def bound_at(self, part: float) -> float:
        """Return the error that is not exceeded in a part of the volume; NaN if less is measured."""
        place = int(np.searchsorted(self.part, part - 1e-9))
        return float(self.bound[place]) if place < len(self.part) else float("nan")

    def mean_at(self, part: float) -> float:
        """Return the mean error of the best part of the volume; NaN if less is measured."""
        place = int(np.searchsorted(self.part, part - 1e-9))
        return float(self.mean[place]) if place < len(self.part) else float("nan")


def error_curve(length: np.ndarray, size: np.ndarray, total: float) -> ErrorCurve:
    """Order vectors by their true errors, and add up the parts of the volume that they stand for.

    The curve does not change where a method leaves out vectors whose errors are among the largest: it only ends
    earlier. So it compares methods that leave out different numbers of vectors at equal completeness.

    Parameters
    ----------
    length : ndarray, shape (vector,)
        Lengths of the errors.
    size : ndarray, shape (vector,)
        Size of the region that each vector stands for, >= 0; vectors of size 0 are left out.
    total : float
        Size of the whole volume, > 0.
    """
    length, size = _numbers(length, "length"), _weights(size, len(length))
    if not (np.isfinite(total) and total > 0):
        raise ValueError(f"total: expected a size > 0, got {total!r}.")
    order = np.argsort(length, kind="stable")
    order = order[size[order] > 0]
    summed = np.cumsum(size[order])
    mean = np.cumsum(size[order] * length[order]) / np.maximum(summed, 1e-300)
    return ErrorCurve(part=summed / total, bound=length[order], mean=mean)


def _numbers(values: np.ndarray, name: str) -> np.ndarray:
    values = np.asarray(values, float)
    if values.ndim != 1 or not np.isfinite(values).all():
        raise ValueError(f"{name}: expected finite numbers of shape (vector,), got shape {values.shape} or others.")
    return values


def _weights(weight: np.ndarray | None, count: int) -> np.ndarray:
    if weight is None:
        return np.ones(count)
    weight = np.asarray(weight, float)
    if weight.shape != (count,) or not np.isfinite(weight).all() or (weight < 0).any():
        raise ValueError(f"weight: expected {count} finite numbers >= 0, got shape {weight.shape} or others.")
    return weight
