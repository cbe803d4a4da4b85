"""Try mistakes that leave a board's dots unlike what the stated rig shows: mirrored pictures, planes elsewhere.

A camera whose pictures are mirrored sees the board as a camera with a mirror image of its orientation. So a mistake is
another nominal rotation, or other depths of the planes. Where the dots are in focus and lie on the lattice in all
planes, their contrast is high. The mistake with the clearly highest contrast fits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lfpiv.calibration.board.detect import find_in_planes, rectifier
from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.first_lattice import first_lattice
from lfpiv.calibration.board.planes import Signals
from lfpiv.calibration.board.pose import CameraPose
from lfpiv.geometry.orientation import Orientation
from lfpiv.lightfield.decoder import LightFieldDecoder

CLEAR = 1.05
"""Least ratio of light by which a mistake must surpass what is stated."""
SHARP = 0.5
"""The board is behind a liquid if the best mistake in air has less than this share of the contrast in a liquid."""
ALIKE_DEG = 20.0
"""Largest angle between two orientations, each correct to ten degrees, that may be the same [degree]."""

_BOARD_MIRRORS = [np.diag([a, b, 1.0]) for a in (1, -1) for b in (1, -1)]


@dataclass(frozen=True, kw_only=True)
class Mistake:
    """How the pictures of a camera and the planes of the board differ from what is stated."""

    left_right: bool = False
    """Pictures are mirrored left to right."""
    up_down: bool = False
    """Pictures are upside down."""
    planes: str = ""
    """"", or "reversed" or "negated": the order or the sign of the depths."""
    stretch: float = 1.0
    """The depths over the stated ones."""

    @property
    def mirror(self) -> np.ndarray:
        """Matrix from the camera axes that are stated to those of the pictures, shape (3, 3)."""
        return np.diag([-1.0 if self.left_right else 1.0, -1.0 if self.up_down else 1.0, 1.0])

    def orientation(self, stated: Orientation) -> Orientation:
        """Return the orientation from which a camera would take the pictures, but for a mirror image of the board."""
        yaw, pitch, roll = stated.yaw_deg, stated.pitch_deg, stated.roll_deg
        return Orientation(
            yaw_deg=-yaw if self.left_right else yaw,
            pitch_deg=-pitch if self.up_down else pitch,
            roll_deg=-roll if self.left_right != self.up_down else roll,
        )

    def depths_mm(self, planes_mm: tuple[float, ...]) -> tuple[float, ...]:
        """Return the depths of the planes [mm]."""
        depths = tuple(self.stretch * z for z in planes_mm)
        return {"": depths, "reversed": depths[::-1], "negated": tuple(-z for z in depths)}[self.planes]


RIGHT = Mistake()
"""No mistake."""


def turn_deg(one: np.ndarray, other: np.ndarray) -> float:
    """Return the least angle between two orientations, in any mirror image of a board of equal dots [degree]."""
    traces = (float(np.trace(one.T @ other @ mirror)) for mirror in _BOARD_MIRRORS if np.linalg.det(mirror) > 0)
    if np.linalg.det(one) * np.linalg.det(other) < 0:
        traces = (float(np.trace(one.T @ other @ mirror)) for mirror in _BOARD_MIRRORS if np.linalg.det(mirror) < 0)
    return float(np.degrees(np.arccos(np.clip((max(traces) - 1) / 2, -1, 1))))


def mistakes(orientation: Orientation, planes_mm: tuple[float, ...]) -> list[Mistake]:
    """Return the mistakes that the dots of a camera can show, none first."""
    mirrors: list[Mistake] = []
    for left_right, up_down in ((False, False), (True, False), (False, True), (True, True)):
        one = Mistake(left_right=left_right, up_down=up_down)
        seen = one.mirror @ orientation.rotation
        if all(turn_deg(seen, known.mirror @ orientation.rotation) > ALIKE_DEG for known in mirrors):
            mirrors.append(one)
    orders: dict[tuple[float, ...], str] = {}
    for planes in ("", "reversed", "negated"):
        orders.setdefault(Mistake(planes=planes).depths_mm(planes_mm), planes)
    return [replace(mirror, planes=planes) for planes in orders.values() for mirror in mirrors]


def contrast(
    signals: Signals,
    decoder: LightFieldDecoder,
    board: DotBoard,
    orientation: Orientation,
    mistake: Mistake,
    *,
    in_liquid: bool = False,
) -> float:
    """Return the sum of the dots' contrasts in all planes if a mistake was made; 0 without a lattice."""
    board = replace(board, planes_mm=mistake.depths_mm(board.planes_mm))
    plan = CameraPose.from_plan(decoder.optics, orientation)
    plan = replace(plan, nominal_rotation=mistake.mirror @ plan.nominal_rotation)
    plan = plan.behind_liquid if in_liquid else plan
    rectify = rectifier(decoder, board, plan)
    start = first_lattice(signals, rectify, board, plan)
    if not start.regular:
        return 0.0
    pose = plan.fitted(start.points_mm, start.chief_mm, decoder.optics)
    planes, _ = find_in_planes(signals, rectify, board, pose, start.sign, decoder.optics)
    return sum(plane.light for plane in planes)


def likely_mistake(
    signals: Signals,
    decoder: LightFieldDecoder,
    board: DotBoard,
    orientation: Orientation,
    *,
    stretches: Sequence[float],
    in_liquid: Callable[[], Mistake | None],
) -> Mistake | None:
    """Return the mistake that clearly fits the dots best: `RIGHT` for the stated rig, None if none fits clearly.

    `stretches` are the depths of the planes over the stated ones that are tried. Behind a liquid no mistake makes the
    dots sharp: `in_liquid` is called there, and its answer returned.
    """
    tried = mistakes(orientation, board.planes_mm)
    tried += [Mistake(stretch=stretch) for stretch in stretches]
    found = [contrast(signals, decoder, board, orientation, mistake) for mistake in tried]
    best = int(np.argmax(found))
    if found[best] < SHARP * contrast(signals, decoder, board, orientation, RIGHT, in_liquid=True):
        return in_liquid()
    if not found[best]:
        return None
    if best == 0:
        return RIGHT
    return tried[best] if found[best] > CLEAR * found[0] else None
