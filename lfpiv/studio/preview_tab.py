"""Tab of preview and tuning: one pair on coarse voxels with other settings, before and after side by side; the cost."""

from __future__ import annotations

import asyncio
import copy
import json
import sys
import tempfile
from asyncio.subprocess import PIPE
from pathlib import Path

import numpy as np
import pyvista as pv
import trame_client.widgets.html as html

import lfpiv
from lfpiv.errors import InputError
from lfpiv.studio import controls, layers, look
from lfpiv.studio.charts import title_of
from lfpiv.studio.draft import Draft
from lfpiv.studio.session import Session

FEW_VOXELS = 60_000
"""Voxels of a trial that is done within seconds."""

AUTOMATIC = ("smart.sieve_voxel", "smart.intensity_cap", "correlation.max_displacement_voxel")
"""Settings that have a value of their own unless a box is ticked."""

SLIDERS = (
    ("correlation.overlap", "overlap of windows", 0.0, 0.9, 0.05, 0.5),
    ("correlation.max_displacement_voxel", "largest displacement [voxel]", 1.0, 32.0, 0.5, 8.0),
    ("correlation.smoothing_voxel", "smoothing of volumes [voxel]", 0.0, 3.0, 0.1, 0.5),
    ("correlation.intensity_power", "power of intensities", 0.1, 1.0, 0.05, 0.5),
    ("smart.iterations", "iterations", 1, 40, 1, 14),
    ("smart.sieve_voxel", "sieve [voxel]", 0.0, 2.0, 0.05, 0.5),
    ("smart.intensity_cap", "cap of intensities [median of the brightest pixels]", 0.0, 10.0, 0.1, 1.0),
    ("smart.relaxation", "relaxation", 0.2, 2.5, 0.1, 1.0),
)
"""Key, label, range, step and first value of each slider."""


def state_of(key: str) -> str:
    """Return the name in the state of a slider's value."""
    return "t_" + key.replace(".", "_")


