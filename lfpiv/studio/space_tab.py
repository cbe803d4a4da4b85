"""Tab of space: the nominal rig, the volume's box and the solids of its mask, which are dragged into place."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import pyvista as pv
import trame_client.widgets.html as html

from lfpiv.experiment.images import read_header
from lfpiv.studio import controls, rig_space
from lfpiv.studio.draft import location_of
from lfpiv.studio.form_tab import WRITE
from lfpiv.studio.look import BACKGROUND, INK
from lfpiv.studio.session import Session

COLOURS = ("#2f81d7", "#d9822b", "#2a9d5c", "#a259c9", "#c0392b", "#0f8b8d")
SOLID, BOARD, HANDLE = "#8a6d3b", "#d4a017", "#d92d20"
SIGNIFICANT = 4
"""Digits of the numbers that dragging writes."""


class Space:
    """State, picture and panel of the tab."""

    def __init__(self, session: Session) -> None:
        self.session, self.state = session, session.state
        self.plotter = pv.Plotter(off_screen=True, window_size=[900, 650])
        self.plotter.render_window.SetMultiSamples(0)
        self.plotter.iren.initialize()  # handles answer events of the page
        self.placed, self.views, self.dragged = False, [], False  # type: tuple[bool, list[Any], bool]
        self.shapes: dict[str, tuple[int, int]] = {}
        self.state.update(
            {"s_seen": False, "s_board": True, "s_cameras": True, "s_drag": "volume", "s_drags": [], "s_facts": []}
        )  # fmt: skip
        self.state.change("s_seen", "s_board", "s_cameras", "s_drag", "theme")(lambda **_: session.guarded(self.draw)())
        self.state.change("tab")(lambda tab, **_: tab == "space" and session.guarded(self.draw)())
        session.listeners.append(self._changed)
        self._panel()

    def _changed(self, what: str) -> None:
        if what == "experiment":
            self.placed = False
            self.shapes.clear()
        if what in ("experiment", "typed") and not self.dragged and self.state.tab == "space":
            self.draw()

    def _shape(self, camera: dict[str, Any]) -> tuple[int, int]:
        """Return the size of a camera's sensor, from its white image if that is there."""
        path = str(camera.get("white_image", ""))
        if path not in self.shapes and self.session.experiment is not None:
            self.shapes[path] = rig_space.UNKNOWN_PIXELS
            with contextlib.suppress(ValueError, OSError):
                header = read_header(self.session.experiment.parent / path, "white_image")
                if header is not None:
                    self.shapes[path] = header.shape
        return self.shapes.get(path, rig_space.UNKNOWN_PIXELS)

    def draw(self) -> None:
        """Draw the rig as the draft states it; what is wrong in the draft is left out."""
        draft, p, s = self.session.draft, self.plotter, self.state
        p.clear()
        p.clear_box_widgets()
        p.clear_plane_widgets()
        p.set_background(BACKGROUND[s.theme])
        if draft is None or draft.problems():
            s.s_facts = ["The form has mistakes to mend first." if draft else "Open an experiment file to see its rig."]
            self.view.update()
            return
        values, ink = draft.values, INK[s.theme]
        volume, solids = values["volume"], values["volume"].get("solid", [])
        centre, size = (np.asarray(volume[key], float) for key in ("centre_mm", "size_mm"))
        length = rig_space.REACH * float(np.linalg.norm(size))
        views = [rig_space.view_of(camera, self._shape(camera)) for camera in values["camera"]]
        for number, ((pupil, corners, _), camera) in enumerate(zip(views, values["camera"], strict=True)):
            colour = COLOURS[number % len(COLOURS)]
            if s.s_cameras:
                p.add_mesh(rig_space.pyramid(pupil, corners, length), color=colour, line_width=2, render=False)
                p.add_mesh(rig_space.body(pupil, length, 0.14 * length), color=colour, render=False)
                place = pupil / np.linalg.norm(pupil) * min(1.3 * length, float(np.linalg.norm(pupil)))
                p.add_point_labels([place], [camera["name"]], text_color=colour, shape=None, font_size=14, render=False)
        if s.s_board:
            for z_mm in values["board"]["planes_mm"]:
                p.add_mesh(rig_space.board_plane(values["board"], z_mm), color=BOARD, point_size=4, render=False)
        for solid in solids:
            shape = rig_space.solid_shape(solid, centre, size)
            if shape.n_points:
                p.add_mesh(shape, color=SOLID, opacity=0.6, render=False)
        box = rig_space.bounds_of(centre, size)
        p.add_mesh(pv.Box(box).extract_all_edges(), color=ink, line_width=2, render=False)
        facts = self._facts(volume, size)
        counted = rig_space.count_seen(views, centre, size)
        seen = np.bincount(np.asarray(counted.cell_data["cameras"]).astype(int), minlength=len(views) + 1)
        facts += [
            f"{100 * part / seen.sum():.0f} % is seen by {n} of {len(views)} cameras"
            for n, part in enumerate(seen)
            if part
        ]
        if s.s_seen:
            p.add_mesh(
                counted, scalars="cameras", cmap="viridis", clim=[0, len(views)], opacity=0.35, render=False,
                scalar_bar_args={"title": "cameras\n", "color": ink, "n_labels": len(views) + 1, "fmt": "%.0f"},
            )  # fmt: skip
        p.add_axes(color=ink)
        self._handles(solids, box, centre, size)
        if not self.placed:
            self.placed = True
            self._turn("volume", box)
        s.s_facts = facts
        names = [f"solid {number}: {solid['kind'].replace('_', ' ')}" for number, solid in enumerate(solids)]
        s.s_drags = [
            {"title": "nothing", "value": ""}, {"title": "box of the volume", "value": "volume"},
            *({"title": name, "value": f"volume.solid.{number}"} for number, name in enumerate(names)),
        ]  # fmt: skip
        self.view.update()

    def _facts(self, volume: dict[str, Any], size: np.ndarray) -> list[str]:
        counts = np.round(size / float(volume["voxel_mm"])).astype(int)
        sides = " x ".join(f"{side:g}" for side in size)
        return [f"{sides} mm: {' x '.join(map(str, counts))} voxels, {counts.prod() / 1e6:.2f} million"]

    def _handles(self, solids: list[dict[str, Any]], box: np.ndarray, centre: np.ndarray, size: np.ndarray) -> None:
        """Put handles on what is to be dragged."""
        name, p = self.state.s_drag, self.plotter
        if p.iren is None:
            return
        if name == "volume":
            self._box_handles(box, INK[self.state.theme])
        elif name.startswith("volume.solid.") and int(name.rpartition(".")[2]) < len(solids):
            solid = solids[int(name.rpartition(".")[2])]
            if solid["kind"] == "box":
                self._box_handles(rig_space.bounds_of(solid["centre_mm"], solid["size_mm"]), SOLID)
            else:
                p.add_plane_widget(
                    self._plane_dragged, normal=solid["normal"], origin=solid["point_mm"], bounds=box, factor=1.0,
                    normal_rotation=True, color=SOLID, outline_translation=False, interaction_event="end",
                )  # fmt: skip

    def _box_handles(self, bounds: np.ndarray, colour: str) -> None:
        widget = self.plotter.add_box_widget(
            self._box_dragged, bounds=bounds, rotation_enabled=False, factor=1.0, color=colour
        )
        widget.GetHandleProperty().SetColor(pv.Color(HANDLE).float_rgb)  # white by itself, as the ground

    def _box_dragged(self, box: pv.PolyData) -> None:
        bounds = np.asarray(box.bounds)
        self._dragged(centre_mm=(bounds[::2] + bounds[1::2]) / 2, size_mm=bounds[1::2] - bounds[::2])

    def _plane_dragged(self, normal: Any, origin: Any) -> None:
        self._dragged(normal=normal, point_mm=origin)

    def _dragged(self, **moved: Any) -> None:
        """Write numbers into the draft unless they are there already, and show them in the form.

        There is no new drawing while the handle is held.
        """
        draft, location = self.session.draft, location_of(self.state.s_drag)
        if draft is None or not location:
            return
        for key, numbers in moved.items():
            values = [float(f"{value:.{SIGNIFICANT}g}") + 0.0 for value in numbers]
            old = draft.get([*location, key])
            if old is None or not np.allclose(old, values, rtol=1e-3, atol=1e-6):
                draft.set([*location, key], values)
        self.dragged = True
        try:
            with self.state:
                self.session.told("draft")
                if not draft.problems():
                    volume = draft.values["volume"]
                    self.state.s_facts = self._facts(volume, np.asarray(volume["size_mm"], float))
        finally:
            self.dragged = False

    def add(self, kind: str) -> None:
        """Add a solid: a wall below, or a box in the middle."""
        draft = self.session.draft
        if draft is None:
            return
        centre, size = (np.asarray(draft.get(("volume", key)), float) for key in ("centre_mm", "size_mm"))
        if kind == "half_space":
            low = centre - [0, 0.4 * size[1], 0]
            draft.add_solid(kind, {"point_mm": low.round(4).tolist(), "normal": [0.0, 1.0, 0.0]})
        else:
            draft.add_solid(kind, {"centre_mm": centre.tolist(), "size_mm": (0.3 * size).round(4).tolist()})
        self.state.s_drag = f"volume.solid.{len(draft.values['volume']['solid']) - 1}"
        self.session.told("draft")
        self.draw()

    def remove(self) -> None:
        """Remove the solid that is being dragged."""
        if self.session.draft is not None and self.state.s_drag.startswith("volume.solid."):
            self.session.draft.remove(location_of(self.state.s_drag))
            self.state.s_drag = "volume"
            self.session.told("draft")
            self.draw()

    def look_along(self, name: str) -> None:
        """Look from a side, or obliquely at the volume or the whole rig."""
        volume = self.session.draft.values["volume"] if self.session.draft is not None else {}
        self._turn(name, rig_space.bounds_of(volume["centre_mm"], volume["size_mm"]))
        self.view.update()

    def _turn(self, name: str, box: np.ndarray) -> None:
        """Turn the camera to a view; of the sides and "volume" the box is seen closely."""
        p = self.plotter
        p.camera_position = {"x": "yz", "y": "xz"}.get(name, "xy")
        if name in ("volume", "rig"):
            p.camera.azimuth, p.camera.elevation = 30.0, 35.0
        middle = (box[::2] + box[1::2]) / 2
        p.reset_camera(bounds=None if name == "rig" else np.repeat(middle, 2) + 1.3 * (box - np.repeat(middle, 2)))
        p.renderer.ResetCameraClippingRange()

    def _panel(self) -> None:
        guarded = self.session.guarded
        with html.Div(classes="lf-split"):
            with html.Div(classes="lf-panel"):
                html.H3("Shown")
                controls.switch("s_cameras", "cameras and their pyramids of view")
                controls.switch("s_board", "planes of the board")
                controls.switch("s_seen", "number of cameras that see each voxel", id="s-seen")
                html.H3("Dragged by its handles")
                controls.choice("s_drag", "part", ("s_drags",), id="s-drag")
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
