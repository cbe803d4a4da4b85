"""Tab of the experiment file as a form: each key with unit, range, default and meaning; mistakes beside the field."""

from __future__ import annotations

import asyncio
import difflib
from typing import Any

import trame_client.widgets.html as html
from trame.widgets import vuetify3 as v3

from lfpiv.errors import InputError
from lfpiv.experiment.opening import open_experiment
from lfpiv.studio import controls
from lfpiv.studio.draft import Draft, location_of
from lfpiv.studio.session import Session

WRITE = "x_texts = {...x_texts, [row.id]: $event.target.value}; trigger('x_write', [row.id, $event.target.value])"
"""What the page does when a field changes."""


class Form:
    """State and page of the tab."""

    def __init__(self, session: Session) -> None:
        self.session, self.state = session, session.state
        self.state.update({"x_tables": [], "x_texts": {}, "x_wrong": {}, "x_elsewhere": [], "x_files": []})
        self.state.update({"x_shown": [0], "x_changed": False, "x_diff": "", "x_checked": ""})
        session.on_change(lambda: session.choose(self.state.experiment_open), "experiment_open")
        self.plain: set[str] = set()
        session.server.trigger("x_write")(session.guarded(self.write))
        session.listeners.append(self._changed)
        self._page()

    def _changed(self, what: str) -> None:
        """Read the file again after another one was opened; show it again after another tab changed the draft."""
        session, s = self.session, self.state
        if what == "experiment":
            places, session.draft = session.places, None
            s.x_files = [{"title": places.name(path), "value": str(path)} for path in places.experiments()]
            self._show(anew=True)
            try:
                session.draft = Draft(session.experiment) if session.experiment is not None else None
            except InputError as error:
                s.x_elsewhere = [str(error)]
                raise
        if what in ("experiment", "draft"):
            self._show(anew=True)
        if what == "experiment":
            wrong = [any(row["id"] in s.x_wrong for row in table["rows"]) for table in s.x_tables]
            s.x_shown = [number for number, is_wrong in enumerate(wrong) if is_wrong] or [0]

    def _show(self, *, anew: bool) -> None:
        """Show the draft; `anew` replaces the texts of all fields."""
        draft, s = self.session.draft, self.state
        if draft is None:
            s.x_tables, s.x_wrong, s.x_elsewhere, s.x_changed = [], {}, [], False
            return
        if anew:
            s.x_tables, s.x_texts = draft.tables(), draft.texts()
            self.plain = {row["id"] for table in s.x_tables for row in table["rows"] if row["plain"]}
        s.x_wrong = draft.problems()
        s.x_elsewhere = [f"{name}: {text}".lstrip(": ") for name, text in s.x_wrong.items() if name not in s.x_texts]
        s.x_changed = draft.changed
        lines = difflib.unified_diff(draft.read.splitlines(), draft.text.splitlines(), "file", "form", lineterm="", n=1)
        s.x_diff = "\n".join(lines)

    def write(self, name: str, text: str) -> None:
        """Take what was typed into a field."""
        self.session.edited.write(location_of(name), str(text), name in self.plain)
        self._show(anew=False)
        self.session.told("typed")

    def edit(self, what: str, place: str = "") -> None:
        """Add or remove a camera, a solid or an optional table, undo all, or save."""
        draft = self.session.edited
        if what == "camera":
            draft.add_camera()
        elif what == "remove":
            draft.remove(location_of(place))
        elif what == "table":
            draft.set((place,), {} if draft.get((place,)) is None else None)
        elif what == "undo":
            self.session.draft = Draft(draft.path)
        elif what == "save":
            draft.save()
            self.session.start(self._check())
            self.session.changed("saved")
        self._show(anew=True)
        self.session.told("typed")

    async def _check(self) -> None:
        """Open the experiment as a run does, and say what it finds."""
        with self.state:
            self.state.x_checked = "saved; checking the images ..."
        try:
            experiment = await asyncio.to_thread(open_experiment, self.session.edited.path)
            text = f"saved; complete: {experiment.pairs} pairs of {len(experiment.cameras)} cameras"
        except ValueError as error:
            text = f"saved; not complete yet: {error}"
        with self.state:
            self.state.x_checked = text

    def _page(self) -> None:
        edit = self.session.guarded(self.edit)
        with html.Div(classes="lf-form"):
            with html.Div(classes="lf-bar"):
                controls.choice("experiment_open", "experiment file", ("x_files",), id="x-open", classes="lf-wide")
                controls.button("Save", (edit, "['save']"), "mdi-content-save", disabled=("!x_changed",), id="x-save")
                controls.button("Undo all", (edit, "['undo']"), disabled=("!x_changed",), id="x-undo")
                controls.button("Add a camera", (edit, "['camera']"), "mdi-camera-plus")
            html.Div("No experiment file is open: choose one above.", v_if="!experiment_name", classes="lf-note")
            html.Div("{{ text }}", v_for="text in x_elsewhere", key="text", classes="lf-wrong", role="alert")
            html.Div("{{ x_checked }}", v_if="x_checked", classes="lf-note", role="status")
            with v3.VExpansionPanels(multiple=True, v_model=("x_shown",), variant="accordion"):
                with v3.VExpansionPanel(v_for="table in x_tables", key="table.path + table.title"):
                    with v3.VExpansionPanelTitle():
                        html.Span("{{ table.title }}")
                        wrong = "table.rows.filter((row) => x_wrong[row.id]).length"
                        said = f"{{{{ {wrong} }}}} to mend"
                        v3.VChip(said, v_if=wrong, color="error", size="x-small", classes="ml-2")
                    with v3.VExpansionPanelText():
                        self._table(edit)
            html.H3("What will be written", v_if="x_changed")
            html.Pre("{{ x_diff }}", v_if="x_changed", classes="lf-diff")

    def _table(self, edit: Any) -> None:
        removable = "table.path.startsWith('camera.') || table.path.startsWith('volume.solid.')"
        controls.button("Remove", (edit, "['remove', table.path]"), v_if=removable)
        with html.Div(v_if="table.optional", classes="lf-buttons"):
            controls.button("Use or leave out this table", (edit, "['table', table.path]"))
        with html.Div(v_for="row in table.rows", key="row.id", classes="lf-field"):
            html.Label("{{ row.key }}{{ row.unit ? ' [' + row.unit + ']' : '' }}", raw_attrs=[":for=\"'x-' + row.id\""])
            with html.Select(
                v_if="row.options.length", raw_attrs=[":id=\"'x-' + row.id\"", ':value="x_texts[row.id]"'],
                change=WRITE,
            ):  # fmt: skip
                html.Option("{{ row.default }} (default)", value="")
                html.Option("{{ one }}", v_for="one in row.options", raw_attrs=[':value="one"'])
            html.Input(
                v_else=True, input=WRITE,
                raw_attrs=[
                    ":id=\"'x-' + row.id\"", ':value="x_texts[row.id]"', ':placeholder="row.default"',
                    'spellcheck="false"', ":aria-invalid=\"x_wrong[row.id] ? 'true' : 'false'\"",
                ],
            )  # fmt: skip
            html.Div("{{ x_wrong[row.id] }}", v_if="x_wrong[row.id]", classes="lf-wrong", role="alert")
            meant = "row.default === 'required' ? row.default : 'default: ' + row.default"
            html.Div(f"{{{{ row.meaning }}}} {{{{ [row.allowed, {meant}].join('; ') }}}}", classes="lf-note")
