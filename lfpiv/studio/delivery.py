"""Pictures of VTK's windows for the page: rendered, encoded as JPEG and sent at once.

trame-vtk encodes in other threads and looks later whether they are done. That takes longer than the picture itself.
"""

from __future__ import annotations

import asyncio
import functools
from typing import Any

import cv2
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

LEAST_PX, HIDDEN_PX = 10, (450, 325)
"""Views of hidden tabs are smaller, and have this size: what is seen until a busy browser asks again is blurred."""
MOVING_PX = 400_000
"""Largest number of pixels of a picture while it is turned or a slider moves; at rest the view's own number."""
SENT = asyncio.Event()
"""Set when the first picture was sent."""
QUALITY = {True: 70, False: 95}
"""Quality of the JPEG of pictures that move, and of others."""


def send_at_once(protocol: Any) -> None:
    """Let the protocol that delivers pictures of views encode them itself."""
    for part in protocol.getLinkProtocols():
        if hasattr(part, "still_render"):
            part.decode = False  # pictures are bytes
            part.still_render = functools.partial(_rendered, part)


def _rendered(part: Any, options: dict[str, Any]) -> dict[str, Any]:
    """Return the picture of a view as trame-vtk sends it; none where nothing changed while it is turned."""
    window = part.get_view(options["view"])
    columns, rows = map(int, options.get("size") or window.GetSize())
    columns, rows = HIDDEN_PX if min(columns, rows) < LEAST_PX else (columns, rows)
    turning = options["view"] in part.views_in_animations
    moving = turning or getattr(window, "lfpiv_moving", False)
    reply = {"stale": False, "mtime": 1, "size": [columns, rows], "global_id": options["view"], "image": None}
    if turning and getattr(window, "lfpiv_drawn", None) == (_changed(window), columns, rows):
        return reply
    if tuple(window.GetSize()) != (columns, rows):
        window.SetSize(columns, rows)
        for renderer in window.GetRenderers():  # in a narrow view the sides stay in sight
            renderer.GetActiveCamera().SetUseHorizontalViewAngle(columns < rows)
    picture = _drawn(window, min(1.0, (MOVING_PX / (columns * rows)) ** 0.5) if moving else 1.0, QUALITY[moving])
    window.lfpiv_drawn = (_changed(window), columns, rows)
    SENT.set()
    return reply | {"image": picture, "memsize": len(picture)}


def _drawn(window: Any, ratio: float, quality: int) -> bytes:
    """Render a window at a part of its size, letters included, and return it as JPEG."""
    size, letters, picture = tuple(window.GetSize()), window.GetDPI(), b""
    props = [prop for renderer in window.GetRenderers() for prop in renderer.GetViewProps()]
    axes = [(prop, prop.GetScreenSize()) for prop in props if prop.IsA("vtkCubeAxesActor")]
    for share in (ratio, 1.0):
        window.SetSize(*(max(round(share * length), LEAST_PX) for length in size))
        window.SetDPI(round(share * letters))
        for prop, height in axes:
            prop.SetScreenSize(share * height)
        if not picture:
            window.Render()
            picture = _encoded(window, quality)
    return picture


def _changed(window: Any) -> int:
    """Return when what a window shows was changed last, in VTK's count of changes."""
    renderers = list(window.GetRenderers())
    seen = (window, *renderers, *(renderer.GetActiveCamera() for renderer in renderers))
    props = (prop.GetRedrawMTime() for renderer in renderers for prop in renderer.GetViewProps())
    return int(max((*(item.GetMTime() for item in seen), *props)))


def _encoded(window: Any, quality: int) -> bytes:
    """Return the pixels of a rendered window as JPEG."""
    columns, rows = window.GetSize()
    values = vtkUnsignedCharArray()
    window.GetPixelData(0, 0, columns - 1, rows - 1, 0, values, 0)
    picture = vtk_to_numpy(values).reshape(rows, columns, 3)[::-1, :, ::-1]  # type: ignore[no-untyped-call]
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
