"""What a prompt shows of weights."""

from __future__ import annotations

from collections.abc import Mapping

from lfpiv.geometry.grid import Grid
from lfpiv.prompt import Card, count, times


def card_of(
    grid: Grid, shapes: Mapping[str, tuple[int, int]], forms: Mapping[str, str], method: str, memory_bytes: int
) -> Card:
    """Return what matters of weights: their voxels, and of each camera the sensor's shape and the form of the weights.

    Cameras without a form are counted when they are first needed.
    """
    facts = [("voxels", f"{times(grid.shape)} (z, y, x) of {grid.voxel_mm:.4g} mm")]
    half = grid.voxel_mm / 2
    for axis, number in zip("xyz", (2, 1, 0), strict=True):
        centres = grid.axis_mm(number)
        facts.append((axis, f"{float(centres[0]) - half:.4g} to {float(centres[-1]) + half:.4g} mm"))
    facts += [
        ("method", method),
        ("memory", f"{memory_bytes / 2**20:,.0f} MiB"),
        ("use", "images = weights(volume), volume = weights.T(images)"),
    ]
    rows = [(name, times(shape), forms.get(name, "counted when first needed")) for name, shape in shapes.items()]
    title = f"Weights of {count(grid.size, 'voxel')} on {count(len(rows), 'camera')}"
    return Card(title, tuple(facts), (("camera", "pixels (rows, columns)", "stored as"), *rows))
