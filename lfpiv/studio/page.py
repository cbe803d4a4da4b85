"""The page: a bar with what is open, tabs, and messages. A tab has its own module, and is built when it is seen."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import trame_client.widgets.html as html
from aiohttp import web
from trame.app import get_server
from trame.ui.vuetify3 import VAppLayout
from trame.widgets import vuetify3 as v3

from lfpiv.results.stores import is_store
from lfpiv.studio import delivery, warning_cards
from lfpiv.studio.access import Places, is_run
from lfpiv.studio.form_tab import Form
from lfpiv.studio.images_tab import Images
from lfpiv.studio.preview_tab import Preview
from lfpiv.studio.results_tab import Results
from lfpiv.studio.runs_tab import Runs
from lfpiv.studio.session import Session
from lfpiv.studio.space_tab import Space

TABS: dict[str, tuple[str, Callable[[Session], Any]]] = {
    "images": ("Rig and images", Images),
    "experiment": ("Experiment", Form),
    "space": ("Space", Space),
    "preview": ("Preview", Preview),
    "runs": ("Runs", Runs),
    "results": ("Results", Results),
}
"""Name of a tab -> its title, and the class that builds it."""


def build(given: Path) -> Session:
    """Build the page for an experiment file, results of a run, or a folder with either."""
    server = get_server("lfpiv studio", client_type="vue3")
    static = Path(__file__).parent / "static"
    server.enable_module(
        {"serve": {"lfpiv_studio": str(static)}, "scripts": ["lfpiv_studio/studio.js"],
         "styles": ["lfpiv_studio/studio.css"], "vue_use": ["lfpivStudio"]}
    )  # fmt: skip
    session = Session(server, Places(root_of(given)))
    session.open(given)
    state = server.state
    state.update({"tab": "results" if session.results else next(iter(TABS)), "theme": "light", "message": ""})
    state.update({"message_shown": False, "trame__title": "lfpiv studio"})
    with VAppLayout(server, theme=("theme",)):
        _bar(session)
        with v3.VMain():
            for name, (_, tab) in TABS.items():
                with v3.VLazy(v_show=f"tab === '{name}'", classes="lf-tab", id=f"tab-{name}", role="tabpanel"):
                    tab(session)
        with v3.VSnackbar(
            "{{ message }}", v_model=("message_shown",), timeout=30000, multi_line=True, location="bottom",
            color="error", classes="lf-message",
        ), v3.Template(v_slot_actions=True):  # fmt: skip
            v3.VBtn("Close", click="message_shown = false", variant="text")
    server.add_protocol_to_configure(delivery.send_at_once)
    session.changed("experiment", "results")
    return session


def routes() -> list[web.RouteDef]:
    """Return the addresses beside the page, all guarded by the token."""

    async def words(request: web.Request) -> web.Response:
        content = warning_cards.page(request.match_info["name"])
        if content is None:
            raise web.HTTPNotFound(text="This page is not installed; it lies in docs/ of the sources of lfpiv.")
        return web.Response(text=content, content_type="text/html")

    return [web.get(r"/pages/{name:\w+}", words)]


def root_of(given: Path) -> Path:
    """Return the folder that may be looked at: a given folder, or the folder of a given file, run or store."""
    return given if given.is_dir() and not is_store(given) and not is_run(given) else given.parent


def _bar(session: Session) -> None:
    with v3.VAppBar(density="compact", flat=True, border=True):
        html.Div("lfpiv studio", classes="lf-brand")
        with v3.VTabs(v_model=("tab",), density="compact", show_arrows=True, classes="lf-tabs"):
            for name, (title, _) in TABS.items():
                v3.VTab(title, value=name)
        v3.VBtn(
            icon=("theme === 'light' ? 'mdi-weather-night' : 'mdi-weather-sunny'",),
            click="theme = theme === 'light' ? 'dark' : 'light'", size="small", title="light or dark", id="theme",
        )  # fmt: skip
