"""`lfpiv init`: a commented experiment file from answers to questions, or from options of the command line.

`QUESTIONS` defines each value once: its option, its question with the unit and the place where the number is found, and
how its text is read.
"""

from __future__ import annotations

import inspect
import itertools
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from lfpiv.errors import InputError

if TYPE_CHECKING:
    from lfpiv.settings.experiment import ExperimentTable

MOST_LOOKED_FOR = 2000
"""Largest number of frames whose images are looked for."""
MOST_PLANES = 1000
"""Largest number of planes that first, last and step may give."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """One value of a new experiment file."""

    key: str
    """Field of `Values`."""
    option: str
    """Option of the command line."""
    form: str
    """Form of the text, in the help."""
    text: str
    """What is asked, with the unit and where the number is found."""
    read: Callable[[str], Any] = str
    """Reads the text; raises ValueError."""
    default: str | None = None

    def value(self, text: str) -> Any:
        """Return the value of an answer, or raise ValueError with what was expected."""
        from pydantic import TypeAdapter, ValidationError  # here: the command line starts without it

        from lfpiv.experiment.template import Values

        try:
            value = self.read(text.strip())
        except ValueError:
            hint = " with a decimal point" if "," in text and "," not in self.form else ""
            raise ValueError(f"expected {self.form}{hint}, found {text!r}") from None
        try:
            return TypeAdapter(Values.model_fields[self.key].rebuild_annotation()).validate_python(value)
        except ValidationError as error:
            reason = error.errors()[0]["msg"].removeprefix("Input ").removeprefix("Value error, ")
            raise ValueError(f"expected {self.form} that {reason}, found {text!r}") from None


def _cameras(text: str) -> tuple[tuple[str, float], ...]:
    """Read "left=45, right=-45"."""
    parts = [part.partition("=") for part in text.split(",")]
    return tuple((name.strip(), float(angle)) for name, _, angle in parts)


def _product(number: Callable[[str], Any]) -> Callable[[str], tuple[Any, ...]]:
    """Return what reads numbers with "x" between them, such as "7x7"."""
    return lambda text: tuple(number(part) for part in text.lower().split("x"))


def _planes(text: str) -> tuple[float, ...]:
    """Read "-2, -1, 0, 1, 2", or "-2:2:1": first, last and step."""
    if ":" not in text:
        return tuple(float(part) for part in text.split(","))
    first, last, step = (float(part) for part in text.split(":"))
    count = (last - first) / step if step else -1.0
    if not 0 <= count < MOST_PLANES or abs(count - round(count)) > 1e-6:
        raise ValueError
    return tuple(round(first + step * number, 9) for number in range(round(count) + 1))


QUESTIONS = (
    Question(key="name", option="--name", form="text", text="name of the experiment, title of its report"),
    Question(
        key="cameras",
        option="--cameras",
        form="NAME=ANGLE,...",
        text="cameras and the angle of each about y [degree], positive on the side of +x, such as left=45, right=-45",
        read=_cameras,
    ),
    Question(
        key="focal_length_mm",
        option="--focal-length",
        form="a number",
        text="focal length of the main lens [mm], engraved on it",
        read=float,
    ),
    Question(
        key="magnification",
        option="--magnification",
        form="a number",
        text="magnification: size on the sensor over size in the volume, of either sign",
        read=float,
    ),
    Question(
        key="f_number",
        option="--f-number",
        form="a number",
        text="aperture of the main lens: the f-number set on its ring",
        read=float,
    ),
    Question(
        key="microlens_pitch_mm",
        option="--microlens-pitch",
        form="a number",
        text="distance of the microlenses [mm], from the maker of the array",
        read=float,
    ),
    Question(
        key="microlens_focal_length_mm",
        option="--microlens-focal-length",
        form="a number",
        text="focal length of the microlenses [mm], from the maker of the array",
        read=float,
    ),
    Question(
        key="microlens_layout",
        option="--microlens-layout",
        form="square or hexagonal",
        text="arrangement of the microlenses",
        default="square",
    ),
    Question(
        key="pixel_um",
        option="--pixel",
        form="a number",
        text="pixel pitch of the sensor [um], from the data sheet of the camera",
        read=float,
    ),
    Question(
        key="image_flip",
        option="--image-flip",
        form="none, horizontal, vertical or both",
        text="pictures show the scene as it is seen (horizontal), upside down (vertical), mirrored left to right "
        "(none), or mirrored and upside down (both)",
        default="horizontal",
    ),
    Question(
        key="white_image",
        option="--white",
        form="a path",
        text="white images, with {camera} for the name of the camera",
        default="white/{camera}.tif",
    ),
    Question(
        key="board_images",
        option="--board",
        form="a path",
        text="images of the board, with {camera} and {plane}",
        default="board/{camera}/plane_{plane:02d}.tif",
    ),
    Question(
        key="dots",
        option="--dots",
        form="NXxNY",
        text="number of dots of the board along x and y, such as 7x7",
        read=_product(int),
    ),
    Question(
        key="spacing_mm",
        option="--spacing",
        form="a number",
        text="distance of the dots [mm], from the drawing of the board",
        read=float,
    ),
    Question(
        key="dot_diameter_mm",
        option="--dot-diameter",
        form="a number",
        text="diameter of a dot [mm], from the drawing of the board",
        read=float,
    ),
    Question(
        key="planes_mm",
        option="--planes",
        form="FIRST:LAST:STEP or Z,Z,...",
        text="depths of the planes of the board [mm], read on the stage, such as -2:2:0.5",
        read=_planes,
    ),
    Question(
        key="particle_images",
        option="--images",
        form="a path",
        text="particle images, with {camera}, {pair} and {frame}, or {camera} and {instant} for a time series",
        default="particles/{camera}/pair_{pair:04d}_{frame}.tif",
    ),
    Question(
        key="count",
        option="--pairs",
        form="a whole number",
        text="number of image pairs, or of instants of a time series",
        read=int,
    ),
    Question(
        key="size_mm",
        option="--size",
        form="XxYxZ",
        text="size of the volume [mm], which the light fills and all cameras see, such as 10x10x6",
        read=_product(float),
    ),
    Question(
        key="voxel_mm",
        option="--voxel",
        form="a number",
        text="edge of a voxel [mm], about a microlens over the magnification",
        read=float,
    ),
    Question(
        key="dt_s",
        option="--dt",
        form="a number",
        text="time between the two frames [s], from the timing of the laser, such as 1e-4",
        read=float,
    ),
)


EXAMPLE = (
    "--cameras left=45,right=-45 --focal-length 100 --magnification -1 --f-number 4 --microlens-pitch 0.1 "
    "--microlens-focal-length 0.8 --pixel 5.5 --dots 7x7 --spacing 1 --dot-diameter 0.1 --planes=-2:2:0.5 --pairs 100 "
    "--size 6x6x3 --dt 1e-4"
)
"""Options of a complete call."""


def with_options(function: Callable[..., None]) -> Callable[..., None]:
    """Give a command that takes ``**answers`` an option for each of `QUESTIONS`."""
    own = inspect.signature(function, eval_str=True)
    parameters = [one for one in own.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
    for one in QUESTIONS:
        default = "" if one.default is None else f" Default: {one.default}"
        option = typer.Option(one.option, metavar="TEXT", help=f"{one.text[0].upper()}{one.text[1:]}.{default}")
        kind = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter(one.key, kind, default=None, annotation=Annotated[str | None, option]))
    function.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    return function


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

    Returns
    -------
    Written

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

    recording, planes = Recording.of_table(table.particles), range(len(table.board.planes_mm))
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
