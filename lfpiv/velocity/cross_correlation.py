"""`correlate`: two particle volumes to a displacement field by multi-pass 3D cross-correlation.

Each pass correlates windows of both volumes, validates the peaks, and hands its field to the next pass, which deforms
both volumes by half of it, one back and one forth, before it correlates again. Displacements are means over the window.
"""

from __future__ import annotations

import enum
import json
import logging
import math
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import scipy.ndimage
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.geometry.volume import is_finite
from lfpiv.velocity import validation
from lfpiv.velocity.predictor import Predictor
from lfpiv.velocity.volume_pair import moves_beyond, prepared, seen, voxel_axes
from lfpiv_kernels.correlation import correlate as kernel
from lfpiv_kernels.correlation import deform
from lfpiv_kernels.correlation.uncertainty import displacement_deviation

log = logging.getLogger(__name__)

COARSE_OVERLAP = 0.75
"""Overlap of all passes but the last: large windows that overlap by half lie too far apart for their neighbours to
judge them in a curved field."""
DEFAULT_WINDOWS = (32, 16, 12, 12)
"""Window edges [voxel] of the passes where none are given, cut to the volume along each axis."""
REFINE_SEARCH = 3
"""Largest lag of the passes after the first [voxel]; what the predictor leaves is found up to 2.5 voxels."""
FIRST_SEARCH = 0.25
"""Largest displacement of the first pass, as a part of its window, where none is given (the one-quarter rule)."""
LOWEST_RIVAL = 0.01
"""Coefficient that stands for lower ones in the peak ratio, which is then finite."""


class Verdict(enum.Enum):
    """What the valid part of the last pass says about the measurement; the text is the advice."""

    GOOD = "most vectors are valid"
    POOR = (
        "many vectors were replaced: use larger windows, or look at the seeding, at the volumes, and whether particles "
        "move as far as is searched (correlation.max_displacement_voxel, by default a quarter of the first window)"
    )
    FAILED = "hardly any vector is valid: check that both volumes show the same particles and that displacements fit"
    TOO_FAR = (
        "particles move farther than is searched, so that valid vectors may be chance: raise "
        "correlation.max_displacement_voxel, use a larger first window, or a shorter dt_s"
    )


