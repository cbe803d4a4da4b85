"""`calibrate`: white images and board images -> the mapping of every camera, with what is known of its quality."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from lfpiv.calibration import checks
from lfpiv.calibration.board.board import DotBoard, Planes, agreeing_dots, measure_board
from lfpiv.calibration.camera import CalibratedCamera, Calibration, load_calibration
from lfpiv.calibration.network import train
from lfpiv.calibration.thin_lens_model import fit_thin_lens, thin_lens_model
from lfpiv.calibration.virtual_samples import guide_between
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.geometry.optics import LensLattice
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.lens_array import find_lens_array
from lfpiv.warn import collected

__all__ = ["CalibratedCamera", "Calibration", "calibrate", "load_calibration", "thin_lens"]

log = logging.getLogger(__name__)

PUPIL_SCALE, PUPIL_SCALE_INCOMPLETE = 0.3, 0.1
"""Largest departure of the fitted pupil from the stated one, and the same where over a tenth of the dots are missing.
Good boards fit within 0.01 and are complete; planes in the wrong order, a wrong angle's sign, an unnoticed mirror gave
0.17 to 1.2 and lost a quarter of the dots or more, because depth and defocus then disagree."""
MODEL_ERROR_PITCH = 0.002
"""Error of a dot's labels that they share and their standard errors do not hold [microlens pitch]."""

Progress = Callable[[float], None]


def calibrate(experiment: Experiment, progress: Progress | None = None) -> Calibration:
    """Calibrate every camera of an experiment from its white and board images (section 3.1 of the paper).

    No camera angle enters the mapping; the nominal one only names the board's dots.

    Parameters
    ----------
    experiment : Experiment
        From `open_experiment`.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        If a white image shows no microlens array or the board's dots cannot be found; names camera and file.
    """
    cameras = {}
    for number, setup in enumerate(experiment.cameras):

        def step(fraction: float, number: int = number) -> None:
            if progress is not None:
                progress((number + fraction) / len(experiment.cameras))

        with collected() as warnings:
            camera = _calibrate_camera(experiment, setup, step)
        named = (replace(warning, subject=setup.name) for warning in warnings)
        cameras[setup.name] = replace(camera, warnings=tuple(named))
    return Calibration(cameras)


def thin_lens(experiment: Experiment, angle_error_deg: float = 0.0) -> Calibration:
    """Calibration by direct ray tracing (DRT): the ideal thin lens of section 2.1 at the nominal camera angles.

    Parameters
    ----------
    experiment : Experiment
        From `open_experiment`; its white images give the microlens arrays.
    angle_error_deg : float
        Error added to the magnitude of every camera's angle [degree], Eqs. 11-12.

    Raises
    ------
    InputError
        If a white image shows no microlens array.
    ValueError
        If `angle_error_deg` is not finite.
    """
    if not math.isfinite(angle_error_deg):
        raise ValueError(f"angle_error_deg: expected a finite angle [degree], got {angle_error_deg}.")
    cameras = {}
    for setup in experiment.cameras:
        with collected() as warnings:
            lattice, decoder, report = _decode(experiment, setup)
        angle = setup.nominal_angle_deg
        cameras[setup.name] = CalibratedCamera(
            name=setup.name,
            optics=setup.optics,
            lattice=lattice,
            decoder=decoder,
            baseline=thin_lens_model(
                setup.optics, angle + np.copysign(angle_error_deg, angle) if angle else angle_error_deg
            ),
            report=report,
            warnings=tuple(replace(warning, subject=setup.name) for warning in warnings),
        )
    return Calibration(cameras)


def _decode(experiment: Experiment, setup: CameraSetup) -> tuple[LensLattice, LightFieldDecoder, dict[str, Any]]:
    white, dark = experiment.white(setup.name), experiment.dark(setup.name)
    optics = setup.optics
    try:
        array = find_lens_array(white, dark, nominal_pitch_px=optics.microimage_pitch_px, layout=optics.layout)
        lattice = array.lattice(optics)
        decoder = LightFieldDecoder.from_white(optics, lattice, white, dark)
    except ValueError as error:
        raise InputError(f"{setup.white_path}: white_image of camera {setup.name!r}: {error}") from None
    report: dict[str, Any] = {
        "lens_array_rms_px": float(array.rms_px),
        "lens_array_pitch_px": float(array.pitch_px),
        "lens_array_rotation_deg": float(array.rotation_deg),
        "lenses": len(array.centres_px),
    }
    checks.check_white(setup, white, dark, decoder)
    return lattice, decoder, report


