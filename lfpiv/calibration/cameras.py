"""Calibrate the cameras of an experiment: from white and board images to the ray mapping of each camera.

Section 3.1 of the paper: the white image gives the microlens array, the board images give labelled rays of dots, and a
thin lens plus a network is fitted to the labels (Eqs. 6-7). Its estimated error is sigma_nor.
Errors of the board that the labels of all cameras show are corrected before.
`thin_lens` gives the mapping by direct ray tracing (DRT) instead, from the stated optics and angles only (Eqs. 1-3).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv.calibration import checks, contradictions, scales
from lfpiv.calibration.board.board import agreeing_dots
from lfpiv.calibration.board.dots import BoardDots, DotBoard
from lfpiv.calibration.board.errors import KINDS, BoardErrors
from lfpiv.calibration.bundle.dot_rays import CameraLabels
from lfpiv.calibration.bundle.fit import fit_board
from lfpiv.calibration.camera import CalibratedCamera, Calibration
from lfpiv.calibration.checks import NominalDifference
from lfpiv.calibration.committee import Rays, distance_of_halves, smooth_departure, train_several
from lfpiv.calibration.liquid import median_distance
from lfpiv.calibration.measured_camera import (
    KeptCameras,
    Measured,
    Sensor,
    decode,
    fit_lens,
    input_errors,
    label_std,
    measure_or_load,
)
from lfpiv.calibration.quality import CalibrationQuality
from lfpiv.calibration.thin_lens_model import ThinLensModel, fit_thin_lens, thin_lens_model
from lfpiv.calibration.training import Training, TrainingSettings, train
from lfpiv.calibration.virtual_samples import sampler_between_dots
from lfpiv.errors import InputError
from lfpiv.experiment import axes
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.experiment.opening import read_experiment
from lfpiv.geometry.orientation import Orientation
from lfpiv.progress import StepProgress, part_of
from lfpiv.warn import collected

log = logging.getLogger(__name__)


def calibrate(experiment: Experiment | str | Path, progress: StepProgress | None = None) -> Calibration:
    """Calibrate every camera of an experiment from its white and board images (section 3.1 of the paper).

    The mapping does not depend on the nominal orientations. They only help to number the board's dots.

    Parameters
    ----------
    experiment : Experiment or path
        From `open_experiment`, or the experiment file, whose particle images are not looked at.
    progress : callable, optional
        Called with the finished fraction.

    Raises
    ------
    InputError
        If the experiment file is not as expected, a white image shows no microlens array, or the board's dots cannot be
        found. Names camera and file.
    """
    opened = experiment if isinstance(experiment, Experiment) else read_experiment(experiment)
    return calibrate_or_continue(opened, None, progress)


def calibrate_or_continue(
    experiment: Experiment, kept: KeptCameras | None, progress: StepProgress | None
) -> Calibration:
    """Calibrate every camera as `calibrate` does, without measuring again the dots of cameras in `kept`."""
    with threadpool_limits(1, "blas"):  # its sums depend on its number of threads
        whole, count = progress or (lambda fraction: None), len(experiment.cameras)
        measured = {}
        for number, setup in enumerate(experiment.cameras):
            step = part_of(whole, 0.75 * number / count, 0.75 * (number + 1) / count)
            measured[setup.name] = measure_or_load(experiment, setup, kept, step)
        log.info("axes: in the recorded pictures %s; %s", axes.directions(experiment), axes.handedness(experiment))
        with collected() as about_axes:
            contradictions.warn_unstated(experiment)
        errors = _fit_board(experiment, measured)
        errors = replace(errors, warnings=(*about_axes, *errors.warnings))
        cameras = {}
        for number, setup in enumerate(experiment.cameras):
            step = part_of(whole, 0.75 + 0.25 * number / count, 0.75 + 0.25 * (number + 1) / count)
            with collected() as warnings:
                camera = _calibrate_camera(experiment, setup, measured[setup.name], errors, step)
            found = (replace(warning, subject=setup.name) for warning in (*measured[setup.name].warnings, *warnings))
            cameras[setup.name] = replace(camera, warnings=tuple(found))
        return Calibration(cameras, board=errors)


def thin_lens(experiment: Experiment, angle_error_deg: float = 0.0) -> Calibration:
    """Calibrate by direct ray tracing (DRT): the ideal thin lens of section 2.1 in the nominal orientations.

    Parameters
    ----------
    experiment : Experiment
        From `open_experiment`. Its white images give the microlens arrays.
    angle_error_deg : float
        Error added to the angle of every camera's axis to z [degree], Eqs. 11-12.

    Raises
    ------
    InputError
        If a white image shows no microlens array, or a camera has no nominal orientation.
    ValueError
        If `angle_error_deg` is not finite.
    """
    if not math.isfinite(angle_error_deg):
        raise ValueError(f"angle_error_deg: expected a finite angle [degree], got {angle_error_deg}.")
    with threadpool_limits(1, "blas"):
        cameras = {}
        for setup in experiment.cameras:
            with collected() as warnings:
                sensor = decode(experiment, setup)
            cameras[setup.name] = CalibratedCamera(
                name=setup.name,
                optics=setup.optics,
                lattice=sensor.lattice,
                decoder=sensor.decoder,
                baseline=thin_lens_model(setup.optics, _stated(experiment, setup).away_from_z(angle_error_deg)),
                report=sensor.quality,
                warnings=tuple(replace(warning, subject=setup.name) for warning in warnings),
            )
        return Calibration(cameras)


def _stated(experiment: Experiment, setup: CameraSetup) -> Orientation:
    if setup.orientation is None:
        raise InputError(
            f"{experiment.path}: camera {setup.name!r}: expected nominal_direction or nominal_angle_deg, which direct "
            "ray tracing takes in place of a calibration, found neither. Add one."
        )
    return setup.orientation


@dataclass(frozen=True, kw_only=True, eq=False)
class _Mapping:
    """Ray mapping of one camera, fitted to the labels of its dots."""

    baseline: ThinLensModel | None
    """Thin lens that the network corrects, or None."""
    training: Training
    """The network and its errors."""
    agreeing: np.ndarray
    """Labels used, shape (n,), bool."""
    error: float
    """Error that the labels' noise and the training make [microlens pitch]."""
    sigma_nor_stated: float
    """Mean distance to the held-out dots at their stated places, Eq. 8 [microlens pitch]."""


