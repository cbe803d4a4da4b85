"""Tracks of single particles over a time series: a picture of them from two sides, and their figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.collections import LineCollection

from lfpiv.geometry.names import COMPONENTS, PARTICLE
from lfpiv.prompt import count
from lfpiv.quantities import scale_of
from lfpiv.report import markup, svg
from lfpiv.report.markup import significant
from lfpiv.report.summary import TrackFigures
from lfpiv.results.track_files import open_tracks

MOST_DRAWN = 300
"""Largest number of tracks in the picture."""
SIDES = ("xy", "xz")
"""Axes across and up of each panel."""


def section(figures: TrackFigures | None, folder: Path) -> str:
    """Return the part of the report on the tracks in the folder of a run, as HTML; nothing without tracks."""
    if figures is None:
        return ""
    head = "<h3>Tracks</h3>"
    table = open_tracks(folder)
    if not figures.tracks:
        text = f"None of the particles was followed long enough; {count(figures.left_out, 'track')} left out."
        return head + markup.paragraph(text)
    valid = table.isel({PARTICLE: table["valid"].values})
    chosen = _drawn(valid)
    shown = valid.isel({PARTICLE: np.isin(valid["track"].values, chosen)})
    text = (
        f"{count(figures.tracks, 'particle')} followed over several instants, with {figures.rows:,} positions; "
        f"{count(figures.left_out, 'track')}, too short or unlike the neighbours, left out. "
        "The file tracks.nc has all of them."
    )
    caption = "Tracks from two sides; a dot marks the end of each."
    if len(chosen) < figures.tracks:
        caption += f" {len(chosen):,} of {figures.tracks:,} are shown, evenly chosen."
    speed = np.sqrt(sum(np.square(shown[name].values) for name in COMPONENTS.values()))
    scale = scale_of(float(np.max(speed)), "m/s")
    panels = [_panel(shown, side, speed * scale.factor, scale.unit) for side in SIDES]
    return head + markup.paragraph(text) + markup.figure(panels, caption, _numbers(valid))


def _drawn(valid: xr.Dataset) -> np.ndarray:
    """Return the tracks of the picture, an even choice."""
    every = np.unique(valid["track"].values)
    return every[np.unique(np.linspace(0, len(every) - 1, MOST_DRAWN).round().astype(int))]


def _panel(shown: xr.Dataset, side: str, speed: np.ndarray, unit: str) -> str:
    """Return the view along the axis that is not named in `side`."""
    across, up = (shown[axis].values for axis in side)
    track = shown["track"].values
    figure, axes = svg.new_panel(3.2)
    points = np.stack([across, up], axis=1)
    joined = np.flatnonzero(track[1:] == track[:-1])
    lines = LineCollection(
        list(np.stack([points[joined], points[joined + 1]], axis=1)),
        array=(speed[joined] + speed[joined + 1]) / 2,
        cmap="viridis",
        linewidths=1.1,
        capstyle="round",
    )
    lines.set_clim(0, float(speed.max()))
    axes.add_collection(lines)
    ends = np.flatnonzero(np.append(track[1:] != track[:-1], True))
    axes.scatter(*points[ends].T, c=speed[ends], cmap="viridis", s=5, vmin=0, vmax=float(speed.max()), linewidths=0)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.03)
    svg.style(axes, xlabel=f"{side[0]} [mm]", ylabel=f"{side[1]} [mm]")
    svg.colour_bar(figure, lines, axes, f"speed [{unit}]", location="bottom")
    return svg.to_svg(figure, f"Tracks of particles in the plane of {side[0]} and {side[1]}, coloured by speed")


def _numbers(valid: xr.Dataset) -> str:
    """Return the table of lengths and of standard errors."""
    _, length = np.unique(valid["track"].values, return_counts=True)
    rows = [
        [words, *(significant(float(np.median(valid[f"uncertainty_{name}"]))) for name in names)]
        for words, names in (
            ("position [voxel]", "xyz"),
            ("velocity [m/s]", "uvw"),
            ("acceleration [m/s²]", [f"acceleration_{axis}" for axis in "xyz"]),
        )
    ]
    text = f"Tracks have {length.min()} to {length.max()} instants, {np.median(length):.0f} in the middle."
    titles = ["standard error, median", "x", "y", "z"]
    return markup.paragraph(text) + markup.table(titles, rows, caption="Median standard errors along the tracks")
