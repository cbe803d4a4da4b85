"""Fig. 13: a surface of equal vorticity beside the displacement in a plane, of several mappings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.ticker import MaxNLocator
from skimage.measure import marching_cubes

from lfpiv.geometry.grid import AXES
from lfpiv.reproduce import plots, rigs
from lfpiv.velocity import derived

ISO_VORTICITY = 0.12
"""The surface [voxel/voxel]."""

Fields = dict[str, np.ndarray]
"""Vectors of a volume pair with both schedules of windows, and its Q."""


def draw_vorticity(panels: Mapping[str, Fields], path: Path) -> None:
    """Draw the field of windows of 8 voxels of each mapping to a file, coloured as the true particles."""
    drawn = plots.figure(11, 8.4)
    drawn.set_layout_engine("constrained", w_pad=0.2, h_pad=0.2)
    drawings = []
    largest = float(np.abs(panels["truth"]["8_field"][..., 2]).max())
    for place, (mapping, packed) in enumerate(panels.items()):
        axes = drawn.add_subplot(2, 2, place + 1, projection="3d")
        drawings.append(axes)
        _draw_surface(axes, packed, largest)
        axes.set_title(plots.NAMES[mapping], fontsize=10, y=0.98)
    colours = ScalarMappable(Normalize(-largest, largest), "coolwarm")
    drawn.colorbar(colours, ax=drawings, shrink=0.5, label="displacement along z [voxel]")
    plots.save(drawn, path)


def _draw_surface(axes: Any, packed: Fields, largest: float) -> None:
    from matplotlib import colormaps
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection
    from scipy.ndimage import map_coordinates

    field = packed["8_field"].astype(float)
    positions = [packed[f"8_{axis}"] for axis in "zyx"]
    coords = dict(zip("zyx", positions, strict=True))
    velocity = {name: (AXES, field[..., k] * rigs.VOXEL_MM * 1e-3) for k, name in enumerate("uvw")}
    curl = derived.vorticity(xr.Dataset(velocity, coords))  # dt = 1 s: voxel per voxel
    magnitude = curl["vorticity_magnitude"].values
    step = [float(p[1] - p[0]) for p in positions]
    if magnitude.max() > ISO_VORTICITY > magnitude.min():
        corners, faces, _, _ = marching_cubes(magnitude, ISO_VORTICITY)
        depth = map_coordinates(field[..., 2], corners[faces].mean(1).T, order=1)
        place = np.array([p[0] for p in positions]) + corners * step
        surface = Poly3DCollection(place[:, [0, 2, 1]][faces], linewidth=0, alpha=0.55)
        surface.set_facecolor(colormaps["coolwarm"]((depth / largest + 1) / 2))
        axes.add_collection3d(surface)
    row = len(positions[1]) // 2
    z, x = np.meshgrid(positions[0], positions[2], indexing="ij")
    part = field[:, row]
    colour = colormaps["coolwarm"]((part[..., 2].ravel() / largest + 1) / 2)
    scale = 0.6 * step[0] / largest
    arrows = [part[..., k].ravel() * scale for k in (2, 0, 1)]
    axes.quiver(z.ravel(), x.ravel(), np.full(z.size, positions[1][row]), *arrows, colors=colour, lw=0.6)
    axes.set(xlabel="z [mm]", ylabel="x [mm]", zlabel="y [mm]")
    axes.set(**{f"{a}lim": (p[0], p[-1]) for a, p in zip("xzy", positions, strict=True)})
    axes.set_box_aspect([float(np.ptp(positions[k])) for k in (0, 2, 1)])
    half = min(abs(positions[0][0]), abs(positions[0][-1]))
    end = np.floor(half) if half >= 1 else np.floor(10 * half) / 10
    axes.set_xticks([-end, end])  # depth is the short axis, seen from the side: more would overlap
    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.zaxis.set_major_locator(MaxNLocator(5))
    axes.view_init(elev=22, azim=-38)
