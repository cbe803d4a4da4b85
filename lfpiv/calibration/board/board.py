"""Calibration boards: the dots of one camera in all planes, named, and their rays labelled for the calibration."""

from __future__ import annotations

import abc
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from lfpiv.calibration.board.detect import DotBoard, find_dots
from lfpiv.calibration.board.label import Labels, label_by_integral
from lfpiv.calibration.board.label_gaussian import label_by_gaussian
from lfpiv.errors import InputError
from lfpiv.geometry.optics import Optics
from lfpiv.lightfield.decoder import LightFieldDecoder

__all__ = ["ESTIMATORS", "BoardDots", "DotBoard", "Planes", "agreeing_dots", "measure_board"]

log = logging.getLogger(__name__)

OUTLIER, OUTLIER_PITCH = 6.0, 0.1
"""A dot is left out where its labels disagree with its neighbours by more than this many times the typical
disagreement, and by more than this fraction of the microlens pitch: wrongly named or damaged."""
NEIGHBOURS = 16
"""Neighbouring dots, in space, that a dot is compared with."""
FEW_ACROSS_PX = 7.0
"""Diameter of microimages below which dots in focus may light too few pixels for the integrated model [pixel]."""
HELD_BYTES = 16
"""What a sensor's pixel may take in the planes' images together; planes beyond that are read anew when needed."""

_SATURATED_PIXELS = 10  # so many pixels at the very same highest value are taken for saturated,
_SATURATED_SIGMA = 20.0  # if they are this far above the dark level

ESTIMATORS = ("lens_integral", "gaussian")
"""The integrated dot model on raw pixels, and the paper's Gaussian fit in sub-aperture views."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BoardDots:
    """Labelled rays of the dots of one camera, for the calibration, and the dots themselves, for the report.

    Dot numbers count over all planes: plane * (nx ny) + row * nx + column.
    """

    points_mm: np.ndarray
    """Board position (x, y, z) of each label's dot [mm], shape (n, 3)."""
    pupil_mm: np.ndarray
    """Pupil point (u, v) of each label [mm], shape (n, 2)."""
    array_mm: np.ndarray
    """Where that ray meets the microlens array, (s, t) [mm], shape (n, 2)."""
    std_mm: np.ndarray
    """Standard error of a label, per coordinate [mm], shape (n,)."""
    dot: np.ndarray
    """Number of each label's dot, shape (n,)."""
    found: np.ndarray
    """Dots measured in each plane, shape (plane,)."""
    expected: np.ndarray
    """Dots of each plane in the camera's field, shape (plane,)."""
    rejected: np.ndarray
    """Dots of each plane that were seen but not trusted, shape (plane,)."""
    rejected_dot: np.ndarray
    """Numbers of the dots that were seen but not trusted, shape (r,)."""
    measured_dot: np.ndarray
    """Numbers of the measured dots, shape (d,)."""
    chief_mm: np.ndarray
    """Where their rays through the pupil's centre meet the array [mm], shape (d, 2)."""
    slope: np.ndarray
    """Their slopes d(s, t)/d(u, v), shape (d, 2, 2)."""
    reduced_chi2: np.ndarray
    """Quality of their fits, about 1; nan for the Gaussian estimator, shape (d,)."""
    response_share: float
    """Part of the white image's scatter from pixel to pixel that is pixel response, the rest being its noise; see
    `LightFieldDecoder.shrunk_gain`. nan for the Gaussian estimator."""
    diameter_mm: float
    """Diameter of the dots as they look [mm]; the board's for the Gaussian estimator."""
    blur_px: float
    """Blur of the sensor and the microlenses, standard deviation [pixel]; nan for the Gaussian estimator."""

    def outlines_px(self, optics: Optics, points: int = 48) -> np.ndarray:
        """Outline of each measured dot's light on the sensor as (column, row) [pixel], shape (d, points, 2)."""
        angle = np.linspace(0, 2 * np.pi, points, endpoint=False)
        rim = optics.pupil_radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        on_array = self.chief_mm[:, None] + np.einsum("dab,pb->dpa", self.slope, rim)
        return optics.sensor_px(on_array + (on_array - rim) * optics.sensor_per_pupil)


