"""Whether a camera's white and board images, and what is stated of them, can be right; what a user must know if not.

What is certainly wrong is refused by an `InputError`; what is suspicious becomes one of the report's warnings.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from lfpiv.calibration.board.board import BoardDots, few_pixels
from lfpiv.calibration.camera import CalibratedCamera
from lfpiv.calibration.thin_lens_model import ThinLensModel, thin_lens_model
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.image_checks import (
    APERTURE,
    GAP_LIGHT,
    NO_PLACE,
    OTHER_APERTURE,
    SATURATED,
    fingerprint,
    gap_light,
    microimage_px,
    saturated_share,
    stated_px,
)
from lfpiv.warn import SENTENCES, Code, Warning, warn

log = logging.getLogger(__name__)

TURN_DEG = 20.0
"""Turn of a camera from its nominal pose that is no misalignment: ten degrees are allowed, and windows bend rays."""
MAGNIFICATION = 0.04
"""Relative difference from the stated magnification that is worth a look; a wrong dot spacing gives half its own."""
EXPLAINED = 0.2
"""Median distance of the dots' rays from the thin lens's that it can be held to [microlens pitch]."""
SIGMA_NOR = {"lens_integral": 0.03, "gaussian": 0.1}
"""Mean error on held-out dots worth a warning, by the dots' estimator [microlens pitch]: good boards leave 0.002 to
0.01, and Gaussian fits, whose own error is 0.04 to 0.07, some 0.05."""
VALUES_PER_DOT = 12
"""Numbers that a dot tells: its ray model, quadratic in the pupil point, for s and t. Its 37 labels are no more."""
REJECTED = 0.5
"""Part of a plane's dots that is left out, from which on something is wrong with the plane."""
FEWEST_PLANES = 2
"""Planes of the board a calibration needs: one alone does not tell the camera's depth."""


def check_white(setup: CameraSetup, white: np.ndarray, dark: np.ndarray | None, decoder: LightFieldDecoder) -> None:
    """Compare the microimages of the white image with the stated aperture, and warn of saturation.

    With a stated aperture larger than the true one all light falls where some is expected; no other check finds that.

    Raises
    ------
    InputError
        If the microimages cannot be those of the stated optics.
    """
    seen, stated = microimage_px(white, dark, decoder), stated_px(setup.optics)
    off = 0.0 if seen is None else max(seen / stated, stated / seen) - 1
    if seen is not None and off > APERTURE:
        optics = setup.optics
        figures = {
            "seen_px": seen,
            "stated_px": stated,
            "f_number": optics.f_number,
            "microlens_focal_length_mm": optics.microlens_focal_length_mm,
            "fitting": optics.f_number * stated / seen,
        }
        warning = Warning(code=Code.APERTURE, figures=figures)
        if off > OTHER_APERTURE:
            raise InputError(f"{setup.white_path}: white_image of camera {setup.name!r}: {warning.sentence}")
        warn(log, replace(warning, subject=setup.name))
    share = saturated_share(white)
    if share > SATURATED:
        warn(log, Warning(code=Code.WHITE_SATURATED, subject=setup.name, figures={"share": share}))


@dataclass(frozen=True, kw_only=True)
class NominalDifference:
    """Pose and magnification of a camera, as the board's dots show them, against the stated ones."""

    turn_deg: float
    """Rotation from the stated pose [degree]."""
    magnification: float
    """Magnification of the board's middle."""


def compare_with_nominal(setup: CameraSetup, fitted: ThinLensModel, missed: float) -> NominalDifference:
    """Warn of a camera that the dots see in another pose, or magnifying otherwise, than the experiment file states.

    No result depends on the stated values. But a difference shows images turned on their side, or a wrong spacing of the
    dots or planes, which no other check finds. Where the thin lens misses the dots' rays by more than `EXPLAINED`, as
    behind a tilted window, its magnification is not compared.
    """
    nominal = thin_lens_model(setup.optics, setup.nominal_angle_deg)
    turn = Rotation.from_matrix(fitted.rotation @ nominal.rotation.T).magnitude() * 180 / math.pi
    depth = float(fitted.rotation[2] @ -fitted.offset_mm)  # of the board's middle
    magnification = fitted.image_distance_mm / (fitted.object_distance_mm - depth)
    ratio = magnification * nominal.object_distance_mm / nominal.image_distance_mm
    if turn > TURN_DEG:
        figures = {"turn_deg": float(turn), "nominal_deg": setup.nominal_angle_deg}
        warn(log, Warning(code=Code.TURNED, subject=setup.name, figures=figures))
    if missed < EXPLAINED and not 1 / (1 + MAGNIFICATION) < ratio < 1 + MAGNIFICATION:
        figures = {"magnification": float(magnification), "stated": abs(setup.optics.magnification)}
        warn(log, Warning(code=Code.MAGNIFIED, subject=setup.name, figures=figures))
    return NominalDifference(turn_deg=float(turn), magnification=float(magnification))


