"""Draw panels, small matplotlib figures, as SVG elements with the colours and type of the page.

A panel is as wide as a phone's screen, so that its text keeps its size; wider screens show several side by side. The
colours of ink and series are replaced by ``currentColor`` and CSS variables: one picture serves light and dark pages.
"""

from __future__ import annotations

import base64
import html
import io
import itertools
import re
from collections.abc import Sequence
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.path import Path

INK = "#7b8a91"
"""Placeholder of the page's text colour."""
SERIES = ("#2f81d7", "#e0762b", "#2ca36c", "#c24790", "#8a6fd2", "#9a8d2b")
"""Placeholders of the page's colours of lines and marks, ``--series-0`` to ``--series-5``."""

WIDTH_INCH = 3.6
"""Width of a panel [inch]: 346 CSS pixels, the text width on a phone."""
IMAGE_WIDTH_INCH, IMAGE_HEIGHTS_INCH, AROUND_IMAGE_INCH = 3.05, (0.5, 3.6), 1.35
"""Width of an image in a panel, least and largest height, and height of its title, labels and colour bar [inch]."""
TEXT_POINT, SMALL_POINT = 9.0, 8.5
"""Sizes of titles and labels, and of tick labels [point]."""

PHOTO_PIXELS = 20_000
"""Largest number of pixels of a grey picture stored as PNG; larger ones are stored as JPEG."""
JPEG_QUALITY = 82

_numbers = itertools.count(1)  # makes the identifiers of panels unique in the page


def new_panel(height_inch: float = 2.6) -> tuple[Figure, Any]:
    """Create an empty panel of a height [inch], and its axes."""
    figure = Figure(figsize=(WIDTH_INCH, height_inch), layout="constrained")
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0)
    return figure, figure.subplots()


def image_panel(
    values: np.ndarray, edges: Sequence[tuple[float, float]], cmap: str, norm: Normalize
) -> tuple[Figure, Any, AxesImage]:
    """Create a panel with an image of cells (up, across) between their ends (across, up), to scale."""
    (left, right), (bottom, top) = edges
    height_inch = float(np.clip(IMAGE_WIDTH_INCH * (top - bottom) / (right - left), *IMAGE_HEIGHTS_INCH))
    figure, axes = new_panel(height_inch + AROUND_IMAGE_INCH)
    extent = (left, right, bottom, top)
    shown = axes.imshow(values, cmap=cmap, norm=norm, extent=extent, origin="lower", interpolation="none")
    return figure, axes, shown


def style(axes: Axes, *, title: str = "", xlabel: str = "", ylabel: str = "", legend: bool = False) -> None:
    """Set titles and labels of axes, in the ink and type of the page."""
    axes.patch.set_alpha(0)
    axes.set_title(title, color=INK, fontsize=TEXT_POINT)
    axes.set_xlabel(xlabel, color=INK, fontsize=TEXT_POINT)
    axes.set_ylabel(ylabel, color=INK, fontsize=TEXT_POINT)
    axes.tick_params(colors=INK, labelsize=SMALL_POINT)
    for offset in (axes.xaxis.get_offset_text(), axes.yaxis.get_offset_text()):
        offset.set(color=INK, fontsize=SMALL_POINT)
    for spine in axes.spines.values():
        spine.set(color=INK, linewidth=0.6)
    texts = [axes.title, axes.xaxis.label, axes.yaxis.label]
    if legend:
        shown = axes.legend(fontsize=SMALL_POINT, labelcolor=INK, frameon=False, handlelength=1.4, borderaxespad=0.2)
        texts += shown.get_texts()
    for text in texts:
        text.set_parse_math(False)  # a name may hold dollar signs


def colour_bar(figure: Figure, shown: ScalarMappable, axes: Axes, label: str, *, location: str = "right") -> None:
    """Add a colour bar beside axes, of the same height, or below them."""
    if location == "right":
        bar = figure.colorbar(shown, cax=axes.inset_axes((1.04, 0, 0.05, 1)))
    else:
        bar = figure.colorbar(shown, ax=axes, location=location, fraction=0.06, pad=0.03)
    bar.ax.locator_params(nbins=5 if location == "right" else 3)
    bar.set_label(label, color=INK, fontsize=TEXT_POINT)
    bar.ax.tick_params(colors=INK, labelsize=SMALL_POINT)
    bar.outline.set(color=INK, linewidth=0.6)


