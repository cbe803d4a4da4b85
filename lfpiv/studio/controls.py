"""Pieces of the page that several tabs use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import trame_client.widgets.html as html
from trame.widgets import vtk
from trame.widgets import vuetify3 as v3

DIGITS = 5  # of a slider's value in the field beside it
KEYS = {
    "ArrowLeft": (-15.0, 0.0, 1.0), "ArrowRight": (15.0, 0.0, 1.0), "ArrowUp": (0.0, 15.0, 1.0),
    "ArrowDown": (0.0, -15.0, 1.0), "+": (0.0, 0.0, 1.2), "-": (0.0, 0.0, 1 / 1.2),
}  # fmt: skip
"""Key that turns a view -> angles to the right and up [degree], and zoom."""


def slider(name: str, label: str, low: Any, high: Any, step: Any, first: Any, *, unit: str = "", **more: Any) -> None:
    """Show a slider of a value of the state, `first` at the start, with a field beside it in which it is typed."""
    with html.Div(classes="lf-slider", **more) as shown:
        shown.server.state.setdefault(name, first)
        html.Label(f"{label}{f' [{unit}]' if unit else ''}", raw_attrs=[f'for="s-{name}"'])
        told = f"{name} = Number($event.target.value)"
        html.Input(type="range", min=low, max=high, step=step, value=(name,), id=f"s-{name}", input=told)
        html.Input(
            type="number", value=(f"+Number({name}).toPrecision({DIGITS})",), step="any", id=f"n-{name}",
            raw_attrs=[f'aria-label="{label}, typed"'], change=told,
        )  # fmt: skip


def choice(name: str, label: str, items: Any, first: str = "", **more: Any) -> None:
    """Show a list to choose from."""
    more |= {"label": label, "items": items, "density": "compact", "hide_details": True, "variant": "outlined"}
    v3.VSelect(v_model=(name,), **more).server.state.setdefault(name, first)


def switch(name: str, label: str, first: bool = False, **more: Any) -> None:
    """Show a box to tick."""
    shown = v3.VCheckbox(v_model=(name,), label=label, density="compact", hide_details=True, **more)
    shown.server.state.setdefault(name, first)


def button(label: str, click: Any, icon: str = "", **more: Any) -> None:
    """Show a button."""
    v3.VBtn(label, click=click, size="small", variant="tonal", prepend_icon=icon or None, **more)


def linked(plotters: Sequence[Any], name: str, titles: Mapping[str, str], also: Any = lambda: True) -> list[Any]:
    """Show plotters beside each other, with one camera turned by hand or keys: title -> when it is seen."""
    views: list[Any] = []

    def turned(*_: Any, **__: Any) -> None:
        for view in views if also() else ():
            view.update()

    def key(pressed: str) -> None:
        camera, (right, up, closer) = plotters[0].camera, KEYS[pressed]
        camera.Azimuth(right)
        camera.Elevation(up)
        camera.OrthogonalizeViewUp()
        camera.zoom(closer)
        for plotter, view in zip(plotters, views, strict=True):
            plotter.renderer.ResetCameraClippingRange()
            view.update()

    for number, (title, shown) in enumerate(titles.items()):
        pressed = f"{list(KEYS)}.includes($event.key) && ($event.preventDefault(), trigger('{name}_key', [$event.key]))"
        said = ['role="group"', f'aria-label="{name}: arrow keys turn it, + and - come closer and go farther"']
        with html.Div(classes="lf-view", v_show=shown, keydown=pressed, raw_attrs=said):
            html.Div(title, classes="lf-name", id=f"{name}-{number}")
            views.append(
                vtk.VtkRemoteView(
                    plotters[number].render_window, ref=f"{name}_{number}", interactive_ratio=1,
                    interactor_events=(f"{name}_{number}_events", ["Animation", "EndAnimation"]),
                    Animation=turned, EndAnimation=turned,
                )
            )  # fmt: skip
    views[0].server.trigger(f"{name}_key")(key)
    return views
