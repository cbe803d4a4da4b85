"""Collect the warnings about the results in a folder. Equal warnings about several pairs become one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from lfpiv.calibration.camera import Calibration
from lfpiv.calibration.coverage import outside_warnings, sight_warnings
from lfpiv.geometry.grid import Grid
from lfpiv.reconstruction.result import SmartStop
from lfpiv.runs.pair_figures import PairFigures
from lfpiv.velocity.cross_correlation import Verdict
from lfpiv.warn import Code, Warning, gather


def rig_warnings(calibration: Calibration, grid: Grid) -> list[Warning]:
    """Return the warnings about the calibration, and about the position of the cameras relative to the volume."""
    found = [warning for camera in calibration.cameras.values() for warning in camera.warnings]
    found += [*outside_warnings(calibration, grid), *sight_warnings(calibration, grid)]
    return [*found, Warning(code=Code.ONE_CAMERA)] if len(calibration.cameras) == 1 else found


def image_warnings(pairs: Mapping[int, Iterable[Warning]]) -> list[Warning]:
    """Return the warnings about the images of all pairs, given those of each pair."""
    return gather(warning.of_pair(pair) for pair, warnings in pairs.items() for warning in warnings)


def pair_warnings(pairs: Mapping[int, PairFigures]) -> list[Warning]:
    """Return the warnings about volumes and vectors of finished pairs, given the figures of each pair."""
    found = []
    for pair, figures in pairs.items():
        if figures.stop is not None and SmartStop.DIVERGED.value in figures.stop.values():
            found.append(Warning(code=Code.DIVERGED, pairs=(pair,), figures={"verdict": SmartStop.DIVERGED.value}))
        motion = figures.motion
        if motion is not None and not motion.followed:
            shares = motion.valid_fraction
            words = {"passes": str(len(shares)), "share": shares[-1], "verdict": motion.verdict}
            found.append(Warning(code=Code.MOTION_LOST, pairs=(pair,), figures=words))
        if figures.verdict != Verdict.GOOD.value:
            words = {"share": figures.valid_fraction, "verdict": figures.verdict}
            found.append(Warning(code=Code.FEW_VALID, pairs=(pair,), figures=words))
    return gather(found)
