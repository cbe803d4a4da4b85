"""Say before a run how many vectors it measures along each axis, and what too few of them leave out."""

from __future__ import annotations

from lfpiv.geometry.grid import AXES
from lfpiv.prompt import times
from lfpiv.settings.processing import DEFAULT_WINDOWS, SMALLEST_WINDOW, Correlation
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


def warnings(correlation: Correlation, shape: Triple) -> tuple[Warning, ...]:
    """Return a warning if there are too few vectors for derivatives along an axis, with windows that give enough."""
    windows = planned(correlation, shape)
    axes = reversed(list(zip(AXES, windows.count, windows.window, shape, strict=True)))
    thin = [(axis, count, edge, voxels) for axis, count, edge, voxels in axes if count < LEAST_VECTORS]
    if not thin:
        return ()
    fitting = {axis: _fitting(edge, voxels, correlation.overlap) for axis, _, edge, voxels in thin}
    enough = [f"{edge} voxels along {axis}" for axis, edge in fitting.items() if edge is not None]
    too_small = [f"{voxels} along {axis}" for axis, _, _, voxels in thin if fitting[axis] is None]
    advice = [f"a last window of at most {', '.join(enough)}"] if enough else []
    advice += [f"a volume of more voxels than {', '.join(too_small)}"] if too_small else []
    figures = {
        "counts": ", ".join(f"{count} along {axis}" for axis, count, _, _ in thin),
        "least": LEAST_VECTORS,
        "advice": " and ".join(advice),
    }
    return (Warning(code=Code.FEW_VECTORS, figures=figures),)


def _fitting(edge: int, voxels: int, overlap: float) -> int | None:
    """Return the largest window below one that gives enough vectors along an axis; None if there is none."""
    shorter = range(edge - 1, SMALLEST_WINDOW - 1, -1)
    counts = ((one, Windows.overlapping((voxels,) * 3, (one,) * 3, overlap).count[0]) for one in shorter)
    return next((one for one, count in counts if count >= LEAST_VECTORS), None)