def measure_board(
    images: Sequence[np.ndarray],
    decoder: LightFieldDecoder,
    board: DotBoard,
    *,
    nominal_angle_deg: float,
    estimator: str = "lens_integral",
    dark: np.ndarray | None = None,
) -> BoardDots:
    """Find, name and label the dots of one camera in all planes of its board.

    Parameters
    ----------
    images : sequence of ndarray, shape (rows, columns)
        Raw image of each plane [counts], dark level and all; dots brighter or darker than the board.
    decoder : LightFieldDecoder
        The camera's decoder.
    board : DotBoard
        The board and the depths of its planes.
    nominal_angle_deg : float
        Planned camera angle alpha (Eqs. 1-3) [degree], right to about 10 degrees.
    estimator : {"lens_integral", "gaussian"}
        "lens_integral" fits each dot to all its raw pixels, integrated over the microlenses. "gaussian" fits a Gaussian
        to the few lenses around the dot in each sub-aperture view (section 3.1 (2) of the paper), which is biased
        towards the lens centres because a dot is hardly wider than a lens.
    dark : ndarray, shape (rows, columns), optional
        Image with the lens capped [counts]. Saturation is told before it is subtracted: afterwards saturated pixels
        scatter as the dark image does.

    Raises
    ------
    InputError
        If the images do not match the board or the camera, or no plane shows the board's dots.
    ValueError
        If `estimator` is unknown, or the angle is not finite.
    """
    if estimator not in ESTIMATORS:
        raise ValueError(f"estimator: expected one of {', '.join(map(repr, ESTIMATORS))}, got {estimator!r}.")
    if not math.isfinite(nominal_angle_deg):
        raise ValueError(f"nominal_angle_deg: expected a finite angle [degree], got {nominal_angle_deg}.")
    if len(images) != len(board.planes_mm):
        raise InputError(f"images: expected one per plane, {len(board.planes_mm)}, got {len(images)}.")
    signals = _Signals(images, decoder, dark)
    with threadpool_limits(1, user_api="blas"):  # on matrices this small threads only get in each other's way
        detection = find_dots(signals, decoder, board, nominal_angle_deg)
        if estimator == "gaussian":
            labels = label_by_gaussian(signals, decoder, board, detection)
        else:
            try:
                labels = label_by_integral(signals, signals.noise, decoder, board, detection)
            except InputError as error:
                raise InputError(f"{error}{few_pixels(decoder.optics)}") from None
    return _collect(labels, board, detection.in_field)


def few_pixels(optics: Optics) -> str:
    """Say, to end a message about missing dots, what to do where microimages are small; empty where they are not."""
    across = 2 * optics.pupil_radius_mm / optics.pupil_pixel_mm
    if across >= FEW_ACROSS_PX:
        return ""
    return (
        f" Microimages of {across:.1f} pixels across leave the dots few pixels to be fitted to: set "
        'network.estimator = "gaussian".'
    )


class _OfPlanes(Sequence[np.ndarray], abc.ABC):
    """Images of the board's planes, each made by `_image` when it is asked for."""

    @overload
    def __getitem__(self, plane: int) -> np.ndarray: ...
    @overload
    def __getitem__(self, plane: slice) -> Sequence[np.ndarray]: ...
    def __getitem__(self, plane: int | slice) -> np.ndarray | Sequence[np.ndarray]:
        if isinstance(plane, slice):
            return [self[n] for n in range(*plane.indices(len(self)))]
        return self._image(plane)

    @abc.abstractmethod
    def _image(self, plane: int) -> np.ndarray: ...


class Planes(_OfPlanes):
    """Images read when they are asked for; whole counts of the first ones are held, as many as `HELD_BYTES` allow."""

    def __init__(self, read: Callable[[int], np.ndarray], count: int):
        self._read, self._count = read, count
        self._held: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return self._count

    def _image(self, plane: int) -> np.ndarray:
        if not 0 <= plane < self._count:
            raise IndexError(plane)
        if plane not in self._held:
            image = self._read(plane)
            if image.min() < 0 or image.max() > np.iinfo(np.uint16).max:
                return image
            counts = image.astype(np.uint16)
            if (len(self._held) + 1) * counts.itemsize > HELD_BYTES or not np.array_equal(counts, image):
                return image
            self._held[plane] = counts
        return self._held[plane]