class Preview:
    """State, pictures and panel of the tab."""

    def __init__(self, session: Session) -> None:
        self.session, self.state = session, session.state
        self.grids: list[pv.ImageData | None] = [None, None]
        self.pictures = (look.Picture.empty((600, 600)), look.Picture.empty((600, 600)))
        self.pictures[1].plotter.camera = self.pictures[0].plotter.camera
        words = dict.fromkeys(("t_windows", "t_busy", "t_before", "t_after", "t_voxels"), "")
        self.state.update({**words, "t_pairs": 1, "t_plan": [], "t_depth": [-1.0, 1.0]})
        session.on_change(self.draw, "t_z", "t_colour", "theme")
        session.on_change(self._tell_voxels, "t_coarser")
        session.listeners.append(self._changed)
        self._panel()

    def _changed(self, what: str) -> None:
        """Take the values of the file."""
        draft, s = self.session.draft, self.state
        if what not in ("experiment", "saved") or draft is None:
            return
        for key, *_, first in SLIDERS:
            value = draft.get(key.split("."))
            stated = isinstance(value, int | float) and not isinstance(value, bool)
            s[state_of(key)] = value if stated else first
            s[f"{state_of(key)}_auto"] = not stated
        s.t_windows = draft.texts()["correlation.windows"]
        count = draft.get(("particles", "pairs")) or draft.get(("particles", "instants"))
        s.t_pairs = count if isinstance(count, int) else 1
        if what == "experiment":
            s.t_coarser = round(max(1.0, (self._voxels() / FEW_VOXELS) ** (1 / 3)), 1)
            self.grids, s.t_before, s.t_after, s.t_plan, s.t_pair = [None, None], "", "", [], 0
        self._tell_voxels()

    def _voxels(self) -> float:
        """Return the number of voxels that the file states; 1 where it cannot be told."""
        try:
            size, edge = (self.session.edited.get(("volume", key)) for key in ("size_mm", "voxel_mm"))
            return float(np.prod(np.asarray(size, float) / float(edge)))
        except (TypeError, ValueError, ZeroDivisionError):
            return 1.0

    def _tell_voxels(self) -> None:
        self.state.t_voxels = f"{self._voxels() / float(self.state.t_coarser) ** 3:,.0f} voxels"

    def trial(self) -> Draft:
        """Return the experiment as the form has it, with the settings of the sliders that differ from it."""
        draft, s = copy.deepcopy(self.session.edited), self.state
        for key, _, _, _, step, first in SLIDERS:
            place, default = key.split("."), None if key in AUTOMATIC else first
            value = type(step)(s[state_of(key)])
            wanted = None if key in AUTOMATIC and s[f"{state_of(key)}_auto"] else value
            stated = draft.get(place)
            if wanted != (default if stated in (None, "auto") else stated):
                draft.set(place, None if wanted == default else wanted)
        if (windows := str(s.t_windows).strip()) != draft.texts()["correlation.windows"]:
            draft.write(("correlation", "windows"), windows, plain=False)
        for name, text in draft.problems().items():
            raise InputError(f"{name}: {text}".lstrip(": "))
        return draft

    async def try_it(self) -> None:
        """Measure the pair with the settings of the sliders."""
        session, draft = self.session, self.trial()
        with session.busy("t_busy", "measuring the pair"), tempfile.TemporaryDirectory(prefix="lfpiv-") as folder:
            request = {
                "experiment": str(draft.path), "results": str(session.results or ""), "values": draft.values,
                "pair": int(self.state.t_pair), "coarser": float(self.state.t_coarser), "out": folder,
            }  # fmt: skip
            answer = json.loads((await self._ask(["-m", "lfpiv.studio.trial"], json.dumps(request)))[-1])
            grid = layers.grid_of(lfpiv.open_results(Path(folder)).isel({"pair": 0}, missing_dims="ignore").squeeze())
        with self.state:
            if self.grids[1] is None:
                self.state.t_z = grid.center[2]
            self.grids, self.state.t_depth = [self.grids[1], grid], list(grid.bounds[4:])
            known = "uncertainty" in grid.point_data and np.isfinite(grid["uncertainty"]).any()
            uncertain = f", uncertainty {np.nanmedian(grid['uncertainty']):.3g} voxel" if known else ""
            valid = f"{100 * grid['valid'].mean():.1f} % of {grid.n_points:,} vectors valid"
            text = f"{valid}{uncertain}, {answer['seconds']} s"
            text += "" if answer["calibrated"] else "; nominal cameras, not calibrated yet"
            stated, tried = (one.text.splitlines() for one in (self.session.edited, draft))
            text += "".join(f"; without {line}" for line in stated if line not in tried)
            text += "".join(f"; {line}" for line in tried if line and line not in stated)
            self.state.t_before, self.state.t_after = self.state.t_after, text
            self.draw()

    def draw(self) -> None:
        """Draw a plane of before and after with the same colours."""
        after = self.grids[1]
        if after is None:
            return
        limits = look.own_limits(after, self.state.t_colour)
        for grid, picture, view in zip(self.grids, self.pictures, self.views, strict=True):
            if grid is None:
                continue
            shown = look.Look(
                colour=self.state.t_colour, limits=limits, slices=(None, None, float(self.state.t_z)),
                theme=self.state.theme, hide_replaced=False, replaced=True,
                arrows=max(1, round(max(grid.dimensions) / 14)),
            )  # fmt: skip
            picture.show(grid, shown, {}, title_of(self.state.t_colour))
            view.update()

    def keep(self) -> None:
        """Write the settings of the sliders that differ from the file into the form."""
        self.session.draft = self.trial()
        self.session.told("draft")
        self.state.tab = "experiment"

    async def plan(self) -> None:
        """Ask what the campaign will take."""
        command = ["-m", "lfpiv", "plan", str(self.session.edited.path)]
        if self.session.results is not None and self.session.results.is_dir():
            command += ["--out", str(self.session.results)]
        with self.session.busy("t_busy", "doing the first pair, whose times are scaled"):
            lines = await self._ask(command, "")
        with self.state:
            self.state.t_plan = lines

    async def _ask(self, arguments: list[str], text: str) -> list[str]:
        """Call Python with arguments, and a text as its standard input; return the lines of its standard output."""
        child = await asyncio.create_subprocess_exec(sys.executable, *arguments, stdin=PIPE, stdout=PIPE, stderr=PIPE)
        out, err = await child.communicate(text.encode())
        if child.returncode:
            raise InputError((err.decode().splitlines() or [f"{arguments[1]}: ended without an answer."])[-1])
        return out.decode().splitlines()

    def _panel(self) -> None:
        guarded = self.session.guarded
        with html.Div(classes="lf-split"):
            with html.Div(classes="lf-panel"):
                html.Div("{{ t_busy }} ...", v_if="t_busy", classes="lf-note", role="status", id="t-busy")
                with html.Div(classes="lf-buttons"):
                    controls.button("Try", guarded(self.try_it), "mdi-play", id="t-try", disabled=("!!t_busy",))
                    controls.button("Write into the form", guarded(self.keep), id="t-keep")
                    controls.button("Cost of the campaign", guarded(self.plan), id="t-plan", disabled=("!!t_busy",))
                html.Div("{{ line }}", v_for="line in t_plan", key="line", classes="lf-note")
                html.Div(
                    "Try measures a pair by correlation on longer voxels: fast, and less accurate than a run. Change a "
                    "slider and try again: before and after stand side by side.", classes="lf-note",
                )  # fmt: skip
                controls.slider("t_pair", "pair", 0, ("t_pairs - 1",), 1, 0, v_if="t_pairs > 1")
                controls.slider("t_coarser", "voxels longer by", 1.0, 4.0, 0.1, 1.0)
                html.Div("{{ t_voxels }}", classes="lf-note")
                html.H3("Correlation and SMART")
                with html.Div(classes="lf-slider"):
                    html.Label("windows of the passes [voxel]", raw_attrs=['for="t-windows"'])
                    html.Input(
                        v_model=("t_windows",), placeholder="[32, 16, 12, 12]", id="t-windows",
                        classes="lf-typed", style="grid-column: 1 / -1",
                    )  # fmt: skip
                for key, label, *numbers in SLIDERS:
                    name, more = state_of(key), {}
                    if key in AUTOMATIC:
                        controls.switch(f"{name}_auto", f"{label.partition(' [')[0]}: automatic", True)
                        more = {"v_if": f"!{name}_auto"}
                    controls.slider(name, label, *numbers, **more)
                html.H3("Shown")
                controls.slider("t_z", "z of the plane", ("t_depth[0]",), ("t_depth[1]",), 0.01, 0.0, unit="mm")
                controls.choice("t_colour", "colour", (["speed", "u", "v", "w", "uncertainty", "peak_ratio"],), "speed")
            with html.Div(classes="lf-main lf-double", v_show="t_after"), html.Div(classes="lf-views"):
                names = {"before: {{ t_before }}": "t_before", "{{ t_before && 'after: ' }}{{ t_after }}": "t_after"}
                plotters = [picture.plotter for picture in self.pictures]
                self.views = controls.linked(plotters, "preview", names)
