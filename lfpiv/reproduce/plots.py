"""Style of the figures: type size, colours, axes and files."""

from __future__ import annotations

import io
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lfpiv import files

DPI = 150
COLOURS = {
    "network": "#2f81d6",
    "drt": "#e0762a",
    "drt_plus_1deg": "#c2478f",
    "no_sieve": "#2ca36b",
    "truth": "#30363c",
    "paper": "#808890",
}
NAMES = {
    "network": "network",
    "drt": "DRT",
    "drt_plus_1deg": "DRT, angle off by 1°",
    "no_sieve": "network, no sieve",
    "truth": "true particles",
}
"""Names of the mappings in figures and tables."""


def figure(width: float, height: float) -> Figure:
    """Make an empty figure of a size [inch] that needs no display and no pyplot."""
    with matplotlib.rc_context({"font.size": 9}):
        drawn = Figure(figsize=(width, height), layout="constrained", facecolor="white")
        FigureCanvasAgg(drawn)
    return drawn


def plain(axes: Axes) -> None:
    """Reduce axes to two spines and a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#e6e9ec", linewidth=0.6)
    axes.set_axisbelow(True)


def save(drawn: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    buffer = io.BytesIO()
    drawn.savefig(buffer, format="png", dpi=DPI)
    files.write_bytes(buffer.getvalue(), path)
