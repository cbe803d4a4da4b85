"""Images of an experiment as recorded, and what lfpiv sees in them: lattice, dots, pupil views, refocused planes.

Overlays are in pixels (column, row) of the recorded picture, before `image_flip` is undone.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy  # loads its parts where they are used

import lfpiv
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.images import FLIPS
from lfpiv.geometry.optics import spread_over_pupil
from lfpiv.lightfield.decoder import NORMAL_MAD
from lfpiv.lightfield.saturation import saturated_pixels
from lfpiv.results.folder import Folder

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

HOT_SIGMA, HOT_RATIO = 12.0, 5.0
"""Least height of a hot pixel: in standard deviations of the noise, and over the height of its highest neighbour."""
KEPT_IMAGES = 3
"""Images, and what is seen in them, that are kept."""
MOST_LISTED = 1000  # frames of particles
ARROW_GAIN = 50.0
"""Factor by which residuals of dots are drawn longer than they are."""
REFOCUSED = 100
"""Places along the longer side of a refocused plane."""
PUPIL_POINTS = 19
"""Points of the pupil whose views are summed into a refocused plane."""


class RawImages:
    """The images of an experiment, of which the last are kept, and its cameras, calibrated by a run or nominal."""

    def __init__(self, experiment: Experiment, results: Path | None = None) -> None:
        self.experiment, self.results = experiment, results
        self.cameras: dict[str, CalibratedCamera] = {}
        self.measured = False  # whether the cameras are calibrated
        self._lock = threading.Lock()
        self.read, self._signal, self._views = (
            lru_cache(KEPT_IMAGES)(call) for call in (self._read, self._above_dark, self._pupil_views)
        )
        self._lens_grid = cache(lambda camera: self.calibrated(camera).decoder.lens_grid())

    def _readers(self, camera: str) -> dict[str, Callable[[], np.ndarray | None]]:
        """Return what reads each image of a camera: white, dark, plane N, background F, and frames or instants."""
        e, setup = self.experiment, self.experiment.camera(camera)
        found: dict[str, Callable[[], np.ndarray | None]] = {"white": partial(e.white, camera)}
        if setup.dark_path:
            found["dark"] = partial(e.dark, camera)
        found |= {f"plane {plane}": partial(e.board_image, camera, plane) for plane in range(len(e.board.planes_mm))}
        if setup.background is not None:
            found |= {f"background {frame}": partial(e.background_image, camera, frame) for frame in e.laser_names}
        frames = map(e.recording.frame, e.recording.frames[:MOST_LISTED])
        return found | {frame.label: partial(e.frame_image, camera, frame) for frame in frames}

    def names(self, camera: str) -> list[str]:
        """Return the names of a camera's images."""
        return list(self._readers(camera))

    def _read(self, camera: str, name: str) -> np.ndarray:
        """Return an image as lfpiv reads it, float32 (rows, columns) [counts]."""
        image = self._readers(camera).get(name, lambda: None)()
        if image is None:
            raise InputError(f"{name}: expected an image of camera {camera!r}, found no such image.")
        return image

    def calibrated(self, camera: str) -> CalibratedCamera:
        """Return a camera: from the results, or a thin lens in its nominal place."""
        with self._lock:
            if not self.cameras:
                file = Folder(self.results).calibration if self.results is not None else None
                names = {setup.name for setup in self.experiment.cameras}
                stored = lfpiv.load_calibration(file).cameras if file is not None and file.is_file() else {}
                self.measured = set(stored) == names
                self.cameras = dict(stored if self.measured else lfpiv.thin_lens(self.experiment).cameras)
            return self.cameras[camera]

    def recorded(self, camera: str, array: np.ndarray) -> np.ndarray:
        """Return an image as its camera recorded it, which undoes what reading did."""
        return np.ascontiguousarray(array[FLIPS[self.experiment.camera(camera).image_flip]])

    def recorded_px(self, camera: str, places: np.ndarray) -> np.ndarray:
        """Return places (column, row) of a recorded picture from places of the picture as it is read, or back."""
        setup = self.experiment.camera(camera)
        rows, columns = setup.optics.sensor_shape
        places, flip = np.array(places, float), FLIPS[setup.image_flip]
        for axis, count in ((0, columns), (1, rows)):
            if flip[1 - axis].step == -1:
                places[..., axis] = count - 1 - places[..., axis]
        return places

    def lattice_px(self, camera: str) -> np.ndarray:
        """Return the centres of the microimages where the lattice has them, shape (lens, 2)."""
        found = self.calibrated(camera)
        centres = self._light_px(camera, found.lattice.centres_mm(self._lens_grid(camera).reshape(-1, 2)))
        rows, columns = found.optics.sensor_shape
        return centres[((centres > -0.5) & (centres < (columns - 0.5, rows - 0.5))).all(1)]

    def _light_px(self, camera: str, array_mm: np.ndarray) -> np.ndarray:
        """Return where light that meets the array (n, 2) [mm] through the middle of the pupil lies [pixel]."""
        optics = self.calibrated(camera).optics
        return self.recorded_px(camera, optics.sensor_px(array_mm * (1 + optics.sensor_per_pupil)))

    def marked_pixels(self, camera: str, image: np.ndarray) -> dict[str, np.ndarray]:
        """Return saturated and hot pixels of an image as it is read, each (n, 2) in the recorded picture."""
        clipped = saturated_pixels(image, self.experiment.camera(camera).white_level)
        around = scipy.ndimage.maximum_filter(image, footprint=np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]]))
        noise = NORMAL_MAD * float(np.median(np.abs(np.diff(image[:, ::7], axis=0)))) / np.sqrt(2)
        level = float(np.percentile(image[::5, ::5], 5))
        hot = image - level > HOT_RATIO * np.maximum(around - level, 0) + HOT_SIGMA * max(noise, 1.0)
        found = {"saturated": clipped, "hot": hot}
        return {name: self.recorded_px(camera, np.argwhere(flags)[:, ::-1]) for name, flags in found.items()}

    def dots(self, camera: str, plane: int) -> tuple[np.ndarray, list[str], np.ndarray]:
        """Return where the dots of a plane lie, what they are called, and their residual arrows.

        (column, row) of each dot's light through the middle of the pupil, as the mapping has it [pixel]; its column and
        row on the board; of measured dots (n, 4), from there `ARROW_GAIN` times the residual [pixel].
        """
        from lfpiv.calibration.board.dots import DotBoard  # imports Taichi

        found, board = self.calibrated(camera), DotBoard.from_settings(self.experiment.board)
        numbers = plane * board.size + np.flatnonzero(board.occupied)
        places = self._light_px(camera, found.map(board.of_dots_mm(numbers), np.zeros((len(numbers), 2))))
        across = self.experiment.board.dots[0]
        names = [f"{number % board.size % across},{number % board.size // across}" for number in numbers]
        arrows = np.zeros((0, 4))
        if found.dots is not None:
            here = np.isin(found.dots.measured_dot, numbers)
            rank = np.searchsorted(numbers, found.dots.measured_dot[here])
            seen = self._light_px(camera, found.dots.chief_mm[here])
            arrows = np.hstack([places[rank], places[rank] + ARROW_GAIN * (seen - places[rank])])
        return places, names, arrows

    def axes_px(self, camera: str) -> np.ndarray:
        """Return where the volume's centre and steps along x and y from it lie, shape (3, 2) [pixel]."""
        found, grid = self.calibrated(camera), self.experiment.grid
        reach = 0.3 * min(n * grid.voxel_mm for n in grid.shape[1:])
        points = grid.centre_mm + reach * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
        return self._light_px(camera, found.map(points, np.zeros((3, 2))))

    def pupil_at(self, camera: str, place: tuple[float, float]) -> tuple[float, float]:
        """Return the pupil point (u, v) that a pixel of the recorded picture sees [mm]."""
        found = self.calibrated(camera)
        column, row = self.recorded_px(camera, np.array(place))
        rows, columns = found.optics.sensor_shape
        at = (int(np.clip(round(row), 0, rows - 1)), int(np.clip(round(column), 0, columns - 1)))
        u, v = found.decoder.pupil_mm[at]
        radius = found.optics.pupil_radius_mm
        shrink = min(1.0, 0.95 * radius / max(float(np.hypot(u, v)), 1e-9))
        return float(u) * shrink, float(v) * shrink

    def _above_dark(self, camera: str, name: str) -> np.ndarray:
        image: np.ndarray = self.read(camera, name)
        return np.asarray(image - np.float32(self.calibrated(camera).decoder.background(image)[0]))

    def pupil_view(self, camera: str, name: str, pupil_mm: tuple[float, float]) -> np.ndarray:
        """Return an image as it is seen through a pupil point: a value for each lens; 0 where none is seen."""
        found = self.calibrated(camera)
        values = found.decoder.sample(self._signal(camera, name), self._lens_grid(camera), pupil_mm)
        basis = np.asarray(found.lattice.basis_mm)
        along = values.T if abs(basis[0][0]) >= abs(basis[0][1]) else values
        return self.recorded(camera, np.nan_to_num(along))

    def _pupil_views(self, camera: str, name: str) -> np.ndarray:
        """Return the views of an image through `PUPIL_POINTS` points, shape (point, i, j)."""
        points = self._points(camera)[:, None, None]
        return self.calibrated(camera).decoder.sample(self._signal(camera, name), self._lens_grid(camera), points)

    def _points(self, camera: str) -> np.ndarray:
        return spread_over_pupil(0.9 * self.calibrated(camera).optics.pupil_radius_mm)[:PUPIL_POINTS]

    def refocused(self, camera: str, name: str, z_mm: float) -> np.ndarray:
        """Return the light of a plane, x to the right and y up, the mean of `PUPIL_POINTS` views; 0: not seen."""
        found, grid = self.calibrated(camera), self.experiment.grid
        sides = grid.voxel_mm * np.array(grid.shape[:0:-1])
        counts = np.rint(REFOCUSED * sides / sides.max()).astype(int)
        x, y = (side * ((np.arange(count) + 0.5) / count - 0.5) for side, count in zip(sides, counts, strict=True))
        points = np.stack(np.meshgrid(grid.centre_mm[0] + x, grid.centre_mm[1] - y, [z_mm]), axis=-1).reshape(-1, 3)
        origin, basis = np.asarray(found.lattice.origin_mm), np.linalg.inv(np.asarray(found.lattice.basis_mm))
        low = self._lens_grid(camera)[0, 0].astype(float)
        lenses = (found.map_fan(points, self._points(camera)) - origin) @ basis - low
        views = self._views(camera, name)
        seen = [
            scipy.ndimage.map_coordinates(view, at.T, order=1, cval=np.nan, prefilter=False)
            for view, at in zip(views, np.moveaxis(lenses, 1, 0), strict=True)
        ]
        mean: np.ndarray = np.nansum(seen, axis=0) / np.maximum(np.isfinite(seen).sum(axis=0), 1)
        return mean.reshape(counts[::-1])
