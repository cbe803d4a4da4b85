"""`calibrate`: white images and board images -> the mapping of every camera, with what is known of its quality."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lfpiv.board import BoardDots, DotBoard, measure_board
from lfpiv.camera import CalibratedCamera, Calibration, load_calibration
from lfpiv.errors import InputError
from lfpiv.experiment import CameraSetup, Experiment
from lfpiv.exposure import GAP_LIGHT, MISPLACED, NO_PLACE, SATURATED, gap_light, saturated_share
from lfpiv.guide import between_dots
from lfpiv.lensarray import find_lens_array
from lfpiv.lightfield import LightFieldDecoder
from lfpiv.network import train
from lfpiv.rig import Grid, LensLattice
from lfpiv.thinlens import ThinLensModel, fit_thin_lens, thin_lens_model

__all__ = ["CalibratedCamera", "Calibration", "calibrate", "load_calibration", "thin_lens", "warn_outside"]

log = logging.getLogger(__name__)

OUTLIER, OUTLIER_PITCH = 6.0, 0.1
"""A dot is left out where its labels disagree with its neighbours by more than this many times the typical
disagreement, and by more than this fraction of the microlens pitch: wrongly named or damaged."""
PUPIL_SCALE, PUPIL_SCALE_INCOMPLETE = 0.3, 0.1
"""Largest departure of the fitted pupil from the stated one, and the same where over a tenth of the dots are missing.
Good boards fit within 0.01 and are complete; planes in the wrong order, a wrong angle's sign, an unnoticed mirror gave
0.17 to 1.2 and lost a quarter of the dots or more, because depth and defocus then disagree."""
TURN_DEG = 20.0
"""Turn of a camera from its nominal pose that is no misalignment: ten degrees are allowed, and windows bend rays."""
MAGNIFICATION = 0.04
"""Relative difference from the stated magnification that is worth a look; a wrong dot spacing gives half its own."""
EXPLAINED = 0.2
"""Median distance of the dots' rays from the thin lens's that it can be held to [microlens pitch]."""
MODEL_ERROR_PITCH = 0.002
"""Error of a dot's labels that they share and their standard errors do not hold [microlens pitch]."""
FEWEST_PLANES = 2
"""Planes of the board a calibration needs: one alone does not tell the camera's depth."""
NEIGHBOURS = 16
"""Neighbouring dots, in space, that a dot is compared with."""

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

        cameras[setup.name] = _calibrate_camera(experiment, setup, step)
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
        )
    return Calibration(cameras)


def warn_outside(calibration: Calibration, grid: Grid) -> None:
    """Log a warning for every camera whose calibrated region does not hold all voxels of a grid.

    The region is the box that the board's dots spanned, widened by half a voxel.
    """
    for camera in calibration.cameras.values():
        if camera.region_mm is None:
            continue
        inside, distance = 1.0, 0.0
        for axis in range(3):
            centres = grid.axis_mm(2 - axis)
            low, high = camera.region_mm[:, axis]
            over = np.maximum(np.maximum(low - centres, centres - high) - grid.voxel_mm / 2, 0.0)
            inside *= float((over <= 1e-9).mean())
            distance = float(np.hypot(distance, over.max()))
        if inside == 1:
            continue
        low, high = camera.region_mm
        box = ", ".join(f"{name} {a:g} to {b:g}" for name, a, b in zip("xyz", low, high, strict=True))
        mend = "shrink the volume or use a larger board or more planes"
        if camera.baseline is None:
            mend += ', or set network.baseline = "thin_lens": a network alone extrapolates badly'
        log.warning(
            "%s: %.0f %% of the volume lies outside the calibrated region (%s mm), by up to %.2f mm: %s.",
            camera.name,
            100 * (1 - inside),
            box,
            distance,
            mend,
        )


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
        "warnings": [],
    }
    share = saturated_share(white)
    if share > SATURATED:
        report["warnings"].append(
            f"{setup.name}: {100 * share:.0f} % of the white image's bright pixels are saturated, so their response is "
            "not known; expose it to two thirds of the range."
        )
    return lattice, decoder, report