def check_light(
    experiment: Experiment,
    setup: CameraSetup,
    decoder: LightFieldDecoder,
    images: Sequence[np.ndarray],
    dark: np.ndarray | None,
) -> None:
    """Refuse board images that are copies or belong to another white image; warn of saturated and doubtful ones."""
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
        saturated[plane] = saturated_share(image)
    worst = int(saturated.argmax())
    if saturated[worst] > SATURATED:
        figures = {"share": float(saturated[worst]), "path": str(paths[worst])}
        warn(log, Warning(code=Code.BOARD_SATURATED, subject=setup.name, figures=figures))
    plane = len(images) // 2
    light = gap_light(images[plane] if dark is None else images[plane] - dark, decoder)
    if light > NO_PLACE:
        raise InputError(
            f"{paths[plane]}: board.images of camera {setup.name!r}: {SENTENCES[Code.MISPLACED]} Are these board images?"
        )
    if light > GAP_LIGHT:
        warn(log, Warning(code=Code.BOARD_MISPLACED, subject=setup.name, figures={"path": str(paths[plane])}))


def check_planes(experiment: Experiment, setup: CameraSetup, dots: BoardDots) -> None:
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
        path = str(experiment.board_path(setup.name, plane))
        figures = {"plane": plane, "z_mm": planes[plane], "path": path}
        warn(log, Warning(code=Code.PLANE_EMPTY, subject=setup.name, figures=figures))


def check_left_out(experiment: Experiment, setup: CameraSetup, dots: BoardDots, left_out: np.ndarray) -> None:
    """Warn of each plane of which most dots do not fit the others: wrongly placed, or another plane's image."""
    seen = dots.found + dots.rejected
    bad = np.flatnonzero((seen > 0) & (left_out >= REJECTED * seen))
    if len(bad) > len(seen) / 2:  # most planes: the cause is not a plane, see `check_mapping`
        return
    for plane in map(int, bad):
        figures = {
            "left_out": int(left_out[plane]),
            "seen": int(seen[plane]),
            "plane": plane,
            "z_mm": experiment.board.planes_mm[plane],
            "path": str(experiment.board_path(setup.name, plane)),
        }
        warn(log, Warning(code=Code.PLANE_LEFT_OUT, subject=setup.name, figures=figures))


def check_mapping(camera: CalibratedCamera, estimator: str, training_dots: int) -> None:
    """Warn of few dots, an irregular lens array, and a mapping that misses the held-out dots."""
    report, sigma_nor = camera.report, SIGMA_NOR[estimator]

    def doubt(code: Code, **figures: float | str) -> None:
        warn(log, Warning(code=code, subject=camera.name, figures=figures))

    if report["dots_found"] < 0.9 * report["dots_expected"]:
        hint = few_pixels(camera.optics) if estimator == "lens_integral" else ""
        doubt(Code.DOTS_MISSING, found=report["dots_found"], expected=report["dots_expected"], hint=hint)
    if report["lens_array_rms_px"] > 0.25:
        doubt(Code.LENSES_IRREGULAR, rms_px=report["lens_array_rms_px"])
    if camera.network is not None:
        values, parameters = VALUES_PER_DOT * training_dots, sum(layer.size for layer in camera.network.layers())
        if values < parameters:
            doubt(Code.FEW_LABELS, dots=training_dots, values=values, parameters=parameters)
    if not report["sigma_nor_test"] <= sigma_nor:
        doubt(Code.MAPPING_ERROR, sigma_nor=report["sigma_nor_test"], usual=sigma_nor)
