"""Warnings that follow from results: from the calibration, from figures of pairs, and from copied images."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from lfpiv.calibration.coverage import outside_warnings, sight_warnings
from lfpiv.experiment.experiment import Experiment
from lfpiv.reconstruction.result import SmartStop
from lfpiv.results.limits import LARGE_RESIDUAL
from lfpiv.runs.pair_figures import PairFigures
from lfpiv.velocity.cross_correlation import Verdict
from lfpiv.warn import Code, Warning, gather

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration


def copied_warnings(copies: Mapping[int, int], *, series: bool) -> list[Warning]:
    """Return the warnings about pairs with an image of another pair; `series`: pairs of instants."""
    noun = "the pair that begins with instant" if series else "pair"
    return gather(
        Warning(code=Code.COPIED, pairs=(pair,), figures={"first": first, "noun": noun})
        for pair, first in sorted(copies.items())
    )


def rig_warnings(calibration: Calibration, experiment: Experiment) -> list[Warning]:
    """Return the warnings about the calibration, and about the position of the cameras relative to the volume."""
    found = [warning for camera in calibration.cameras.values() for warning in camera.warnings]
    found += () if calibration.board is None else calibration.board.warnings
    found += [*outside_warnings(calibration, experiment.grid), *sight_warnings(calibration, experiment.grid)]
    alone = len(calibration.cameras) == 1 and not experiment.by_links  # pairs with too few links say it
    return [*found, Warning(code=Code.ONE_CAMERA)] if alone else found


def pair_warnings(pair: int, figures: PairFigures) -> Iterator[Warning]:
    """Yield the warnings about volumes and vectors of a pair."""
    if figures.stop is not None and SmartStop.DIVERGED.value in figures.stop.values():
        yield Warning(code=Code.DIVERGED, pairs=(pair,), figures={"verdict": SmartStop.DIVERGED.value})
    residual = max((history[-1] for history in (figures.residual or {}).values() if history), default=0.0)
    if residual > LARGE_RESIDUAL:
        yield Warning(code=Code.UNEXPLAINED, pairs=(pair,), figures={"residual": residual})
    joint = figures.joint
    if joint is not None and not joint.fitted:
        yield Warning(code=Code.NOT_JOINT, pairs=(pair,), figures={"verdict": joint.verdict})
    if figures.verdict != Verdict.GOOD.value:
        yield figures.few_valid_warning(pair)
    if figures.lost_unseeded > 0:
        yield figures.unseeded_warning(pair)
