"""Find a camera that shows the second frames of pairs elsewhere than the first ones, beside the other cameras.

Particles move alike in all cameras, and a camera that moved before the recording shows both frames at the same wrong
place. So the first frames are the measure: what is left is a camera that moved between its exposures, or images that
were shifted. A shift in the plane of the lines of sight is another depth to all cameras (`shifted_images` finds it).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.selfcalibration.disparity import CameraVolumes, unlinked
from lfpiv.selfcalibration.movements import MovementFit, fit_movements
from lfpiv.warn import Code, Warning

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

MOVED_VOXEL = 0.5
"""Least distance between both frames that is told [voxel]. Sound rigs show less than 0.1 by three pairs."""
FRAMES = 2
"""Instants of a pair."""


def moved_frames(volumes: CameraVolumes, cameras: Mapping[str, CalibratedCamera], *, in_order: bool) -> Warning | None:
    """Return the warning about a camera whose second frames are elsewhere than its first ones; None if there is none.

    `volumes` holds both frames of some pairs, one pair after the other. `in_order`: no camera's frames are exchanged;
    else the warning names that cause, too.
    """
    moved = _between(volumes, cameras)
    voxel_mm = volumes.weights.volume.voxel_mm
    if moved is None or moved.separation.mm < MOVED_VOXEL * voxel_mm:
        return None
    if not moved.separation.significant:
        alone = (_between(part, cameras) for part in volumes.each(FRAMES))
        if not moved.agrees_with(one for one in alone if one is not None):
            return None
    shifts = {name: movement.shift_mm for name, movement in moved.movements.items()}
    others = len(shifts) / (len(shifts) - 1)  # shifts have the mean zero
    apart = {name: others * shift for name, shift in shifts.items()}
    name = max(apart, key=lambda one: float(np.linalg.norm(apart[one])))
    named = list(cameras) if len(cameras) == 2 else [name]
    camera, centre = cameras[name], volumes.weights.volume.centre_mm
    ends = camera.map(np.stack([centre, centre + apart[name]]), np.zeros((2, 2)))
    lenses = float(np.linalg.norm(ends[1] - ends[0])) / camera.optics.microlens_pitch_mm
    figures: dict[str, float | str] = {"voxel": moved.separation.mm / voxel_mm, "lenses": lenses}
    figures["cause"] = "its images are shifted" + ("" if in_order else ", or its two frames are exchanged")
    return Warning(code=Code.MOVED_FRAMES, subject=" or ".join(named), figures=figures)


def _between(volumes: CameraVolumes, cameras: Mapping[str, CalibratedCamera]) -> MovementFit | None:
    """Return the movements of the cameras from first to second frames; None where a camera shows nothing in common."""
    fits = []
    for part in volumes.every(FRAMES):
        found = part.disparities()
        if unlinked(found, cameras):
            return None
        fits.append(fit_movements(found, list(cameras), volumes.weights.volume))
    return fits[1].since(fits[0])
