"""Tab of the results: vectors in space, turned, sliced and coloured; two runs side by side."""

from __future__ import annotations

import asyncio
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyvista as pv
import trame_client.widgets.html as html
import xarray as xr

from lfpiv.errors import InputError
from lfpiv.results.reader import open_readable
from lfpiv.studio import charts, controls, layers, look
from lfpiv.studio.charts import LABELS, title_of
from lfpiv.studio.results_files import FRAMES_PER_S, Files
from lfpiv.studio.session import Session

COLOURS = ("", "viridis", "magma", "coolwarm", "turbo", "cividis", "gray")
PLAIN = ("moment", "colour", "colours", "level", "opacity", "length", "replaced", "lines", *look.CLOUDS)
"""What is shown as the state has it."""
MOST_ARROWS = 40
"""Largest number of arrows along an axis that the slider gives: more fill the picture, and take seconds."""
REST_S = 0.25
"""Time without a change after which a picture is drawn with all its pixels."""


class Results:
    """State, pictures and panel of the tab."""

    def __init__(self, session: Session) -> None:
        self.session, self.state = session, session.state
        self.open, self.grid = lru_cache(2)(self._results), lru_cache(40)(self._grid)
        self.cloud = lru_cache(4)(layers.cloud_of)
        self.doubtful: set[str] = set()
        self.pictures = (look.Picture.empty(), look.Picture.empty())
        self.pictures[1].plotter.camera = self.pictures[0].plotter.camera
        self.charted: tuple[object, ...] = ()
        self.next: asyncio.Handle | None = None  # the next drawing
        self.state.update({
            "r_moments": [], "r_numbers": 0, "r_fields": [], "r_box": [[0, 1, 0.1]] * 3, "r_ends": [0.0, 1.0, 0.01],
            "r_fewest": 1, "r_has": [], "r_playing": False, "r_chart": "", "r_others": [], "r_left": {},
        })  # fmt: skip
        others = "own low high on_x on_y on_z x y z hide every limited other chart_kind".split()
        watched = (f"r_{name}" for name in (*(item.name for item in fields(look.Look)), *others))
        session.on_change(self.request, "theme", *watched)
        session.on_change(self._step_to, "r_step")
        session.on_change(self._range_of_level, "r_surface")
        session.on_change(self._play, "r_playing")
        session.on_change(lambda: session.choose(self.state.results_open), "results_open")
        self.files = Files(self)
        session.listeners.append(self._opened)
        session.server.controller.on_client_connected.add(lambda **_: self.request())  # the chart, after the picture
        self._panel()

    def _opened(self, what: str) -> None:
        """Open other results."""
        if what != "results":
            return
        for kept in (self.open, self.grid, self.cloud):
            kept.cache_clear()
        self.doubtful.clear()
        self.state.r_left = {}
        self.charted, places, folder = (), self.session.places, self.session.results
        others = [{"title": places.name(path), "value": str(path)} for path in places.results()]
        self.state.r_others = [{"title": "nothing", "value": ""}, *others]
        if folder is None:
            self.state.update({"r_moments": [], "r_numbers": 0, "r_chart": ""})
            for picture in self.pictures:
                picture.clear()
            return self.request()
        results = self.open(str(folder))
        noun = "instant" if "instant" in results.dims else "pair"
        titles = {str(number): f"{noun} {number}" for number in results[noun].values}
        self.state.r_numbers, self.state.r_step, self.state.r_moment = len(titles), 0, next(iter(titles))
        if len(titles) > 1:
            titles |= {"mean": "mean of all", "fluctuations": "rms and stresses"}
        self.state.r_moments = [{"title": title, "value": value} for value, title in titles.items()]
        files = {"particles": folder / "particles", "tracks": folder / "tracks.nc"}
        self.state.r_has = [name for name, path in files.items() if path.exists()]
        self._first_look()
        self.request()

    def _results(self, folder: str) -> xr.Dataset:
        """Return the vectors of a folder, which lies in those given."""
        results, left_out = open_readable(self.session.places.within(folder), every=folder in self.doubtful)
        cards = [{"name": path.name, "why": why} for path, why in left_out.items()]
        self.state.r_left = {**self.state.r_left, folder: cards}
        return results

    def _grid(self, folder: str, moment: str) -> pv.ImageData:
        """Return the fields of a moment as a grid."""
        try:
            return layers.grid_of(layers.field_at(self.open(folder), moment))
        except InputError:
            if folder in self.doubtful:
                raise
        self.doubtful.add(folder)  # a file is wrong of which the opening read the first bytes only
        self.open.cache_clear()
        return self._grid(folder, moment)

    def _first_look(self) -> None:
        """Choose places, levels and lists that suit the fields."""
        state, grid = self.state, self.grid(str(self.session.results), self.state.r_moment)
        bounds = np.reshape(grid.bounds, (3, 2))
        state.r_box = [[float(low), float(high), float((high - low) / 200) or 0.1] for low, high in bounds]
        state.r_x, state.r_y, state.r_z = (float(value) for value in grid.center)
        names = [name for name in (*LABELS, *grid.array_names) if name in grid.array_names and name != "velocity"]
        state.r_fields = [{"title": title_of(name), "value": name} for name in dict.fromkeys(names)]
        state.r_every, state.r_fewest = (max(1, round(max(grid.dimensions) / n)) for n in (16, MOST_ARROWS))
        state.r_surface = "vorticity_magnitude" if "vorticity_magnitude" in names else ""
        self._range_of_level()

    def _range_of_level(self) -> None:
        """Let the slider of the level run over the values of the field; start at 60 % of the way."""
        name, folder = self.state.r_surface, self.session.results
        if not name or folder is None:
            return
        values = self.grid(str(folder), self.state.r_moment)[name]
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
        self.state.r_ends = [low, high, (high - low) / 200 or 1.0]
        least = max(low, 0.0) if name == "q_criterion" else low  # vortices are where Q is positive
        self.state.r_level = least + (0.2 if name == "q_criterion" else 0.6) * (high - least)

    @property
    def wanted(self) -> look.Look:
        """What the state asks for."""
        s = self.state
        plain = {name: type(getattr(look.Look, name))(s[f"r_{name}"]) for name in PLAIN}
        return look.Look(
            **plain, limits=None if s.r_own else (float(s.r_low), max(float(s.r_high), float(s.r_low) + 1e-9)),
            slices=tuple(float(s[f"r_{a}"]) if s[f"r_on_{a}"] else None for a in "xyz"),  # type: ignore[arg-type]
            surface=s.r_surface or None, arrows=int(s.r_every) if s.r_arrows else 0, hide_replaced=bool(s.r_hide),
            uncertainty=float(s.r_uncertainty) if s.r_limited else None, theme=s.theme,
        )  # fmt: skip

    def request(self) -> None:
        """Draw soon, and with all pixels when nothing changes any more."""
        if self.next is not None:
            self.next.cancel()
        self.next = asyncio.get_running_loop().call_soon(self._draw_now, not self.state.r_playing)

    def _draw_now(self, moving: bool) -> None:
        with self.state:
            self.session.guarded(self.draw)(moving)
        if moving:
            self.next = asyncio.get_running_loop().call_later(REST_S, self._draw_now, False)

    @property
    def folders(self) -> list[str]:
        """Return the folders that are seen: the results, and those they are compared with."""
        return [str(self.session.results), *([self.state.r_other] if self.state.r_other else [])]

    def alike(self, wanted: look.Look) -> look.Look:
        """Return a look whose colours mean the same in both pictures, if two runs are compared."""
        if not self.state.r_other or wanted.limits is not None:
            return wanted
        grid = self.grid(self.folders[0], wanted.moment)
        return replace(wanted, limits=self.pictures[0].limits(grid, wanted.colour))

    def show(self, wanted: look.Look, moving: bool = False) -> None:
        """Change the pictures to a look, without sending them."""
        wanted = self.alike(wanted)
        for folder, picture in zip(self.folders, self.pictures, strict=False):
            grid = self.grid(folder, wanted.moment)
            if wanted.colour not in grid.array_names:
                raise InputError(f"{title_of(wanted.colour)}: {folder} has no such field. Choose another colour.")
            clouds = {name: self.cloud(name, folder, wanted.moment) for name in look.CLOUDS if getattr(wanted, name)}
            picture.show(grid, wanted, clouds, title_of(wanted.colour), moving)

    def draw(self, moving: bool = False) -> None:
        """Draw what the state asks for, in both pictures if two runs are compared; faster while something moves."""
        wanted, folders = self.wanted, self.folders
        try:
            if self.session.results is not None:
                self.show(wanted, moving)
        finally:
            for picture, view in zip(self.pictures, self.views[: len(folders)], strict=False):
                picture.plotter.set_background(look.BACKGROUND[wanted.theme])
                picture.plotter.render_window.lfpiv_moving = moving
                view.update()
        if self.session.results is None:
            return
        if self.state.r_own:
            low, high = self.pictures[0].limits(self.grid(folders[0], wanted.moment), wanted.colour)
            self.state.r_low, self.state.r_high = float(f"{low:.4g}"), float(f"{high:.4g}")
        if not moving:
            self._chart(wanted, folders)

    def _chart(self, wanted: look.Look, folders: list[str]) -> None:
        """Draw the histogram of the colour's field, or profiles along the axes through the planes' places."""
        kind = self.state.r_chart_kind
        place = [] if kind == "histogram" else [self.state.r_x, self.state.r_y, self.state.r_z]
        key = (kind, *place, wanted.moment, wanted.colour, wanted.hide_replaced, wanted.uncertainty, *folders)
        if key == self.charted:
            return
        self.charted, lines = key, {}
        for folder, picture in zip(folders, self.pictures, strict=False):
            grid = picture.drawn["trusted"]
            if kind == "histogram":
                lines[Path(folder).name] = charts.histogram(grid[wanted.colour])
            else:
                number, ends = "xyz".index(kind), np.array([place, place], float)
                ends[:, number] = grid.bounds[2 * number : 2 * number + 2]
                slim = layers.slim(grid, wanted.colour)
                line = slim.sample_over_line(*ends, resolution=max(1, grid.dimensions[number] - 1))
                lines[Path(folder).name] = (line.points[:, number], line[wanted.colour])
        titles = [title_of(wanted.colour), "number of vectors"]
        self.state.r_chart = charts.chart(lines, *(titles if kind == "histogram" else [f"{kind} [mm]", titles[0]]))

    def _step_to(self) -> None:
        if self.session.results is not None and self.state.r_numbers:
            self.state.r_moment = self.state.r_moments[int(self.state.r_step)]["value"]

    async def _play(self) -> None:
        """Show one moment after the other until it is stopped."""
        step = int(self.state.r_step)  # counted here: a slow page answers with steps that are over
        while self.state.r_playing:
            step = (step + 1) % max(1, self.state.r_numbers)
            with self.state:
                self.state.r_step = step
            await asyncio.sleep(1 / FRAMES_PER_S["series"])

    def look_along(self, name: str) -> None:
        """Turn the camera to a view by its name."""
        look.look_along(self.pictures[0].plotter, name, self.grid(str(self.session.results), self.wanted.moment).bounds)
        for picture, view in zip(self.pictures, self.views, strict=True):
            picture.plotter.renderer.ResetCameraClippingRange()
            view.update()

    def _panel(self) -> None:
        with html.Div(classes="lf-split"):
            with html.Div(classes="lf-panel"):
                self._moment_controls()
                self._layer_controls()
                self._chart_controls()
                self._view_controls()
                self.files.buttons()
            with html.Div(classes="lf-main"), html.Div(classes="lf-views"):
                other = "{{ r_others.find((run) => run.value === r_other)?.title }}"
                names = {"{{ results_name }}": "true", other: "!!r_other"}
                plotters = [picture.plotter for picture in self.pictures]
                self.views = controls.linked(plotters, "results", names, lambda: bool(self.state.r_other))

    def _moment_controls(self) -> None:
        html.Div("No results are open: start a run in the tab Runs.", v_if="!results_name", classes="lf-note")
        controls.choice("results_open", "results", ("r_others.slice(1)",), id="r-open", v_if="r_others.length > 1")
        with html.Template(v_for="cards in r_left"):
            with html.Div(v_for="card in cards", key="card.name", classes="lf-card lf-left", role="alert"):
                html.B("{{ card.name }} is left out")
                html.Div("{{ card.why }}")
        html.Div(
            "The studio's folder holds no experiment file of these results.", v_if="results_name && !experiment_name",
            classes="lf-note", id="r-alone",
        )  # fmt: skip
        controls.choice("r_moment", "shown", ("r_moments",), "0", id="r-moment")
        with html.Div(v_if="r_numbers > 1"):
            controls.slider("r_step", "through the series", 0, ("r_numbers - 1",), 1, 0)
            controls.button("{{ r_playing ? 'Stop' : 'Play' }}", "r_playing = !r_playing", id="r-play")
        controls.choice("r_colour", "colour", ("r_fields",), "speed", id="r-colour")
        maps = [{"title": name or "viridis, signed fields coolwarm", "value": name} for name in COLOURS]
        controls.choice("r_colours", "colour map", (maps,))
        controls.switch("r_own", "colours over the field's own range", True)
        with html.Div(v_if="!r_own"):
            step = ("(r_high - r_low) / 100",)
            controls.slider("r_low", "lowest", ("Math.min(r_low, -Math.abs(r_high))",), ("r_high",), step, 0.0)
            controls.slider("r_high", "highest", ("r_low",), ("2 * Math.abs(r_high) || 1",), step, 1.0)

    def _layer_controls(self) -> None:
        html.H3("Planes")
        for number, axis in enumerate("xyz"):
            controls.switch(f"r_on_{axis}", f"plane normal to {axis}", axis == "z", id=f"r-on-{axis}")
            low, high, step = (f"r_box[{number}][{part}]" for part in range(3))
            controls.slider(f"r_{axis}", axis, (low,), (high,), (step,), 0.0, unit="mm", v_if=f"r_on_{axis}")
        html.H3("Isosurface")
        controls.choice("r_surface", "field", ("[{title: 'none', value: ''}, ...r_fields]",), id="r-surface")
        with html.Div(v_if="r_surface"):
            controls.slider("r_level", "level", ("r_ends[0]",), ("r_ends[1]",), ("r_ends[2]",), 0.0)
            controls.slider("r_opacity", "opacity", 0.1, 1, 0.05, 0.6)
        html.H3("Arrows and streamlines")
        controls.switch("r_arrows", "arrows", id="r-arrows")
        with html.Div(v_if="r_arrows"):
            controls.slider("r_every", "on every n-th vector", ("r_fewest",), ("r_fewest + 9",), 1, 1)
            controls.slider("r_length", "length", 0.2, 6, 0.1, 1.5)
        controls.slider("r_lines", "streamlines", 0, 300, 5, 0)
        with html.Div(v_if="r_has.includes('particles')"):
            controls.switch("r_particles", "particles")
        with html.Div(v_if="r_has.includes('tracks')"):
            controls.switch("r_tracks", "tracks")
        html.H3("Trust")
        controls.switch("r_hide", "leave out replaced vectors", True)
        controls.switch("r_replaced", "show replaced vectors in grey")
        controls.switch("r_limited", "leave out uncertain vectors")
        controls.slider("r_uncertainty", "largest uncertainty", 0, 2, 0.02, 0.5, unit="voxel", v_if="r_limited")

    def _chart_controls(self) -> None:
        html.H3("Chart")
        kinds = ["histogram", "x", "y", "z"]
        controls.choice("r_chart_kind", "histogram, or profile along an axis", (kinds,), "histogram")
        html.Div(v_html=("r_chart",))

    def _view_controls(self) -> None:
        html.H3("View")
        with html.Div(classes="lf-buttons"):
            for name in look.VIEWS:
                controls.button(name, (self.look_along, f"['{name}']"))
            names = ("left", "right", "up", "down", "closer", "farther")
            for name, icon, key in zip(names, "⟲⟳↑↓+−", controls.KEYS, strict=True):
                said = [f'aria-label="turn {name}"']
                controls.button(icon, f"trigger('results_key', ['{key}'])", raw_attrs=said, id=f"r-turn-{name}")
        controls.choice("r_other", "side by side with", ("r_others",), id="r-other")
