"""Bounds of the values in experiment and scene files, and the types of their keys.

The bounds are far wider than any rig. They refuse wrong units and typing errors, and keep products and quotients of
the values within floating-point numbers and within the memory.
"""

from __future__ import annotations

import math
import unicodedata
from typing import Annotated

from pydantic import AfterValidator, Field

LARGEST = 1e9
"""Largest magnitude of a number that has no narrower bound, in its own unit."""
SMALLEST = 1e-9
"""Smallest positive number that has no narrower bound, in its own unit."""
SHORTEST_MM = 1e-6
"""Shortest length: a nanometre [mm]."""
LONGEST_MM = 1e6
"""Longest length, and largest coordinate: a kilometre [mm]."""
SHORTEST_FOCUS_MM = 1e-3
"""Shortest focal length of a lens [mm]."""
LONGEST_FOCUS_MM = 1e5
"""Longest focal length of a lens [mm]."""
LEAST_MAGNIFICATION = 1e-4
"""Least magnitude of the magnification."""
LARGEST_MAGNIFICATION = 1e3
"""Largest magnitude of the magnification."""
LEAST_F_NUMBER = 0.1
"""Least f-number; 0.5 is the limit of a lens in air."""
LARGEST_F_NUMBER = 1e4
"""Largest f-number; pinhole cameras have some hundreds."""
SMALLEST_PIXEL_UM = 0.01
"""Smallest pixel pitch [um]."""
LARGEST_PIXEL_UM = 1e4
"""Largest pixel pitch [um]."""
SHORTEST_S = 1e-12
"""Shortest time between two frames [s]."""
LONGEST_S = 1e6
"""Longest time between two frames: eleven days [s]."""
LARGEST_ANGLE_DEG = 360.0
"""Largest magnitude of an angle [degree]."""
SHORTEST_DIRECTION = 1e-6
"""Least length of a vector that states a direction, in any unit."""
LEAST_GIB = 1e-3
"""Least memory that a run may be limited to [GiB]."""
LARGEST_GIB = 1e6
"""Largest memory that a run may be limited to [GiB]."""

MOST = 10**9
"""Largest whole number that counts something and has no narrower bound, such as image pairs."""
LARGEST_SEED = 2**63 - 1
"""Largest seed of random numbers."""
MOST_CAMERAS = 64
"""Largest number of cameras of an experiment."""
MOST_PLANES = 1000
"""Largest number of planes of a board."""
MOST_DOTS_ACROSS = 10**6
"""Largest number of dots of a board along an axis."""
MOST_DOTS = 10**6
"""Largest number of dots of a board in all its planes."""
MOST_SOLIDS = 1000
"""Largest number of solids, walls, surfaces or windows."""
MOST_VOXELS = 10**11
"""Largest number of voxels of a volume, guard layers included. A run of as many needs some 10 TB of memory."""
LARGEST_REFINEMENT = 4
"""Largest edge of a voxel over that of the voxels that are reconstructed: 64 times as many."""
MOST_STEPS = 10**6
"""Largest number of iterations or epochs."""
MOST_SUBSETS = 64
"""Largest number of ordered subsets."""
MOST_PASSES = 32
"""Largest number of passes of the correlation."""
LARGEST_WINDOW = 4096
"""Largest edge of an interrogation window [voxel]."""
LARGEST_DISPLACEMENT_VOXEL = 1e6
"""Largest displacement that may be searched [voxel]."""
MOST_LAYERS = 64
"""Largest number of hidden layers of a network."""
MOST_NODES = 1000
"""Largest number of nodes of a hidden layer."""
MOST_PARAMETERS = 10_000
"""Largest number of a network's weights and biases. The training's normal matrix has the square of it."""
MOST_SIDE_PX = 65_536
"""Largest number of rows or columns of a simulated sensor [pixel]."""
MOST_PARTICLES = 10**8
"""Largest number of simulated particles of a pair."""
MOST_RAYS = 2**24
"""Largest number of simulated rays of a dot, a particle or a pixel."""
MOST_MODES = 5000
"""Largest number of Fourier modes of simulated turbulence."""
MOST_SIMULATED_PAIRS = 10**6
"""Largest number of simulated pairs."""

