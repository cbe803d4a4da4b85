"""Say why the board images of the cameras contradict the stated rig: try likely mistakes, and name the fitting one."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from lfpiv.calibration import plane_focus
from lfpiv.calibration.board.dots import BoardDots, DotBoard
from lfpiv.calibration.board.hypotheses import ALIKE_DEG, RIGHT, Mistake, likely_mistake, mistakes, turn_deg
from lfpiv.calibration.board.planes import Signals, board_images
from lfpiv.calibration.liquid import LiquidSurface, median_distance, mistake_in_liquid
from lfpiv.calibration.thin_lens_model import ThinLensModel
from lfpiv.errors import InputError
from lfpiv.experiment.axes import MIRRORED, UPSIDE_DOWN, names_of, stated_for
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.image_checks import GAP_LIGHT, NO_PLACE, gap_light
from lfpiv.lightfield.lattice_fit import disagreement
from lfpiv.warn import SENTENCES, Code, Warning, warn
from lfpiv.warn.sentences import OTHER_LIGHT, SHIFTED_LIGHT

log = logging.getLogger(__name__)

COMPLETE = 0.9
"""Part of the expected dots that a complete board shows."""
STRETCHES = (0.0254, 1 / 25.4, 0.1, 0.5, 2.0, 10.0, 25.4)
"""Depths of the planes over the stated ones, if these are in another unit, or are half or twice the distances."""
WIDER, NARROWER = 1.25, 0.6
"""Aperture over the stated one if planes are twice or half as far apart: 1.40 and 0.42 were found, water shows 0.75."""
PUPIL_SCALE = 0.05
"""Difference of the fitted pupil scale from 1 above which depth and defocus of the dots may contradict each other."""
FITTED_PITCH = 0.1
"""Median residual of the thin lens up to which its pupil contradicts nothing, as behind a liquid [microlens pitch]."""
UNFITTED_PITCH = 1.0
"""Median residual of the thin lens above which labels are doubtful whatever its pupil [microlens pitch]."""
NEARER_DEG = 10.0
"""Angle by which the fitted pose must be nearer to a mirror image of the stated one than to itself [degree]."""
OTHER_ARRAY = 0.5
"""Board images belong to another camera if less light falls between the microimages of its white image: at most this
share of the light between those of the own white image."""
BAND_ROWS = 512
"""Rows of board images that are compared, in the middle of the sensor."""
NOISE = 0.2
"""Two images of the board differ by noise if diagonal neighbours of their difference correlate by less."""
SEEN = 0.5
"""Least correlation of such images, so that they show more than noise."""

Decoders = Callable[[CameraSetup], LightFieldDecoder]
Dots = Callable[[CameraSetup, LightFieldDecoder, Mistake], BoardDots | None]
"""Measures the dots of a camera as they are if a mistake was made; None where it finds none."""


def check_place(
    experiment: Experiment,
    setup: CameraSetup,
    decoder: LightFieldDecoder,
    images: Sequence[np.ndarray],
    others: Callable[[], Mapping[str, LightFieldDecoder]],
) -> None:
    """Refuse board images whose light does not lie in the microimages of the white image, or of planes at one place.

    `others` returns the decoders of the other cameras, of which an image that does not fit may be.
    """
    dark, paths = experiment.dark(setup.name), [experiment.board_path(setup.name, n) for n in range(len(images))]
    planes_mm = experiment.board.planes_mm
    for one, other in combinations(range(len(images)), 2):
        if planes_mm[one] != planes_mm[other] and _differ_by_noise(images[one], images[other]):
            raise InputError(
                f"{paths[other]}: board.images of camera {setup.name!r}: plane {other} shows, but for noise, what "
                f"plane {one} shows, while board.planes_mm has them at {planes_mm[one]:g} and {planes_mm[other]:g} mm. "
                "Give each plane its own image, and look whether the stage moved."
            )
    between, wrong, found = np.zeros(len(images)), [], ""
    for plane, image in enumerate(images):
        light = image if dark is None else image - dark
        between[plane] = gap_light(light, decoder)
        above, misplaced = light - np.float32(decoder.background(light)[0]), bool(between[plane] > NO_PLACE)
        if misplaced or disagreement(above, decoder) is not None:
            wrong.append(plane)
            found = found or _found(disagreement(above, decoder, others(), misplaced=misplaced), misplaced)
    worst = int(between.argmax())
    if wrong:
        found += " Are these board images?"
        if len(wrong) < len(images):
            which = f"plane {wrong[0]} does" if len(wrong) == 1 else f"planes {', '.join(map(str, wrong))} do"
            found += f" Only {which} not fit the white image: record the board again, or leave out what does not fit."
        raise InputError(f"{paths[wrong[0]]}: board.images of camera {setup.name!r}: {found}")
    if between[worst] > GAP_LIGHT:
        warn(log, Warning(code=Code.BOARD_MISPLACED, subject=setup.name, figures={"path": str(paths[worst])}))


def _differ_by_noise(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether two images of the board differ by noise and brightness alone.

    Noise is independent from pixel to pixel. Dots that stand or come into focus elsewhere change whole microimages.
    """
    start = max((len(first) - BAND_ROWS) // 2, 0)
    one, other = (image[start : start + BAND_ROWS].astype(float) for image in (first, second))
    one, other = one - one.mean(), other - other.mean()
    both = float((one * other).sum())
    left = other - one * (both / max(float((one**2).sum()), 1e-30))
    near = float((left[1:, 1:] * left[:-1, :-1]).sum())
    seen = both > SEEN * float(np.linalg.norm(one) * np.linalg.norm(other))
    return seen and near <= NOISE * float((left**2).sum())


def _found(shift: Mapping[str, Any] | None, misplaced: bool) -> str:
    """Say how the light of a board image lies beside the microimages of the white image."""
    sentences = [SENTENCES[Code.MISPLACED]] if misplaced else []
    if shift is not None:
        sentences.append((SHIFTED_LIGHT if "shift_px" in shift else OTHER_LIGHT).format(**shift) + ".")
    return " ".join(sentences)


def doubtful(setup: CameraSetup, dots: BoardDots, lens: ThinLensModel, surface: LiquidSurface | None) -> bool:
    """Return whether the dots of a camera may contradict its stated orientation or the order of the planes.

    Likely mistakes are then tried, which takes seconds. So a right camera may be doubtful. A camera whose labels the
    `surface` of a liquid explains is none.
    """
    stated = setup.orientation
    if stated is None or surface is not None:
        return False
    misfit = median_distance(dots.array_mm - lens(dots.points_mm, dots.pupil_mm)) / setup.optics.microlens_pitch_mm
    if misfit > UNFITTED_PITCH or (misfit > FITTED_PITCH and abs(lens.pupil_scale - 1) > PUPIL_SCALE):
        return True
    if dots.found.sum() < COMPLETE * dots.expected.sum():
        return True
    nearer = turn_deg(lens.rotation, stated.rotation) - NEARER_DEG
    mirrors = (Mistake(left_right=True).mirror, Mistake(up_down=True).mirror)
    return any(turn_deg(lens.rotation, mirror @ stated.rotation) < nearer for mirror in mirrors)


def warn_unstated(experiment: Experiment) -> None:
    """Warn where neither the experiment file nor a camera at an angle says whether pictures are mirrored."""
    cameras = experiment.cameras
    shown = (
        setup.stated_flip is not None
        or setup.orientation is None
        or Mistake(left_right=True) in mistakes(setup.orientation, ())
        for setup in cameras
    )
    if not (experiment.board.mark or any(shown)):
        figures = {"cameras": names_of([setup.name for setup in cameras])}
        warn(log, Warning(code=Code.FLIP_UNSTATED, figures=figures))


def cause(experiment: Experiment, decoder_of: Decoders, dots_of: Dots, stretches: Sequence[float] = ()) -> str | None:
    """Name the mistake that explains all board images better than the stated rig, as a message; None without one.

    A board with a mark names its dots by itself and is left out. `stretches` come from `likely_stretches`. Behind a
    liquid the labels of `dots_of` are judged.
    """
    if experiment.board.mark:
        return None
    board = DotBoard.from_settings(experiment.board)
    found: dict[str, Mistake] = {}
    decoders = {}
    for setup in experiment.cameras:
        if setup.orientation is None:
            continue
        decoders[setup.name] = decoder = decoder_of(setup)
        signals = Signals.from_images(board_images(experiment, setup.name), decoder, experiment.dark(setup.name))
        tried = [*mistakes(setup.orientation, board.planes_mm), *(Mistake(stretch=one) for one in STRETCHES)]
        wet = partial(mistake_in_liquid, partial(dots_of, setup, decoder), tried, setup.orientation, decoder.optics)
        mistake = likely_mistake(signals, decoder, board, setup.orientation, stretches=stretches, in_liquid=wet)
        if mistake is not None and mistake.planes:  # two planes in each other's place resemble the reverse order
            views = [dots for one in (RIGHT, mistake) if (dots := dots_of(setup, decoder, one)) is not None]
            if views and (text := plane_focus.mistaken_depths(experiment, setup, *views)):
                return text
        if mistake is not None and mistake != RIGHT:
            found[setup.name] = mistake
    sentences = [_exchanged(experiment, found, decoders) or _mirrors(experiment, found), _planes(experiment, found)]
    text = " ".join(sentence for sentence in sentences if sentence)
    return f"{experiment.path}: {text}" if text else None


def likely_stretches(lens: ThinLensModel | None) -> list[float]:
    """Return the ratios of true to stated depths that dots may show: other units, a half and twice.

    `lens` is the camera fitted to its dots, None if they were not found. Planes that are further apart than stated
    look as through a wider aperture.
    """
    if lens is None:
        return list(STRETCHES)
    return [one for one in STRETCHES if (lens.pupil_scale > WIDER if one > 1 else lens.pupil_scale < NARROWER)]


def _exchanged(experiment: Experiment, found: Mapping[str, Mistake], decoders: Mapping[str, LightFieldDecoder]) -> str:
    """Name two cameras whose board images fit the white image of the other one; "" if there are none."""
    middle = len(experiment.board.planes_mm) // 2
    for first, second in combinations(found, 2):
        if decoders[first].optics.sensor_shape != decoders[second].optics.sensor_shape:
            continue
        light = np.array(
            [
                [gap_light(experiment.board_image(board, middle), decoders[white]) for white in (first, second)]
                for board in (first, second)
            ]
        )
        if light[0, 1] < OTHER_ARRAY * light[0, 0] and light[1, 0] < OTHER_ARRAY * light[1, 1]:
            return (
                f"board.images: those of camera {first!r} fit the microlenses in the white image of camera {second!r}, "
                f"and the reverse. Exchange the board images of {first!r} and {second!r}, or their white images."
            )
    return ""


def _planes(experiment: Experiment, found: Mapping[str, Mistake]) -> str:
    """Name planes with a wrong order, sign or size of their depths; "" without any."""
    stretches = {mistake.stretch for mistake in found.values()}
    if len(found) == len(experiment.cameras) and len(stretches) == 1 and stretches != {1.0}:
        depths = ", ".join(f"{z:.4g}" for z in next(iter(found.values())).depths_mm(experiment.board.planes_mm))
        return (
            f"board.planes_mm: the dots come into focus as if the planes were {stretches.pop():.3g} times as far apart "
            f"as stated. Check the unit, which is the millimetre; planes_mm = [{depths}] would fit."
        )
    names = [name for name, mistake in found.items() if mistake.planes]
    if not names:
        return ""
    if len(names) < len(experiment.cameras):
        return (
            f"board.images: those of {_cameras(names)} are in the reverse order of board.planes_mm; the other cameras' "
            "images are not. Name the files in the order of the planes."
        )
    depths = ", ".join(f"{z:g}" for z in found[names[0]].depths_mm(experiment.board.planes_mm))
    return (
        "board.planes_mm: expected the depths in the order of the images, z growing towards the cameras; the dots are "
        f"in focus in another order. Set planes_mm = [{depths}]."
    )


def _mirrors(experiment: Experiment, found: Mapping[str, Mistake]) -> str:
    """Name cameras with another orientation or flip than stated, with the remedy; "" without any."""
    sentences = []
    for left_right, up_down in ((True, False), (False, True), (True, True)):
        names = [name for name, one in found.items() if (one.left_right, one.up_down) == (left_right, up_down)]
        if names:
            what = "upside down" if up_down and not left_right else "mirrored left to right"
            what = "turned by 180 degrees" if left_right and up_down else what
            sentences.append(_remedy(experiment, names, what, _flips(experiment, names, left_right, up_down)))
    return " ".join(sentences)


def _flips(experiment: Experiment, names: list[str], left_right: bool, up_down: bool) -> str:
    """Return the values of ``image_flip`` that reverse what the pictures of some cameras show."""
    values: dict[str, list[str]] = {}
    for name in names:
        flip = experiment.camera(name).image_flip
        flip = MIRRORED[flip] if left_right else flip
        flip = UPSIDE_DOWN[flip] if up_down else flip
        values.setdefault(stated_for(flip, experiment.board.axes), []).append(name)
    return " and ".join(f'image_flip = "{flip}" for {_cameras(whose)}' for flip, whose in values.items())


def _remedy(experiment: Experiment, names: list[str], what: str, flips: str) -> str:
    """Say what the pictures of some cameras look like, and what to set. `flips` are the values that fit."""
    others = [camera.name for camera in experiment.cameras if camera.name not in names]
    key = _key(experiment, names)
    unlike = f", unlike those of {_cameras(others)}" if others else ""
    flips_stated = sorted({str(experiment.camera(name).stated_flip) for name in names})
    stated = ", ".join("image_flip is absent" if flip == "None" else f'image_flip = "{flip}"' for flip in flips_stated)
    seen = f"the pictures of {_cameras(names)} are {what} against what is stated ({stated}){unlike}."
    if others and _same_place(experiment, names, others):
        return f"{seen} Change the sign of {key} of {_cameras(names)}, or set {flips}."
    ordinary = {experiment.camera(name).stated_flip for name in names} <= {"horizontal", "vertical"}
    if what == "mirrored left to right" and not others and ordinary:
        other = "right-handed" if experiment.board.axes == "left-handed" else "left-handed"
        return (
            f"{seen} Change the sign of {key} of {_cameras(names)}: it is positive on the side of +x, and x points to "
            f"the right as the cameras see it. Where a mirror is in the way, set {flips} instead; where x is meant to "
            f'point the other way, board.axes = "{other}".'
        )
    other = ", or the board images of two cameras are exchanged" if _facing(experiment, names) else ""
    if what == "mirrored left to right" and not experiment.board.mark:  # a board without a mark looks alike upside down
        flips += f", or {_flips(experiment, names, True, True)} where they are upside down, too"
    return f"{seen} Set {flips}. If the pictures do lie as stated, {key} has the wrong sign{other}. See `lfpiv check`."


def _facing(experiment: Experiment, names: list[str]) -> bool:
    """Return whether two cameras are stated where the mirror images of each other would be."""
    stated = [one for name in names if (one := experiment.camera(name).orientation) is not None]
    mirror = Mistake(left_right=True).mirror
    return any(turn_deg(mirror @ one.rotation, other.rotation) < ALIKE_DEG for one, other in combinations(stated, 2))


def _same_place(experiment: Experiment, names: list[str], others: list[str]) -> bool:
    """Return whether two cameras, of different groups, are stated to stand at the same place."""
    stated = [[experiment.camera(name).orientation for name in some] for some in (names, others)]
    return any(
        np.degrees(np.arccos(np.clip(one.rotation[2] @ other.rotation[2], -1, 1))) < ALIKE_DEG
        for one in stated[0]
        for other in stated[1]
        if one is not None and other is not None
    )


def _key(experiment: Experiment, names: list[str]) -> str:
    stated = [experiment.camera(name).orientation for name in names]
    return "nominal_direction" if any(one is not None and one.pitch_deg for one in stated) else "nominal_angle_deg"


def _cameras(names: list[str]) -> str:
    return f"camera {names_of(names)}" if len(names) == 1 else f"cameras {names_of(names)}"
