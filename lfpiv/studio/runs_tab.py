"""Tab of runs: start, pause, resume and stop `lfpiv run`; its stages, time left, warnings and log."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import trame_client.widgets.html as html
from trame.widgets import vuetify3 as v3

from lfpiv.errors import InputError
from lfpiv.studio import controls, run_process, warning_cards
from lfpiv.studio.session import Session

SHOWN_LINES = 60  # of the log
LOOK_EVERY_S = 0.5
"""Interval at which the state of a run is read [s]."""


class Runs:
    """State and page of the tab."""

    def __init__(self, session: Session) -> None:
        self.session, self.state = session, session.state
        self.process: int | None = None
        self.stopped = False
        self.state.update({
            "p_out": "results", "p_pairs": "", "p_workers": "", "p_status": "none", "p_stages": [], "p_log": "",
            "p_warnings": [], "p_end": "", "p_left": "",
        })  # fmt: skip
        session.listeners.append(self._changed)
        session.start(self._watch())
        session.closers.append(self._close)
        self._page()

    @property
    def out(self) -> Path:
        """Folder of results that is asked for, within the given folders."""
        return self.session.places.within(str(self.state.p_out or "results"))

    def _changed(self, what: str) -> None:
        """Offer the folder of the open results, or a new folder beside the experiment file."""
        results, experiment = self.session.results, self.session.experiment
        if what == "results" and results is not None and results.is_dir():
            self.state.p_out = self.session.places.name(results)
            self.state.p_warnings = self._cards(run_process.finished_warnings(results))
            self.state.p_end = "results are there; Start measures what is missing or changed"
        elif what == "experiment" and results is None and experiment is not None:
            self.state.p_out = self.session.places.name(experiment.parent / "results")

    def start(self, out: str, pairs: str, workers: str, volumes: bool) -> None:
        """Start a run with the folder and options of the page; finished parts are not repeated."""
        session, s = self.session, self.state
        # a busy browser may set the state after the click
        s.p_out, s.p_pairs, s.p_workers, s.p_volumes = out, pairs, workers, volumes
        if session.edited.changed:
            raise InputError("experiment: the form has changes that are not saved. Save them first, or undo them.")
        options = [f"{name}={value}" for name, value in {"--pairs": pairs, "--workers": workers}.items() if value]
        options += ["--keep-volumes"] if volumes else []
        self.process = run_process.start(session.edited.path, self.out, options)
        s.p_end, s.p_warnings = "", []
        self._look()

    def control(self, what: str) -> None:
        """Pause, resume or stop the run."""
        if self.process is not None:
            self.stopped = what == "stop"
            run_process.control(self.process, what)
        self._look()

    async def _watch(self) -> None:
        """Show the state of the run again and again."""
        while True:
            await asyncio.sleep(LOOK_EVERY_S)
            with self.state:
                self.session.guarded(self._look)()

    def _look(self) -> None:
        """Show the state of the run that writes the folder, whoever started it."""
        s = self.state
        try:
            out = self.out
        except InputError:
            return
        found = run_process.holder(out)
        if found is not None and self.process != found.process:
            self.process = found.process
        now = "none" if self.process is None else run_process.status(self.process)
        if now in ("running", "paused") or s.p_status in ("running", "paused"):
            s.p_stages, s.p_left = run_process.stages(out), run_process.time_left(out)
            s.p_log = "\n".join(run_process.tail(out / run_process.LOG).splitlines()[-SHOWN_LINES:])
            s.p_warnings = self._cards({"text": text} for text in run_process.logged_warnings(out))
        if s.p_status in ("running", "paused") and now == "ended":
            self._ended(out)
        s.p_status = now

    def _ended(self, out: Path) -> None:
        """Show warnings of the finished run, and its results in the other tabs."""
        own = run_process.children.get(self.process or 0)
        number = own.poll() if own is not None else None
        self.process = None
        ends = {0: "finished", 3: "finished; some pairs failed", None: "ended"}
        early = "stopped; Start goes on from there" if self.stopped else "ended early; see its log"
        self.state.p_end, self.stopped = ends.get(number, early), False
        if number in (0, 3, None) and (finished := run_process.finished_warnings(out)):
            self.state.p_warnings = self._cards(finished)
        if any((out / "vectors").glob("*.nc")):
            self.session.results = out
            self.session.changed("results")

    def _cards(self, warnings: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
        """Return the texts, links and places that the page shows of warnings."""
        draft = self.session.draft
        cameras = [] if draft is None else [str(camera.get("name")) for camera in draft.get(("camera",)) or []]
        return [warning_cards.card(warning, cameras) for warning in warnings]

    def _close(self) -> None:
        """End the run with the studio if that is asked for; otherwise leave it."""
        if self.process is not None and self.state.p_stop_with_studio:
            run_process.control(self.process, "stop")

    def _page(self) -> None:
        control = self.session.guarded(self.control)
        running = "['running', 'paused'].includes(p_status)"
        with html.Div(classes="lf-form"):
            with html.Div(classes="lf-bar"):
                for name, label, hint in (
                    ("p_out", "folder of results", "results"), ("p_pairs", "pairs, such as 0:10", "all"),
                    ("p_workers", "workers", "1"),
                ):  # fmt: skip
                    v3.VTextField(
                        v_model=(name,), label=label, placeholder=hint, density="compact", hide_details=True,
                        variant="outlined", id=name.replace("_", "-"), disabled=(running,), persistent_placeholder=True,
                    )  # fmt: skip
                controls.switch("p_volumes", "keep volumes")
                controls.switch("p_stop_with_studio", "stop the run when the studio ends")
            with html.Div(classes="lf-bar"):
                start = (self.session.guarded(self.start), "[p_out, p_pairs, p_workers, p_volumes]")
                controls.button("Start", start, "mdi-play", id="p-start", disabled=(running,), color="primary")
                shown = {"pause": "p_status === 'running'", "resume": "p_status === 'paused'", "stop": running}
                for what, when in shown.items():
                    icon, look = f"mdi-{what.replace('resume', 'play')}", {"color": "error"} if what == "stop" else {}
                    controls.button(what.title(), (control, f"['{what}']"), icon, id=f"p-{what}", v_if=when, **look)
                said = f"{{{{ !{running} ? p_end : p_status }}}} {{{{ p_status === 'running' ? p_left : '' }}}}"
                html.Span(said, id="p-status", role="status")
            html.Div(
                "The run goes on without this page and without the studio; `lfpiv run` with the same file and folder "
                "continues it.", v_if=running, classes="lf-note",
            )  # fmt: skip
            with html.Template(v_for="stage in p_stages", key="stage.name"):
                self._bar("stage", "lf-stage")
                with html.Template(v_for="pair in stage.pairs", key="pair.name"):
                    self._bar("pair", "lf-stage lf-one")
            with html.Div(v_for="(warning, number) in p_warnings", key="number", classes="lf-card", role="alert"):
                html.B("{{ warning.what }}")
                html.Div("{{ warning.remedy }}")
                with html.Div(classes="lf-buttons"):
                    controls.button(
                        "See it in the image", "i_place = {...warning.place}; tab = 'images'", "mdi-image-search",
                        v_if="warning.place", classes="lf-see",
                    )  # fmt: skip
                    html.A("More on {{ warning.code || 'warnings' }}", href=("warning.link",), target="_blank")
            with html.Details(v_if="p_log", open=True):
                html.Summary("log")
                html.Pre("{{ p_log }}", classes="lf-diff", id="p-log")

    def _bar(self, name: str, classes: str) -> None:
        """Show the bar of a stage or of a pair."""
        with html.Div(classes=classes):
            html.Span(f"{{{{ {name}.name }}}}")
            named = {"raw_attrs": [f':aria-label="{name}.name"']}
            v3.VProgressLinear(model_value=(f"{name}.percent",), height=8, rounded=True, color="primary", **named)
            html.Span(f"{{{{ {name}.percent }}}} % {{{{ {name}.left }}}}", classes="lf-note")
