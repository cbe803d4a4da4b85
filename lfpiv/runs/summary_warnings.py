"""Collect the warnings about the results in a folder: each once, with the pairs that it concerns."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lfpiv.calibration.camera import Calibration
from lfpiv.calibration.coverage import outside_warnings, sight_warnings
from lfpiv.geometry.grid import Grid
from lfpiv.reconstruction.volume import Stop
from lfpiv.velocity.cross_correlation import Verdict
from lfpiv.warn import Code, Warning, gather


def stored_warnings(attributes: Mapping[str, Any]) -> list[Warning]:
    """Read the warnings about the images of a pair from the attributes of its file, of version 0.1.0 too."""
    stored = json.loads(attributes.get("warnings", attributes.get("findings", "[]")))
    return [Warning.from_json(one) for one in stored]


def rig_warnings(calibration: Calibration, grid: Grid) -> list[Warning]:
    """Return the warnings about the calibration, and about the position of the cameras relative to the volume."""
    found = [warning for camera in calibration.cameras.values() for warning in camera.warnings]
    found += [*outside_warnings(calibration, grid), *sight_warnings(calibration, grid)]
    return [*found, Warning(code=Code.ONE_CAMERA)] if len(calibration.cameras) == 1 else found


def image_warnings(pairs: Iterable[Mapping[str, Any]]) -> list[Warning]:
    """Return the warnings about the images of all pairs, from the ``warnings`` in their entries of the summary."""
    return gather(
        Warning.from_json(stored).of_pair(pair["pair"]) for pair in pairs for stored in pair.get("warnings", ())
    )


def pair_warnings(pairs: Sequence[Mapping[str, Any]]) -> list[Warning]:
    """Return the warnings about volumes and vectors of finished pairs, from their entries of the summary."""
    found = []
    for pair in pairs:
        of_pair, motion = (pair["pair"],), pair.get("motion")
        if Stop.DIVERGED.value in pair.get("stop", {}).values():
            found.append(Warning(code=Code.DIVERGED, pairs=of_pair, figures={"verdict": Stop.DIVERGED.value}))
        if motion is not None and not motion["followed"]:
            shares = motion["valid_fraction"]
            figures = {"passes": str(len(shares)), "share": shares[-1], "verdict": motion["verdict"]}
            found.append(Warning(code=Code.MOTION_LOST, pairs=of_pair, figures=figures))
        if pair["verdict"] != Verdict.GOOD.value:
            figures = {"share": pair["valid_fraction"], "verdict": pair["verdict"]}
            found.append(Warning(code=Code.FEW_VALID, pairs=of_pair, figures=figures))
    return gather(found)