def arrows(start: np.ndarray, step: np.ndarray, head: float) -> Path:
    """Return arrows as one path. Heads have the length `head`, at most 0.4 of the shaft.

    Parameters
    ----------
    start, step : ndarray, shape (arrow, 2)
        Tail and vector of each arrow, in units of the axes. Arrows that are not finite are left out.
    head : float
        Length of a head in the same units.
    """
    good = np.isfinite(step).all(1) & (np.hypot(*step.T) > 0)
    start, step = start[good], step[good]
    length = np.hypot(*step.T)[:, None]
    along = step / np.maximum(length, 1e-30)
    aside = np.stack([-along[:, 1], along[:, 0]], axis=1)
    tip, barb = start + step, np.minimum(head, length / 2.5)
    back = tip - barb * along
    points = np.stack([start, tip, back + 0.45 * barb * aside, tip, back - 0.45 * barb * aside], axis=1)
    codes = np.tile([Path.MOVETO, Path.LINETO, Path.MOVETO, Path.LINETO, Path.LINETO], len(points))
    return Path(points.reshape(-1, 2), codes)


def to_svg(figure: Figure, alt: str) -> str:
    """Return a panel as an SVG element. Screen readers read `alt`."""
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "lfpiv"}):
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"<style.*?</style>\s*", "", text, flags=re.DOTALL)  # as in report.css
    text = _own_identifiers(text)
    text = re.sub(r'href="data:image/png;base64,\s*([^"]+)"', _smaller_picture, text)
    text = re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text)
    text = re.sub(r"font: ([\d.]+)px [^;\"]*", r"font-size: \1px", text)
    text = text.replace(INK, "currentColor")
    for number, colour in enumerate(SERIES):
        text = text.replace(colour, f"var(--series-{number})")
    width, height = 72 * figure.get_size_inches()  # [point], as in the file
    head = (
        f'<svg class="panel" role="img" aria-label="{html.escape(alt)}" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width / 0.75:.0f}" height="{height / 0.75:.0f}">'
    )
    return head + re.sub(r"\s*\n\s*", "\n", text[text.index(">") + 1 :]).strip()


def _own_identifiers(text: str) -> str:
    """Make referenced identifiers unique in the page; drop the others."""
    used = set(re.findall(r"url\(#([^)]+)\)", text)) | set(re.findall(r'href="#([^"]+)"', text))
    mark = f"svg{next(_numbers)}-"

    def keep(match: re.Match[str]) -> str:
        return f' id="{mark}{match[1]}"' if match[1] in used else ""

    text = re.sub(r' id="([^"]+)"', keep, text)
    return re.sub(r'(url\(#|href="#)', rf"\g<1>{mark}", text).replace("xlink:href", "href")


def _smaller_picture(match: re.Match[str]) -> str:
    """Encode an opaque grey picture with one channel, a large one as JPEG."""
    data = base64.b64decode(re.sub(r"\s", "", match[1]))
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None:
        return match[0]
    kind = "png"
    opaque = picture.ndim == 3 and (picture.shape[2] == 3 or (picture[..., 3] == 255).all())
    if opaque and (picture[..., 0] == picture[..., 1]).all() and (picture[..., 1] == picture[..., 2]).all():
        grey = picture[..., 0]
        if grey.size > PHOTO_PIXELS:
            kind, data = "jpeg", cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
        else:
            data = cv2.imencode(".png", grey, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    elif opaque:
        data = cv2.imencode(".png", picture[..., :3], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    return f'href="data:image/{kind};base64,{base64.b64encode(data).decode()}"'


def cell_edges(centres: np.ndarray) -> tuple[float, float]:
    """Return the outer edges of evenly spaced cells; a single cell has the width 1."""
    half = float(np.median(np.diff(centres))) / 2 if centres.size > 1 else 0.5
    return float(centres[0]) - half, float(centres[-1]) + half


def spread_ticks(axes: Axes) -> None:
    """Limit the number of ticks along x and y."""
    axes.locator_params(nbins=5)