def correlate(
    volume_a: xr.DataArray | np.ndarray,
    volume_b: xr.DataArray | np.ndarray,
    *,
    dt_s: float,
    windows: Sequence[int | Sequence[int]] | None = None,
    overlap: float = 0.5,
    voxel_mm: float | None = None,
    max_displacement_voxel: float | None = None,
    smoothing_voxel: float = 0.0,
    intensity_power: float = 1.0,
) -> xr.Dataset:
    """Measure the displacement of the particles between two volumes.

    Windows of the first pass are correlated over a wide range of lags, those of later passes around the field of the
    pass before, by which both volumes are deformed (`lfpiv_kernels.correlation.deform`). Peaks are located by a three-point
    Gaussian fit and validated by the normalised median test; where a vector fails it, the second peak is taken if that
    passes, else what the neighbours predict. With more than one pass nothing distinguishes the two volumes: swapping
    them negates the result. A single pass takes windows of the first volume only: twice as fast, less accurate.

    Parameters
    ----------
    volume_a, volume_b : DataArray or ndarray, shape (z, y, x)
        Intensities at the first and the second instant; finite, of any sign. Either two DataArrays, which
        carry coordinates z, y, x [mm], or two arrays.
    dt_s : float
        Time between the two [s].
    windows : sequence, optional
        Window of each pass [voxel], one edge, cut to the volume where it is larger, or (z, y, x). The last one sets the
        vector grid, all others overlap by at least `COARSE_OVERLAP`; name one twice to iterate.
        Default: `DEFAULT_WINDOWS`, cut to the volume.
    overlap : float
        Part of a window shared with its neighbour, 0 <= overlap < 1.
    voxel_mm : float, optional
        Voxel edge [mm]; needed for ndarrays, whose first voxel is then centred at 0, and only for them.
    max_displacement_voxel : float, optional
        Largest displacement the first pass looks for along each axis [voxel]. Default: a quarter of its window.
    smoothing_voxel : float
        Standard deviation of a Gaussian applied to both volumes first [voxel]; 0: none. For particles that are single
        bright voxels, about 0.5; it widens larger ones, so that more ghosts meet (blobs of 0.7 voxel: a quarter more
        error). What `reconstruct` made of Gaussians is as smooth already: volumes that say so, by their attribute
        ``sieve_voxel``, are only smoothed by what is missing, sqrt(smoothing_voxel^2 - sieve_voxel^2).
    intensity_power : float
        Power of the smoothed intensities that is correlated, negative ones taken as 0; 1: as they are. Below 1 a few
        bright particles, and the ghosts they cast, no longer outweigh the others: 0.5 lowered the error of
        reconstructed volumes by a fifth on every flow tried (docs/accuracy.md).

    Returns
    -------
    Dataset
        Dims z, y, x: window centres [mm]. ``u``, ``v``, ``w`` [m/s] and ``displacement_x``, ``_y``, ``_z`` [voxel]:
        means over the window, finite unless no vector at all is valid; ``valid``: true where the vector was measured
        and passed validation, false where it was replaced, as it is where two cameras see less than three quarters of
        the window, if volumes say so by their coordinate ``views``; ``peak_ratio``: highest correlation over the
        highest more than two lags away from it;
        ``correlation``: coefficient at the peak; ``uncertainty`` [voxel]: standard deviation of the displacement
        vector (root of the summed variances of its components ``uncertainty_x``, ``_y``, ``_z``), from the correlation
        statistics of [1]_, NaN where the vector was replaced and after a single pass. Attributes: a verdict,
        ``valid_fraction`` and ``seen_fraction``, the parts of the vectors that are valid and where two cameras see
        enough, and as JSON the settings and what each pass did.

    Raises
    ------
    ValueError
        If the volumes differ in kind, shape or coordinates, are not finite, or an argument is out of range.

    References
    ----------
    .. [1] B. Wieneke, "PIV uncertainty quantification from correlation statistics", Meas. Sci. Technol. 26 (2015)
       074002, doi:10.1088/0957-0233/26/7/074002.
    """
    first, second = prepared(volume_a, "volume_a"), prepared(volume_b, "volume_b")
    axes_mm, spacing_mm = voxel_axes(volume_a, volume_b, voxel_mm)
    if not (is_finite(dt_s) and dt_s > 0):
        raise ValueError(f"dt_s: expected a positive time [s], got {dt_s!r}.")
    if not (is_finite(overlap) and 0 <= overlap < 1):
        raise ValueError(f"overlap: expected 0 <= overlap < 1, got {overlap!r}.")
    if not (is_finite(smoothing_voxel) and smoothing_voxel >= 0):
        raise ValueError(f"smoothing_voxel: expected a value >= 0, got {smoothing_voxel!r}.")
    if not (is_finite(intensity_power) and intensity_power > 0):
        raise ValueError(f"intensity_power: expected a value > 0, got {intensity_power!r}.")
    schedule = _check_windows(windows, first.shape)
    search = first_search = _first_search(max_displacement_voxel, schedule[0], first.shape)
    missing = missing_smoothing(smoothing_voxel, volume_a, volume_b)
    first, second = (emphasise(volume, missing, intensity_power) for volume in (first, second))
    multi_pass = _MultiPass(first, second, symmetric=len(schedule) > 1)
    for window in schedule[:-1]:
        multi_pass.run(window, max(overlap, COARSE_OVERLAP), search)
        search = (REFINE_SEARCH,) * 3
    multi_pass.run(schedule[-1], overlap, search, seen=seen(volume_a, volume_b))
    settings = {
        "windows": [list(window) for window in schedule],
        "overlap": overlap,
        "max_displacement_voxel": max_displacement_voxel,
        "smoothing_voxel": smoothing_voxel,
        "intensity_power": intensity_power,
    }
    share = float(multi_pass.valid[multi_pass.seen].mean()) if multi_pass.seen.any() else 0.0
    verdict = Verdict.GOOD if share >= 0.8 else Verdict.POOR if share >= 0.3 else Verdict.FAILED
    if verdict is not Verdict.GOOD:
        if moves_beyond(first, second, first_search):
            verdict = Verdict.TOO_FAR
        log.warning("correlation: %.0f %% of the vectors are valid; %s", 100 * share, verdict.value)
    return _dataset(multi_pass, axes_mm, spacing_mm, dt_s, verdict, settings)


