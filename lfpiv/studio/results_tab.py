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
UNIT = "{{{{ r_fields.find((field) => field.value === {})?.unit }}}}"
"""Unit of the field that a value of the state names, as the page shows it."""
MOST_ARROWS = 40
"""Largest number of arrows along an axis that the slider gives: more fill the picture, and take seconds."""
REST_S = 0.25
"""Time without a change after which a picture is drawn with all its pixels."""


class Results:
    """State, pictures and panel of the tab."""

    def __init__(self, session: Session) -> None:
        self.session, self.state = session, session.state
        self.open, self.fields = lru_cache(2)(self._results), lru_cache(40)(self._fields)
        self.cloud = lru_cache(4)(layers.cloud_of)
        self.doubtful: set[str] = set()
        self.titles: dict[str, str] = {}
        self.pictures = (look.Picture.empty(), look.Picture.empty())
        self.pictures[1].plotter.camera = self.pictures[0].plotter.camera
        self.charted: tuple[object, ...] = ()
        self.next: asyncio.Handle | None = None  # the next drawing
        self.state.update({
            "r_moments": [], "r_numbers": 0, "r_fields": [], "r_box": [[0, 1, 0.1]] * 3, "r_ends": [0.0, 1.0, 0.01],
            "r_fewest": 1, "r_has": [], "r_playing": False, "r_chart": "", "r_others": [], "r_left": {}, "r_busy": "",
            "r_facts": [],
        })  # fmt: skip
        others = "own low high on_x on_y on_z x y z hide every limited other chart_kind".split()
        watched = (f"r_{name}" for name in (*(item.name for item in fields(look.Look)), *others) if name != "moment")
        session.on_change(self._moment_chosen, "r_moment")
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
        for kept in (self.open, self.fields, self.cloud):
            kept.cache_clear()
        self.doubtful.clear()
        self.state.r_left = {}
        self.charted, places, folder = (), self.session.places, self.session.results
        others = [{"title": places.name(path), "value": str(path)} for path in places.results()]
        self.state.r_others = [{"title": "nothing", "value": ""}, *others]
        if folder is None:
            self.state.update({"r_moments": [], "r_numbers": 0, "r_chart": "", "r_facts": []})
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
        self.state.r_has = [name for name in look.CLOUDS if any(folder.glob(f"{name}*"))]
        self._first_look()
        self.request()

    def _results(self, folder: str) -> xr.Dataset:
        """Return the vectors of a folder, which lies in those given."""
        results, left_out = open_readable(self.session.places.within(folder), every=folder in self.doubtful)
        cards = [{"name": path.name, "why": why} for path, why in left_out.items()]
        self.state.r_left = {**self.state.r_left, folder: cards}
        return results

    def _fields(self, folder: str, moment: str) -> tuple[pv.ImageData, xr.Dataset]:
        """Return a moment as a grid that has few of its fields, and as vectors."""
        vectors = layers.field_at(self.open(folder), moment)
        try:
            return layers.grid_of(vectors, () if moment.isdigit() else None), vectors
        except InputError:
            if folder in self.doubtful:
                raise
        self.doubtful.add(folder)  # a file is wrong of which the opening read the first bytes only
        self.open.cache_clear()
        return self._fields(folder, moment)

    def grid(self, folder: str, moment: str, *names: str | None) -> pv.ImageData:
        """Return the grid of a moment with the fields that were asked for up to now."""
        grid, vectors = self.fields(folder, moment)
        layers.add_fields(grid, vectors, filter(None, names))
        return grid

    def _first_look(self) -> None:
        """Choose places, levels and lists that suit the fields."""
        state, grid = self.state, self.grid(str(self.session.results), self.state.r_moment)
        bounds = np.reshape(grid.bounds, (3, 2))
        state.r_box = [[float(low), float(high), float((high - low) / 200) or 0.1] for low, high in bounds]
        state.r_x, state.r_y, state.r_z = (float(value) for value in grid.center)
        state.r_every, state.r_fewest = (max(1, round(max(grid.dimensions) / n)) for n in (16, MOST_ARROWS))
        self._list_fields()
        state.r_surface = "vorticity_magnitude" if "vorticity_magnitude" in self.titles else ""
        self._range_of_level()

    def _list_fields(self) -> None:
        """List the fields of the moment, and choose another colour if it does not have the chosen one."""
        state, vectors = self.state, self.fields(str(self.session.results), self.state.r_moment)[1]
        known = layers.names_of(vectors)
        names = [name for name in dict.fromkeys((*LABELS, *known)) if name in known]
        units = [vectors[name].attrs.get("units", "") if name in vectors else "" for name in names]
        self.titles = {name: title_of(name, unit) for name, unit in zip(names, units, strict=True)}
        state.r_fields = [
            {"title": title, "value": name, "unit": title.partition("[")[2].rstrip("]") or "1"}
            for name, title in self.titles.items()
        ]
        state.r_surface = state.r_surface if state.r_surface in names else ""
        state.r_colour = state.r_colour if state.r_colour in names else "speed"

    async def _moment_chosen(self) -> None:
        """Read a statistic beside the page; show it, or a pair."""
        s, moment = self.state, self.state.r_moment
        if self.session.results is None:
            return
        if not moment.isdigit():
            with self.session.busy("r_busy", "reading all of the series"):
                await asyncio.gather(*(asyncio.to_thread(self.grid, folder, moment) for folder in self.folders))
        with s:
            if moment == s.r_moment:
                s.r_colour = "turbulent_kinetic_energy" if moment == "fluctuations" else s.r_colour
                self._list_fields()
                self.request()

    def _range_of_level(self) -> None:
        """Let the slider of the level run over the values of the field; start at 60 % of the way."""
        name, folder = self.state.r_surface, self.session.results
        if not name or folder is None:
            return
        values = self.grid(str(folder), self.state.r_moment, name)[name]
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
        if self.state.r_busy:
            return
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
        grid = self.grid(self.folders[0], wanted.moment, wanted.colour)
        return replace(wanted, limits=self.pictures[0].limits(grid, wanted.colour))

    def show(self, wanted: look.Look, moving: bool = False) -> None:
        """Change the pictures to a look, without sending them."""
        wanted = self.alike(wanted)
        for folder, picture in zip(self.folders, self.pictures, strict=False):
            grid = self.grid(folder, wanted.moment, wanted.colour, wanted.surface)
            if wanted.colour not in grid.array_names:
                raise InputError(f"{wanted.colour}: {folder} has no such field. Choose another colour.")
            clouds = {name: self.cloud(name, folder, wanted.moment) for name in look.CLOUDS if getattr(wanted, name)}
            picture.show(grid, wanted, clouds, self.titles.get(wanted.colour, wanted.colour), moving)

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
            grid = self.grid(folders[0], wanted.moment, wanted.colour)
            low, high = self.pictures[0].limits(grid, wanted.colour)
            self.state.r_low, self.state.r_high = float(f"{low:.4g}"), float(f"{high:.4g}")
        if not moving:
            self._chart(wanted, folders)
            self.state.r_facts = self._facts(self.grid(folders[0], wanted.moment), wanted.colour)

    def _facts(self, grid: pv.ImageData, name: str) -> list[str]:
        """Say how many vectors are valid, how uncertain they are, and the value where the planes meet."""
        number = grid.find_closest_point([self.state[f"r_{axis}"] for axis in "xyz"])
        valid = grid["valid"] > 0.5 if "valid" in grid.point_data else np.ones(grid.n_points, bool)
        facts = [f"{100 * valid.mean():.1f} % of {grid.n_points:,} vectors are valid"]
        if "uncertainty" in grid.point_data and np.isfinite(grid["uncertainty"][valid]).any():
            facts.append(f"median uncertainty {np.nanmedian(grid['uncertainty'][valid]):.2g} voxel")
        where, replaced = ", ".join(f"{at:.3g}" for at in grid.points[number]), "" if valid[number] else ", replaced"
        return [*facts, f"{self.titles[name]} at ({where}) mm: {grid[name][number]:.4g}{replaced}"]

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
        titles = [self.titles.get(wanted.colour, wanted.colour), "number of vectors"]
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
                self._view_controls()
                self.files.buttons()
            with html.Div(classes="lf-main"), html.Div(classes="lf-views"):
                other = "{{ r_others.find((run) => run.value === r_other)?.title }}"
                names = {"{{ results_name }}": "true", other: "!!r_other"}
                plotters = [picture.plotter for picture in self.pictures]
                self.views = controls.linked(plotters, "results", names, lambda: bool(self.state.r_other))

    def _moment_controls(self) -> None:
        html.Div("{{ r_busy }} ...", v_if="r_busy", classes="lf-note", role="status")
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
            step, unit = ("(r_high - r_low) / 100",), UNIT.format("r_colour")
            controls.slider(
                "r_low", "lowest", ("Math.min(r_low, -Math.abs(r_high))",), ("r_high",), step, 0.0, unit=unit
            )
            controls.slider("r_high", "highest", ("r_low",), ("2 * Math.abs(r_high) || 1",), step, 1.0, unit=unit)

    def _layer_controls(self) -> None:
        html.H3("Planes")
        for number, axis in enumerate("xyz"):
            controls.switch(f"r_on_{axis}", f"plane normal to {axis}", axis == "z", id=f"r-on-{axis}")
            low, high, step = (f"r_box[{number}][{part}]" for part in range(3))
            controls.slider(f"r_{axis}", axis, (low,), (high,), (step,), 0.0, unit="mm", v_if=f"r_on_{axis}")
        html.H3("Isosurface")
        controls.choice("r_surface", "field", ("[{title: 'none', value: ''}, ...r_fields]",), id="r-surface")
        with html.Div(v_if="r_surface"):
            controls.slider(
                "r_level", "level", ("r_ends[0]",), ("r_ends[1]",), ("r_ends[2]",), 0.0, unit=UNIT.format("r_surface")
            )
            controls.slider("r_opacity", "opacity", 0.1, 1, 0.05, 0.6)
        html.H3("Arrows and streamlines")
        controls.switch("r_arrows", "arrows", id="r-arrows")
        with html.Div(v_if="r_arrows"):
            controls.slider("r_every", "on every n-th vector", ("r_fewest",), ("r_fewest + 9",), 1, 1)
            controls.slider("r_length", "length of the longest", 0.2, 6, 0.1, 1.5, unit="their distance")
        controls.slider("r_lines", "streamlines", 0, 300, 5, 0)
        for name in look.CLOUDS:
            controls.switch(f"r_{name}", name, v_if=f"r_has.includes('{name}')")
        html.H3("Trust")
        html.Div("{{ fact }}", v_for="fact in r_facts", key="fact", classes="lf-note lf-fact")
        controls.switch("r_hide", "leave out replaced vectors", True)
        controls.switch("r_replaced", "show replaced vectors in grey")
        controls.switch("r_limited", "leave out uncertain vectors")
        controls.slider("r_uncertainty", "largest uncertainty", 0, 2, 0.02, 0.5, unit="voxel", v_if="r_limited")

    def _view_controls(self) -> None:
        html.H3("Chart")
        controls.choice("r_chart_kind", "histogram, or profile along", (["histogram", *"xyz"],), "histogram")
        html.Div(v_html=("r_chart",))
        html.H3("View")
        with html.Div(classes="lf-buttons"):
            for name in look.VIEWS:
                controls.button(name, (self.look_along, f"['{name}']"))
            names = ("left", "right", "up", "down", "closer", "farther")
            for name, icon, key in zip(names, "⟲⟳↑↓+−", controls.KEYS, strict=True):
                said = [f'aria-label="turn {name}"']
                controls.button(icon, f"trigger('results_key', ['{key}'])", raw_attrs=said, id=f"r-turn-{name}")
        controls.choice("r_other", "side by side with", ("r_others",), id="r-other")
