"""What a picture of vectors shows, drawn with PyVista layer by layer, and as a script that draws the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import pyvista as pv

from lfpiv.studio import layers

pv.vtk_verbosity("error")  # VTK warns where it finds no screen, and then draws without

BACKGROUND = {"light": "white", "dark": "#16191d"}
INK = {"light": "#202327", "dark": "#e6e8ea"}
VIEWS = {"x": "yz", "y": "xz", "z": "xy", "oblique": "xy"}
REPLACED = "#8a8f98"
"""Colour of vectors that are replaced."""
TICKS = (0.15, 0.35, 0.8)
"""Least sides, as shares of the longest, that have two ticks, three, and ticks at round numbers."""
LINE_PX = 3  # width of streamlines
CLOUDS: dict[str, Any] = {"particles": {"point_size": 4.0}, "tracks": {"line_width": 2.0}}
"""What is drawn as it is -> its style."""
SIGNED = {"u", "v", "w", "divergence", "q_criterion", "vorticity_x", "vorticity_y", "vorticity_z", "uv", "uw", "vw"}
"""Fields whose colours are centred on zero."""


@dataclass(frozen=True)
class Look:
    """What is shown of a field of vectors."""

    moment: str = "0"
    """Number of a pair or instant, "mean" or "fluctuations"."""
    colour: str = "speed"
    """Field that colours slices, surface, arrows and streamlines."""
    colours: str = ""
    """Name of the colour map; "" for coolwarm of signed fields, and viridis of others."""
    limits: tuple[float, float] | None = None
    """Ends of the colour scale; None for the field's own."""
    slices: tuple[float | None, float | None, float | None] = (None, None, 0.0)
    """Place of the planes normal to x, y, z [mm]; None for none."""
    surface: str | None = None
    """Field of the isosurface; None for none."""
    level: float = 0.0
    opacity: float = 1.0
    """Opacity of the isosurface."""
    arrows: int = 0
    """Arrows on every n-th vector; 0 for none."""
    length: float = 1.5
    """Length of the longest arrow [spacing of the arrows]."""
    replaced: bool = False
    """Whether replaced vectors are shown as grey arrows."""
    hide_replaced: bool = True
    """Whether slices, surface and streamlines leave out replaced vectors."""
    uncertainty: float | None = None
    """Vectors that are more uncertain are left out [voxel]; None for all."""
    lines: int = 0
    """Number of streamlines."""
    particles: bool = False
    tracks: bool = False
    theme: str = "light"


def own_limits(grid: pv.ImageData, name: str) -> tuple[float, float]:
    """Return the ends of the colour scale of a field: its 1st and 99th percentile, even about zero if it is signed."""
    values = grid[name][np.isfinite(grid[name])] if name in grid.point_data else np.zeros(0)
    if not values.size:
        return 0.0, 1.0
    low, high = (float(value) for value in np.percentile(values, (1, 99)))
    if name in SIGNED:
        low, high = -max(abs(low), abs(high)), max(abs(low), abs(high))
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def look_along(plotter: pv.Plotter, view: str, bounds: Any) -> None:
    """Look at a box along an axis, or obliquely; without bounds at all that is drawn."""
    camera, plotter.camera_position = plotter.camera, VIEWS.get(view, "xy")
    if view not in "xyz":
        camera.azimuth, camera.elevation = 25.0, 20.0
    plotter.reset_camera(bounds=bounds, render=False)
    camera.zoom(0.7)
    plotter.renderer.ResetCameraClippingRange()


