"""Say before a run how many vectors it measures along each axis, and what too few of them leave out."""

from __future__ import annotations

from collections.abc import Iterator

from lfpiv.experiment.settings import DEFAULT_WINDOWS, SMALLEST_WINDOW, Correlation
from lfpiv.geometry.grid import AXES
from lfpiv.prompt import times
from lfpiv.velocity.derived import LEAST_VECTORS
from lfpiv.velocity.settings import Triple, cut_windows
from lfpiv.velocity.windows import Windows
from lfpiv.warn import Code, Warning


def planned(correlation: Correlation, shape: Triple) -> Windows:
    """Return the windows whose displacements are the vectors: those of the last pass.

    Parameters
    ----------
    correlation : Correlation
        Settings; absent windows are the default ones, cut to the volume.
    shape : (int, int, int)
        Voxels of the volume (z, y, x).
    """
    window = cut_windows((correlation.windows or DEFAULT_WINDOWS)[-1:], shape)[0]
    return Windows.overlapping(shape, window, correlation.overlap)


def sentence(correlation: Correlation, shape: Triple, voxel_mm: float) -> str:
    """Return the number of vectors along each axis, their windows, overlap and distance."""
    windows = planned(correlation, shape)
    z, y, x = windows.count
    apart = times([step * voxel_mm for step in windows.step[::-1]])
    return (
        f"{times((x, y, z))} vectors (x, y, z), {x * y * z:,} in all: windows of {times(windows.window[::-1])} voxels "
        f"that overlap by {100 * correlation.overlap:.0f} %, {apart} mm apart"
    )


def warnings(correlation: Correlation, shape: Triple) -> Iterator[Warning]:
    """Yield a warning for each axis along which there are too few vectors for derivatives."""
    windows = planned(correlation, shape)
    for axis, count, edge, voxels in reversed(list(zip(AXES, windows.count, windows.window, shape, strict=True))):
        if count < LEAST_VECTORS:
            fitting = _fitting(edge, voxels, correlation.overlap)
            advice = f"a last window of {fitting} voxels or fewer along {axis} has {LEAST_VECTORS}"
            if fitting is None:
                advice = f"the volume needs more voxels along {axis} than {voxels}"
            figures = {"axis": axis, "count": count, "least": LEAST_VECTORS, "advice": advice}
            yield Warning(code=Code.FEW_VECTORS, figures=figures)


def _fitting(edge: int, voxels: int, overlap: float) -> int | None:
    """Return the largest window below one that gives enough vectors along an axis; None if there is none."""
    shorter = range(edge - 1, SMALLEST_WINDOW - 1, -1)
    counts = ((one, Windows.overlapping((voxels,) * 3, (one,) * 3, overlap).count[0]) for one in shorter)
    return next((one for one, count in counts if count >= LEAST_VECTORS), None)