LONGEST_NAME = 200
"""Most characters of a name."""
LONGEST_CAMERA_NAME = 60
"""Most characters of a camera's name, which is in names of files."""
LONGEST_PATH = 1000
"""Most characters of a path in the file."""
LONGEST_PART_BYTES = 255
"""Longest name of a file or folder [byte], a limit of file systems."""

UNPRINTABLE = ("Cc", "Cs")
"""Categories of Unicode that no name has: control characters and lone surrogates."""

ESCAPED = "\b\f\n\r\t"
"""Control characters that a path of Windows in double quotes may hold unintended, as ``"raw\\new"`` does."""


def _printable(text: str) -> str:
    if any(unicodedata.category(character) in UNPRINTABLE for character in text):
        raise ValueError("text without control characters")
    return text


def _path(text: str) -> str:
    if any(len(part.encode(errors="surrogatepass")) > LONGEST_PART_BYTES for part in text.split("/")):
        raise ValueError(f"names of files and folders of at most {LONGEST_PART_BYTES} bytes")
    if any(character in ESCAPED for character in text):
        raise ValueError(r"a path without control characters, which \b, \f, \n, \r and \t in double quotes are; use /")
    return _printable(text)


def _direction(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if not any(value):
        raise ValueError("a direction other than (0, 0, 0)")
    if math.hypot(*value) < SHORTEST_DIRECTION:
        raise ValueError(f"a direction of length {SHORTEST_DIRECTION:g} or more")
    return value


def _magnification(value: float) -> float:
    if value == 0:
        raise ValueError("a number other than 0")
    if not LEAST_MAGNIFICATION <= abs(value) <= LARGEST_MAGNIFICATION:
        raise ValueError(f"a number of magnitude {LEAST_MAGNIFICATION:g} to {LARGEST_MAGNIFICATION:g}")
    return value


# Strict types refuse text and `true` in place of a number; an integer is a number. TOML's lists become tuples.
Number = Annotated[float, Field(strict=True, ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(strict=True, ge=SMALLEST, le=LARGEST)]
NonNegative = Annotated[float, Field(strict=True, ge=0, le=LARGEST)]
Length = Annotated[float, Field(strict=True, ge=SHORTEST_MM, le=LONGEST_MM)]
Thickness = Annotated[float, Field(strict=True, ge=0, le=LONGEST_MM)]
Coordinate = Annotated[float, Field(strict=True, ge=-LONGEST_MM, le=LONGEST_MM)]
FocalLength = Annotated[float, Field(strict=True, ge=SHORTEST_FOCUS_MM, le=LONGEST_FOCUS_MM)]
Magnification = Annotated[float, Field(strict=True), AfterValidator(_magnification)]
FNumber = Annotated[float, Field(strict=True, ge=LEAST_F_NUMBER, le=LARGEST_F_NUMBER)]
PixelPitch = Annotated[float, Field(strict=True, ge=SMALLEST_PIXEL_UM, le=LARGEST_PIXEL_UM)]
Interval = Annotated[float, Field(strict=True, ge=SHORTEST_S, le=LONGEST_S)]
Angle = Annotated[float, Field(strict=True, ge=-LARGEST_ANGLE_DEG, le=LARGEST_ANGLE_DEG)]
Memory = Annotated[float, Field(strict=True, ge=LEAST_GIB, le=LARGEST_GIB)]
Count = Annotated[int, Field(strict=True, ge=1, le=MOST)]
Steps = Annotated[int, Field(strict=True, ge=1, le=MOST_STEPS)]
Rays = Annotated[int, Field(strict=True, ge=1, le=MOST_RAYS)]
Seed = Annotated[int, Field(strict=True, ge=0, le=LARGEST_SEED)]
Flag = Annotated[bool, Field(strict=True)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Direction = Annotated[tuple[Number, Number, Number], AfterValidator(_direction)]
Name = Annotated[str, Field(min_length=1, max_length=LONGEST_NAME), AfterValidator(_printable)]
PathText = Annotated[str, Field(min_length=1, max_length=LONGEST_PATH), AfterValidator(_path)]