@dataclass
class Picture:
    """A plotter that shows a look, and draws anew only the layers that changed."""

    plotter: pv.Plotter
    drawn: dict[str, Any] = field(default_factory=dict)
    """Layer -> what it was drawn from."""
    placed: bool = False
    """Whether the camera looks at the volume."""

    @classmethod
    def empty(cls, size: tuple[int, int] = (900, 650)) -> Picture:
        """Return a picture without layers, drawn off the screen."""
        plotter = pv.Plotter(off_screen=True, window_size=list(size))
        plotter.render_window.SetMultiSamples(0)  # twice to four times as slow in software
        plotter.camera.SetUseHorizontalViewAngle(size[0] < size[1])
        plotter.camera.SetWindowCenter(0.0, -0.08)  # room for the colour scale below
        return cls(plotter)

    def clear(self) -> None:
        """Remove all that is drawn."""
        self.plotter.clear()
        self.drawn.clear()
        self.placed = False

    def show(
        self, whole: pv.ImageData, look: Look, clouds: dict[str, pv.PolyData], title: str, moving: bool = False
    ) -> None:
        """Draw what differs from what is drawn; less of what would take long while something moves."""
        self.drawn["whole"] = whole  # its id names it as long as it lives
        key = (id(whole), look.hide_replaced, look.uncertainty, *whole.array_names)
        grid = self._kept("trusted", key, lambda: layers.trusted(whole, look.hide_replaced, look.uncertainty))
        limits = look.limits or self.limits(whole, look.colour)
        cmap = look.colours or ("coolwarm" if look.colour in SIGNED else "viridis")
        ink = INK[look.theme]
        paint: dict[str, Any] = {"cmap": cmap, "clim": list(limits), "scalars": look.colour}
        shade = (look.colour, cmap, limits, look.theme, title)
        bar = {
            "title": f"{title}\n", "color": ink, "vertical": False, "fmt": "%.3g", "n_labels": 5,
            "position_x": 0.2, "position_y": 0.02, "width": 0.6, "height": 0.08,
            "title_font_size": 15, "label_font_size": 13, "unconstrained_font_size": True,
        }  # fmt: skip
        for axis, at in zip("xyz", look.slices, strict=True):
            self._layer(
                f"slice {axis}", None if at is None else (key, at, shade),
                lambda axis=axis, at=at: layers.slice_at(grid, axis, at, look.colour), **paint,
                lighting=False, nan_opacity=0.0,
            )  # fmt: skip
        self._layer(
            "surface", look.surface and (key, look.surface, look.level, shade),
            lambda: layers.surface(grid, look.surface or "", look.level, look.colour), **paint,
        )  # fmt: skip
        if "surface" in self.plotter.actors:
            shown = self.plotter.actors["surface"].prop
            shown.opacity, shown.interpolation = look.opacity, "Phong"
        self._layer(
            "arrows", look.arrows and (key, look.arrows, look.length, shade),
            lambda: layers.arrows(grid, look.arrows, look.length, look.colour, moving=moving), moving, **paint,
        )  # fmt: skip
        self._layer(
            "replaced", look.replaced and (id(whole), look.arrows, look.length),
            lambda: layers.arrows(whole, max(look.arrows, 1), look.length, "speed", True, moving), moving,
            color=REPLACED,
        )  # fmt: skip
        self._layer(
            "lines", look.lines and (key, look.lines, shade),
            lambda: layers.stream_lines(grid, look.lines, look.colour, moving), moving, **paint,
            line_width=LINE_PX, render_lines_as_tubes=True,
        )  # fmt: skip
        for name, style in CLOUDS.items():
            cloud = clouds.get(name) if getattr(look, name) else None
            colour = paint if cloud is not None and look.colour in cloud.point_data else {"color": ink}
            self._layer(name, cloud is not None and (id(cloud), shade), lambda cloud=cloud: cloud, **colour, **style)
        if self.drawn.get("frame") != (id(whole), shade):
            self._frame(whole, ink, BACKGROUND[look.theme], bar, paint)
            self.drawn["frame"] = (id(whole), shade)

    def limits(self, grid: pv.ImageData, name: str) -> tuple[float, float]:
        """Return the ends of the colour scale of a field, which are computed once."""
        return self._kept("limits", (id(grid), name), lambda: own_limits(grid, name))

    def _kept(self, name: str, key: Any, make: Any) -> Any:
        if self.drawn.get(f"{name} key") != key:
            self.drawn |= {f"{name} key": key, name: make()}
        return self.drawn[name]

    def _layer(self, name: str, key: Any, make: Any, moving: bool = False, **style: Any) -> None:
        """Draw a layer unless it is drawn from the same; remove it without a key."""
        if not key:
            if self.drawn.pop(name, None) is not None:
                self.plotter.remove_actor(name, render=False)
            return
        if self.drawn.get(name) in (key, (moving, key)):
            return
        mesh = make()
        if not mesh.n_points:
            self.plotter.remove_actor(name, render=False)
        else:
            self.plotter.add_mesh(mesh, name=name, show_scalar_bar=False, reset_camera=False, render=False, **style)
        self.drawn[name] = (moving, key) if moving else key

    def _frame(self, grid: pv.ImageData, ink: str, ground: str, bar: dict[str, Any], paint: dict[str, Any]) -> None:
        """Draw background, box, axes and colour scale."""
        plotter = self.plotter
        plotter.set_background(ground)
        plotter.add_mesh(grid.outline(), color=ink, name="outline", reset_camera=False, render=False)
        plotter.remove_bounds_axes()
        sides = np.ptp(np.reshape(grid.bounds, (3, 2)), axis=1)
        x, y, z = ticks = np.digitize(sides / sides.max(), TICKS).tolist()
        axes = plotter.show_bounds(
            bounds=grid.bounds, color=ink, xtitle="x [mm]", ytitle="y [mm]", ztitle="z [mm]", font_size=11, grid=False,
            location="outer", n_xlabels=x + 1, n_ylabels=y + 1, n_zlabels=z + 1, show_xlabels=x > 0, show_ylabels=y > 0,
            show_zlabels=z > 0, ticks="outside", fmt="%.3g", use_3d_text=False, render=False,
        )  # fmt: skip
        for axis in [axis for axis in range(3) if ticks[axis] == len(TICKS)]:
            axes.SetAxisLabels(axis, None)  # VTK's own, at round numbers, are too many on short sides
        if plotter.scalar_bars:
            plotter.remove_scalar_bar(render=False)
        scale = pv.DataSetMapper()
        scale.lookup_table = pv.LookupTable(paint["cmap"], scalar_range=paint["clim"])
        plotter.add_scalar_bar(mapper=scale, render=False, **bar)
        if not self.placed:
            look_along(plotter, "oblique", grid.bounds)
            self.placed = True

    def image(self) -> np.ndarray:
        """Return the picture, shape (rows, columns, 3)."""
        self.plotter.show(auto_close=False, interactive=False)
        return np.asarray(self.plotter.screenshot(return_img=True))


