"""Measure what the white and board images of one camera show: its microlens array, its dots, and a thin lens.

A calibration that is interrupted goes on from the cameras that were measured (`KeptCameras`).
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from lfpiv.calibration import checks, contradictions, plane_focus
from lfpiv.calibration.board.board import measure_board
from lfpiv.calibration.board.dots import BoardDots, DotBoard
from lfpiv.calibration.board.hypotheses import RIGHT, Mistake
from lfpiv.calibration.board.planes import board_images
from lfpiv.calibration.camera import CalibratedCamera
from lfpiv.calibration.liquid import LiquidSurface, liquid_surface
from lfpiv.calibration.quality import LensArrayQuality
from lfpiv.calibration.thin_lens_model import ThinLensModel, fit_thin_lens
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.geometry.optics import LensLattice
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.lens_array import find_lens_array
from lfpiv.progress import StepProgress
from lfpiv.warn import Warning, collected

log = logging.getLogger(__name__)

MODEL_ERROR_PITCH = 0.002
"""Error that all labels of a dot share, beside their standard errors [microlens pitch]."""


class KeptCameras(Protocol):
    """Keeps what the images of each camera show, so that an interrupted calibration goes on from there."""

    def load(self, name: str) -> CalibratedCamera | None:
        """Return a camera that was kept; None if there is none that fits the experiment."""

    def keep(self, camera: CalibratedCamera) -> None:
        """Keep a camera: its decoder, the labels of its dots and the thin lens fitted to them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensor:
    """Microlens array and decoder of one camera, from its white image."""

    lattice: LensLattice
    decoder: LightFieldDecoder
    quality: LensArrayQuality


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """What the white and board images of one camera show."""

    sensor: Sensor
    dots: BoardDots
    """Labels, with the points of the board as stated."""
    lens: ThinLensModel
    """Thin lens fitted to them."""
    surface: LiquidSurface | None
    """Surface of a liquid, where it explains the labels and the thin lens does not."""
    warnings: tuple[Warning, ...] = ()

    def as_camera(self, setup: CameraSetup) -> CalibratedCamera:
        """Return the camera with the thin lens as its mapping, to be stored."""
        return CalibratedCamera(
            name=setup.name,
            optics=setup.optics,
            lattice=self.sensor.lattice,
            decoder=self.sensor.decoder,
            baseline=self.lens,
            report=self.sensor.quality,
            warnings=self.warnings,
            dots=self.dots,
        )

    @classmethod
    def from_camera(cls, camera: CalibratedCamera) -> Measured | None:
        """Return what `as_camera` made a camera of; None for another one."""
        lens, dots, quality = camera.baseline, camera.dots, camera.report
        if lens is None or dots is None or quality is None or camera.network is not None:
            return None
        sensor = Sensor(lattice=camera.lattice, decoder=camera.decoder, quality=quality)
        surface = liquid_surface(dots, lens, camera.optics)
        return cls(sensor=sensor, dots=dots, lens=lens, surface=surface, warnings=camera.warnings)


def measure_or_load(
    experiment: Experiment, setup: CameraSetup, kept: KeptCameras | None, step: StepProgress
) -> Measured:
    """Return what the images of a camera show, from an interrupted calibration if it kept that."""
    camera = None if kept is None else kept.load(setup.name)
    if camera is not None and (known := Measured.from_camera(camera)) is not None:
        log.info("%s: dots measured before, kept", setup.name)
        step(1.0)
        return known
    with collected(quiet=True) as warnings:  # a mistake in the stated rig would explain them
        found = _measure_camera(experiment, setup, step)
    for warning in warnings:
        log.warning("%s", warning.sentence)
    found = replace(found, warnings=tuple(warnings))
    if kept is not None:
        kept.keep(found.as_camera(setup))
    return found


def _others(experiment: Experiment, setup: CameraSetup) -> dict[str, LightFieldDecoder]:
    """Return the decoders of the other cameras whose white images show an array."""
    found = {}
    for other in experiment.cameras:
        with contextlib.suppress(InputError):
            if other.name != setup.name:
                found[other.name] = decode(experiment, other).decoder
    return found


