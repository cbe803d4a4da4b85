"""Whether a camera's white and board images, and what is stated of them, can be right; what a user must know if not.

What is certainly wrong is refused by an `InputError`; what is suspicious becomes one of the report's warnings.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any

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
    MISPLACED,
    NO_PLACE,
    OTHER_APERTURE,
    SATURATED,
    fingerprint,
    gap_light,
    microimage_px,
    saturated_share,
    stated_px,
)

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


def check_white(
    setup: CameraSetup,
    white: np.ndarray,
    dark: np.ndarray | None,
    decoder: LightFieldDecoder,
    report: dict[str, Any],
) -> None:
    """Hold the white image against the stated aperture, and look for saturation.

    Where the stated aperture is larger than the true one, all light falls where some is expected, and nothing else
    would tell.
    """
    told, stated = microimage_px(white, dark, decoder), stated_px(setup.optics)
    off = 0.0 if told is None else max(told / stated, stated / told) - 1
    if told is not None and off > APERTURE:
        optics = setup.optics
        text = (
            f"the microimages are {told:.1f} px wide, not {stated:.1f} px as f_number = {optics.f_number:g} and "
            f"microlens_focal_length_mm = {optics.microlens_focal_length_mm:g} have it; f_number = "
            f"{optics.f_number * stated / told:.3g} would fit. Check both, and the aperture of all images."
        )
        if off > OTHER_APERTURE:
            raise InputError(f"{setup.white_path}: white_image of camera {setup.name!r}: {text}")
        report["warnings"].append(f"{setup.name}: {text}")
    share = saturated_share(white)
    if share > SATURATED:
        report["warnings"].append(
            f"{setup.name}: {100 * share:.0f} % of the white image's bright pixels are saturated, so their response is "
            "not known; expose it to two thirds of the range."
        )


def compare_with_nominal(setup: CameraSetup, fitted: ThinLensModel, missed: float, report: dict[str, Any]) -> None:
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


def check_light(
    experiment: Experiment,
    setup: CameraSetup,
    decoder: LightFieldDecoder,
    images: Sequence[np.ndarray],
    dark: np.ndarray | None,
    report: dict[str, Any],
) -> None:
    """Refuse, or warn of, board images that are copies, saturated, or do not belong to the white image."""
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
        report["warnings"].append(
            f"{setup.name}: {100 * saturated[worst]:.0f} % of the bright pixels of {paths[worst]} are saturated and "
            "left out, so the dots are known less well; expose the board to two thirds of the range."
        )
    plane = len(images) // 2
    light = gap_light(images[plane] if dark is None else images[plane] - dark, decoder)
    if light > NO_PLACE:
        raise InputError(f"{paths[plane]}: board.images of camera {setup.name!r}: {MISPLACED} Are these board images?")
    if light > GAP_LIGHT:
        report["warnings"].append(f"{setup.name}: {paths[plane]}: {MISPLACED}")


def check_planes(experiment: Experiment, setup: CameraSetup, dots: BoardDots, report: dict[str, Any]) -> None:
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


def check_left_out(
    experiment: Experiment, setup: CameraSetup, dots: BoardDots, left_out: np.ndarray, report: dict[str, Any]
) -> None:
    """Warn of each plane of which most dots do not fit the others: wrongly placed, or another plane's image."""
    seen = dots.found + dots.rejected
    bad = np.flatnonzero((seen > 0) & (left_out >= REJECTED * seen))
    if len(bad) > len(seen) / 2:  # then it is not the planes: see `warn`
        return
    for plane in bad:
        report["warnings"].append(
            f"{setup.name}: {left_out[plane]} of {seen[plane]} dots of plane {plane} of the board (z = "
            f"{experiment.board.planes_mm[plane]:g} mm) do not fit the others and are left out: check that place in "
            f"board.planes_mm, and {experiment.board_path(setup.name, int(plane))}."
        )


def warn(camera: CalibratedCamera, estimator: str, training_dots: int) -> None:
    """Put what a user must know into the report's warnings, and log it."""
    report, warnings, sigma_nor = camera.report, camera.report["warnings"], SIGMA_NOR[estimator]
    if report["dots_found"] < 0.9 * report["dots_expected"]:
        warnings.append(
            f"{camera.name}: only {report['dots_found']} of {report['dots_expected']} board dots in the field were "
            "found; check focus, exposure and the planes listed in the report."
            + (few_pixels(camera.optics) if estimator == "lens_integral" else "")
        )
    if report["lens_array_rms_px"] > 0.25:
        warnings.append(
            f"{camera.name}: microimages lie {report['lens_array_rms_px']:.2f} px (rms) off a regular lattice; check "
            "the white image."
        )
    if camera.network is not None:
        values, parameters = VALUES_PER_DOT * training_dots, sum(layer.size for layer in camera.network.layers())
        if values < parameters:
            warnings.append(
                f"{camera.name}: {training_dots} dots tell the network {values} values for its {parameters} "
                "parameters, so it can be wrong between the dots; use more dots or planes, or fewer nodes "
                "(network.hidden)."
            )
    if not report["sigma_nor_test"] <= sigma_nor:
        warnings.append(
            f"{camera.name}: the mapping is {report['sigma_nor_test']:.3f} pitch off on held-out dots (sigma_nor), "
            f"{sigma_nor:g} and less is usual; use more dots or planes, and check the board's images."
        )
    for text in warnings:
        log.warning("%s", text)
