"""What a run does about cameras that moved since the board was recorded: it says so, or corrects the calibration."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv.lightfield.particle_signal import NOISE, seen_structure
from lfpiv.runs.pair import read_light
from lfpiv.selfcalibration.disparity import SEARCH_VOXEL, disparities, unlinked
from lfpiv.selfcalibration.movements import SelfCalibration, explained_mm, fit_movements, self_calibrate
from lfpiv.warn import Code, Warning, warn

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera, Calibration
    from lfpiv.experiment.experiment import Experiment
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

LARGE_VOXEL = 0.5
"""Disparity above which a warning is due [voxel]: at one voxel vectors are half as far off again."""

TRIED = 3
"""Pairs that are tried where the first ones cannot tell."""


def correct(
    experiment: Experiment, calibration: Calibration, progress: Callable[[float], None]
) -> tuple[SelfCalibration, dict[str, Any]]:
    """Correct a calibration by the pairs that the experiment names; also its figures for the summary.

    Raises
    ------
    ValueError
        If images cannot be used, or do not tell how the cameras stand.
    """
    pairs = experiment.self_calibration_pairs
    darks = _darks(experiment)
    images = [_light(experiment, calibration.cameras, darks, pair) for pair in pairs]
    found = self_calibrate(calibration, experiment.grid, images, progress=progress)
    movements = {
        name: {
            "shift_mm": np.round(move.shift_mm, 5).tolist(),
            "shift_std_mm": np.round(move.std[:3], 5).tolist(),
            "rotation_deg": np.round(np.degrees(move.rotation_rad), 4).tolist(),
            "rotation_std_deg": np.round(np.degrees(move.std[3:]), 4).tolist(),
        }
        for name, move in found.movements.items()
    }
    before, after = (apart / experiment.grid.voxel_mm for apart in (found.apart_mm[0], found.apart_mm[-1]))
    corrections = len(found.apart_mm) - 1
    log.info("self-calibration: cameras were %.2f voxel apart, now %.2f (%d corrections)", before, after, corrections)
    return found, {
        "pairs": pairs,
        "corrections": corrections,
        "disparity_before_voxel": round(before, 3),
        "disparity_voxel": round(after, 3),
        "movements": movements,
    }


def check(experiment: Experiment, weights: Weights, pairs: Iterable[int]) -> dict[str, Any]:
    """Measure by the first usable pair how far cameras stand apart; warn where it is much, return figures.

    Empty where that cannot be told: one camera, no pair whose images show particles, or cameras that show none in
    common, of which it warns.
    """
    if len(weights.cameras) < 2 or weights.method != "footprint":
        return {}
    darks, alone = _darks(experiment), dict[int, list[str]]()
    for pair in islice(pairs, TRIED):
        try:
            images = [_light(experiment, weights.cameras, darks, pair)]
            if any(seen_structure(image, weights.cameras[name].decoder) < NOISE for name, image in images[0].items()):
                continue
            found = disparities(weights, images)
        except ValueError as error:  # the pair's own turn will tell
            log.debug("disparity of the cameras in pair %d: %s", pair, error)
            continue
        alone[pair] = unlinked(found, weights.cameras)
        if alone[pair]:
            continue
        movements = fit_movements(found, list(weights.cameras), experiment.grid)
        disparity = explained_mm(found, movements, experiment.grid) / experiment.grid.voxel_mm
        log.info("cameras show the particles of pair %d within %.2f voxel of each other", pair, disparity)
        if disparity > LARGE_VOXEL:
            warn(log, _warning(disparity, experiment, weights.cameras))
        return {"disparity_voxel": round(disparity, 3), "disparity_pair": pair}
    if alone:
        lost = dict.fromkeys(name for some in alone.values() for name in some)
        others = "" if len(lost) == len(weights.cameras) else " and the other cameras"
        figures = {"names": f"{' and '.join(lost)}{others}", "search": SEARCH_VOXEL}
        warn(log, Warning(code=Code.NOTHING_IN_COMMON, pairs=tuple(alone), figures=figures))
    return {}


def _warning(disparity: float, experiment: Experiment, cameras: Mapping[str, CalibratedCamera]) -> Warning:
    names = " and ".join(cameras) if len(cameras) == 2 else "the cameras"
    mend = (
        "record the board again"
        if experiment.self_calibration.pairs
        else f"set self_calibration.pairs = {min(5, experiment.pairs)}, or record the board again"
    )
    millimetres = disparity * experiment.grid.voxel_mm
    figures = {"names": names, "voxel": disparity, "mm": millimetres, "advice": mend}
    return Warning(code=Code.APART, figures=figures)


def _darks(experiment: Experiment) -> dict[str, np.ndarray | None]:
    """Dark image of every camera [counts], None where there is none."""
    return {camera.name: experiment.dark(camera.name) for camera in experiment.cameras}


def _light(
    experiment: Experiment,
    cameras: Mapping[str, CalibratedCamera],
    darks: Mapping[str, np.ndarray | None],
    pair: int,
) -> dict[str, np.ndarray]:
    """Images of the first frame of a pair, without dark and background."""
    return read_light(experiment, cameras, darks, pair, experiment.frames[0]).light
