"""Questions of `lfpiv init`: each value of a new experiment file once.

A question has its option, its text with the unit and the place where the number is found, and how an answer is read.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import typer

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
    """Form of the text, in messages about others."""
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
            problem = error.errors()[0]
            reason = problem["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
            why = "" if problem["type"] in ("missing", "too_long") else f" ({reason})"  # the form says how many
            raise ValueError(f"expected {self.form}{why}, found {text!r}") from None


def _cameras(text: str) -> tuple[tuple[str, float], ...]:
    """Read "left=45, right=-45"."""
    parts = [part.partition("=") for part in text.split(",")]
    return tuple((name.strip(), float(angle)) for name, _, angle in parts)


def _product(number: Callable[[str], Any]) -> Callable[[str], tuple[Any, ...]]:
    """Return what reads numbers with "x", a comma or a blank between them, such as "7x7" or "[7, 7]"."""
    return lambda text: tuple(number(part) for part in re.split(r"\s*[x,]\s*|\s+", text.lower().strip("[( )]")))


def _planes(text: str) -> tuple[float, ...]:
    """Read "-2, -1, 0, 1, 2", or "-2:2:1": first, last and step."""
    if ":" not in text:
        return tuple(float(part) for part in text.strip("[( )]").split(","))
    first, last, step = (float(part) for part in text.split(":"))
    count = (last - first) / step if step else -1.0
    if not 0 <= count < MOST_PLANES or abs(count - round(count)) > 1e-6:
        raise ValueError
    return tuple(round(first + step * number, 9) for number in range(round(count) + 1))


def _number(key: str, option: str, text: str) -> Question:
    """Return a question for a number."""
    return Question(key=key, option=option, form="a number", text=text, read=float)


def _pattern(key: str, option: str, text: str, default: str) -> Question:
    """Return a question for a pattern of paths."""
    return Question(key=key, option=option, form="a path", text=text, default=default)


QUESTIONS = (
    Question(key="name", option="--name", form="text", text="name of the experiment, title of its report"),
    Question(
        key="cameras",
        option="--cameras",
        form="NAME=ANGLE, NAME=ANGLE, such as left=45, right=-45",
        text="cameras and the angle of each about y [degree], positive on the side of +x, such as left=45, right=-45",
        read=_cameras,
    ),
    _number("focal_length_mm", "--focal-length", "focal length of the main lens [mm], engraved on it"),
    _number(
        "magnification", "--magnification", "magnification: size on the sensor over size in the volume, of either sign"
    ),
    _number("f_number", "--f-number", "aperture of the main lens: the f-number set on its ring"),
    _number("microlens_pitch_mm", "--microlens-pitch", "distance of the microlenses [mm], from the maker of the array"),
    _number(
        "microlens_focal_length_mm",
        "--microlens-focal-length",
        "focal length of the microlenses [mm], from the maker of the array",
    ),
    Question(
        key="microlens_layout",
        option="--microlens-layout",
        form="square or hexagonal",
        text="arrangement of the microlenses",
        default="square",
    ),
    _number("pixel_um", "--pixel", "pixel pitch of the sensor [um], from the data sheet of the camera"),
    Question(
        key="image_flip",
        option="--image-flip",
        form="none, horizontal, vertical or both",
        text="pictures show the scene as it is seen (horizontal), upside down (vertical), mirrored left to right "
        "(none), or mirrored and upside down (both)",
        default="horizontal",
    ),
    _pattern("white_image", "--white", "white images, with {camera} for the name of the camera", "white/{camera}.tif"),
    _pattern(
        "board_images",
        "--board",
        "images of the board, with {camera} and {plane}",
        "board/{camera}/plane_{plane:02d}.tif",
    ),
    Question(
        key="dots",
        option="--dots",
        form="two whole numbers, such as 7x7",
        text="number of dots of the board along x and y, such as 7x7",
        read=_product(int),
    ),
    _number("spacing_mm", "--spacing", "distance of the dots [mm], from the drawing of the board"),
    _number("dot_diameter_mm", "--dot-diameter", "diameter of a dot [mm], from the drawing of the board"),
    Question(
        key="planes_mm",
        option="--planes",
        form="FIRST:LAST:STEP or Z, Z, ..., such as -2:2:0.5",
        text="depths of the planes of the board [mm], read on the stage, such as -2:2:0.5",
        read=_planes,
    ),
    _pattern(
        "particle_images",
        "--images",
        "particle images, with {camera}, {pair} and {frame}, or {camera} and {instant} for a time series",
        "particles/{camera}/pair_{pair:04d}_{frame}.tif",
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
        form="three numbers, such as 10x10x6",
        text="size of the volume [mm], which the light fills and all cameras see, such as 10x10x6",
        read=_product(float),
    ),
    _number("voxel_mm", "--voxel", "edge of a voxel [mm], about a microlens over the magnification"),
    _number("dt_s", "--dt", "time between the two frames [s], from the timing of the laser, such as 1e-4"),
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
