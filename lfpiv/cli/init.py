"""`lfpiv init`: a commented experiment file from answers to questions, or from options of the command line.

`lfpiv.cli.questions` has the questions.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from lfpiv.cli.questions import QUESTIONS, Question
from lfpiv.errors import InputError

if TYPE_CHECKING:
    from lfpiv.settings.experiment import ExperimentTable

MOST_LOOKED_FOR = 2000
"""Largest number of frames whose images are looked for."""


class Written(NamedTuple):
    """What is known of an experiment file that was written."""

    missing: str
    """What is missing before the experiment can run; empty if nothing is."""
    vectors: str
    """How many vectors a run measures."""
    warnings: tuple[str, ...]
    """What too few vectors leave out."""
    taken: tuple[str, ...]
    """Options that were neither given nor asked for, with the values that are taken."""


def write_experiment(path: Path, given: Mapping[str, str | None]) -> Written:
    """Write a new experiment file from given answers; on an interactive terminal ask for others without a default.

    Parameters
    ----------
    path : Path
        The file to write.
    given : mapping of str to str or None
        Key of a question -> its answer, None where there is none.

    Raises
    ------
    InputError
        If the file exists, an answer is missing or wrong, or the values do not fit each other.
    """
    from lfpiv.experiment.opening import check_tables, grid_of, read_experiment
    from lfpiv.experiment.template import SCHEMA, Values, experiment_text
    from lfpiv.experiment.toml import parse, validated
    from lfpiv.files import write_json, write_text
    from lfpiv.settings.experiment import ExperimentTable
    from lfpiv.settings.keys import json_schema
    from lfpiv.velocity import vector_grid

    if path.exists():
        raise InputError(f"{path}: expected a new file to write, found one that exists. Name another, or remove it.")
    answers, taken = _answers(given, path)
    values = Values.model_validate(answers)
    text = experiment_text(values)
    table = validated(parse(text, path), path, ExperimentTable)
    check_tables(path, table)
    grid = grid_of(path, table)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(text, path)
        write_json(json_schema(ExperimentTable), path.parent / SCHEMA)
    except OSError as error:
        raise InputError(f"{path}: the file cannot be written ({error.strerror}). Name another folder.") from None
    missing = ""
    try:
        read_experiment(path)
    except InputError as error:
        missing = _missing_images(path, table) or str(error)
    vectors = vector_grid.sentence(table.correlation, grid.shape, grid.voxel_mm)
    warnings = vector_grid.warnings(table.correlation, grid.shape)
    return Written(missing, vectors, tuple(warning.sentence for warning in warnings), taken)


def _missing_images(path: Path, table: ExperimentTable) -> str:
    """Name all images that a new file states and that are not there, the board's or the pairs' of a camera together."""
    from lfpiv.experiment.readers.source import split
    from lfpiv.experiment.recording import Recording

    recording, planes = Recording.from_table(table.particles), range(len(table.board.planes_mm))
    frames = [recording.frame(number).fields for number in recording.frames[:MOST_LOOKED_FOR]]
    groups = [[camera.white_image] for camera in table.camera]
    for pattern, fields in (
        (table.board.images, [{"plane": plane} for plane in planes]),
        (table.particles.images, frames),
    ):
        groups += [[pattern.format(camera=camera.name, **one) for one in fields] for camera in table.camera]
    found = []
    for group in groups:
        lacking = [name for name in dict.fromkeys(group) if not split(path.parent / name).file.is_file()]
        if lacking:
            found.append(lacking[0] if len(lacking) == 1 else f"{lacking[0]} to {lacking[-1]} ({len(lacking)} images)")
    return f"no such files: {', '.join(found)}" if found else ""


def _answers(given: Mapping[str, str | None], path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Read the given answers, take defaults, and ask for the rest; return the answers, and what is taken unasked."""
    answers: dict[str, Any] = {}
    interactive, missing, taken = sys.stdin.isatty(), [], []
    for one in QUESTIONS:
        text = given[one.key]
        if text is None and (text := _default(one, answers, path)) is not None:
            taken.append(f"{one.option} {text}")
        if text is None and interactive:
            answers[one.key] = _ask(one)
            continue
        if text is None:
            missing += [one.option] if one.key != "voxel_mm" else []  # which follows from others that are missing
            continue
        try:
            answers[one.key] = one.value(text)
        except ValueError as error:
            raise InputError(f"{one.option}: {error}.") from None
    if missing:
        raise InputError(f"init: expected {', '.join(missing)}: without a terminal nothing is asked.")
    return answers, tuple(taken)


def _default(one: Question, answers: Mapping[str, Any], path: Path) -> str | None:
    """Return the default of a question, which may follow from earlier answers or from images that are there."""
    if one.key == "name":
        return path.absolute().parent.name or "experiment"
    if one.key in ("dt_s", "count") and {"cameras", "particle_images"} <= set(answers):
        from lfpiv.experiment.recorded_times import proposed

        read = proposed if one.key == "dt_s" else _counted
        return read(path, answers["particle_images"], answers["cameras"][0][0])
    if one.key == "voxel_mm" and {"microlens_pitch_mm", "magnification"} <= set(answers):
        return f"{answers['microlens_pitch_mm'] / abs(answers['magnification']):.3g}"
    return one.default


def _counted(path: Path, particle_images: str, camera: str) -> str | None:
    """Count the pairs or instants of a camera whose images are there; None without any, or where a file has many."""
    from lfpiv.experiment.readers.source import split

    def file(number: int) -> Path:
        fields = {"camera": camera, "instant": number, "pair": number, "image": number, "frame": "a"}
        return split(path.parent / particle_images.format(**fields)).file

    try:
        if file(0) == file(1):
            return None
        count = next(number for number in itertools.count() if not file(number).is_file())
    except (LookupError, ValueError):  # the pattern is checked elsewhere
        return None
    return str(count) if count else None


def _ask(one: Question) -> Any:
    """Ask until the answer can be read."""

    def read(text: str) -> Any:
        try:
            return one.value(text)
        except ValueError as error:
            raise typer.BadParameter(f"{error}.") from None

    return typer.prompt(one.text[0].upper() + one.text[1:], value_proc=read, err=True)