class _Signals(_OfPlanes):
    """The planes' images above their dark levels, nan where saturated; only the last one asked for is kept as float."""

    def __init__(self, images: Sequence[np.ndarray], decoder: LightFieldDecoder, dark: np.ndarray | None):
        self._images, self._dark = images, dark
        self._plane, self._signal = -1, np.empty((0, 0), np.float32)
        shape = tuple(decoder.optics.sensor_shape)
        if dark is not None and np.shape(dark) != shape:
            raise InputError(f"dark: expected an image of shape {shape}, got {np.shape(dark)}.")
        levels = []
        for plane, image in enumerate(images):
            if np.shape(image) != shape:
                raise InputError(
                    f"plane {plane} of the board: expected an image of shape {shape}, got {np.shape(image)}."
                )
            bad = np.size(image) - np.count_nonzero(np.isfinite(image))
            if bad:
                raise InputError(f"plane {plane} of the board: expected finite counts, got {bad} pixels that are not.")
            levels.append(decoder.background(self._undarkened(image)))
        self._levels = levels
        self.noise = float(np.median([sigma for _, sigma in levels]))

    def __len__(self) -> int:
        return len(self._images)

    def _image(self, plane: int) -> np.ndarray:
        if plane != self._plane:
            image = np.asarray(self._images[plane])
            level, sigma = self._levels[plane]
            signal = self._undarkened(image)
            signal -= np.float32(level)
            top = image == image.max()  # of the raw image, where all saturated pixels are alike
            if np.count_nonzero(top) >= _SATURATED_PIXELS and np.median(signal[top]) > _SATURATED_SIGMA * sigma:
                signal[top] = np.nan
            self._plane, self._signal = plane, signal
        return self._signal

    def _undarkened(self, image: np.ndarray) -> np.ndarray:
        """Copy of an image without the dark one [counts], float32."""
        light = np.array(image, np.float32)
        if self._dark is not None:
            light -= self._dark
        return light


def agreeing_dots(dots: BoardDots, departure_mm: np.ndarray, pitch_mm: float) -> np.ndarray:
    """Labels of the dots that agree with their neighbours: bool, shape (n,).

    `departure_mm` (n, 2) is each label's distance from a fitted thin lens. Real optics depart from that smoothly, so
    each dot's mean departure is compared with the median of its neighbours' in space.
    """
    number, first, inverse = np.unique(dots.dot, return_index=True, return_inverse=True)
    count = np.bincount(inverse)
    mean = np.stack([np.bincount(inverse, weights=column) / count for column in departure_mm.T], axis=1)
    _, neighbour = cKDTree(dots.points_mm[first]).query(dots.points_mm[first], k=min(NEIGHBOURS + 1, len(number)))
    misfit = np.linalg.norm(mean - np.median(mean[neighbour[:, 1:]], axis=1), axis=1)
    bad = misfit > max(OUTLIER * 1.4826 * float(np.median(misfit)), OUTLIER_PITCH * pitch_mm)
    if bad.any():
        log.info("%d dots disagree with their neighbours and are left out: %s", bad.sum(), number[bad].tolist())
    good: np.ndarray = ~bad[inverse]
    return good


def _collect(labels: Labels, board: DotBoard, in_field: np.ndarray) -> BoardDots:
    planes = len(board.planes_mm)
    found = np.bincount(labels.measured_dot // board.size, minlength=planes)
    visible = in_field.copy()
    visible.ravel()[labels.measured_dot] = True
    dots = BoardDots(
        points_mm=board.of_dots_mm(labels.dot),
        found=found,
        expected=visible.sum(1),
        rejected=np.bincount(labels.rejected_dot // board.size, minlength=planes),
        **vars(labels),
    )
    log.info("board: %d of %d dots measured, %d rejected", found.sum(), dots.expected.sum(), dots.rejected.sum())
    return dots