class _MultiPass:
    """The field after each pass, order (z, y, x) [voxel], and what the next pass needs of it."""

    field: np.ndarray
    """Displacements of the last pass, shape (z, y, x, 3)."""
    valid: np.ndarray
    """Where they are measured, shape (z, y, x)."""
    guess: np.ndarray
    """What the next pass starts from."""
    peaks: kernel.WindowPeaks
    """Correlation peaks of the last pass."""
    seen: np.ndarray
    """Which of its windows enough cameras see, shape (z, y, x)."""

    def __init__(self, first: np.ndarray, second: np.ndarray, *, symmetric: bool):
        self.volumes, self.symmetric = (first, second), symmetric
        self.centres: list[np.ndarray] = []
        self.passes: list[dict[str, Any]] = []

    @cached_property
    def coefficients(self) -> tuple[np.ndarray, np.ndarray]:
        """Both volumes as splines, which deformed volumes are sampled from."""
        first, second = self.volumes
        return deform.spline_coefficients(first), deform.spline_coefficients(second)

    def run(
        self,
        window: tuple[int, int, int],
        overlap: float,
        search: tuple[int, int, int],
        seen: np.ndarray | None = None,
    ) -> None:
        """Deform by the field so far, correlate, validate; windows that hold too little of what is `seen` fail."""
        shape = self.volumes[0].shape
        step = _triple(max(1, round(edge * (1 - overlap))) for edge in window)
        origin, count = kernel.window_grid(shape, window, step)
        centres = [o + (w - 1) / 2 + s * np.arange(n) for o, w, s, n in zip(origin, window, step, count, strict=True)]
        first, second, predicted = *self.volumes, np.zeros(3)
        if self.passes:
            predictor = Predictor(self.guess, self.centres, shape)
            first, second = deform.deform_pair(*self.coefficients, predictor.field, predictor.spacing)
            predicted = predictor.window_means(origin, step, count, window)
            centres = [centre + deform.OFFSET for centre in centres]
        self.peaks = kernel.correlate_windows(
            first, second, window=window, step=step, search=search, symmetric=self.symmetric
        )
        self.seen = np.ones(count, bool)
        if seen is not None:
            self.seen = validation.seen_windows(seen, window, origin, step, count)
        self.field, self.valid = validation.validate(
            self.peaks.displacement + predicted,
            self.peaks.second_displacement + predicted,
            self.peaks.measured,
            search,
            seen=self.seen,
            predicted=predicted if self.passes and overlap < COARSE_OVERLAP else None,
            peak_ratio=self.peaks.correlation / np.maximum(self.peaks.rival, LOWEST_RIVAL),
        )
        # without any valid vector what was known before is the best guess
        self.guess = self.field if self.valid.any() else np.broadcast_to(predicted, self.field.shape)
        self.centres, self.deformed, self.layout = centres, (first, second), (window, origin, step, count)
        left = np.linalg.norm((self.field - predicted)[self.valid], axis=-1)
        self.passes.append(
            {
                "window": list(window),
                "search": list(search),
                "vectors": self.valid.size,
                "valid": round(float(self.valid.mean()), 4),
                "median_correlation": round(float(np.median(self.peaks.correlation)), 4),
                "median_step_voxel": round(float(np.median(left)), 4) if left.size else None,
            }
        )
        log.debug("correlation pass %d: %s", len(self.passes), self.passes[-1])


def _dataset(
    result: _MultiPass,
    axes_mm: list[np.ndarray],
    spacing_mm: tuple[float, float, float],
    dt_s: float,
    verdict: Verdict,
    settings: dict[str, Any],
) -> xr.Dataset:
    """Put the last pass into the form of the product, with units and its verdict."""
    deviation = np.full(result.field.shape, np.nan)
    if len(result.passes) > 1:  # the statistics need volumes that were deformed onto each other
        window, origin, step, count = result.layout
        deviation = displacement_deviation(*result.deformed, window=window, origin=origin, step=step, count=count)
        deviation[~result.valid] = np.nan
    rival = np.maximum(result.peaks.rival, LOWEST_RIVAL)
    ratio = np.where(result.peaks.correlation > 0, result.peaks.correlation / rival, np.nan)
    dims = AXES
    variables: dict[str, tuple[tuple[str, ...], np.ndarray, dict[str, str]]] = {}
    for k, (name, axis) in enumerate(zip("wvu", AXES, strict=True)):
        metres = spacing_mm[k] * 1e-3
        velocity = result.field[..., k] * metres / dt_s
        variables[name] = (dims, velocity, {"units": "m/s", "long_name": f"velocity along {axis}"})
        attributes = {"units": "voxel", "long_name": f"displacement along {axis}, mean over the window"}
        variables[f"displacement_{axis}"] = (dims, result.field[..., k], attributes)
        attributes = {"units": "voxel", "long_name": f"standard deviation of the displacement along {axis}"}
        variables[f"uncertainty_{axis}"] = (dims, deviation[..., k], attributes)
    total = np.sqrt((deviation**2).sum(-1))
    attributes = {
        "units": "voxel",
        "long_name": "standard deviation of the displacement vector, correlation statistics",
    }
    variables["uncertainty"] = (dims, total, attributes)
    variables = {name: (d, values.astype(np.float32), a) for name, (d, values, a) in variables.items()}
    ratio_name = "highest correlation over the highest more than two lags away"
    variables["peak_ratio"] = (dims, ratio.astype(np.float32), {"units": "1", "long_name": ratio_name})
    coefficient = {"units": "1", "long_name": "correlation coefficient at the peak"}
    variables["correlation"] = (dims, result.peaks.correlation, coefficient)
    variables["valid"] = (dims, result.valid, {"long_name": "measured and passed validation; false: replaced"})
    places = {}
    for axis, centres, positions in zip(AXES, result.centres, axes_mm, strict=True):
        distance = (positions[-1] - positions[0]) / max(len(positions) - 1, 1)
        attributes = {"units": "mm", "long_name": "centre of the window"}
        places[axis] = (axis, positions[0] + distance * centres, attributes)
    summary = {
        "title": "displacement and velocity of particles between two volumes",
        "dt_s": float(dt_s),
        "voxel_mm": [float(s) for s in spacing_mm],
        "valid_fraction": float(result.valid.mean()),
        "seen_fraction": float(result.seen.mean()),
        "verdict": verdict.value,
        "settings": json.dumps(settings),
        "passes": json.dumps(result.passes),
    }
    return xr.Dataset(variables, places, summary)


