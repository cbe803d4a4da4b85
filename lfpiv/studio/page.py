"""The page: a bar, tabs, and messages. The browser loads it while the tab that is seen first is built, then the others.

The browser waits for what is imported here, so that is little.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import trame_client.widgets.html as html
from aiohttp import web
from trame.app import get_server
from trame.ui.html import DivLayout
from trame.ui.vuetify3 import VAppLayout
from trame.widgets import client
from trame.widgets import vuetify3 as v3
from trame_vtk.modules import common, vtk

from lfpiv.studio import delivery

TABS = {
    "images": ("Rig and images", "images_tab", "Images"), "experiment": ("Experiment", "form_tab", "Form"),
    "space": ("Space", "space_tab", "Space"), "preview": ("Preview", "preview_tab", "Preview"),
    "runs": ("Runs", "runs_tab", "Runs"), "results": ("Results", "results_tab", "Results"),
}  # fmt: skip
"""Name of a tab -> its title, and the module and the class that build it."""
LONGEST_S = 10.0
"""Longest time that other tabs wait for the first picture of results [s]."""


def opened() -> Any:
    """Return a server with the page, whose tabs are empty."""
    server = get_server("lfpiv studio", client_type="vue3")
    own = {"serve": {"lfpiv_studio": str(Path(__file__).parent / "static")}, "scripts": ["lfpiv_studio/studio.js"],
           "styles": ["lfpiv_studio/studio.css"], "vue_use": ["lfpivStudio"]}  # fmt: skip
    for module in (own, common, vtk):
        server.enable_module(module)
    server.add_protocol_to_configure(delivery.send_at_once)
    server.state.update({"tab": "", "theme": "light", "message": "", "message_shown": False})
    server.state.update({"trame__title": "lfpiv studio"} | {f"trame__template_{name}": "" for name in TABS})
    with VAppLayout(server, theme=("theme",)):
        _bar()
        with v3.VMain():
            html.Div("lfpiv studio is starting ...", v_if="!tab", classes="lf-doc", role="status")
            for name in TABS:
                with v3.VLazy(v_show=f"tab === '{name}'", classes="lf-tab", id=f"tab-{name}", role="tabpanel"):
                    client.ServerTemplate(name=name)
        with v3.VSnackbar(
            "{{ message }}", v_model=("message_shown",), timeout=30000, multi_line=True, location="bottom",
            color="error", classes="lf-message",
        ), v3.Template(v_slot_actions=True):  # fmt: skip
            v3.VBtn("Close", click="message_shown = false", variant="text")
    return server


async def fill(server: Any, given: Path, closers: list[Callable[[], None]]) -> None:
    """Build the tabs for an experiment file, results of a run, or a folder with either."""
    access, sessions, *_ = [
        await asyncio.to_thread(import_module, f"lfpiv.studio.{name}") for name in ("access", "session", "look")
    ]
    session = sessions.Session(server, access.Places(access.root_of(given)), closers=closers)
    with server.state:
        session.open(given)
        session.changed()
    first = "results" if session.results else next(iter(TABS))
    for name in sorted(TABS, key=lambda name: name != first):
        module = await asyncio.to_thread(import_module, f"lfpiv.studio.{TABS[name][1]}")
        known = len(session.listeners)
        with server.state, DivLayout(server, template_name=name, classes="lf-fill"):
            getattr(module, TABS[name][2])(session)
        with server.state:
            server.state.tab = server.state.tab or name
            for listener in session.listeners[known:]:
                for what in ("experiment", "results"):
                    session.guarded(listener)(what)
        if name == "results" == first:
            await asyncio.wait({asyncio.ensure_future(delivery.SENT.wait())}, timeout=LONGEST_S)


def routes() -> list[web.RouteDef]:
    """Return the addresses beside the page, all guarded by the token."""

    async def words(request: web.Request) -> web.Response:
        from lfpiv.studio import warning_cards

        content = warning_cards.page(request.match_info["name"])
        if content is None:
            raise web.HTTPNotFound(text="This page is not installed; it lies in docs/ of the sources of lfpiv.")
        return web.Response(text=content, content_type="text/html")

    return [web.get(r"/pages/{name:\w+}", words)]


def _bar() -> None:
    with v3.VAppBar(density="compact", flat=True, border=True):
        html.Div("lfpiv studio", classes="lf-brand")
        with v3.VTabs(v_model=("tab",), density="compact", show_arrows=True, classes="lf-tabs", v_if="tab"):
            for name, (title, *_) in TABS.items():
                v3.VTab(title, value=name, disabled=(f"!trame__template_{name}",))  # until it is built
        v3.VBtn(
            icon=("theme === 'light' ? 'mdi-weather-night' : 'mdi-weather-sunny'",),
            click="theme = theme === 'light' ? 'dark' : 'light'", size="small", title="light or dark", id="theme",
        )  # fmt: skip
