"""Questions of `lfpiv init`: each value of a new experiment file once.

A question has its option, its text with the unit and the place where the number is found, and how an answer is read.
"""

from __future__ import annotations

import inspect
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
