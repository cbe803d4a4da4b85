"""Check the white and board images of a camera and the fitted mapping against the stated optics, pose and board.

What is impossible is refused by an `InputError`. What is doubtful becomes a warning.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lfpiv.calibration.board.board import few_pixels
from lfpiv.calibration.board.dots import BoardDots, DotBoard
from lfpiv.calibration.board.errors import BoardErrors
from lfpiv.calibration.board.pupil_zones import worst
from lfpiv.calibration.liquid import LiquidSurface
from lfpiv.calibration.network import Network
from lfpiv.calibration.plane_focus import mistaken_depths
from lfpiv.calibration.quality import CalibrationQuality
from lfpiv.calibration.thin_lens_model import ThinLensModel
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import CameraSetup, Experiment, white_level
from lfpiv.geometry.optics import LensLattice
from lfpiv.geometry.orientation import Orientation
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.frame_comparison import fingerprint
from lfpiv.lightfield.image_checks import (
    APERTURE,
    OTHER_APERTURE,
    microimage_px,
    stated_px,
)
from lfpiv.lightfield.saturation import SATURATED, saturated_share
from lfpiv.lightfield.tone_curve import CURVED, tone_exponent
from lfpiv.warn import Code, Warning, warn

log = logging.getLogger(__name__)

TURN_DEG = 20.0
"""Rotation from the nominal pose above which a warning is due [degree]."""
MAGNIFICATION = 0.04
"""Relative difference from the stated magnification above which a warning is due."""
LENS_PITCH = 0.03
"""Relative difference from the stated pitch of the microlenses above which a warning is due."""
EXPLAINED_PITCH = 0.2
"""Median residual of the thin lens below which its magnification is compared [microlens pitch]."""
PUPIL_SCALE, PUPIL_SCALE_INCOMPLETE = 0.3, 0.1
"""Largest difference of the fitted pupil scale from 1 where no thin lens fits the labels, and the same where over a
tenth of the dots are missing."""
FITTED_PITCH = 0.1
"""Median residual of the thin lens up to which labels are right whatever its pupil [microlens pitch]."""
MEDIUM = 0.1
"""Difference of the refractive index of what the board stands in from 1 above which a warning is due."""
COMPLETE = 0.9
"""Part of the expected dots that a complete board shows."""
HIDDEN_SHARE, HIDDEN_PITCH = 0.4, 0.05
"""Share of the dots whose light stays within one microlens from which a warning is due, and the light beyond the
microlens that is hardly seen [pitch]."""
SIGMA_NOR_PITCH = {"lens_integral": 0.03, "gaussian": 0.1}
"""Error on held-out dots above which a warning is due, by estimator [microlens pitch]."""
LENS_ARRAY_RMS_PX = 0.25
"""Distance of the microimages from a lattice above which a warning is due [pixel]."""
VALUES_PER_DOT = 12
"""Values that one dot contributes: a ray model for s and t, quadratic in the pupil point."""
REJECTED = 0.5
"""Part of a plane's dots that is rejected above which a warning is due."""
STEEPEST_DEG = 4.0
"""Largest tilt of a plane of the board against the others [degree]: ten times what a stage does."""
OFF_PITCHES = 1.0
"""Distance of a plane's dots from where they are stated to be above which a warning is due [microlens pitch]."""
ROUNDING = 0.4
"""Noise of the gaps up to which an image has none, apart from rounding [counts]."""
FEWEST_PLANES = 2
"""Least number of planes. One plane does not determine the camera's depth."""


def check_white(setup: CameraSetup, white: np.ndarray, dark: np.ndarray | None, decoder: LightFieldDecoder) -> None:
    """Compare distance and diameter of the microimages with the stated optics, and warn of saturation and a tone curve.

    No other check finds a stated aperture that is larger than the true one.

    Raises
    ------
    InputError
        If the diameter differs by more than `OTHER_APERTURE`.
    """
    _check_pitch(setup, decoder.lattice.pitch_mm / setup.optics.microlens_pitch_mm)
    seen, stated = microimage_px(white, dark, decoder), stated_px(setup.optics)
    difference = 0.0 if seen is None else max(seen / stated, stated / seen) - 1
    if seen is not None and difference > APERTURE:
        optics = setup.optics
        figures = {
            "seen_px": seen,
            "stated_px": stated,
            "f_number": optics.f_number,
            "microlens_focal_length_mm": optics.microlens_focal_length_mm,
            "fitting": optics.f_number * stated / seen,
        }
        warning = Warning(code=Code.APERTURE, figures=figures)
        if difference > OTHER_APERTURE:
            raise InputError(f"{setup.white_path}: white_image of camera {setup.name!r}: {warning.sentence}")
        warn(log, replace(warning, subject=setup.name))
    noisy = decoder.background(white)[1] > ROUNDING  # without noise the middles of all microimages share one value
    share = saturated_share(white, white_level(setup.white_path, setup), piles=noisy)
    if share > SATURATED:
        warn(log, Warning(code=Code.WHITE_SATURATED, subject=setup.name, figures={"share": share}))
    _check_tones(f"{setup.name}, white image", white)


