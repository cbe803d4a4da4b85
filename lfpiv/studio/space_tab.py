"""Tab of space: the nominal rig, the volume's box and the solids of its mask, which are dragged into place."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyvista as pv
import trame_client.widgets.html as html

from lfpiv.experiment.images import read_header
from lfpiv.settings.rig import CameraTable
from lfpiv.settings.volume import Box, ExperimentVolume, HalfSpace
from lfpiv.studio import controls, rig_space
from lfpiv.studio.draft import location_of
from lfpiv.studio.form_tab import WRITE
from lfpiv.studio.look import BACKGROUND, INK, look_along
from lfpiv.studio.session import NO_EXPERIMENT, Session

COLOURS = ("#2f81d7", "#d9822b", "#2a9d5c", "#a259c9", "#c0392b", "#0f8b8d")
SOLID, BOARD, HANDLE = "#8a6d3b", "#d4a017", "#d92d20"
DIGITS = 4  # of the numbers that dragging writes


class Space:
    """State, picture and panel of the tab."""

    def __init__(self, session: Session) -> None:
        self.session, self.state = session, session.state
        self.plotter = pv.Plotter(off_screen=True, window_size=[900, 650])
        self.plotter.render_window.SetMultiSamples(0)
        self.plotter.iren.initialize()  # handles answer events of the page
        self.placed, self.dragged, self.box = False, False, np.zeros(6)
        self.shapes: dict[str, tuple[int, int]] = {}
        self.state.update({"s_drags": [], "s_facts": []})
        session.on_change(self.draw, "s_seen", "s_board", "s_cameras", "s_drag", "theme")
        session.on_change(lambda: self.draw() if self.state.tab == "space" else None, "tab")
        session.listeners.append(self._changed)
        self._panel()

    def _changed(self, what: str) -> None:
        if what == "experiment":
            self.placed = False
            self.shapes.clear()
        if what in ("experiment", "typed") and not self.dragged and self.state.tab == "space":
            self.draw()

    def _shape(self, camera: CameraTable) -> tuple[int, int]:
        """Return the size of a camera's sensor, from its white image if that is there."""
        with contextlib.suppress(ValueError, OSError):
            path = self.session.edited.path.parent / camera.white_image
            if camera.name not in self.shapes and (header := read_header(path, "white_image", camera.raw)) is not None:
                self.shapes[camera.name] = header.shape
        return self.shapes.get(camera.name, rig_space.UNKNOWN_PIXELS)

    def draw(self) -> None:
        """Draw the rig as the draft states it; one with mistakes is not drawn."""
        draft, p, s = self.session.draft, self.plotter, self.state
        p.clear()
        p.clear_box_widgets()
        p.clear_plane_widgets()
        p.set_background(BACKGROUND[s.theme])
        if draft is None or draft.problems():
            s.s_facts = ["The form has mistakes to mend first." if draft else NO_EXPERIMENT]
            self.view.update()
            return
        table, ink = draft.table, INK[s.theme]
        volume, solids = table.volume, table.volume.solid
        self.box = box = rig_space.bounds_of(volume.centre_mm, volume.size_mm)
        length = rig_space.REACH * float(np.linalg.norm(volume.size_mm))
        views = [rig_space.View.from_table(camera, self._shape(camera)) for camera in table.camera]
        for view, camera, colour in zip(views, table.camera, itertools.cycle(COLOURS), strict=False):
            if s.s_cameras:
                distance, place = view.camera.distance, np.asarray(view.camera.position)
                near, label = (place * min(1.0, part * length / distance) for part in (1.0, 1.3))
                p.add_mesh(view.pyramid(length), color=colour, line_width=2, render=False)
                body = pv.Cone(center=near, direction=-near, height=0.14 * length, radius=0.07 * length)
                p.add_mesh(body, color=colour, render=False)
                p.add_point_labels(
                    [label], [camera.name], text_color=colour, shape=None, font_size=14, show_points=False, render=False
                )
        for z_mm in table.board.planes_mm if s.s_board else ():
            p.add_mesh(rig_space.board_plane(table.board, z_mm), color=BOARD, point_size=4, render=False)
        for solid in solids:
            shape = rig_space.solid_shape(solid, box)
            if shape.n_points:
                p.add_mesh(shape, color=SOLID, opacity=0.6, render=False)
        p.add_mesh(pv.Box(box).extract_all_edges(), color=ink, line_width=2, render=False)
        counted = rig_space.count_seen(views, np.asarray(volume.centre_mm), np.asarray(volume.size_mm))
        share = np.bincount(counted["cameras"].astype(int)) / counted.n_cells
        seen = [f"{part:.0%} is seen by {n} of {len(views)} cameras" for n, part in enumerate(share) if part]
        if s.s_seen:
            p.add_mesh(
                counted, scalars="cameras", cmap="viridis", clim=[0, len(views)], opacity=0.35, render=False,
                scalar_bar_args={"title": "cameras\n", "color": ink, "n_labels": len(views) + 1, "fmt": "%.0f"},
            )  # fmt: skip
        p.add_axes(color=ink)
        parts = {"": "nothing", "volume": "box of the volume"}
        parts |= {f"volume.solid.{n}": f"solid {n}: {one.kind.replace('_', ' ')}" for n, one in enumerate(solids)}
        s.s_drag = s.s_drag if s.s_drag in parts else "volume"
        s.s_drags = [{"title": title, "value": name} for name, title in parts.items()]
        self._handles(solids)
        if not self.placed:
            self.placed = True
            look_along(p, "volume", box)
        s.s_facts = [facts(volume), *(text.replace("%", " %") for text in seen)]  # after handles, which tell theirs
        self.view.update()

    def _handles(self, solids: Sequence[Box | HalfSpace]) -> None:
        """Put handles on what is to be dragged."""
        name, box = self.state.s_drag, self.box
        solid = solids[int(name.rpartition(".")[2])] if name.startswith("volume.solid.") else None
        if isinstance(solid, HalfSpace):
            self.plotter.add_plane_widget(
                lambda normal, origin: self._dragged(normal=normal, point_mm=origin), normal=solid.normal,
                origin=solid.point_mm, bounds=box, factor=1.0,
                normal_rotation=True, color=SOLID, outline_translation=False, interaction_event="end",
            )  # fmt: skip
        elif solid is not None or name == "volume":
            bounds = box if solid is None else rig_space.bounds_of(solid.centre_mm, solid.size_mm)
            widget = self.plotter.add_box_widget(
                lambda box: self._dragged(centre_mm=box.center, size_mm=np.ptp(box.points, axis=0)), bounds=bounds,
                rotation_enabled=False, factor=1.0,
                color=INK[self.state.theme] if solid is None else SOLID,
            )  # fmt: skip
            widget.GetHandleProperty().SetColor(pv.Color(HANDLE).float_rgb)  # white by itself, as the ground

    def _dragged(self, **moved: Any) -> None:
        """Write new numbers into the draft and the form, without a new drawing while the handle is held."""
        draft, location = self.session.edited, location_of(self.state.s_drag)
        for key, numbers in moved.items() if location else ():
            values = [float(f"{value:.{DIGITS}g}") + 0.0 for value in numbers]
            old = draft.get([*location, key])
            if old is None or not np.allclose(old, values, rtol=1e-3, atol=1e-6):
                draft.set([*location, key], values)
        self.dragged = True
        try:
            with self.state:
                self.session.told("draft")
                if not draft.problems():
                    self.state.s_facts = [facts(draft.table.volume)]
        finally:
            self.dragged = False

    def add(self, kind: str) -> None:
        """Add a solid: a wall below, or a box in the middle."""
        draft = self.session.edited
        centre, size = (np.asarray(draft.get(("volume", key)), float) for key in ("centre_mm", "size_mm"))
        if kind == "half_space":
            low = centre - [0, 0.4 * size[1], 0]
            draft.add_solid(kind, {"point_mm": low.round(4).tolist(), "normal": [0.0, 1.0, 0.0]})
        else:
            draft.add_solid(kind, {"centre_mm": centre.tolist(), "size_mm": (0.3 * size).round(4).tolist()})
        self._drag(f"volume.solid.{len(draft.get(('volume', 'solid'))) - 1}")

    def remove(self) -> None:
        """Remove the solid that is being dragged."""
        self.session.edited.remove(location_of(self.state.s_drag))
        self._drag("volume")

    def _drag(self, name: str) -> None:
        """Put handles on another part after solids were added or removed."""
        self.state.s_drag = name
        self.session.told("draft")
        self.draw()

    def look_along(self, name: str) -> None:
        """Look from a side, or obliquely at the volume or the whole rig."""
        look_along(self.plotter, name, None if name == "rig" else self.box)
        self.view.update()

    def _panel(self) -> None:
        guarded = self.session.guarded
        with html.Div(classes="lf-split"):
            with html.Div(classes="lf-panel"):
                html.H3("Shown")
                controls.switch("s_cameras", "cameras and their pyramids of view", True)
                controls.switch("s_board", "planes of the board", True)
                controls.switch("s_seen", "number of cameras that see each voxel", id="s-seen")
                html.H3("Dragged by its handles")
                controls.choice("s_drag", "part", ("s_drags",), "volume", id="s-drag")
                with html.Div(classes="lf-buttons"):
                    controls.button("Add a wall", (guarded(self.add), "['half_space']"), id="s-wall")
                    controls.button("Add a box", (guarded(self.add), "['box']"), id="s-box")
                    controls.button("Remove", guarded(self.remove), v_if="s_drag.startsWith('volume.solid.')")
                parts = "new RegExp(`^${s_drag}.(centre_mm|size_mm|point_mm|normal)$`)"
                with html.Div(v_for=f"key in Object.keys(x_texts).filter((key) => {parts}.test(key))", key="key"):
                    html.Label("{{ key }}", raw_attrs=[":for=\"'s-' + key\""], classes="lf-note")
                    html.Input(
                        raw_attrs=[":id=\"'s-' + key\"", ':value="x_texts[key]"'], classes="lf-typed",
                        change=WRITE.replace("row.id", "key"),
                    )  # fmt: skip
                html.Div("{{ fact }}", v_for="fact in s_facts", key="fact", classes="lf-note")
                html.Div("Numbers go to the tab Experiment, which saves them. Cameras are drawn where the file states "
                         "them; distances beyond the volume are shortened.", classes="lf-note")  # fmt: skip
                html.H3("View")
                with html.Div(classes="lf-buttons"):
                    for name in ("volume", "rig", "x", "y", "z"):
                        text = f"along {name}" if len(name) == 1 else name
                        controls.button(text, (guarded(self.look_along), f"['{name}']"), id=f"s-look-{name}")
            with html.Div(classes="lf-main", id="s-view"):
                (self.view,) = controls.linked([self.plotter], "space", {"": "true"}, lambda: False)


def facts(volume: ExperimentVolume) -> str:
    """Return the size of a volume in words."""
    counts = np.round(np.asarray(volume.size_mm) / volume.voxel_mm).astype(int)
    sides = " x ".join(f"{side:g}" for side in volume.size_mm)
    return f"{sides} mm: {' x '.join(map(str, counts))} voxels, {counts.prod() / 1e6:.2f} million"