def _calibrate_camera(experiment: Experiment, setup: CameraSetup, step: Progress) -> CalibratedCamera:
    lattice, decoder, report = _decode(experiment, setup)
    step(0.15)
    dark = experiment.dark(setup.name)
    images = [experiment.board_image(setup.name, plane) for plane in range(len(experiment.board.planes_mm))]
    if dark is not None:
        images = [image - dark for image in images]
    _check_light(experiment, setup, decoder, images, report)
    step(0.2)
    board, settings = experiment.board, experiment.network
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
        )
    except np.linalg.LinAlgError:  # a ValueError too, whose text says nothing
        raise InputError(
            f"{experiment.path}: board.images of camera {setup.name!r}: expected images of the board's dots, found "
            "blobs that no camera sees as a board. Check that these are board images and what [board] says."
        ) from None
    except ValueError as error:
        raise InputError(f"{experiment.path}: board.images of camera {setup.name!r}: {error}") from None
    _check_planes(experiment, setup, dots, report)
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
        _compare_with_nominal(setup, fitted, missed, report)
        keep = _agreeing_dots(dots, array - fitted(points, pupil), pitch)
        baseline = fitted if settings.baseline == "thin_lens" else None
        target = array if baseline is None else array - baseline(points, pupil)
        training = train(
            np.hstack([points, pupil])[keep],
            target[keep],
            hidden=settings.hidden,
            epochs=settings.epochs,
            groups=dots.dot[keep],
            std=std[keep],
            guide=between_dots(points[keep], pupil[keep], target[keep], std[keep], pitch_mm=pitch, seed=settings.seed),
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
    report |= {
        "sigma_nor_test": training.sigma_nor,
        "dots_found": found,
        "dots_expected": expected,
        "dots_found_per_plane": dots.found.tolist(),
        "dots_expected_per_plane": dots.expected.tolist(),
        "dots_rejected": int(dots.rejected.sum()) + len(np.unique(dots.dot[~keep])),
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
    _warn(camera)
    log.info(
        "%s: %d of %d dots, sigma_nor %.4f pitch on held-out dots", setup.name, found, expected, training.sigma_nor
    )
    step(1.0)
    return camera


def _compare_with_nominal(setup: CameraSetup, fitted: ThinLensModel, missed: float, report: dict[str, Any]) -> None:
    """Warn of a camera that the dots see elsewhere, or magnifying otherwise, than the experiment file says.

    Both are measured to a fraction of a degree and of a percent, and no result depends on what is stated. But they tell
    what nothing else does: pictures turned on their side, a wrong spacing of the dots or of the planes. Where the thin
    lens misses the dots' rays by more than `EXPLAINED`, as behind a tilted window, its magnification means nothing.
    """
    nominal = thin_lens_model(setup.optics, setup.nominal_angle_deg)
    turn = Rotation.from_matrix(fitted.rotation @ nominal.rotation.T).magnitude() * 180 / math.pi
    depth = float(fitted.rotation[2] @ -fitted.offset_mm)  # of the board's middle, where the axes are said to meet
    magnification = fitted.image_distance_mm / (fitted.object_distance_mm - depth)
    ratio = magnification * nominal.object_distance_mm / nominal.image_distance_mm
    report |= {"turn_from_nominal_deg": float(turn), "magnification": float(magnification)}
    if turn > TURN_DEG:
        report["warnings"].append(
            f"{setup.name}: by the board's dots the camera stands {turn:.0f} degrees from where nominal_angle_deg = "
            f"{setup.nominal_angle_deg:g} has it. Are its pictures turned by 90 degrees? Then x and y are."
        )
    if missed < EXPLAINED and not 1 / (1 + MAGNIFICATION) < ratio < 1 + MAGNIFICATION:
        report["warnings"].append(
            f"{setup.name}: the board's dots are magnified {magnification:.3f} times, not "
            f"{abs(setup.optics.magnification):g} times as stated. Check magnification, and board.spacing_mm and "
            "board.planes_mm: all lengths and velocities depend on those two."
        )


def _check_light(
    experiment: Experiment,
    setup: CameraSetup,
    decoder: LightFieldDecoder,
    images: Sequence[np.ndarray],
    report: dict[str, Any],
) -> None:
    """Refuse, or warn of, a white image that does not belong to the board's images."""
    plane = len(images) // 2
    light = gap_light(images[plane], decoder)
    if light > GAP_LIGHT:
        path = experiment.board_path(setup.name, plane)
        if light > NO_PLACE:
            raise InputError(f"{path}: board.images of camera {setup.name!r}: {MISPLACED} Are these board images?")
        report["warnings"].append(f"{setup.name}: {path}: {MISPLACED}")


def _check_planes(experiment: Experiment, setup: CameraSetup, dots: BoardDots, report: dict[str, Any]) -> None:
    """Refuse a board seen in fewer than two planes; warn of each plane in which no dot was found, by file."""
    planes = experiment.board.planes_mm
    empty = [plane for plane in range(len(planes)) if dots.found[plane] == 0]
    shown = len(planes) - len(empty)
    if shown < FEWEST_PLANES:
        raise InputError(
            f"{experiment.path}: board.images of camera {setup.name!r}: expected dots in {FEWEST_PLANES} planes or "
            f"more, found them in {shown} of {len(planes)}. Look at {experiment.board_path(setup.name, empty[0])}."
        )
    for plane in empty:
        report["warnings"].append(
            f"{setup.name}: no dot was found in plane {plane} of the board (z = {planes[plane]:g} mm), "
            f"{experiment.board_path(setup.name, plane)}: look at the image; the calibration goes without it."
        )


def _agreeing_dots(dots: BoardDots, departure_mm: np.ndarray, pitch_mm: float) -> np.ndarray:
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


def _warn(camera: CalibratedCamera) -> None:
    """Put what a user must know into the report's warnings, and log it."""
    report, warnings = camera.report, camera.report["warnings"]
    if report["dots_found"] < 0.9 * report["dots_expected"]:
        warnings.append(
            f"{camera.name}: only {report['dots_found']} of {report['dots_expected']} board dots in the field were "
            "found; check focus, exposure and the planes listed in the report."
        )
    if report["lens_array_rms_px"] > 0.25:
        warnings.append(
            f"{camera.name}: microimages lie {report['lens_array_rms_px']:.2f} px (rms) off a regular lattice; check "
            "the white image."
        )
    for text in warnings:
        log.warning("%s", text)