def _check_tones(subject: str, image: np.ndarray) -> None:
    if (exponent := tone_exponent(image)) > CURVED:
        warn(log, Warning(code=Code.TONE_CURVE, subject=subject, figures={"exponent": exponent}))


def _check_pitch(setup: CameraSetup, ratio: float) -> None:
    """Warn if the microlenses' pitch in the white image over the stated one tells another pitch or pixel size."""
    if abs(ratio - 1) > LENS_PITCH:
        optics = setup.optics
        figures = {
            "seen_px": optics.microimage_pitch_px * ratio,
            "stated_px": optics.microimage_pitch_px,
            "microlens_pitch_mm": optics.microlens_pitch_mm,
            "pixel_um": 1000 * optics.pixel_mm,
            "fitting_mm": optics.microlens_pitch_mm * ratio,
            "fitting_um": 1000 * optics.pixel_mm / ratio,
        }
        warn(log, Warning(code=Code.LENS_PITCH, subject=setup.name, figures=figures))


@dataclass(frozen=True, kw_only=True)
class NominalDifference:
    """Pose and magnification of a camera, fitted to the dots, against the stated ones."""

    turn_deg: float
    """Rotation from the stated orientation [degree], nan without one."""
    magnification: float
    """Magnification at the middle of the board."""


def check_pupil(
    experiment: Experiment, setup: CameraSetup, dots: BoardDots, fitted: ThinLensModel, residual_pitch: float
) -> None:
    """Refuse labels that fit only a camera with another pupil: depth and defocus of the dots contradict each other.

    Labels that a thin lens fits are right, whatever its pupil: behind a plane surface of a liquid it is another one.
    `residual_pitch` is the labels' median distance from the fitted thin lens [microlens pitch].
    """
    if residual_pitch <= FITTED_PITCH:
        return
    found, expected = dots.found.sum(), dots.expected.sum()
    limit = PUPIL_SCALE if found >= COMPLETE * expected else PUPIL_SCALE_INCOMPLETE
    if not abs(fitted.pupil_scale - 1) <= limit:
        if text := mistaken_depths(experiment, setup, dots):
            raise InputError(text)
        raise InputError(
            f"{experiment.path}: camera {setup.name!r}: the stated rig contradicts the board images. {found} of "
            f"{expected} dots were found, and their blur at each depth is that of an aperture {fitted.pupil_scale:.2f} "
            "times as wide as stated. In air, mirrored pictures or another order of the planes would not explain it: "
            "check board.planes_mm, board.spacing_mm, focal_length_mm, magnification and f_number, and that the board "
            "images are of this camera. If it looks obliquely into a liquid, check first its nominal orientation, "
            "image_flip and the order of the planes."
        )


def compare_with_nominal(
    setup: CameraSetup, fitted: ThinLensModel, residual_pitch: float, surface: LiquidSurface | None = None
) -> NominalDifference:
    """Warn where the fitted pose or magnification differs from the stated one.

    No result depends on the stated values. A difference shows rotated images or a wrong spacing of dots or planes, and
    no other check finds them. The magnification is compared only where the thin lens fits the labels, so not behind a
    tilted window. `residual_pitch` is the labels' median distance from the fitted thin lens [microlens pitch].
    `surface` is a liquid's surface if it explains the labels and the thin lens does not.
    """
    stated = setup.orientation
    rotation = (fitted if surface is None else surface.lens).rotation
    turn = math.nan
    if stated is not None:
        turn = Rotation.from_matrix(rotation @ stated.rotation.T).magnitude() * 180 / math.pi
    depth = float(fitted.rotation[2] @ -fitted.offset_mm)  # of the middle of the board
    magnification = fitted.image_distance_mm / (fitted.object_distance_mm - depth)
    ratio = magnification * setup.optics.object_distance_mm / setup.optics.image_distance_mm
    if stated is not None and turn > TURN_DEG:
        axis = Orientation.from_direction(rotation[2])
        axis = Orientation(round(axis.yaw_deg), round(axis.pitch_deg))
        figures = {"turn_deg": float(turn), "nominal": f"{stated}; its axis stands {axis}"}
        warn(log, Warning(code=Code.TURNED, subject=setup.name, figures=figures))
    if surface is not None:
        warn(log, Warning(code=Code.MEDIUM, subject=setup.name, figures=_medium(surface.index)))
    elif residual_pitch < EXPLAINED_PITCH and not 1 / (1 + MAGNIFICATION) < ratio < 1 + MAGNIFICATION:
        figures = {"magnification": float(magnification), "stated": abs(setup.optics.magnification)}
        warn(log, Warning(code=Code.MAGNIFIED, subject=setup.name, figures=figures))
    elif residual_pitch < FITTED_PITCH:
        # Behind a plane surface a point at the depth z appears at z / n. A lens without the surface, n times as far
        # away and with n times the focal length, takes the same images through the same pupil.
        index = fitted.image_distance_mm / setup.optics.image_distance_mm / fitted.pupil_scale
        if abs(index - 1) > MEDIUM:
            warn(log, Warning(code=Code.MEDIUM, subject=setup.name, figures=_medium(index)))
    return NominalDifference(turn_deg=float(turn), magnification=float(magnification))


