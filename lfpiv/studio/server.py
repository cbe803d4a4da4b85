"""Start the studio: a server of this machine only, with a token in its address, and its page in the browser."""

from __future__ import annotations

import asyncio
import gc
import importlib.util
import logging
import os
import secrets
import signal
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lfpiv.errors import InputError

NEEDED = ("trame", "trame_vtk", "trame_vuetify", "pyvista", "tomlkit", "imageio_ffmpeg", "psutil")
"""Packages of the extra `studio`."""


def require_extra() -> None:
    """Raise InputError where packages of the extra `studio` are missing."""
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        named = ", ".join(name.replace("_", "-") for name in missing)
        raise InputError(
            f"lfpiv studio: expected the packages of the extra `studio`, found no {named}. "
            "Install them: pip install 'lfpiv[studio]'"
        )


def quiet_closed_pages() -> None:
    """Suppress log records of connections that a closed page ended while the server was sending to it."""
    for name in ("wslink.protocol", "asyncio"):
        logging.getLogger(name).addFilter(
            lambda record: not isinstance((record.exc_info or sys.exc_info())[1], ConnectionError)
        )


def serve(
    path: str | Path | None = None,
    *,
    port: int = 0,
    browser: bool = True,
    ready: Callable[[str], None] | None = None,
) -> None:
    """Serve the studio for an experiment file, results or a folder with either, until it is interrupted.

    Port 0 is a free one. `ready` is called with the address, token included, when the page can be opened. Raise
    InputError if packages of the extra are missing, or there is nothing at `path`, by default the present folder.
    """
    require_extra()
    given = Path.cwd() if path is None else Path(path)
    if not given.exists():
        raise InputError(f"{given}: expected an experiment file or the results of a run, found nothing there.")
    quiet_closed_pages()
    arguments, sys.argv = sys.argv, sys.argv[:1]  # trame would parse the options
    try:
        asyncio.run(_run(given.resolve(), port, browser, ready))
    finally:
        sys.argv = arguments


async def _run(given: Path, port: int, browser: bool, ready: Callable[[str], None] | None) -> None:
    """Serve until a signal comes. Then call the tabs' closers and end the process at once, threads included."""
    gc.disable()  # garbage collection during imports takes a fifth of the start
    from lfpiv.studio import access, page

    token, server, listening = secrets.token_urlsafe(24), page.opened(), asyncio.Event()
    closers: list[Callable[[], None]] = []

    def bind(bound: Any) -> None:
        bound.app.middlewares.append(access.guard(token))
        bound.app.add_routes(page.routes())

    def started(**_: Any) -> None:
        address = f"http://127.0.0.1:{server.port}/index.html?token={token}"
        if ready is not None:
            ready(address)
        if browser:
            webbrowser.open(address)
        listening.set()

    async def fill() -> None:
        await listening.wait()
        await page.fill(server, given, closers)
        gc.freeze()
        gc.enable()

    def end() -> None:
        for close in closers:
            close()
        sys.stdout.flush()
        os._exit(0)

    server.controller.on_server_bind.add(bind)
    server.controller.on_server_ready.add(started)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, end)
    serving = server.start(  # thread: no handlers of signals besides those above
        port=port, host="127.0.0.1", exec_mode="coroutine", open_browser=False, show_connection_info=False,
        disable_logging=True, timeout=0, thread=True,
    )  # fmt: skip
    try:
        await asyncio.gather(serving, fill())
    except OSError as error:
        if listening.is_set():
            raise
        raise InputError(f"port {port}: {(error.strerror or str(error)).lower()}. Choose another --port.") from None