def _fit_board(experiment: Experiment, measured: Mapping[str, Measured]) -> BoardErrors:
    """Fit the errors of the board to the labels of all cameras, and warn of planes far from where they should be."""
    board = DotBoard.from_settings(experiment.board)
    cameras = [
        CameraLabels(
            dots=_without_surface(measured[setup.name]),
            lens=measured[setup.name].lens,
            pupil_radius_mm=setup.optics.pupil_radius_mm,
            pitch_mm=measured[setup.name].sensor.lattice.pitch_mm,
        )
        for setup in experiment.cameras
    ]
    with input_errors(f"{experiment.path}: labels of all cameras"):
        errors = fit_board(cameras, board)
    pitch = min(setup.optics.microlens_pitch_mm / abs(setup.optics.magnification) for setup in experiment.cameras)
    _log_board(errors)
    with collected() as warnings:
        scales.check_scales(experiment, cameras)
        checks.check_board(errors, board, pitch, experiment.path)
    return replace(errors, warnings=tuple(warnings))


def _without_surface(measured: Measured) -> BoardDots:
    """Return labels less what the surface of a liquid bends, as the thin lens in air would have them.

    With few planes, the fit of the board would take this bend for a tilt of planes.
    """
    dots, lens, surface = measured.dots, measured.lens, measured.surface
    if surface is None:
        return dots
    bent = surface(dots.points_mm, dots.pupil_mm) - lens(dots.points_mm, dots.pupil_mm)
    return replace(dots, array_mm=dots.array_mm - bent)


def _log_board(errors: BoardErrors) -> None:
    if not errors.corrected:
        log.info("board: its dots show no errors of planes or dots that exceed chance; it is used as stated")
        return
    text = f"board: errors found and corrected: {', '.join(KINDS[kind] for kind in errors.corrected)}"
    if "depth" in errors.corrected:
        off, std = 1e3 * errors.plane[:, 2], 1e3 * errors.plane_std[:, 2]
        worst = int(np.abs(off).argmax())
        text += f"; planes stand up to {abs(off[worst]):.2g} um off along z (standard error {std[worst]:.2g} um)"
    log.info("%s", text)


def _calibrate_camera(
    experiment: Experiment, setup: CameraSetup, measured: Measured, errors: BoardErrors, step: StepProgress
) -> CalibratedCamera:
    sensor, dots, lens = measured.sensor, measured.dots, measured.lens
    stated_mm = dots.points_mm
    if errors.corrected:
        corrected = errors.points_mm(DotBoard.from_settings(experiment.board), dots.dot)
        dots = replace(dots, points_mm=corrected)
        lens = fit_lens(experiment, setup, dots, sensor.lattice.pitch_mm)
    residual = dots.array_mm - lens(dots.points_mm, dots.pupil_mm)
    typical_pitch = median_distance(residual) / sensor.lattice.pitch_mm
    if measured.surface is None:
        checks.check_pupil(experiment, setup, dots, lens, typical_pitch)
    nominal = checks.compare_with_nominal(setup, lens, typical_pitch, measured.surface)
    mapping = _fit_mapping(experiment, setup, dots, stated_mm, lens, residual, sensor.lattice.pitch_mm)
    step(0.9)
    rejected = dots.rejected + _disagreeing_per_plane(dots, mapping.agreeing, math.prod(experiment.board.dots))
    checks.check_rejected(experiment, setup, dots, rejected)
    quality = _quality(sensor, dots, mapping, nominal, int(rejected.sum()))
    training_dots = len(np.unique(dots.dot[mapping.agreeing][mapping.training.split.training]))
    checks.check_mapping(setup, quality, mapping.training.network, experiment.network.estimator, training_dots)
    checks.check_dot_size(setup, dots, lens, sensor.lattice)
    checks.check_pupil_zones(setup, dots, sensor.lattice.pitch_mm)
    log.info(
        "camera %s: calibrated with %d of %d dots; rays are off by %.2g microlens pitches (sigma_nor)",
        setup.name, quality.dots_found, quality.dots_expected, quality.sigma_nor_test,
    )  # fmt: skip
    step(1.0)
    used = dots.points_mm[mapping.agreeing]
    return CalibratedCamera(
        name=setup.name,
        optics=setup.optics,
        lattice=sensor.lattice,
        decoder=sensor.decoder,
        network=mapping.training.network,
        baseline=mapping.baseline,
        region_mm=np.stack([used.min(0), used.max(0)]),
        report=quality,
        dots=dots,
        test_errors=mapping.training.test_errors,
    )