def _medium(index: float) -> dict[str, float]:
    return {"index": index, "depth": 1 / index}


def check_light(experiment: Experiment, setup: CameraSetup, images: Sequence[np.ndarray]) -> None:
    """Refuse board images that are copies. Warn of saturation and tone curves."""
    paths = [experiment.board_path(setup.name, plane) for plane in range(len(images))]
    first: dict[bytes, int] = {}
    saturated = np.zeros(len(images))
    for plane, image in enumerate(images):
        other = first.setdefault(fingerprint(np.asarray(image, np.float32)), plane)
        if other != plane and image.min() < image.max():
            raise InputError(
                f"{paths[plane]}: board.images of camera {setup.name!r}: expected an image of its own, found the same "
                f"image as {paths[other]}. Check what was copied."
            )
        saturated[plane] = saturated_share(image, white_level(paths[plane], setup))
    worst = int(saturated.argmax())
    if saturated[worst] > SATURATED:
        figures = {"share": float(saturated[worst]), "path": str(paths[worst])}
        warn(log, Warning(code=Code.BOARD_SATURATED, subject=setup.name, figures=figures))
    plane = len(images) // 2
    _check_tones(f"{setup.name}, plane {plane}", images[plane])


def check_planes(experiment: Experiment, setup: CameraSetup, dots: BoardDots) -> None:
    """Refuse a board with dots in fewer than two planes. Warn of each plane without dots."""
    planes = experiment.board.planes_mm
    empty = [plane for plane in range(len(planes)) if dots.found[plane] == 0]
    shown = len(planes) - len(empty)
    if shown < FEWEST_PLANES:
        raise InputError(
            f"{experiment.path}: board.images of camera {setup.name!r}: expected dots in {FEWEST_PLANES} planes or "
            f"more, found them in {shown} of {len(planes)}. Look at {experiment.board_path(setup.name, empty[0])}."
        )
    for plane in empty:
        path = str(experiment.board_path(setup.name, plane))
        figures = {"plane": plane, "z_mm": planes[plane], "path": path}
        warn(log, Warning(code=Code.PLANE_EMPTY, subject=setup.name, figures=figures))


def check_rejected(experiment: Experiment, setup: CameraSetup, dots: BoardDots, rejected: np.ndarray) -> None:
    """Warn of each plane with most dots rejected: its depth is wrong, or its image belongs to another plane.

    `rejected` counts the rejected dots of each plane, with those that disagree with their neighbours.
    """
    seen = dots.found + dots.rejected
    bad = np.flatnonzero((seen > 0) & (rejected >= REJECTED * seen))
    if len(bad) > len(seen) / 2:  # the cause is not a single plane; see `check_mapping`
        return
    for plane in map(int, bad):
        figures = {
            "left_out": int(rejected[plane]),
            "seen": int(seen[plane]),
            "plane": plane,
            "z_mm": experiment.board.planes_mm[plane],
            "path": str(experiment.board_path(setup.name, plane)),
        }
        warn(log, Warning(code=Code.PLANE_LEFT_OUT, subject=setup.name, figures=figures))


