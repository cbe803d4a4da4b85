"""Plots of the low-swirl injector (LSI): profiles of the mean velocity along y, and the mean velocity in planes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.patches import Rectangle
from scipy.interpolate import RegularGridInterpolator

from lfpiv.reproduce import plots
from lfpiv.reproduce.lsi_twin import DEPTHS_D, DIAMETER_MM, LightField, Sheet, Twin

NAMES = {"u": "radial velocity u", "v": "axial velocity v"}
"""What the velocity components are called."""
DRAWN = ("light_field", "planar", "recorded", "windows")
"""Profiles that are drawn, see `lsi.sample_profiles`."""


def draw_profiles(twin: Twin, profiles: Mapping[str, np.ndarray], path: Path) -> None:
    """Draw the mean velocity of both methods and of the true flow along y, in the three depths `DEPTHS_D`.

    `profiles` is from `lsi.sample_profiles`.
    """
    drawn = plots.figure(9, 3.6)
    axes = drawn.subplots(1, 2, sharey=True)
    height = (profiles["y_mm"] - twin.outlet_mm[1]) / DIAMETER_MM
    colours = ("#2f81d6", "#e0762a", "#2ca36b")
    for component, (axis, letter) in enumerate(zip(axes, "uv", strict=True)):
        for plane, (depth, colour) in enumerate(zip(DEPTHS_D, colours, strict=True)):
            light_field, planar, true, window_mean = (profiles[name][plane, :, component] for name in DRAWN)
            axis.plot(light_field, height, "o", color=colour, ms=4)
            axis.plot(planar, height, "x", color=colour, ms=5)
            axis.plot(true, height, "-", color=colour, lw=1, label=f"z/D = {depth:g}")
            axis.plot(window_mean, height, ":", color=colour, lw=1)
        axis.set(xlabel=f"{NAMES[letter]} [m/s]")
        plots.plain(axis)
    for marker, label in (("o", "light field"), ("x", "planar PIV"), ("-", "true flow"), (":", "its window mean")):
        axes[1].plot([], [], marker, color="#30363c", ms=4, label=label)
    axes[0].set_ylabel("y/D")
    axes[1].legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    plots.save(drawn, path)


def draw_planes(twin: Twin, volume: LightField, planar: Sequence[Sheet], path: Path) -> None:
    """Draw the mean velocity of both methods in the three planes `DEPTHS_D`, and the volume's outline on planar PIV."""
    drawn = plots.figure(9, 6.4)
    axes = drawn.subplots(2, 3, sharex=True, sharey=True)
    to_m_s = 1 / 1000 / twin.dt_s
    z_mm, y_mm, x_mm = volume["axes_mm"]
    field = RegularGridInterpolator((z_mm,), volume["displacement_mm"])
    slices = [field([depth])[0] for depth in twin.depths_mm]
    top = to_m_s * max(float(np.nanmax(plane["displacement_mm"][..., 1])) for plane in planar)
    width, height = np.array(twin.sizes.volume_mm[:2]) / DIAMETER_MM
    corner = -np.array(twin.outlet_mm[:2]) / DIAMETER_MM - np.array([width, height]) / 2
    for number, (depth, plane) in enumerate(zip(DEPTHS_D, planar, strict=True)):
        shown = ((plane["x_mm"], plane["y_mm"], plane["displacement_mm"]), (x_mm, y_mm, slices[number]))
        for axis, (x, y, displacement) in zip(axes[:, number], shown, strict=True):
            across, up = (x - twin.outlet_mm[0]) / DIAMETER_MM, (y - twin.outlet_mm[1]) / DIAMETER_MM
            velocity = to_m_s * displacement[..., :2]
            colours = axis.pcolormesh(across, up, velocity[..., 1], cmap="viridis", vmin=0, vmax=top, shading="nearest")
            step = max(1, round(max(len(x), len(y)) / 14))
            arrows = np.moveaxis(velocity[::step, ::step], -1, 0)
            axis.quiver(across[::step], up[::step], *arrows, color="white", scale=14 * top, width=0.008)
            axis.set_aspect("equal")
            axis.tick_params(labelsize=7)
        axes[0, number].add_patch(Rectangle(tuple(corner), width, height, fill=False, edgecolor="black"))
        axes[0, number].set_title(f"z/D = {depth:g}", fontsize=9)
        axes[1, number].set_xlabel("x/D")
    axes[0, 0].set_ylabel("planar PIV: y/D")
    axes[1, 0].set_ylabel("light-field PIV: y/D")
    drawn.colorbar(colours, ax=axes, label="axial velocity v [m/s]", shrink=0.7)
    plots.save(drawn, path)
