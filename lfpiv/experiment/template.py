"""Write a new experiment file from few values, with comments: units, and where to find each number.

`Values` are the values that a rig must state. `experiment_text` returns the text of the file, with the other keys that
are often changed as comments.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from pydantic import Field

from lfpiv.experiment.axes import ORDINARY
from lfpiv.settings.bounds import (
    Coordinate,
    Count,
    FNumber,
    FocalLength,
    Interval,
    Length,
    Magnification,
    Name,
    PathText,
    PixelPitch,
)
from lfpiv.settings.rig import Dots, Flip
from lfpiv.settings.table import Table

SCHEMA = "lfpiv-experiment.schema.json"
"""Name of the JSON Schema of experiment files beside a new file, by which editors complete and check it."""
COMMENT_COLUMN = 45
"""Column at which comments begin."""


class Values(Table):
    """Values of a new experiment file. All cameras have the same optics."""

    name: Name
    """Name of the experiment, title of its report."""
    cameras: Annotated[tuple[tuple[str, float], ...], Field(min_length=1)]
    """Name and nominal angle of each camera [degree]."""
    focal_length_mm: FocalLength
    magnification: Magnification
    f_number: FNumber
    microlens_pitch_mm: Length
    microlens_focal_length_mm: FocalLength
    microlens_layout: Literal["square", "hexagonal"] = "square"
    pixel_um: PixelPitch
    image_flip: Flip = ORDINARY
    white_image: PathText
    """Path with ``{camera}``."""
    board_images: PathText
    dots: tuple[Dots, Dots]
    spacing_mm: Length
    dot_diameter_mm: Length
    planes_mm: Annotated[tuple[Coordinate, ...], Field(min_length=2)]
    particle_images: PathText
    count: Count
    """Number of image pairs, or of instants if the path has ``{instant}``."""
    size_mm: tuple[Length, Length, Length]
    voxel_mm: Length
    dt_s: Interval


def experiment_text(values: Values) -> str:
    """Return the text of an experiment file."""
    parts = [_head(values), *(_camera(values, name, angle) for name, angle in values.cameras)]
    parts += [_board(values), _volume(values), _particles(values), _OPTIONAL]
    return "\n".join(parts)


def _head(values: Values) -> str:
    return "\n".join(
        [
            f"#:schema ./{SCHEMA}",
            "# Experiment of lfpiv. Lengths are in mm, times in s, angles in degrees. Paths are relative to this file.",
            "# z is the depth axis, from the volume towards the cameras, y points up, x to the right; the origin is",
            "# where the cameras' axes meet. A line that begins with '# ' and a key shows an optional key.",
            "",
            _row("name", values.name, "title of the report"),
            _row("dt_s", values.dt_s, "between the two frames [s]: from the timing of the laser"),
            "",
        ]
    )


def _camera(values: Values, name: str, angle: float) -> str:
    return "\n".join(
        [
            "[[camera]]",
            _row("name", name, "fills in {camera} in paths"),
            _row("white_image", values.white_image.replace("{camera}", name), "an evenly lit white surface"),
            _optional("dark_image", f"dark/{name}.tif", "lens capped; not needed"),
            _row("focal_length_mm", values.focal_length_mm, "main lens: engraved on it"),
            _row("magnification", values.magnification, "size on the sensor over size in the volume"),
            _row("f_number", values.f_number, "main lens: as set on its ring"),
            _row("microlens_pitch_mm", values.microlens_pitch_mm, "from the maker of the array"),
            _row("microlens_focal_length_mm", values.microlens_focal_length_mm, "from the maker of the array"),
            _row("microlens_layout", values.microlens_layout, '"square" or "hexagonal"'),
            _row("pixel_um", values.pixel_um, "pixel pitch [um]: data sheet of the camera"),
            _row("nominal_angle_deg", angle, "about y, to 10 degrees, positive on the side of +x"),
            _row("image_flip", values.image_flip, '"horizontal": pictures show the scene as it is seen; "vertical":'),
            " " * COMMENT_COLUMN + '# upside down; "none": mirrored left to right; "both": both',
            "",
        ]
    )


def _board(values: Values) -> str:
    return "\n".join(
        [
            "[board]",
            _row("dots", values.dots, "number along x and y"),
            _row("spacing_mm", values.spacing_mm, "between neighbouring dots: drawing of the board"),
            _row("dot_diameter_mm", values.dot_diameter_mm, "drawing of the board"),
            _row("planes_mm", values.planes_mm, "depths z, in the order of the images: read on the stage"),
            _row("images", values.board_images, "planes are counted from 0"),
            "",
        ]
    )


def _volume(values: Values) -> str:
    return "\n".join(
        [
            "[volume]" + " " * (COMMENT_COLUMN - len("[volume]")) + "# all in the order x, y, z",
            _row("centre_mm", [0.0, 0.0, 0.0], "from where the cameras' axes meet"),
            _row("size_mm", values.size_mm, "what the light fills and all cameras see"),
            _row("voxel_mm", values.voxel_mm, "about microlens_pitch_mm / |magnification|"),
            "",
        ]
    )


def _particles(values: Values) -> str:
    rows = ["[particles]"]
    if "{instant" in values.particle_images:
        rows.append(_row("images", values.particle_images, "one file for each camera and instant"))
        rows.append(_row("instants", values.count, "number of recorded instants"))
        rows.append(_optional("first", 0, "number of the first one"))
        rows.append(_optional("step", 1, "instants k and k + step are correlated, dt_s apart"))
    else:
        rows.append(_row("images", values.particle_images, "pairs are counted from 0"))
        rows.append(_row("pairs", values.count, "number of image pairs"))
        rows.append(_optional("frames", ["a", "b"], "what {frame} stands for"))
    rows.append(_optional("background", "auto", 'or "none", "minimum", "median": light that stands still'))
    return "\n".join([*rows, ""])


_OPTIONAL = """\
# Everything below has a default that suits most rigs; the page of settings has all keys.
#
# [correlation]
# windows = [32, 16, 12, 12]                 # of each pass [voxel]; the last one sets the resolution
# overlap = 0.5                              # of neighbouring windows; 0.75 for pictures
# max_displacement_voxel = 8.0               # default: a quarter of the first window
#
# [self_calibration]
# pairs = 5                                  # corrects the calibration for cameras that moved since the board
"""


def _row(key: str, value: Any, comment: str) -> str:
    shown = f"{key} = {json.dumps(value, ensure_ascii=False)}"
    return f"{shown:<{COMMENT_COLUMN - 1}} # {comment}"


def _optional(key: str, value: Any, comment: str) -> str:
    shown = f"# {key} = {json.dumps(value, ensure_ascii=False)}"
    return f"{shown:<{COMMENT_COLUMN - 1}} # {comment}"
