"""Draw a vector field as curves: profiles along a line, and histograms of displacements and uncertainties."""

from __future__ import annotations

import numpy as np
import xarray as xr

from lfpiv.report import markup
from lfpiv.report.flow import Quantity, View
from lfpiv.report.markup import number, significant
from lfpiv.report.svg import INK, SERIES, new_panel, spread_ticks, style, to_svg

TAIL = 4.0
"""Multiple of the median up to which uncertainties have bars of their own."""
BAND = 2.0
"""Standard deviations to either side that a band shows."""


def profile_panel(fields: xr.Dataset, kinds: dict[str, Quantity], view: View, voxel: float) -> tuple[str, str]:
    """Draw and tabulate the velocity along the line of a view.

    Parameters
    ----------
    fields : Dataset
        Quantities from `flow.shown`.
    kinds : dict
        Quantity -> how it is written.
    view : View
        The line.
    voxel : float
        Velocity of one voxel, in the unit of the velocities.
    """
    line = fields.isel({axis: place for axis, place in view.place.items() if axis != view.along})
    position, valid = line[view.along].values, line["valid"].values
    error = np.zeros(len(position))
    if "uncertainty" in line:
        error = np.nan_to_num(BAND * voxel * line["uncertainty"].values)
    figure, axes = new_panel(2.6)
    axes.axhline(0, color=INK, linewidth=0.6)
    for k, (name, dashes) in enumerate(zip("uvw", ("-", "--", ":"), strict=True)):
        values = np.where(line["masked"].values, np.nan, line[name].values)
        axes.fill_between(position, values - error, values + error, where=valid, color=SERIES[k], alpha=0.18, lw=0)
        axes.plot(position, values, dashes, color=SERIES[k], lw=1.4, label=name)
        for chosen, face in ((valid, SERIES[k]), (~valid, "none")):
            axes.plot(position[chosen], values[chosen], "o", ms=3, mec=SERIES[k], mfc=face)
    unit = kinds["speed"].unit
    where = ", ".join(
        f"{axis} = {number(float(fields[axis][view.place[axis]]), 2)} mm" for axis in "xyz" if axis != view.along
    )
    style(axes, title=where, xlabel=f"{view.along} [mm]", ylabel=f"velocity [{unit}]", legend=True)
    spread_ticks(axes)
    rows = [
        [
            number(float(place), 3),
            *(significant(float(line[name][k])) for name in "uvw"),
            significant(float(error[k]) / BAND) if error[k] else markup.NONE,
            "yes" if valid[k] else "no",
        ]
        for k, place in enumerate(position)
    ]
    titles = [f"{view.along} [mm]", *(f"{name} [{unit}]" for name in "uvw"), f"uncertainty [{unit}]", "valid"]
    table = markup.table(titles, rows, caption=f"Velocity along {view.along} at {where}")
    return to_svg(figure, f"Velocity along {view.along} at {where}."), table


def displacement_histogram(vectors: xr.Dataset, axis: str) -> tuple[str, np.ndarray, np.ndarray]:
    """Draw a histogram of the valid displacements along an axis [voxel]; return the panel, counts and edges."""
    values = vectors[f"displacement_{axis}"].values[vectors["valid"].values]
    values = values[np.isfinite(values)]
    counts, edges = np.histogram(values, int(np.clip(np.sqrt(values.size), 8, 60)))
    figure, axes = new_panel(2.2)
    axes.stairs(counts, edges, fill=True, color=SERIES["xyz".index(axis)], alpha=0.8)
    style(axes, title=f"along {axis}", xlabel="displacement [voxel]", ylabel="vectors")
    spread_ticks(axes)
    return to_svg(figure, f"Histogram of {values.size:,} displacements along {axis}."), counts, edges


def uncertainty_histogram(uncertainty: np.ndarray) -> str:
    """Draw a histogram of uncertainties [voxel], with their median. The last bar holds all larger ones."""
    median = float(np.median(uncertainty))
    top = max(min(float(np.percentile(uncertainty, 99.5)), TAIL * median), 1e-9)
    figure, axes = new_panel(2.6)
    axes.hist(
        np.minimum(uncertainty, top),
        np.linspace(0, top, int(np.clip(np.sqrt(uncertainty.size), 8, 50)) + 1),
        color=SERIES[0],
        alpha=0.8,
    )
    axes.axvline(median, color=INK, linewidth=1.2, linestyle="--")
    axes.set(xlim=(0, top))
    style(axes, title=f"valid vectors; median {median:.2g} (dashed)", xlabel="uncertainty [voxel]", ylabel="vectors")
    spread_ticks(axes)
    return to_svg(figure, f"Histogram of the uncertainty of {uncertainty.size:,} vectors, median {median:.3g} voxel.")


def uncertainty_over_depth(vectors: xr.Dataset) -> str:
    """Draw the median uncertainty of the valid vectors over the depth [voxel]."""
    known = vectors["uncertainty"].where(vectors["valid"])
    middle = [float(np.nanmedian(plane)) if np.isfinite(plane).any() else np.nan for plane in known.values]
    figure, axes = new_panel(2.6)
    axes.plot(vectors["z"].values, middle, "o-", color=SERIES[0], lw=1.4, ms=4)
    axes.set_ylim(0, 1.15 * np.nanmax(middle) if np.isfinite(middle).any() else 1.0)
    style(axes, title="median over the depth", xlabel="z [mm]", ylabel="uncertainty [voxel]")
    spread_ticks(axes)
    return to_svg(figure, f"Median uncertainty over z, {np.nanmin(middle):.3g} to {np.nanmax(middle):.3g} voxel.")