def check_board(errors: BoardErrors, board: DotBoard, pitch_mm: float, path: Path) -> None:
    """Warn of each plane whose dots lie, root mean square, further off than `OFF_PITCHES`.

    `pitch_mm` is the microlens pitch as an object in focus sees it [mm], `path` the experiment file.

    Raises
    ------
    InputError
        If a plane is tilted against the others by more than `STEEPEST_DEG`: bent rays look like that, too.
    """
    tilts = np.degrees(errors.plane[:, 3:5] - np.median(errors.plane[:, 3:5], axis=0))
    steepest = int(np.hypot(*tilts.T).argmax())
    if (tilt := float(np.hypot(*tilts[steepest]))) > STEEPEST_DEG:
        raise InputError(
            f"{path}: board.planes_mm: expected planes that a stage moves without tilting them, found that the dots of "
            f"plane {steepest} (z = {board.planes_mm[steepest]:g} mm) fit only if it is tilted by {tilt:.1f} degrees "
            "against the others. If the board was not tilted, check the order of the planes, and nominal orientation "
            "and image_flip of the cameras. If these are right, rays cross a window or liquid at so steep an angle "
            "that the calibration cannot follow them: look through it more squarely, or through a prism."
        )
    dots = np.arange(len(board.planes_mm) * board.size)
    off = errors.points_mm(board, dots) - board.of_dots_mm(dots)
    rms = np.sqrt((off**2).sum(1).reshape(-1, board.size).mean(1))
    for plane in map(int, np.flatnonzero(rms > OFF_PITCHES * pitch_mm)):
        x, y = map(float, errors.plane[plane, :2])
        figures = {
            "plane": plane,
            "z_mm": board.planes_mm[plane],
            "fitted_mm": float(errors.depth_mm[plane]),
            "x_mm": x,
            "y_mm": y,
            "tilt_deg": float(np.degrees(np.hypot(*errors.plane[plane, 3:5]))),
        }
        warn(log, Warning(code=Code.PLANE_OFF, figures=figures))


def check_mapping(
    setup: CameraSetup, quality: CalibrationQuality, network: Network, estimator: str, training_dots: int
) -> None:
    """Warn of missing dots, an irregular lens array, too few dots for the network, and a large test error."""

    def doubt(code: Code, **figures: float | str) -> None:
        warn(log, Warning(code=code, subject=setup.name, figures=figures))

    if quality.dots_found < COMPLETE * quality.dots_expected:
        hint = few_pixels(setup.optics) if estimator == "lens_integral" else ""
        doubt(Code.DOTS_MISSING, found=quality.dots_found, expected=quality.dots_expected, hint=hint)
    if quality.lens_array_rms_px > LENS_ARRAY_RMS_PX:
        doubt(Code.LENSES_IRREGULAR, rms_px=quality.lens_array_rms_px)
    values, parameters = VALUES_PER_DOT * training_dots, sum(layer.size for layer in network.layers())
    if values < parameters:
        doubt(Code.FEW_LABELS, dots=training_dots, values=values, parameters=parameters)
    if not quality.sigma_nor_test <= SIGMA_NOR_PITCH[estimator]:
        doubt(Code.MAPPING_ERROR, sigma_nor=quality.sigma_nor_test, usual=SIGMA_NOR_PITCH[estimator])


def check_dot_size(setup: CameraSetup, dots: BoardDots, lens: ThinLensModel, lattice: LensLattice) -> None:
    """Warn where the light of many dots stays within one microlens along a row of the array, whatever the pupil point.

    The lens tells where their light lies, since the labels of such dots do not.
    """
    points = np.unique(dots.points_mm, axis=0)
    middle, radius = np.zeros((len(points), 2)), setup.optics.pupil_radius_mm
    chief = lens(points, middle)
    offset = chief - lattice.centres_mm(lattice.nearest(chief))
    x, y = (lens(points + dots.diameter_mm / 2 * np.eye(3)[axis], middle) - chief for axis in (0, 1))
    u, v = (lens(points, middle + radius * np.eye(2)[axis]) - chief for axis in (0, 1))
    share = 0.0
    for row in np.asarray(lattice.basis_mm) / lattice.pitch_mm:
        reach = np.abs(offset @ row) + np.hypot(x @ row, y @ row) + np.hypot(u @ row, v @ row)
        share = max(share, float(np.mean(reach < (0.5 + HIDDEN_PITCH) * lattice.pitch_mm)))
    if share > HIDDEN_SHARE:
        diameter_mm = setup.optics.microlens_pitch_mm / abs(setup.optics.magnification)
        figures = {"share": share, "diameter_mm": diameter_mm}
        warn(log, Warning(code=Code.SMALL_DOTS, subject=setup.name, figures=figures))


def check_pupil_zones(setup: CameraSetup, dots: BoardDots, pitch_mm: float) -> None:
    """Warn where the light of the dots lies beside their labels in a zone of the pupil: the lens bends rays further."""
    off_mm, (u, v) = worst(dots.left_over_mm)
    if off_mm > 0:
        figures = {"off_pitch": off_mm / pitch_mm, "u": u, "v": v, "f_number": setup.optics.f_number}
        warn(log, Warning(code=Code.PUPIL_ZONE, subject=setup.name, figures=figures))
