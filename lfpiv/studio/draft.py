"""The experiment file as it is edited: values are replaced in its text, comments and order stay."""

from __future__ import annotations

import contextlib
import functools
import operator
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import BaseModel, ValidationError

from lfpiv.errors import InputError
from lfpiv.experiment import problems
from lfpiv.experiment.opening import check_tables
from lfpiv.experiment.toml import parse, read_text
from lfpiv.files import write_text
from lfpiv.settings.experiment import ExperimentTable
from lfpiv.settings.keys import key_rows, tables_of, unit_of
from lfpiv.settings.volume import Box, HalfSpace

Location = tuple[int | str, ...]

OPTIONAL = ("tracking",)
"""Tables that change what a run does by being there, even when they are empty."""
UNKNOWN = {
    "unit": "", "allowed": "empty the field to remove it", "default": "none", "meaning": "No key of lfpiv.",
    "options": [], "plain": True,
}  # fmt: skip
"""What a form shows of a key that the settings do not have."""


class Draft:
    """The text of an experiment file, with what is wrong in it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.read = read_text(path)
        parse(self.read, path)
        self.document = tomlkit.parse(self.read)

    @property
    def values(self) -> dict[str, Any]:
        """The values, as plain Python."""
        return self.document.unwrap()

    @property
    def table(self) -> ExperimentTable:
        """The values, checked; ValidationError where one is wrong."""
        return ExperimentTable.model_validate(self.values)

    @property
    def text(self) -> str:
        """The text of the file."""
        return tomlkit.dumps(self.document)

    @property
    def changed(self) -> bool:
        """Whether the text differs from the file as it was read."""
        return self.text != self.read

    def get(self, location: Sequence[int | str]) -> Any:
        """Return the value at a place, or None where there is none."""
        try:
            return functools.reduce(operator.getitem, location, self.values)  # type: ignore[arg-type]
        except (KeyError, IndexError, TypeError):
            return None

    def set(self, location: Sequence[int | str], value: Any) -> None:
        """Replace a value, or remove the key for None. A missing table is added at the end of the file."""
        table: Any = self.document
        if value is None and self.get(location) is None:
            return
        for part in location[:-1]:
            table = table.setdefault(part, tomlkit.table()) if isinstance(part, str) else table[part]
        if value is None:
            del table[location[-1]]
        else:
            table[location[-1]] = value

    def write(self, location: Sequence[int | str], text: str, plain: bool) -> None:
        """Replace a value by a text that a person typed: TOML, or words without quotes; nothing removes the key."""
        value: Any = text.strip() or None
        if value and not plain:
            with contextlib.suppress(Exception):  # words that are no TOML are refused by settings that want a number
                value = tomlkit.value(value).unwrap()
        self.set(location, value)

    def add_solid(self, kind: str, where: dict[str, Any]) -> None:
        """Add a solid to the volume."""
        volume: Any = self.document["volume"]
        volume.setdefault("solid", tomlkit.aot()).append(tomlkit.item({"kind": kind, **where}))

    def remove(self, location: Sequence[int | str]) -> None:
        """Remove an entry of a list of tables, such as a camera or a solid."""
        document: Any = self.document
        del functools.reduce(operator.getitem, location[:-1], document)[location[-1]]

    def add_camera(self) -> None:
        """Add a camera with the values of the last one, under another name."""
        cameras: Any = self.document["camera"]
        names = {camera["name"] for camera in cameras}
        name = next(name for n in range(1, 100) if (name := f"camera{n}") not in names)
        cameras.append(tomlkit.item(cameras[-1].unwrap() | {"name": name}))

    def problems(self) -> dict[str, str]:
        """Return what is wrong at each place, by its dotted name; "" for the file as a whole."""
        values = self.values
        try:
            check_tables(self.path, self.table)
        except ValidationError as error:
            found = problems.explain_each(error, ExperimentTable, values)
            return {".".join(map(str, location)): text for location, text in found.items()}
        except InputError as error:
            return {"": str(error).removeprefix(f"{self.path}: ")}
        return {}

    def save(self) -> None:
        """Write the file; InputError if a value is wrong, or another program changed it since it was read."""
        wrong = self.problems()
        if wrong:
            raise InputError(f"{self.path}: not saved. {next(f'{key}: {text}' for key, text in wrong.items())}")
        if read_text(self.path) != self.read:
            raise InputError(f"{self.path}: another program changed the file since it was opened. Open it again.")
        text = self.text
        parse(text, self.path)
        write_text(text, self.path)
        self.read = text

    def tables(self) -> list[dict[str, Any]]:
        """Return what a form of the file needs: tables, and for each key its range, unit, default and meaning."""
        found = [self._form("", ExperimentTable, "experiment")]
        for name, field in ExperimentTable.model_fields.items():
            model = next(tables_of(field.annotation), None)
            if model is None:
                continue
            if name == "camera":
                found += [
                    self._form(f"camera.{number}", model, f"camera {camera.get('name', number)}")
                    for number, camera in enumerate(self.values.get("camera", []))
                ]
            else:
                found.append(self._form(name, model, name.replace("_", " ")))
            if name == "volume":
                for number, solid in enumerate(self.values.get("volume", {}).get("solid", [])):
                    shape = HalfSpace if solid.get("kind") == "half_space" else Box
                    kind = str(solid.get("kind")).replace("_", " ")
                    found.append(self._form(f"volume.solid.{number}", shape, f"solid {number}: {kind}"))
        return found

    def _form(self, path: str, model: type[BaseModel], title: str) -> dict[str, Any]:
        """Return a table of a form: keys of its model, then keys in the file that no model has."""
        rows, values = list(_rows(model)), self.get(location_of(path))
        known = {row["key"] for row in rows} | set(model.model_fields)
        values = values.items() if isinstance(values, dict) else ()
        unknown = [key for key, value in values if key not in known and not isinstance(value, dict)]
        rows += [{**UNKNOWN, "key": key} for key in unknown]
        rows = [{**row, "id": f"{path}.{row['key']}" if path else row["key"]} for row in rows]
        return {"path": path, "title": title, "rows": rows, "optional": path in OPTIONAL}

    def texts(self) -> dict[str, str]:
        """Return the text of each value by its dotted name; "" where the file does not state it."""
        texts = {}
        for row in (row for table in self.tables() for row in table["rows"]):
            value = self.get(location_of(row["id"]))
            plain = row["plain"] or isinstance(value, str)
            texts[row["id"]] = "" if value is None else str(value) if plain else tomlkit.item(value).as_string().strip()
        return texts


def location_of(name: str) -> Location:
    """Return the place of a dotted name."""
    return tuple(int(part) if part.isdigit() else part for part in name.split(".") if part)


@functools.cache
def _rows(model: type[BaseModel]) -> tuple[dict[str, Any], ...]:
    """Return what a form needs of the keys of a table."""
    properties = model.model_json_schema()["properties"]
    rows = []
    for key, *words in key_rows(model):
        kind, choices = properties[key].get("type"), properties[key].get("enum")
        options = choices or (["true", "false"] if kind == "boolean" else [])
        told = dict(zip(("allowed", "default", "meaning"), (text.replace("`", "") for text in words), strict=True))
        rows.append({"key": key, "unit": unit_of(key), "options": options, "plain": kind == "string", **told})
    return tuple(rows)