def _fit_mapping(
    experiment: Experiment,
    setup: CameraSetup,
    dots: BoardDots,
    stated_mm: np.ndarray,
    lens: ThinLensModel,
    residual: np.ndarray,
    pitch_mm: float,
) -> _Mapping:
    """Leave out dots that disagree with their neighbours, and train the network."""
    settings, place = experiment.network, f"{experiment.path}: labels of camera {setup.name!r}"
    std = label_std(dots, pitch_mm)
    agreeing = agreeing_dots(dots, residual, pitch_mm)
    baseline = lens if settings.baseline == "thin_lens" else None
    points, pupil, std = dots.points_mm[agreeing], dots.pupil_mm[agreeing], std[agreeing]
    target = (dots.array_mm if baseline is None else residual)[agreeing]

    rules = TrainingSettings(hidden=tuple(settings.hidden), epochs=settings.epochs, shrink=baseline is not None)

    def trained(seed: int, part: np.ndarray | slice = slice(None), target: np.ndarray = target) -> Training:
        where, labels, errors = (points[part], pupil[part]), target[part], std[part]
        return train(
            np.hstack(where),
            labels,
            replace(rules, seed=seed),
            groups=dots.dot[agreeing][part],
            std=errors,
            virtual_samples=sampler_between_dots(*where, labels, errors, pitch_mm=pitch_mm, seed=seed),
            unit=pitch_mm,
        )

    def of_part(part: np.ndarray) -> Rays:
        if baseline is None:
            network = trained(settings.seed, part).network
            return lambda *rays: network(np.hstack(rays))
        array = dots.array_mm[agreeing]
        own = fit_thin_lens(points[part], pupil[part], array[part], setup.optics, std=std[part])
        correction = trained(settings.seed, part, array - own(points, pupil)).network
        return lambda *rays: own(*rays) + correction(np.hstack(rays))

    region_mm, radius = np.stack([points.min(0), points.max(0)]), setup.optics.pupil_radius_mm
    with input_errors(place):
        chosen = train_several(trained, region_mm, radius, seed=settings.seed, unit=pitch_mm)
        training, inputs = chosen.training, np.hstack([points, pupil])
        held_out_mm, number = training.sigma_nor * pitch_mm, dots.dot[agreeing]
        halves = distance_of_halves(of_part, number, region_mm, radius, settings.seed, held_out_mm) / pitch_mm
    chance = max(chosen.error, training.sigma_nor if math.isnan(halves) else halves)
    unfollowed = smooth_departure(inputs, target - training.network(inputs), number) / pitch_mm
    held_out = training.split.test
    held = stated_mm[agreeing][held_out], pupil[held_out]
    mapped = training.network(np.hstack(held)) + (0.0 if baseline is None else baseline(*held))
    stated = np.linalg.norm(mapped - dots.array_mm[agreeing][held_out], axis=1) / pitch_mm
    return _Mapping(
        baseline=baseline,
        training=training,
        agreeing=agreeing,
        error=math.hypot(chance, unfollowed),
        sigma_nor_stated=float(stated.mean()),
    )


def _disagreeing_per_plane(dots: BoardDots, agreeing: np.ndarray, dots_per_plane: int) -> np.ndarray:
    return np.bincount(np.unique(dots.dot[~agreeing]) // dots_per_plane, minlength=len(dots.found))


def _quality(
    sensor: Sensor, dots: BoardDots, mapping: _Mapping, nominal: NominalDifference, rejected: int
) -> CalibrationQuality:
    training = mapping.training
    return CalibrationQuality(
        **vars(sensor.quality),
        turn_from_nominal_deg=nominal.turn_deg,
        magnification=nominal.magnification,
        sigma_nor_test=math.hypot(mapping.error, dots.shared_error_mm / sensor.lattice.pitch_mm),
        sigma_nor_stated=mapping.sigma_nor_stated,
        dots_found=int(dots.found.sum()),
        dots_expected=int(dots.expected.sum()),
        dots_found_per_plane=dots.found.tolist(),
        dots_expected_per_plane=dots.expected.tolist(),
        dots_rejected=rejected,
        labels=int(mapping.agreeing.sum()),
        epochs=training.epochs,
        stop=training.stop.value,
        training_s=training.seconds,
        network_shrinkage=training.shrinkage,
        dot_diameter_mm=dots.diameter_mm,
        blur_px=dots.blur_px,
        response_share=dots.response_share,
    )