def script(look: Look, results: Sequence[str], title: str, camera: Any, size: tuple[int, int]) -> str:
    """Return a program that draws folders of results, or stores, as they are seen: ``picture.png``, ``picture1.png``.

    `title` is the colour scale's, `camera` position, focal point and direction upwards, `size` columns and rows.
    """
    stated = {item.name: getattr(look, item.name) for item in fields(look)}
    values = "".join(f"    {name}={value!r},\n" for name, value in stated.items() if value != getattr(Look, name))
    clouds = [f'"{name}": cloud_of("{name}", results, LOOK.moment)' for name in CLOUDS if getattr(look, name)]
    chosen = f", pairs=({look.moment}, {look.moment} + 1)" if look.moment.isdigit() else ""  # others may be damaged
    return (
        '"""Draw vectors as they were seen in lfpiv studio. Needs lfpiv and pyvista."""\n\n'
        "import lfpiv\nfrom lfpiv.studio.layers import cloud_of, field_at, grid_of\n"
        f"from lfpiv.studio.look import Look, Picture\n\nRESULTS = {list(results)!r}\nLOOK = Look(\n{values})\n\n"
        "for number, results in enumerate(RESULTS):\n"
        f"    grid = grid_of(field_at(lfpiv.open_results(results{chosen}), LOOK.moment))\n"
        f"    clouds = {{{', '.join(clouds)}}}\n"
        f"    picture = Picture.empty({tuple(size)!r})\n"
        f"    picture.show(grid, LOOK, clouds, {title!r})\n"
        f"    picture.plotter.camera_position = {camera!r}\n"
        "    picture.plotter.renderer.reset_camera_clipping_range()\n"
        "    picture.image()  # before it, add to picture.plotter what PyVista draws\n"
        '    picture.plotter.screenshot("picture%s.png" % (number or ""))\n'
    )