def missing_smoothing(smoothing_voxel: float, *volumes: xr.DataArray | np.ndarray) -> float:
    """Return what volumes lack of a smoothing [voxel]: those made of Gaussians, ``sieve_voxel``, are as smooth."""
    sieve = min(
        float(volume.attrs.get("sieve_voxel", 0.0)) if isinstance(volume, xr.DataArray) else 0.0 for volume in volumes
    )
    return math.sqrt(max(smoothing_voxel**2 - sieve**2, 0.0)) if sieve > 0 else smoothing_voxel


def emphasise(volume: np.ndarray, smoothing_voxel: float, intensity_power: float) -> np.ndarray:
    """Return a volume without background, shape (z, y, x), float32, as it is compared: smoothed, to a power."""
    if smoothing_voxel > 0:
        volume = scipy.ndimage.gaussian_filter(volume, smoothing_voxel, mode="constant")
    return volume if intensity_power == 1 else np.maximum(volume, 0) ** np.float32(intensity_power)


def _check_windows(windows: Sequence[Any] | None, shape: tuple[int, int, int]) -> list[tuple[int, int, int]]:
    """Window of each pass as (z, y, x)."""
    if windows is None:
        return [_triple(min(edge, n) for n in shape) for edge in DEFAULT_WINDOWS]
    if isinstance(windows, (int, float, str)):
        raise ValueError(f"windows: expected a sequence, one window per pass, got {windows!r}.")
    schedule = []
    for window in windows:
        given = tuple(window) if np.ndim(window) else (window,) * 3
        if len(given) != 3 or not all(is_finite(edge) and int(edge) == edge and edge >= 4 for edge in given):
            raise ValueError(f"windows: expected edges of whole voxels >= 4, one or (z, y, x) per pass, got {window}.")
        edges = _triple(int(edge) for edge in given)
        too_large = [(axis, edge, n) for axis, edge, n in zip(AXES, edges, shape, strict=True) if edge > n]
        if too_large and np.ndim(window):
            axis, edge, n = too_large[0]
            raise ValueError(
                f"windows: expected edges within the volume, got {edge} along {axis}, which has {n} voxels. "
                "Use a smaller window, or a single edge, which is cut to the volume."
            )
        if too_large:
            log.info("window %d is cut to the volume %s", edges[0], shape)
            edges = _triple(min(edge, n) for edge, n in zip(edges, shape, strict=True))
        schedule.append(edges)
    if not schedule:
        raise ValueError("windows: expected at least one pass, got none.")
    return schedule


def _first_search(
    max_displacement_voxel: float | None, window: tuple[int, int, int], shape: tuple[int, int, int]
) -> tuple[int, int, int]:
    """Largest lag of the first pass: a peak needs one lag beyond it."""
    if max_displacement_voxel is None:
        return _triple(max(REFINE_SEARCH, math.ceil(FIRST_SEARCH * edge) + 1) for edge in window)
    if not (is_finite(max_displacement_voxel) and 0 < max_displacement_voxel < max(shape)):
        raise ValueError(
            f"max_displacement_voxel: expected a value > 0 and within the volume {shape}, got {max_displacement_voxel}."
        )
    return _triple(min(max(REFINE_SEARCH, math.ceil(max_displacement_voxel) + 1), max(2, n - 1)) for n in shape)


def _triple(values: Iterable[int]) -> tuple[int, int, int]:
    """Values along z, y, x as a tuple."""
    z, y, x = values
    return z, y, x
