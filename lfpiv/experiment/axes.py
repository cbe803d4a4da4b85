"""Handedness of the world axes: what the pictures of the cameras must look like for x, y, z to be right-handed.

Images of equal dots do not show it. The mirrored light field of such a board is that of another possible rig, with
cameras at angles of the other sign (``docs/conventions.md``).
"""

from __future__ import annotations

from collections.abc import Sequence

from lfpiv.experiment.experiment import Experiment
from lfpiv.settings.rig import Flip

ORDINARY: Flip = "horizontal"
"""``image_flip`` of an ordinary camera, whose pictures are upright and not mirrored."""
MIRRORED = {"none": "horizontal", "horizontal": "none", "vertical": "both", "both": "vertical"}
"""Each ``image_flip``, and the same with left and right exchanged."""
UPSIDE_DOWN = {"none": "vertical", "vertical": "none", "horizontal": "both", "both": "horizontal"}
"""Each ``image_flip``, and the same with up and down exchanged."""
_LOOK = {
    "none": "x points left and y up",
    "horizontal": "x points right and y up",
    "vertical": "x points right and y down",
    "both": "x points left and y down",
}
"""Directions in a picture as it is recorded, by the mirroring that is reversed on reading."""


def flip_on_reading(stated: str | None, handedness: str) -> str:
    """Return the mirroring that is reversed on reading, from the keys ``image_flip`` and ``board.axes``."""
    if stated is None:
        return "none"
    return MIRRORED[stated] if handedness == "left-handed" else stated


def stated_for(flip: str, handedness: str) -> str:
    """Return the ``image_flip`` to state so that a mirroring is reversed on reading."""
    return MIRRORED[flip] if handedness == "left-handed" else flip


def names_of(cameras: Sequence[str]) -> str:
    """Return names as ``'a', 'b' and 'c'``."""
    quoted = [repr(name) for name in cameras]
    return " and ".join(part for part in (", ".join(quoted[:-1]), quoted[-1]) if part)


def directions(experiment: Experiment) -> str:
    """Say where x and y point in the recorded pictures of each camera, as it is stated."""
    groups: dict[str, list[str]] = {}
    for camera in experiment.cameras:
        groups.setdefault(camera.image_flip, []).append(camera.name)
    return "; ".join(f"{_LOOK[flip]} for {names_of(names)}" for flip, names in groups.items())


def handedness(experiment: Experiment) -> str:
    """Say whether x, y, z are right-handed, as far as it is stated."""
    if experiment.board.axes == "left-handed":
        return "x, y, z are left-handed, as board.axes says: vorticity has the other sign"
    unstated = [camera.name for camera in experiment.cameras if camera.stated_flip is None]
    if not unstated:
        return "x, y, z are right-handed if the pictures look as image_flip says"
    return (
        f"image_flip is not stated for {names_of(unstated)}: x, y, z are right-handed only if these pictures are "
        "mirrored left to right; where they are not, state image_flip and correct the signs of the angles"
    )
