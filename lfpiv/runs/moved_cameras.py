"""Cameras that moved since the board was recorded: warn about them, or correct the calibration.

Both use the particle images of the first frame of some pairs. `check` measures how far apart the cameras show the same
particles; `correct` fits the movements of the cameras to these disparities.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv.lightfield.particle_signal import NOISE
from lfpiv.progress import StepProgress
from lfpiv.runs.frame_light import frame_light, read_darks
from lfpiv.selfcalibration.disparity import SEARCH_VOXEL, disparities, unlinked
from lfpiv.selfcalibration.movements import SelfCalibration, explained_mm, fit_movements, self_calibrate
from lfpiv.warn import Code, Warning, warn

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera, Calibration
    from lfpiv.experiment.experiment import Experiment
    from lfpiv.selfcalibration.movements import Movement
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

LARGE_VOXEL = 0.5
"""Disparity of the cameras above which `check` warns [voxel]."""

TRIED = 3
"""Largest number of pairs that `check` tries."""


@dataclass(frozen=True, kw_only=True)
class MovementFigures:
    """Movement of one camera, with standard errors."""

    shift_mm: Sequence[float]
    shift_std_mm: Sequence[float]
    rotation_deg: Sequence[float]
    rotation_std_deg: Sequence[float]

    @classmethod
    def of(cls, movement: Movement) -> MovementFigures:
        """Round a movement for the summary."""
        return cls(
            shift_mm=np.round(movement.shift_mm, 5).tolist(),
            shift_std_mm=np.round(movement.std[:3], 5).tolist(),
            rotation_deg=np.round(np.degrees(movement.rotation_rad), 4).tolist(),
            rotation_std_deg=np.round(np.degrees(movement.std[3:]), 4).tolist(),
        )


@dataclass(frozen=True, kw_only=True)
class SelfCalibrationFigures:
    """Figures of a self-calibration for the summary."""

    pairs: Sequence[int]
    """Pairs whose images were used."""
    corrections: int
    disparity_before_voxel: float
    disparity_voxel: float
    movements: Mapping[str, MovementFigures]
    """Camera -> its movement."""

    def to_json(self) -> dict[str, Any]:
        """Return the form that a file stores."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> SelfCalibrationFigures:
        """Read the form that a file stores."""
        movements = {name: MovementFigures(**one) for name, one in stored["movements"].items()}
        return cls(**{**stored, "movements": movements})


@dataclass(frozen=True, kw_only=True)
class CameraDisparity:
    """Distance at which the cameras show the same particles."""

    voxel: float
    pair: int
    """Pair that it was measured with."""


def correct(
    experiment: Experiment, calibration: Calibration, progress: StepProgress
) -> tuple[SelfCalibration, SelfCalibrationFigures]:
    """Correct a calibration by the pairs that the experiment names; return it with its figures.

    Raises
    ------
    ValueError
        If images cannot be used, or show too few particles to find the movements.
    """
    pairs, darks, frame = experiment.self_calibration_pairs, read_darks(experiment), experiment.frames[0]
    images = [frame_light(experiment, calibration.cameras, darks, pair, frame).images for pair in pairs]
    found = self_calibrate(calibration, experiment.grid, images, progress=progress)
    before, after = (apart / experiment.grid.voxel_mm for apart in (found.apart_mm[0], found.apart_mm[-1]))
    corrections = len(found.apart_mm) - 1
    log.info("self-calibration: cameras were %.2f voxel apart, now %.2f (%d corrections)", before, after, corrections)
    return found, SelfCalibrationFigures(
        pairs=pairs,
        corrections=corrections,
        disparity_before_voxel=round(before, 3),
        disparity_voxel=round(after, 3),
        movements={name: MovementFigures.of(movement) for name, movement in found.movements.items()},
    )


def check(experiment: Experiment, weights: Weights, pairs: Iterable[int]) -> CameraDisparity | None:
    """Measure with the first usable pair how far apart the cameras show the same particles; warn if it is far.

    Return None if there is one camera only, if no pair shows particles, or if the cameras show none in common. Warn in
    the last case.
    """
    if len(weights.cameras) < 2 or weights.method != "footprint":
        return None
    darks, grid = read_darks(experiment), experiment.grid
    without_links = dict[int, list[str]]()
    for pair in islice(pairs, TRIED):
        try:
            light = frame_light(experiment, weights.cameras, darks, pair, experiment.frames[0])
            if min(light.structure.values()) < NOISE:
                continue
            found = disparities(weights, [light.images])
        except ValueError as error:  # a pair that cannot be used fails when it is reconstructed
            log.debug("disparity of the cameras in pair %d: %s", pair, error)
            continue
        if lost := unlinked(found, weights.cameras):
            without_links[pair] = lost
            continue
        disparity = explained_mm(found, fit_movements(found, list(weights.cameras), grid), grid) / grid.voxel_mm
        log.info("cameras show the particles of pair %d within %.2f voxel of each other", pair, disparity)
        if disparity > LARGE_VOXEL:
            warn(log, _apart(disparity, experiment, weights.cameras))
        return CameraDisparity(voxel=round(disparity, 3), pair=pair)
    if without_links:
        warn(log, _nothing_in_common(without_links, len(weights.cameras)))
    return None


def _apart(disparity: float, experiment: Experiment, cameras: Mapping[str, CalibratedCamera]) -> Warning:
    names = " and ".join(cameras) if len(cameras) == 2 else "the cameras"
    advice = (
        "record the board again"
        if experiment.self_calibration.pairs
        else f"set self_calibration.pairs = {min(5, experiment.pairs)}, or record the board again"
    )
    distance_mm = disparity * experiment.grid.voxel_mm
    return Warning(code=Code.APART, figures={"names": names, "voxel": disparity, "mm": distance_mm, "advice": advice})


def _nothing_in_common(lost: Mapping[int, Sequence[str]], cameras: int) -> Warning:
    """Return the warning about the cameras, by pair, that share no particle with another camera."""
    names = dict.fromkeys(name for some in lost.values() for name in some)
    others = "" if len(names) == cameras else " and the other cameras"
    figures = {"names": f"{' and '.join(names)}{others}", "search": SEARCH_VOXEL}
    return Warning(code=Code.NOTHING_IN_COMMON, pairs=tuple(lost), figures=figures)