def _calibrate_camera(experiment: Experiment, setup: CameraSetup, step: Progress) -> CalibratedCamera:
    lattice, decoder, report = _decode(experiment, setup)
    step(0.15)
    board, settings, dark = experiment.board, experiment.network, experiment.dark(setup.name)
    images = Planes(lambda plane: experiment.board_image(setup.name, plane), len(board.planes_mm))
    checks.check_light(experiment, setup, decoder, images, dark)
    step(0.2)
    try:
        dots = measure_board(
            images,
            decoder,
            DotBoard(
                dots=board.dots,
                spacing_mm=board.spacing_mm,
                diameter_mm=board.dot_diameter_mm,
                planes_mm=tuple(board.planes_mm),
            ),
            nominal_angle_deg=setup.nominal_angle_deg,
            estimator=settings.estimator,
            dark=dark,
        )
    except np.linalg.LinAlgError:  # a ValueError too, whose text says nothing
        raise InputError(
            f"{experiment.path}: board.images of camera {setup.name!r}: expected images of the board's dots, found "
            "blobs that no camera sees as a board. Check that these are board images and what [board] says."
        ) from None
    except ValueError as error:
        raise InputError(f"{experiment.path}: board.images of camera {setup.name!r}: {error}") from None
    checks.check_planes(experiment, setup, dots)
    step(0.75)

    points, pupil, array = dots.points_mm, dots.pupil_mm, dots.array_mm
    pitch = lattice.pitch_mm
    std = np.hypot(dots.std_mm, MODEL_ERROR_PITCH * pitch)
    try:
        fitted = fit_thin_lens(points, pupil, array, setup.optics, std=std)
        complete = dots.found.sum() >= 0.9 * dots.expected.sum()
        if not abs(fitted.pupil_scale - 1) <= (PUPIL_SCALE if complete else PUPIL_SCALE_INCOMPLETE):
            raise InputError(
                f"{experiment.path}: camera {setup.name!r}: expected dots that a camera of the stated optics can see, "
                f"found {dots.found.sum()} of {dots.expected.sum()} dots that would need its pupil scaled by "
                f"{fitted.pupil_scale:.2f}. Check the sign of nominal_angle_deg, image_flip, and the order and sign of "
                "board.planes_mm."
            )
        missed = float(np.median(np.linalg.norm(array - fitted(points, pupil), axis=1))) / pitch
        nominal = checks.compare_with_nominal(setup, fitted, missed)
        keep = agreeing_dots(dots, array - fitted(points, pupil), pitch)
        baseline = fitted if settings.baseline == "thin_lens" else None
        target = array if baseline is None else array - baseline(points, pupil)
        training = train(
            np.hstack([points, pupil])[keep],
            target[keep],
            hidden=settings.hidden,
            epochs=settings.epochs,
            groups=dots.dot[keep],
            std=std[keep],
            guide=guide_between(points[keep], pupil[keep], target[keep], std[keep], pitch_mm=pitch, seed=settings.seed),
            shrink=baseline is not None,
            seed=settings.seed,
            unit=pitch,
        )
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{experiment.path}: labels of camera {setup.name!r}: {error}") from None
    step(0.95)
    found, expected = int(dots.found.sum()), int(dots.expected.sum())
    left_out = np.bincount(np.unique(dots.dot[~keep]) // math.prod(board.dots), minlength=len(images)) + dots.rejected
    checks.check_left_out(experiment, setup, dots, left_out)
    report |= {
        "turn_from_nominal_deg": nominal.turn_deg,
        "magnification": nominal.magnification,
        "sigma_nor_test": training.sigma_nor,
        "dots_found": found,
        "dots_expected": expected,
        "dots_found_per_plane": dots.found.tolist(),
        "dots_expected_per_plane": dots.expected.tolist(),
        "dots_rejected": int(left_out.sum()),
        "labels": int(keep.sum()),
        "epochs": training.epochs,
        "stop": training.stop.value,
        "training_s": training.seconds,
        "network_shrinkage": training.shrinkage,
        "dot_diameter_mm": dots.diameter_mm,
        "blur_px": dots.blur_px,
        "response_share": dots.response_share,
    }
    camera = CalibratedCamera(
        name=setup.name,
        optics=setup.optics,
        lattice=lattice,
        decoder=decoder,
        network=training.network,
        baseline=baseline,
        region_mm=np.stack([points[keep].min(0), points[keep].max(0)]),
        report=report,
        dots=dots,
        test_errors=training.test_errors,
    )
    training_dots = len(np.unique(dots.dot[keep][training.training_index]))
    checks.check_mapping(camera, settings.estimator, training_dots)
    log.info(
        "%s: %d of %d dots, sigma_nor %.4f pitch on held-out dots", setup.name, found, expected, training.sigma_nor
    )
    step(1.0)
    return camera
