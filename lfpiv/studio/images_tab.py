"""Tab of rig and images: any image with lattice, dots and axes over it, pupil views, refocused planes."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import trame_client.widgets.html as html
from trame_client.widgets.core import AbstractElement

from lfpiv.experiment.opening import read_experiment
from lfpiv.studio import charts, controls
from lfpiv.studio.session import NO_EXPERIMENT, Session, sent

if TYPE_CHECKING:
    from lfpiv.studio.raw_images import RawImages

LATTICE, DOT, ARROW, X_AXIS, Y_AXIS = "#37b24d", "#ffd43b", "#ff6b6b", "#ff6b6b", "#4dabf7"
MARKED = {"saturated": "#ff922b", "hot": "#e64980"}
BRIGHTEST = 1.2
"""White of views, relative to their brightest parts: an even view is no blank."""
MOST_MARKS = 3000
"""Largest number of pixels, dots or lenses that are marked."""


class Picture(AbstractElement):  # type: ignore[misc]  # trame has no types
    """Element of a picture of counts, drawn by static/studio.js."""

    def __init__(self, **options: Any) -> None:
        super().__init__("lf-image", **options)
        self._attr_names += ["image", "low", "high", "marks", "name", "smooth", "region"]
        self._event_names += ["point"]


class Images:
    """State and panel of the tab."""

    def __init__(self, session: Session) -> None:
        self.session, self.state = session, session.state
        self.raw: RawImages | None = None
        self.shown: tuple[RawImages, str, str] | None = None
        self.state.update({
            "i_cameras": [], "i_names": [], "i_image": None, "i_top": 1.0, "i_marks": [], "i_facts": [],
            "i_chart": "", "i_radius": 1.0, "i_pupil": None, "i_pupil_high": 1.0, "i_depth": [-1.0, 1.0],
            "i_plane": None, "i_busy": "", "i_source": "", "i_place": None, "i_region": [],
        })  # fmt: skip
        session.on_change(self._open, "tab")
        session.on_change(self._go, "i_place")
        session.on_change(self._show, "i_camera", "i_name")
        changing = {self._mark: "lattice dots pixels axes", self._pupil: "u v", self._refocus: "z both"}
        for draw, names in changing.items():
            session.on_change(partial(self._draw, draw), *(f"i_{name}" for name in names.split()))
        session.listeners.append(self._changed)
        self._panel()

    def _changed(self, what: str) -> Any:
        """Forget what belongs to an experiment or a run that was open before."""
        if what in ("experiment", "results", "saved"):
            self.raw = self.state.i_image = self.state.i_pupil = self.state.i_plane = None
            return self._open()

    async def _open(self) -> None:
        """Read the experiment beside the page."""
        path = self.session.experiment
        if path is None or self.raw is not None or self.state.tab != "images" or self.state.i_busy:
            return
        with self.session.busy("i_busy", "reading the experiment"):
            from lfpiv.studio.raw_images import RawImages  # late: its libraries would delay the first picture

            self.raw = raw = RawImages(await asyncio.to_thread(read_experiment, path), self.session.results)
        with self.state as s:
            s.i_cameras = [setup.name for setup in raw.experiment.cameras]
            s.i_camera = s.i_cameras[0]
            z, grid = float(raw.experiment.grid.centre_mm[2]), raw.experiment.grid
            half = grid.shape[0] * grid.voxel_mm / 2
            s.i_depth, s.i_z = [z - half, z + half], z
            self._go()
        await self._show()

    def _go(self) -> None:
        """Show the camera, the image and the region that a warning names, as soon as the experiment is read."""
        raw, s, place = self.raw, self.state, self.state.i_place
        if raw is None or not place or place["camera"] not in s.i_cameras:
            return
        s.i_place, s.i_camera = None, place["camera"]
        if place["image"] in raw.names(s.i_camera):
            s.i_name = place["image"]
        corners = np.reshape(place["region"], (-1, 2))
        found = raw.recorded_px(s.i_camera, corners) if len(corners) else corners
        s.i_region = [*found.min(0).tolist(), *found.max(0).tolist()] if len(found) else []

    async def _show(self) -> None:
        """List the images of the camera, show the chosen one, and what is seen in it once the camera is decoded."""
        raw, camera = self.raw, self.state.i_camera
        if raw is None or not camera:
            return
        with self.state as s:
            s.i_names = raw.names(camera)
            name = s.i_name = s.i_name if s.i_name in s.i_names else s.i_names[0]
        if self.shown == (shown := (raw, camera, name)):
            return
        self.shown = shown
        image = await asyncio.to_thread(raw.read, camera, name)
        with self.state as s:
            if (s.i_camera, s.i_name) != (camera, name):
                return
            s.i_image = sent(raw.recorded(camera, image))
            sample = image[::3, ::3]
            s.i_top = float(image.max())
            s.i_low, s.i_high = (float(f"{v:.5g}") for v in np.percentile(sample, (1, 99.8)))
            s.i_marks = []
            values, counts = charts.histogram(image)
            s.i_chart = charts.chart({"": (values, np.log10(1 + counts))}, "counts", "log10(pixels)")
        with self.session.busy("i_busy", "finding the microlenses"):
            found = await asyncio.to_thread(raw.calibrated, camera)
        with self.state as s:
            s.i_radius = found.optics.pupil_radius_mm
            s.i_source = "measured by the run" if raw.measured else "nominal, not calibrated yet"
            if (s.i_camera, s.i_name) == (camera, name):
                self._draw(self._mark, self._pupil, self._refocus)

    def _draw(self, *parts: Callable[[RawImages], None]) -> None:
        """Draw parts of what is seen, once the cameras are known and an image is chosen."""
        if self.raw is not None and self.raw.cameras and self.state.i_name:
            for part in parts:
                part(self.raw)

    def _mark(self, raw: RawImages) -> None:
        """Put lattice, dots, axes and marked pixels over the picture."""
        s, camera, name = self.state, self.state.i_camera, self.state.i_name
        image = raw.read(camera, name)
        marks, facts = [], [f"{image.min():.6g} to {image.max():.6g} counts, mean {image.mean():.5g}"]
        optics = raw.calibrated(camera).optics
        if s.i_lattice:
            centres = raw.lattice_px(camera)
            radius = optics.pupil_radius_mm * optics.sensor_per_pupil / optics.pixel_mm
            marks.append(mark("circles", LATTICE, centres, radius=float(radius)))
            facts.append(f"{len(centres):,} microimages, {optics.microimage_pitch_px:.2f} px apart (stated)")
        for kind, places in raw.marked_pixels(camera, image).items():
            facts.append(f"{len(places):,} {kind} pixels")
            if s.i_pixels and len(places):
                marks.append(mark("circles", MARKED[kind], places[:MOST_MARKS], radius=2.0))
        if s.i_dots and name.startswith("plane"):
            places, names, arrows = raw.dots(camera, int(name.split()[1]))
            marks.append(mark("circles", DOT, places, radius=optics.microimage_pitch_px / 2) | {"names": names})
            marks.append(mark("arrows", ARROW, arrows))
        if s.i_axes:
            centre, x, y = raw.axes_px(camera)
            for end, colour, axis in ((x, X_AXIS, "x"), (y, Y_AXIS, "y")):
                marks.append(mark("arrows", colour, np.array([[*centre, *end]])))
                marks.append(mark("points", colour, end[None]) | {"names": [axis]})
        s.i_marks, s.i_facts = marks, facts

    def follow(self, place: list[float]) -> None:
        """Look through the pupil point that the pixel under the pointer sees."""
        if self.raw is not None and self.raw.cameras and self.state.i_follow:
            u, v = self.raw.pupil_at(self.state.i_camera, (place[0], place[1]))
            self.state.i_u, self.state.i_v = float(f"{u:.4g}"), float(f"{v:.4g}")

    def _pupil(self, raw: RawImages) -> None:
        s = self.state
        view = raw.pupil_view(s.i_camera, s.i_name, (float(s.i_u), float(s.i_v)))
        s.i_pupil_high = BRIGHTEST * float(np.percentile(view, 99.7)) or 1.0
        s.i_pupil = sent(view)

    def _refocus(self, raw: RawImages) -> None:
        s = self.state
        names = [camera for camera in s.i_cameras if s.i_name in raw.names(camera)]
        shown = [s.i_camera, *(name for name in names if name != s.i_camera)] if s.i_both else [s.i_camera]
        planes = [raw.refocused(camera, s.i_name, float(s.i_z)) for camera in shown[:2]]
        planes = [plane / (BRIGHTEST * float(np.percentile(plane, 99.7)) or 1.0) for plane in planes]
        if len(planes) == 2:  # red and cyan: what both see is white
            planes = [np.stack([planes[0], planes[1], planes[1]], axis=-1)]
        s.i_plane = sent(planes[0])

    def _panel(self) -> None:
        with html.Div(classes="lf-split"):
            with html.Div(classes="lf-panel"):
                html.Div(NO_EXPERIMENT, v_if="!experiment_name", classes="lf-note")
                html.Div("{{ i_busy }} ...", v_if="i_busy", classes="lf-note", role="status")
                controls.choice("i_camera", "camera", ("i_cameras",), id="i-camera")
                controls.choice("i_name", "image", ("i_names",), id="i-name")
                html.H3("Over the picture")
                controls.switch("i_lattice", "lattice of the microlenses", True, id="i-lattice")
                controls.switch("i_dots", "dots of the board, named; residuals x 50", True)
                controls.switch("i_axes", "axes x and y of the volume", True)
                controls.switch("i_pixels", "saturated and hot pixels", True)
                html.Div("cameras: {{ i_source }}", v_if="i_source", classes="lf-note")
                html.H3("Counts")
                controls.slider("i_low", "black", 0, ("i_top",), ("i_top / 500",), 0.0, unit="counts")
                controls.slider("i_high", "white", 0, ("i_top",), ("i_top / 500",), 1.0, unit="counts")
                html.Div("{{ fact }}", v_for="fact in i_facts", key="fact", classes="lf-note")
                html.Div(v_html=("i_chart",))
                html.H3("Through one point of the pupil")
                controls.switch("i_follow", "follows the pointer", True)
                for name in "uv":
                    ends = ("-i_radius",), ("i_radius",)
                    controls.slider(f"i_{name}", name, *ends, ("i_radius / 50",), 0.0, unit="mm")
                html.H3("Refocused")
                controls.slider("i_z", "z", ("i_depth[0]",), ("i_depth[1]",), 0.01, 0.0, unit="mm")
                controls.switch("i_both", "two cameras at once: red and cyan", id="i-both")
            with html.Div(classes="lf-main"), html.Div(classes="lf-pictures"):
                Picture(
                    image=("i_image",), low=("i_low",), high=("i_high",), marks=("i_marks",), region=("i_region",),
                    name=("i_camera + ', ' + i_name",), point=(self.follow, "[$event]"), id="i-picture",
                )  # fmt: skip
                with html.Div(classes="lf-side"):
                    Picture(
                        image=("i_pupil",), low=0, high=("i_pupil_high",), id="i-pupil",
                        name=("`through (u, v) = (${i_u}, ${i_v}) mm`",),
                    )  # fmt: skip
                    name = "`refocused at z = ${i_z} mm${i_both ? ': red ' + i_camera + ', cyan the other' : ''}`"
                    Picture(image=("i_plane",), low=0, high=1, smooth=True, id="i-plane", name=(name,))


def mark(kind: str, colour: str, places: np.ndarray, radius: float = 0.0) -> dict[str, Any]:
    """Return marks as the page draws them: circles, points or arrows at places [pixel]."""
    return {"kind": kind, "colour": colour, "places": np.round(places, 2).tolist(), "radius": radius}
