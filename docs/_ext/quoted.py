"""Figures that the tutorial quotes, from the demonstration that the build of the pages runs; needs no Sphinx itself.

Machines round differently, and a run of many steps amplifies that. So figures of a run are quoted as they come out,
and only a run beyond all machines is a fault.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

TUTORIAL = Path(__file__).resolve().parents[1] / "tutorial.md"

ERROR_VOXEL = 0.05
"""Room of the mean error, for machines."""
MOVED_VOXEL = 0.05
"""Room of the largest displacement: half of its last digit. It is simulated, not measured."""
SIGMA_PITCH = 0.0005
"""Room of the ends of the range of sigma_nor; another seed of the network moves it by 0.0003."""
VALID_PERCENT = 3.0
"""Room of the valid vectors: 99 % of the demonstration's on one machine are 100 % on another."""

_PATTERNS = {
    "pixels": r"cameras of (\d+) x (\d+) pixels",
    "angles": r"from ([+-]\d+) and ([+-]\d+) degrees",
    "error": r"mean error of the vectors, some (\d+(?:\.\d+)?) voxel",
    "moved": r"the flow moves by up to (\d+(?:\.\d+)?)",
    "dots": r"all (\d+) dots of each board were found",
    "sigma": r"\*sigma_nor\*: (\d+(?:\.\d+)?) to (\d+(?:\.\d+)?) microlens",
    "valid": r"\*valid vectors\*: (\d+(?:\.\d+)?) % passed",
}


def quotes(text: str) -> dict[str, tuple[float, ...]]:
    """Numbers that a text quotes, by what they are of; ValueError where one of them is not found."""
    found = {}
    for name, pattern in _PATTERNS.items():
        match = re.search(pattern.replace(" ", r"\s+"), text)
        if match is None:
            raise ValueError(f"{TUTORIAL.name}: expected the demonstration's {name} as {pattern!r}, found none.")
        found[name] = tuple(map(float, match.groups()))
    return found


def unknown_numbers(text: str) -> list[str]:
    """Numbers in the list of the demonstration's figures that nothing checks."""
    section = re.search(r"(?s)two more that the log and the report have:\n(.*?)\n\n[^-\s]", text)[1]
    for pattern in _PATTERNS.values():
        section = re.sub(pattern.replace(" ", r"\s+"), "", section)
    return re.findall(r"\d[\d.]*\d|\d", section)


def of_scene(scene: Any) -> dict[str, tuple[float, ...]]:
    """Return what the scene of the demonstration says of the quoted figures."""
    first, last = scene.camera[0], scene.camera[-1]
    return {
        "pixels": (first.sensor_width_px, first.sensor_height_px),
        "angles": (first.nominal_angle_deg, last.nominal_angle_deg),
        "dots": (math.prod(scene.board.dots) * len(scene.board.planes_mm),),
    }


def measured(summary: Mapping[str, Any]) -> dict[str, tuple[float, ...]]:
    """Return what a run of the demonstration (`summary`, of `lfpiv.cli.demo.run`) says of the quoted figures."""
    sigma = [camera["sigma_nor_test"] for camera in summary["calibration"].values()]
    return {
        "error": (summary["demo"]["mean_error_voxel"],),
        "moved": (summary["demo"]["largest_displacement_voxel"],),
        "sigma": (min(sigma), max(sigma)),
        "valid": (100 * summary["valid_fraction"],),
    }


def as_built(text: str, summary: Mapping[str, Any]) -> str:
    """Return the tutorial's text with the figures of a run of the demonstration, each with as many decimals as before.

    The ends of the range of sigma_nor are rounded outwards, and stay where they enclose the run's.
    """
    said = quotes(text)
    for name, values in measured(summary).items():
        if not all(map(math.isfinite, values)):  # told by `differences`
            continue
        if name == "sigma":
            values = min(values[0], said[name][0]), max(values[1], said[name][1])
        match = re.search(_PATTERNS[name].replace(" ", r"\s+"), text)
        for group in reversed(range(len(values))):
            start, end = match.span(group + 1)
            decimals = len(text[start:end].partition(".")[2])
            rounded = (math.floor, math.ceil)[group] if name == "sigma" else round
            shown = rounded(round(values[group] * 10**decimals, 6)) / 10**decimals
            text = f"{text[:start]}{shown:.{decimals}f}{text[end:]}"
    return text


def differences(text: str, scene: Any, summary: Mapping[str, Any]) -> list[str]:
    """List figures of the tutorial from which a run of the demonstration differs by more than machines do.

    The time it takes is quoted too, and not compared: no two machines agree.
    """
    said, cameras = quotes(text), summary["calibration"].values()
    given = of_scene(scene) | measured(summary)
    wrong = [f"dots: {camera['dots_found']}" for camera in cameras if (camera["dots_found"],) != said["dots"]]
    room = {"error": ERROR_VOXEL, "moved": MOVED_VOXEL, "sigma": SIGMA_PITCH, "valid": VALID_PERCENT}
    for name, values in given.items():
        # ends of a range must enclose, everything else agree
        outside = (
            (said[name][0] - values[0], values[1] - said[name][1])
            if name == "sigma"
            else [abs(a - b) for a, b in zip(values, said[name], strict=True)]
        )
        if not all(gap <= room.get(name, 0.0) for gap in outside):  # NaN is a difference, too
            wrong.append(f"{name}: {said[name]} is quoted, {values} came out")
    return wrong
