"""Errors of vectors from direct ray tracing with wrong camera angles: Fig. 14 of the paper with more errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.reproduce import plots, rigs

LABELS = {
    "plus": "both separation angles overestimated",
    "turned": "both cameras turned in one sense",
    "rolled": "cameras rolled against each other",
}
SIZES_DEG = (0, *rigs.ANGLE_ERRORS_DEG)
"""Errors of the angles [degree]; 0: exact angles."""
Errors = Mapping[str, Sequence[float]]
"""Mean errors [voxel] by kind of the angles' error, one for each of `SIZES_DEG`."""


def by_kind(errors: Mapping[str, float]) -> Errors:
    """Group mean errors [voxel] by the kinds of `rigs.TURNED_DEG`."""
    return {
        kind: [errors["drt"], *(errors[f"drt_{kind}_{size}deg"] for size in rigs.ANGLE_ERRORS_DEG)] for kind in LABELS
    }


def stretch(size_deg: float) -> np.ndarray:
    """Return the factors (x, y, z) by which overestimated separation angles stretch the volume.

    Two cameras see x cos(a) -+ z sin(a). With a + d instead of a the same rays meet at x cos(a) / cos(a + d) and
    z sin(a) / sin(a + d). The volume is longer along x, shorter along z, and as sharp.
    """
    angle = np.radians(rigs.ANGLES_DEG[0])
    wrong = angle + np.radians(size_deg)
    return np.array([np.cos(angle) / np.cos(wrong), 1.0, np.sin(angle) / np.sin(wrong)])


def reached(errors: Sequence[float], contrast: float) -> float | None:
    """Return the angles' error [degree] at which the mean error is `contrast` times that of exact angles, or None.

    The mean error is interpolated linearly between the computed sizes.
    """
    ratio = np.array(errors) / errors[0]
    above = np.flatnonzero(ratio >= contrast)
    if len(above) == 0:
        return None
    around = slice(above[0] - 1, above[0] + 1)
    return float(np.interp(contrast, ratio[around], SIZES_DEG[around]))


def describe(errors: Errors, stretch_voxel: float, contrast: float, goal: float, ppm: float) -> str:
    """Describe the effect of wrong angles on the vectors, beside the paper's finding."""
    factors = 100 * (stretch(1.0) - 1)
    text = (
        "DRT off by 1 degree: both separation angles overestimated, +46 and -46 degrees (Eqs. 11 and 12). Two cameras "
        "that are off by the same angle agree on where their rays meet, in a volume stretched by "
        f"{factors[0]:.1f} % along x and shortened by {-factors[2]:.1f} % along z: particles lie in wrong places, at "
        "the edges by more than at the centre, but they stay sharp. In the analytic flow the stretch gives an error "
        f"of {stretch_voxel:.3f} voxel. "
    )
    if contrast < goal:
        text += f"The paper's contrast of 2 is not found: {contrast:.2f}. The stretch is too small an error for it. "
    text += f"At {ppm} ppm the mean error grows to {goal:g} times that of the right angles: "
    ends = []
    for kind, label in LABELS.items():
        size = reached(errors[kind], goal)
        ends.append(f"{label}, " + (f"at {size:.1f} degrees" if size else f"not within {SIZES_DEG[-1]} degrees"))
    return text + "; ".join(ends) + ". All this grows with the volume. The network needs none of these angles."


def table(errors: Errors, ppm: float) -> dict[str, Any]:
    """Return a table of mean errors, one row per size."""
    return {
        "caption": f"Mean error [voxel] against the true particles' correlation at {ppm} ppm by direct ray tracing "
        "with wrong angles. Rolled: half the error for each camera.",
        "columns": ["error [degree]", *LABELS.values()],
        "rows": [[size, *row] for size, *row in zip(SIZES_DEG, *(errors[kind] for kind in LABELS), strict=True)],
    }


def draw(errors: Errors, network: float, ppm: float, path: Path) -> None:
    """Draw the mean errors over the angles' error."""
    drawn = plots.figure(5.2, 3.2)
    axes = drawn.subplots()
    for (kind, label), colour in zip(LABELS.items(), ("#c2478f", "#2ca36b", "#8a63d2"), strict=True):
        axes.plot(SIZES_DEG, errors[kind], "o-", color=colour, ms=4, lw=1.2, label=label)
    axes.axhline(network, color=plots.COLOURS["network"], lw=1.2, ls="--", label="network: no angle given")
    axes.set(xlabel="error of the angles given to DRT [degree]", ylabel="mean error [voxel]", title=f"{ppm} ppm")
    axes.set(xlim=(0, None), ylim=(0, None))
    plots.plain(axes)
    axes.legend(frameon=False, fontsize=7)
    plots.save(drawn, path)
