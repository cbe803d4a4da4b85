"""Tables of the cameras and of the calibration board."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation
from lfpiv.settings import bounds
from lfpiv.settings.bounds import (
    Coordinate,
    Direction,
    FNumber,
    FocalLength,
    Length,
    Magnification,
    PathText,
    PixelPitch,
    Positive,
)
from lfpiv.settings.table import Table

TURNS = 8
"""Turns and mirrors of a square grid."""

Flip = Literal["none", "horizontal", "vertical", "both"]
"""Orientation of recorded pictures: "horizontal" is an ordinary camera's, which are upright and not mirrored."""


class NominalCamera(Table):
    """Nominal keys of ``[[camera]]``, in experiments and in scenes of the simulator."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=bounds.LONGEST_CAMERA_NAME)]
    """Name of the camera in paths and messages, of letters, digits, '_', '-' and '.'."""
    focal_length_mm: FocalLength
    """Focal length of the main lens [mm]."""
    magnification: Magnification
    """Magnification of the main lens, other than 0, of either sign."""
    f_number: FNumber
    """f-number to which the main lens was set."""
    microlens_pitch_mm: Length
    """Distance between neighbouring microlenses [mm]."""
    microlens_focal_length_mm: FocalLength
    """Focal length of the microlenses, equal to their distance from the sensor [mm]."""
    pixel_um: PixelPitch
    """Pixel pitch of the sensor [um]."""
    microlens_layout: Literal["square", "hexagonal"] = "square"
    """Arrangement of the microlenses."""
    nominal_angle_deg: Annotated[float, Field(strict=True, ge=-180, le=180)] | None = None
    """Angle of the camera about y, correct to about 10. It numbers the board's dots and never enters the mapping
    [degree]. Alternative to `nominal_direction`."""
    nominal_direction: Direction | None = None
    """Vector (x, y, z) from the origin towards the camera, of any length, correct to about 10 degrees. Rows of the
    picture are normal to the world's y axis; a camera straight above or below has x along its rows."""
    nominal_roll_deg: Annotated[float, Field(strict=True, ge=-180, le=180)] = 0.0
    """Rotation of the camera about its viewing axis, clockwise as seen from behind the camera [degree]."""

    @model_validator(mode="after")
    def _one_orientation(self) -> NominalCamera:
        if self.nominal_angle_deg is not None and self.nominal_direction is not None:
            raise ValueError("either nominal_angle_deg or nominal_direction")
        return self

    @property
    def orientation(self) -> Orientation | None:
        """Nominal orientation, or None where none is stated."""
        if self.nominal_direction is not None:
            return Orientation.from_direction(self.nominal_direction, self.nominal_roll_deg)
        if self.nominal_angle_deg is not None:
            return Orientation(self.nominal_angle_deg, 0.0, self.nominal_roll_deg)
        return None

    def optics_of(self, sensor_shape: tuple[int, int]) -> Optics:
        """Return the nominal optics with a sensor of (rows, columns) pixels."""
        return Optics(
            focal_length_mm=self.focal_length_mm,
            magnification=self.magnification,
            f_number=self.f_number,
            microlens_pitch_mm=self.microlens_pitch_mm,
            microlens_focal_length_mm=self.microlens_focal_length_mm,
            pixel_mm=self.pixel_um / 1000,
            sensor_shape=sensor_shape,
            layout=self.microlens_layout,
        )


Pixels = Annotated[int, Field(strict=True, ge=1, le=100_000)]


class RawTime(Table):
    """Table ``[camera.raw.time]``: a number in each image's block that says when it was recorded."""

    at_byte: Annotated[int, Field(strict=True, ge=0, lt=2**40)]
    """Place of the number, from the first byte of ``frame_header_bytes`` [byte]."""
    dtype: Literal["uint32", "uint64", "int64", "float64"]
    """Type of the number, of the byte order of the pixels."""
    unit_s: Annotated[float, Field(strict=True, ge=1e-12, le=1)]
    """Unit of the number [s]."""


class RawImages(Table):
    """Table ``[camera.raw]``: layout of the camera's files without a header, ``.raw`` and ``.bin``."""

    shape: tuple[Pixels, Pixels]
    """Number of rows and columns of an image [pixel]."""
    dtype: Literal["uint8", "uint16", "uint32", "int16", "int32", "float32", "float64"]
    """Type of a stored pixel."""
    byte_order: Literal["little", "big"] = "little"
    """Order of the bytes of a pixel, least first or last."""
    header_bytes: Annotated[int, Field(strict=True, ge=0, lt=2**62)] = 0
    """Length of the file's header [byte]."""
    frame_header_bytes: Annotated[int, Field(strict=True, ge=0, lt=2**31)] = 0
    """Length of what stands before the pixels of each image [byte]."""
    frame_footer_bytes: Annotated[int, Field(strict=True, ge=0, lt=2**31)] = 0
    """Length of what stands behind the pixels of each image, such as a time stamp and filling [byte]."""
    time: RawTime | None = None
    """Where each block states its time; absent: it does not."""

    @model_validator(mode="after")
    def _time_in_block(self) -> RawImages:
        pixels = self.shape[0] * self.shape[1] * int(self.dtype.lstrip("uintfloa")) // 8
        block = self.frame_header_bytes + pixels + self.frame_footer_bytes
        if self.time is not None and self.time.at_byte + int(self.time.dtype[-2:]) // 8 > block:
            raise ValueError(f"a time within the {block} bytes of an image's block")
        return self


