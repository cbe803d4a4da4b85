"""Label the rays of detected dots by Gaussian fits in sub-aperture views, as the paper does."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from lfpiv.calibration.board.detect import Detection, DotBoard
from lfpiv.calibration.board.dot_model import spread_over_pupil
from lfpiv.calibration.board.label import Labels
from lfpiv.lightfield.decoder import LightFieldDecoder

_PUPIL_PART = 0.92  # views stay this far inside the pupil's edge, where pixels are wholly lit


def label_by_gaussian(
    signals: Sequence[np.ndarray], decoder: LightFieldDecoder, board: DotBoard, detection: Detection
) -> Labels:
    """Fit a Gaussian to the lenses around each dot in each view: their logarithms lie on a paraboloid [34].

    On a square array these are the three-point estimators of the two axes; on a hexagonal one the paraboloid goes
    through all six neighbours.
    """
    optics, lattice = decoder.optics, decoder.lattice
    steps = np.array([(0, 0)] + [s for s in itertools.product((-1, 0, 1), repeat=2) if any(s)])
    steps = steps[np.hypot(*(steps @ np.asarray(lattice.basis_mm)).T) < 1.2 * lattice.pitch_mm]
    a, b = steps.T.astype(float)
    columns = [np.ones(len(a)), a, b, a * a, b * b] + ([a * b] if len(steps) > 5 else [])
    solve = np.linalg.pinv(np.stack(columns, axis=1))
    slope = detection.pose.rays(board.of_dots_mm(detection.dot))[1]
    views = spread_over_pupil(_PUPIL_PART * optics.pupil_radius_mm)
    expected = detection.chief_mm[:, None] + slope[:, None, None] * views
    label = np.full(expected.shape, np.nan)
    for plane in np.unique(detection.dot // board.size):
        mine = detection.dot // board.size == plane
        signal = np.nan_to_num(signals[plane], nan=np.nanmax(signals[plane]))  # nan where saturated
        lens = lattice.nearest(expected[mine])
        for _ in range(3):  # the last values are those around the brightest lens
            values = detection.sign * decoder.sample(signal, lens[:, :, None] + steps, views[:, None])
            lens = lens + steps[np.where(np.isnan(values), -np.inf, values).argmax(-1)]
        values = detection.sign * decoder.sample(signal, lens[:, :, None] + steps, views[:, None])
        if detection.sign < 0:  # a dark dot is a dip below the board
            values = values + np.nanpercentile(-values, 75)
        label[mine] = lattice.centres_mm(lens) + _gaussian_peak(values, solve) @ np.asarray(lattice.basis_mm)

    miss = label - expected
    centre = np.nanmedian(np.where(np.isnan(miss).all(1, keepdims=True), 0, miss), axis=1)
    miss -= centre[:, None]
    label[np.hypot(miss[..., 0], miss[..., 1]) > lattice.pitch_mm] = np.nan
    good = ~np.isnan(label[..., 0])
    trusted = good.sum(1) >= len(views) // 4
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
    )


def _gaussian_peak(values: np.ndarray, solve: np.ndarray) -> np.ndarray:
    """Peak of the paraboloid through the logarithms of the values around a lens [lattice steps]; nan where none is."""
    peak = values[..., :1]
    with np.errstate(invalid="ignore", divide="ignore"):
        bright = peak > 0.2 * np.nanmedian(peak)
        c = np.moveaxis(np.log(np.maximum(values, 0.01 * peak)) @ solve.T, -1, 0)
        cross = c[5] if len(c) > 5 else np.zeros_like(c[0])
        determinant = 4 * c[3] * c[4] - cross**2
        shift = np.stack([cross * c[2] - 2 * c[4] * c[1], cross * c[1] - 2 * c[3] * c[2]], -1) / determinant[..., None]
        good = bright[..., 0] & (determinant > 0) & (c[3] < 0) & (np.abs(shift) <= 1).all(-1)
    return np.where(good[..., None], shift, np.nan)
