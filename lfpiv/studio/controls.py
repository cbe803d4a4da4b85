"""Pieces of the page that several tabs use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import trame_client.widgets.html as html
from trame.widgets import vtk
from trame.widgets import vuetify3 as v3

DIGITS = 5
"""Digits of a slider's value in the field beside it."""


def slider(name: str, label: str, low: Any, high: Any, step: Any, *, unit: str = "", **more: Any) -> None:
    """Show a slider of a value of the state, with a field beside it in which the value is typed."""
    with html.Div(classes="lf-slider", **more):
        html.Label(f"{label}{f' [{unit}]' if unit else ''}", for_=f"s-{name}")
        v3.VSlider(
            v_model=(name,), min=low, max=high, step=step, density="compact", hide_details=True, id=f"s-{name}",
            thumb_size=14, track_size=3, aria_label=label,
        )  # fmt: skip
        html.Input(
            type="number", value=(f"+Number({name}).toPrecision({DIGITS})",), step="any", id=f"n-{name}",
            aria_label=f"{label}, typed", change=f"{name} = Number($event.target.value)",
        )  # fmt: skip


def choice(name: str, label: str, items: Any, **more: Any) -> None:
    """Show a list to choose from."""
    v3.VSelect(
        v_model=(name,), label=label, items=items, density="compact", hide_details=True, variant="outlined", **more
    )


def switch(name: str, label: str, **more: Any) -> None:
    """Show a box to tick."""
    v3.VCheckbox(v_model=(name,), label=label, density="compact", hide_details=True, **more)


def button(label: str, click: Any, icon: str = "", **more: Any) -> None:
    """Show a button."""
    options = {"prepend_icon": icon} if icon else {}
    v3.VBtn(label, click=click, size="small", variant="tonal", **options, **more)


def linked(pictures: Sequence[Any], name: str, titles: Mapping[str, str], also: Any = lambda: True) -> list[Any]:
    """Show pictures beside each other, whose cameras are the same: title -> when it is seen.

    When one is turned all are drawn anew if `also` says so.
    """
    views: list[Any] = []

    def turned(*_: Any, **__: Any) -> None:
        for view in views if also() else ():
            view.update()

    for number, (title, shown) in enumerate(titles.items()):
        with html.Div(classes="lf-view", v_show=shown):
            html.Div(title, classes="lf-name", id=f"{name}-{number}")
            views.append(picture(pictures[number].plotter, f"{name}_{number}", turned))
    return views


def picture(plotter: Any, name: str, turned: Any = None) -> Any:
    """Show what a plotter draws; `turned` is called when it was turned by hand."""
    events = {"interactor_events": (f"{name}_events", ["Animation", "EndAnimation"])} if turned else {}
    events |= {"Animation": turned, "EndAnimation": turned} if turned else {}
    return vtk.VtkRemoteView(plotter.render_window, ref=name, interactive_ratio=1, **events)
