"""What a user takes along from the results: pictures, films, fields, tables, and the script that draws what is seen."""

from __future__ import annotations

import asyncio
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import imageio_ffmpeg
import numpy as np
import trame_client.widgets.html as html
from trame.widgets import vuetify3 as v3

from lfpiv.results import tables
from lfpiv.studio import controls, layers, look

FRAMES_PER_S = {"turn": 20, "series": 8}
"""Pictures of a film per second."""
TURN = 60
"""Pictures of a turn."""
DOWNLOADS = {
    "png": ("PNG", "lfpiv.png", "image/png"), "turn": ("Film of a turn", "turn.mp4", "video/mp4"),
    "series": ("Film of the series", "series.mp4", "video/mp4"), "vti": ("VTI", "field.vti", "application/xml"),
    "csv": ("CSV", "field.csv", "text/csv"),
}  # fmt: skip
"""Kind -> its button, the name and the type of its file."""


class Files:
    """Downloads of the tab of results."""

    def __init__(self, results: Any) -> None:
        self.results, self.session, self.state = results, results.session, results.state
        self.state.update({"r_script": "", "r_script_shown": False})
        for kind in DOWNLOADS:
            self.session.server.trigger(f"r_{kind}")(getattr(self, kind))

    def _seen(self) -> np.ndarray:
        """Return the picture, two side by side where two runs are compared; even numbers of rows and columns."""
        images = [picture.image() for picture in self.results.pictures[: 2 if self.state.r_other else 1]]
        rows = min(image.shape[0] for image in images) // 2 * 2
        return np.ascontiguousarray(np.hstack([image[:rows, : image.shape[1] // 2 * 2] for image in images]))

    def png(self) -> Any:
        """Return the picture as PNG."""
        return self._attached(cv2.imencode(".png", self._seen()[..., ::-1])[1].tobytes())

    async def turn(self) -> Any:
        """Return a film of one turn as MP4."""
        camera = self.results.pictures[0].plotter.camera
        return await self._film("turn", TURN, lambda _: camera.Azimuth(360 / TURN))

    async def series(self) -> Any:
        """Return a film of the series as MP4."""
        wanted, moments = self.results.wanted, self.state.r_moments
        film = await self._film(
            "series", self.state.r_numbers,
            lambda number: self.results.show(replace(wanted, moment=moments[number]["value"])),
        )  # fmt: skip
        self.results.draw()
        return film

    async def _film(self, kind: str, count: int, step: Any) -> Any:
        """Take a picture after each step; the page stays alive meanwhile."""
        with tempfile.TemporaryDirectory() as folder:
            path, size = Path(folder) / "film.mp4", self._seen().shape
            fps = FRAMES_PER_S[kind]
            writer = imageio_ffmpeg.write_frames(str(path), size[1::-1], fps=fps, macro_block_size=2, quality=8)
            writer.send(None)
            for number in range(count):
                step(number)
                if (image := self._seen()).shape == size:
                    writer.send(image)
                await asyncio.sleep(0)
            writer.close()
            return self._attached(path.read_bytes())

    def vti(self) -> Any:
        """Return the fields of the moment as VTK image data."""
        grid = self.results.grid(self.results.folders[0], self.results.wanted.moment, *self.results.titles)
        return self._written("field.vti", grid.save)

    def csv(self) -> Any:
        """Return the vectors of the moment as a table, a row each."""
        vectors = layers.field_at(self.results.open(self.results.folders[0]), self.results.wanted.moment).load()
        return self._written("field.csv", lambda path: tables.write_vectors(vectors, path))

    def _written(self, name: str, write: Any) -> Any:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder) / name)
            return self._attached((Path(folder) / name).read_bytes())

    def _attached(self, content: bytes) -> Any:
        return self.session.server.protocol.addAttachment(content)

    def copy(self) -> None:
        """Show the script that draws what is seen."""
        plotter, folders = self.results.pictures[0].plotter, self.results.folders
        camera = [tuple(float(value) for value in vector) for vector in plotter.camera_position]
        size = tuple(plotter.window_size)
        seen = self.results.alike(self.results.wanted)
        self.state.r_script = look.script(seen, folders, self.results.titles[seen.colour], camera, size)
        self.state.r_script_shown = True

    def buttons(self) -> None:
        """Show the buttons."""
        html.H3("Take along")
        with html.Div(classes="lf-buttons"):
            for kind, (label, name, mime) in DOWNLOADS.items():
                click = f"utils.download('{name}', trigger('r_{kind}'), '{mime}')"
                more = {"v_if": "r_numbers > 1"} if kind == "series" else {}
                controls.button(label, click, id=f"r-{kind}", **more)
            controls.button("Copy as Python", self.copy, "mdi-language-python", id="r-copy")
        with v3.VDialog(v_model=("r_script_shown",), max_width=900):
            with v3.VCard(title="This picture as Python", classes="pa-3"):
                html.Textarea(
                    v_model=("r_script",), readonly=True, rows=18, id="r-script", raw_attrs=['aria-label="script"'],
                    style="width:100%;font-family:monospace;font-size:12px",
                )  # fmt: skip
                controls.button("Copy", "window.navigator.clipboard.writeText(r_script)", "mdi-content-copy")
