"""Label the rays of the detected dots by Gaussian fits in sub-aperture views (section 3.1 (2) of the paper).

These labels are biased towards the lens centres because a dot is about as wide as a lens.
"""

from __future__ import annotations

import numpy as np

from lfpiv.calibration.board.dot_model import ZONES
from lfpiv.calibration.board.dots import Detection, DotBoard, Labels
from lfpiv.calibration.board.planes import Signals
from lfpiv.calibration.board.pupil_zones import PARTS
from lfpiv.geometry.optics import NEIGHBOURS, LensLattice, spread_over_pupil
from lfpiv.lightfield.decoder import LightFieldDecoder

_PUPIL_SHARE = 0.92  # views lie within this share of the pupil's radius, where pixels are fully lit
_NEIGHBOUR_PITCHES = 1.2  # lenses around a dot's brightest lens that a fit takes
_CLIMBS = 3  # steps from the expected lens to the brightest one
_BOARD_PERCENTILE = 75  # level of the board among the lenses around a dark dot
_FEWEST_VIEWS = 0.25  # share of the views in which a trusted dot is fitted
_FAINTEST_PEAK = 0.2  # of the typical peak
_LEAST_VALUE = 0.01  # of the peak, before the logarithm is taken


def label_by_gaussian(signals: Signals, decoder: LightFieldDecoder, board: DotBoard, detection: Detection) -> Labels:
    """Fit a Gaussian to the lenses around each dot in each view: the logarithms lie on a paraboloid [34].

    On a square array this is the three-point estimator of each axis. On a hexagonal array the paraboloid goes through
    all six neighbours.
    """
    lattice = decoder.lattice
    slope = detection.pose.rays(board.of_dots_mm(detection.dot))[1]
    views = spread_over_pupil(_PUPIL_SHARE * decoder.optics.pupil_radius_mm)
    expected = detection.chief_mm[:, None] + slope[:, None, None] * views
    label = np.full(expected.shape, np.nan)
    plane = detection.dot // board.size
    for p in np.unique(plane):
        label[plane == p] = _peaks_mm(signals.of_plane(p), decoder, detection.sign, expected[plane == p], views)

    miss = label - expected
    centre = np.nanmedian(np.where(np.isnan(miss).all(1, keepdims=True), 0, miss), axis=1)
    miss -= centre[:, None]
    label[np.hypot(miss[..., 0], miss[..., 1]) > lattice.pitch_mm] = np.nan
    good = ~np.isnan(label[..., 0])
    trusted = good.sum(1) >= int(_FEWEST_VIEWS * len(views))
    good &= trusted[:, None]
    std = np.sqrt(np.nanmean(np.where(good[..., None], miss**2, np.nan)[trusted], axis=(1, 2)))
    return Labels(
        pupil_mm=np.broadcast_to(views, label.shape)[good],
        array_mm=label[good],
        std_mm=np.repeat(std, good.sum(1)[trusted]),
        dot=np.repeat(detection.dot, good.sum(1)),
        rejected_dot=detection.dot[~trusted],
        measured_dot=detection.dot[trusted],
        chief_mm=(detection.chief_mm + centre)[trusted],
        slope=slope[trusted, None, None] * np.eye(2),
        reduced_chi2=np.full(trusted.sum(), np.nan),
        response_share=np.nan,
        diameter_mm=board.diameter_mm,
        blur_px=np.nan,
        left_over_mm=np.zeros((PARTS, ZONES, 2)),
        shared_error_mm=0.0,
    )


def _peaks_mm(
    signal: np.ndarray, decoder: LightFieldDecoder, sign: int, expected_mm: np.ndarray, views: np.ndarray
) -> np.ndarray:
    """Return the peak of each dot of one plane in each view (s, t) [mm], nan where none is, (dot, views, 2)."""
    lattice = decoder.lattice
    signal = np.nan_to_num(signal, nan=np.nanmax(signal))  # nan where saturated
    steps = _lens_steps(lattice)
    lens = lattice.nearest(expected_mm)
    for _ in range(_CLIMBS):
        values = sign * decoder.sample(signal, lens[:, :, None] + steps, views[:, None])
        lens = lens + steps[np.where(np.isnan(values), -np.inf, values).argmax(-1)]
    values = sign * decoder.sample(signal, lens[:, :, None] + steps, views[:, None])
    if sign < 0:  # a dark dot is a dip below the board
        values = values + np.nanpercentile(-values, _BOARD_PERCENTILE)
    peaks: np.ndarray = lattice.centres_mm(lens) + _gaussian_peak(values, steps) @ np.asarray(lattice.basis_mm)
    return peaks


def _lens_steps(lattice: LensLattice) -> np.ndarray:
    """Return the lattice steps to a lens itself, then to its neighbours, shape (n, 2)."""
    steps = np.vstack([(0, 0), NEIGHBOURS])
    near: np.ndarray = steps[
        np.hypot(*(steps @ np.asarray(lattice.basis_mm)).T) < _NEIGHBOUR_PITCHES * lattice.pitch_mm
    ]
    return near


def _gaussian_peak(values: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the peak of the paraboloid through the logarithms of the values around a lens [lattice steps], or nan."""
    a, b = steps.T.astype(float)
    columns = [np.ones(len(a)), a, b, a * a, b * b] + ([a * b] if len(steps) > 5 else [])
    solve = np.linalg.pinv(np.stack(columns, axis=1))
    peak = values[..., :1]
    with np.errstate(invalid="ignore", divide="ignore"):
        bright = peak > _FAINTEST_PEAK * np.nanmedian(peak)
        c = np.moveaxis(np.log(np.maximum(values, _LEAST_VALUE * peak)) @ solve.T, -1, 0)
        cross = c[5] if len(c) > 5 else np.zeros_like(c[0])
        determinant = 4 * c[3] * c[4] - cross**2
        shift = np.stack([cross * c[2] - 2 * c[4] * c[1], cross * c[1] - 2 * c[3] * c[2]], -1) / determinant[..., None]
        good = bright[..., 0] & (determinant > 0) & (c[3] < 0) & (np.abs(shift) <= 1).all(-1)
    return np.where(good[..., None], shift, np.nan)