def _measure_camera(experiment: Experiment, setup: CameraSetup, step: StepProgress) -> Measured:
    sensor = decode(experiment, setup)
    step(0.2)
    images = board_images(experiment, setup.name)
    checks.check_light(experiment, setup, images)
    contradictions.check_place(experiment, setup, sensor.decoder, images, lambda: _others(experiment, setup))

    known: BoardDots | None = None

    def cause(lens: ThinLensModel | None) -> str | None:
        with collected(quiet=True):
            return likely_cause(experiment, contradictions.likely_stretches(lens), {setup.name: known})

    try:
        dots = known = _measure_dots(experiment, setup, sensor.decoder, images)
    except InputError as error:
        raise InputError(cause(None) or str(error)) from None
    plane_focus.check_depths(experiment, setup, dots)
    try:
        lens = fit_lens(experiment, setup, dots, sensor.lattice.pitch_mm)
    except InputError as error:
        shown = cause(None) or plane_focus.mistaken_depths(experiment, setup, dots)
        shown = shown or plane_focus.reversed_order(experiment, setup, dots)
        raise InputError(shown or str(error)) from None
    surface = liquid_surface(dots, lens, setup.optics)
    if contradictions.doubtful(setup, dots, lens, surface) and (text := cause(lens)):
        raise InputError(text)
    plane_focus.check_order(experiment, setup, dots)
    step(1.0)
    return Measured(sensor=sensor, dots=dots, lens=lens, surface=surface)


def likely_cause(
    experiment: Experiment, stretches: Sequence[float], known: Mapping[str, BoardDots | None] | None = None
) -> str | None:
    """Name the mistake that explains all board images better than the stated rig; see `contradictions.cause`.

    `known` has the dots of cameras that were measured as stated; None where they were not found.
    """

    def dots_of(setup: CameraSetup, decoder: LightFieldDecoder, mistake: Mistake) -> BoardDots | None:
        if mistake == RIGHT and known is not None and setup.name in known:
            return known[setup.name]
        with contextlib.suppress(InputError):
            return _measure_dots(experiment, setup, decoder, board_images(experiment, setup.name), mistake)
        return None

    return contradictions.cause(experiment, lambda setup: decode(experiment, setup).decoder, dots_of, stretches)


def fit_lens(experiment: Experiment, setup: CameraSetup, dots: BoardDots, pitch_mm: float) -> ThinLensModel:
    """Fit a thin lens to the labels of a camera, weighted by their standard deviations."""
    with input_errors(f"{experiment.path}: labels of camera {setup.name!r}"):
        std = label_std(dots, pitch_mm)
        return fit_thin_lens(dots.points_mm, dots.pupil_mm, dots.array_mm, setup.optics, std=std)


def label_std(dots: BoardDots, pitch_mm: float) -> np.ndarray:
    """Return the standard deviation of the labels [mm], shape (n,), the error that a dot's labels share included."""
    return np.hypot(dots.std_mm, MODEL_ERROR_PITCH * pitch_mm)


def decode(experiment: Experiment, setup: CameraSetup) -> Sensor:
    """Find the microlens array in the white image and make the decoder."""
    white, dark, optics = experiment.white(setup.name), experiment.dark(setup.name), setup.optics
    with input_errors(f"{setup.white_path}: white_image of camera {setup.name!r}"):
        array = find_lens_array(white, dark, nominal_pitch_px=optics.microimage_pitch_px, layout=optics.layout)
        lattice = array.lattice(optics)
        decoder = LightFieldDecoder.from_white(optics, lattice, white, dark)
    checks.check_white(setup, white, dark, decoder)
    quality = LensArrayQuality(
        lens_array_rms_px=float(array.rms_px),
        lens_array_pitch_px=float(array.pitch_px),
        lens_array_rotation_deg=float(array.rotation_deg),
        lenses=len(array.centres_px),
    )
    return Sensor(lattice=lattice, decoder=decoder, quality=quality)


def _measure_dots(
    experiment: Experiment,
    setup: CameraSetup,
    decoder: LightFieldDecoder,
    images: Sequence[np.ndarray],
    mistake: Mistake = RIGHT,
) -> BoardDots:
    """Measure the dots of a camera as they are if a mistake was made."""
    board, dark = DotBoard.from_settings(experiment.board), experiment.dark(setup.name)
    board = replace(board, planes_mm=mistake.depths_mm(board.planes_mm))
    place = f"{experiment.path}: board.images of camera {setup.name!r}"
    with input_errors(place):
        dots = measure_board(
            images,
            decoder,
            board,
            orientation=None if setup.orientation is None else mistake.orientation(setup.orientation),
            estimator=experiment.network.estimator,
            dark=dark,
        )
    checks.check_planes(experiment, setup, dots)
    return dots


@contextlib.contextmanager
def input_errors(place: str) -> Iterator[None]:
    """Name the file and the camera in every InputError, and where a matrix is singular.

    Any other error is a fault of the program.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{place}: {error}") from None
    except np.linalg.LinAlgError:
        raise InputError(
            f"{place}: expected a board's dots at several places and depths, found dots that determine no camera, or "
            "blobs that are no dots. Look at the board images, and check the numbers in [board]."
        ) from None