class CameraTable(NominalCamera):
    """Table ``[[camera]]``: nominal optics and calibration images of one camera."""

    white_image: PathText
    """Path of an image of an evenly lit white surface."""
    dark_image: PathText | None = None
    """Path of an image with the lens capped; absent: the gaps between microimages give the dark level."""
    background_image: PathText | None = None
    """Path, optionally with ``{frame}``, of an image of the scene lit by the laser, without particles; absent: the
    series of image pairs shows what stands still."""
    white_level: Positive | None = None
    """Value from which on pixels are saturated [count]; absent: the white level of a ``.cine`` header, and the value at
    which the pixels of an image pile up."""
    image_flip: Flip | None = None
    """How pictures show the scene: "horizontal" as it is seen (an ordinary camera), "vertical" upside down, "none"
    mirrored left to right, "both" mirrored and upside down; absent: read as "none" where the board agrees."""
    raw: RawImages | None = None
    """Layout of the camera's files without a header; absent: it has none."""


Dots = Annotated[int, Field(strict=True, ge=2, le=bounds.MOST_DOTS_ACROSS)]


Place = Annotated[int, Field(strict=True, ge=0, lt=bounds.MOST_DOTS_ACROSS)]


def _turned(places: tuple[tuple[int, int], ...]) -> list[list[tuple[int, int]]]:
    """Return places on a square grid in its eight turns and mirrors."""
    signs = [(a, b) for a in (1, -1) for b in (1, -1)]
    both = (places, [(row, column) for column, row in places])
    return [[(a * column, b * row) for column, row in some] for some in both for a, b in signs]


def _from_corner(places: list[tuple[int, int]]) -> frozenset[tuple[int, int]]:
    """Return places counted from the corner of the rectangle around them."""
    left, low = (min(place[axis] for place in places) for axis in (0, 1))
    return frozenset((column - left, row - low) for column, row in places)


class NominalBoard(Table):
    """Keys of ``[board]``, in experiments and in scenes of the simulator."""

    dots: tuple[Dots, Dots]
    """Number of dots along x and y."""
    spacing_mm: Length
    """Distance between neighbouring dots [mm]."""
    dot_diameter_mm: Length
    """Diameter of a dot, less than their distance [mm]."""
    planes_mm: Annotated[tuple[Coordinate, ...], Field(min_length=2, max_length=bounds.MOST_PLANES)]
    """Depth z of each plane, all different [mm]."""
    mark: Annotated[tuple[tuple[Place, Place], ...], Field(max_length=bounds.MOST_DOTS_ACROSS)] = ()
    """Places (column, row) without a dot, counted from 0 along x and y: a mark that names the dots, so that cameras
    need no nominal orientation. No turn or mirror of the grid may carry it over into itself; three places suffice."""

    @field_validator("mark")
    @classmethod
    def _tells_turns(cls, mark: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
        if mark and len(set(map(_from_corner, _turned(mark)))) < TURNS:
            raise ValueError("places that no turn or mirror of the grid carries over into themselves")
        return mark

    @model_validator(mode="after")
    def _mark_on_board(self) -> NominalBoard:
        if any(column >= self.dots[0] or row >= self.dots[1] for column, row in self.mark):
            raise ValueError("a mark of places on the board: column below dots[0], row below dots[1]")
        return self

    @model_validator(mode="after")
    def _dots_apart(self) -> NominalBoard:
        if self.dot_diameter_mm >= self.spacing_mm:
            raise ValueError("dot_diameter_mm smaller than spacing_mm")
        return self


class Board(NominalBoard):
    """Table ``[board]``: the dot board and the depths of its planes."""

    images: PathText
    """Path of the board images with ``{camera}`` and ``{plane}``; planes count from 0."""
    axes: Literal["right-handed", "left-handed"] = "right-handed"
    """Handedness of x, y, z. "left-handed" says that x is meant to point left where y is up and z points to the
    cameras."""

    @field_validator("planes_mm")
    @classmethod
    def _distinct(cls, planes: tuple[float, ...]) -> tuple[float, ...]:
        if len(set(planes)) != len(planes):
            raise ValueError("a different depth for each plane")
        return planes
