"""Figures that the tutorial quotes, held against the demonstration that the build runs; needs no Sphinx itself."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

TUTORIAL = Path(__file__).resolve().parents[1] / "tutorial.md"

ERROR_VOXEL = 0.05
"""Of the mean error, quoted with one digit: half of its last."""
MOVED_VOXEL = 0.05
"""Of the largest displacement, likewise."""
SIGMA_PITCH = 0.0005
"""Of the ends of the range of sigma_nor, likewise; another seed of the network moves it by 0.0003."""
VALID_PERCENT = 1.0
"""Of the valid vectors: about 25 vectors of the demonstration's 2,560."""

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


def differences(text: str, scene: Any, summary: Mapping[str, Any]) -> list[str]:
    """List figures of the tutorial that differ from a run of the demonstration (`summary`, of `lfpiv.cli.demo.run`).

    The time it takes is quoted too, and not compared: no two machines agree.
    """
    said, cameras = quotes(text), summary["calibration"].values()
    given = of_scene(scene) | {
        "error": (summary["demo"]["mean_error_voxel"],),
        "moved": (summary["demo"]["largest_displacement_voxel"],),
        "sigma": (min(c["sigma_nor_test"] for c in cameras), max(c["sigma_nor_test"] for c in cameras)),
        "valid": (100 * summary["valid_fraction"],),
    }
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
