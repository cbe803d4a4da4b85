"""Tables of the experiment file as frozen models: every key with its range, its default and one sentence.

The pages of settings show these sentences (`docs/_ext/tables.py`).
"""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from lfpiv.experiment import bounds
from lfpiv.experiment.bounds import (
    Coordinate,
    Count,
    Direction,
    Flag,
    FNumber,
    FocalLength,
    Interval,
    Length,
    Magnification,
    Memory,
    Name,
    PathText,
    PixelPitch,
    Point,
    Seed,
    Steps,
    Thickness,
)
from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation

TURNS = 8
"""Turns and mirrors of a square grid."""

SMALLEST_WINDOW = 4
"""Smallest edge of an interrogation window that holds a correlation peak [voxel]."""

Edge = Annotated[int, Field(strict=True, ge=SMALLEST_WINDOW, le=bounds.LARGEST_WINDOW)]
Window = Edge | tuple[Edge, Edge, Edge]

DEFAULT_WINDOWS = (32, 16, 12, 12)
"""Window edge of each pass where none is stated [voxel], cut to the volume along each axis."""


class Table(BaseModel):
    """Base of all tables: frozen, refuses unknown keys and infinite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Smart(Table):
    """Table ``[smart]``: settings of the reconstruction (Eq. 5)."""

    iterations: Steps = 14
    """Largest number of SMART iterations, passes over all rays; without `subsets` some 40 are needed."""
    subsets: Annotated[int, Field(strict=True, ge=1, le=bounds.MOST_SUBSETS)] | Literal["auto"] = "auto"
    """Number of ordered subsets of the rays: 1 for plain SMART, the number of cameras or twice that; "auto" chooses,
    and goes on with fewer where the subsets contradict each other."""
    relaxation: Annotated[float, Field(strict=True, gt=0, le=3)] = 1.0
    """Relaxation mu of Eq. 5; values near 3 diverge."""
    normalisation: Literal["column", "paper"] = "column"
    """Exponent of Eq. 5: divided by the voxel's column sum, or as printed with weights scaled to a maximum of 1."""
    accelerate: Flag = True
    """Whether Nesterov's momentum in the volume's logarithm reduces the number of iterations to the same limit."""
    smoothing_voxel: Annotated[float, Field(strict=True, ge=0, le=5)] = 0.0
    """Standard deviation of a Gaussian smoothing of the volume after each iteration [voxel]; 0 switches it off."""
    floor_share: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.1
    """Lower limit of the noise floor, as a share of the images' brightness; 0 takes the measured noise."""
    intensity_cap: Annotated[float, Field(strict=True, ge=0, le=100)] | Literal["auto"] = "auto"
    """Upper limit of the images' counts, as a multiple of the median over the lit microimages of each one's brightest
    pixel; 0 switches it off, "auto" does so where the images show equally bright particles, and takes 1 for other
    particles smaller than voxels and 2 for larger ones."""
    sieve_voxel: Annotated[float, Field(strict=True, ge=0, le=5)] | Literal["auto"] = "auto"
    """Standard deviation of the Gaussians that make up the volume [voxel]; 0 lets voxels vary freely, "auto" takes the
    particles' size from the images, or 0 where particles are smaller than voxels."""
    refinement: Annotated[float, Field(strict=True, ge=1, le=bounds.LARGEST_REFINEMENT)] | Literal["auto"] = "auto"
    """Edge of a voxel over that of the voxels that are reconstructed, which the volume is then sampled from; "auto"
    follows from the particles' size in the images, and is 1 where they are large enough."""
    active_share: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    """Share of the first guess's maximum below which voxels are left out; 0 keeps all."""
    tolerance: Annotated[float, Field(strict=True, ge=0, lt=1)] = 5e-4
    """Relative decrease of the misfit per iteration below which SMART stops; 0 runs all iterations."""
    motion_passes: Annotated[int, Field(strict=True, ge=0, le=10)] = 0
    """Number of times the motion is measured and both frames are reconstructed again from their common light along it;
    0 reconstructs each frame separately."""
    predict: Flag = False
    """Whether an instant of a time series starts from the one before, moved by the flow, and is corrected by those
    beside it; it takes fewer iterations."""

    def of_one_frame(self, refinement: float = 1.0) -> dict[str, Any]:
        """Return the settings of `lfpiv.reconstruct`, which reconstructs one frame.

        `refinement` is the edge of a voxel over that of the reconstructed ones, in which lengths are returned.
        """
        settings = self.model_dump(exclude={"motion_passes", "predict", "refinement"})
        lengths = ("sieve_voxel", "smoothing_voxel")
        return settings | {name: settings[name] * refinement for name in lengths if settings[name] != "auto"}


Displacement = Annotated[float, Field(strict=True, gt=0, le=bounds.LARGEST_DISPLACEMENT_VOXEL)]


class Correlation(Table):
    """Table ``[correlation]``: settings of the cross-correlation."""

    windows: Annotated[tuple[Window, ...], Field(min_length=1, max_length=bounds.MOST_PASSES)] | None = None
    """Window of each pass within the volume, one edge or (z, y, x) [voxel]; absent: 32, 16, 12, 12, cut to it."""
    overlap: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.5
    """Fraction by which neighbouring windows overlap."""
    max_displacement_voxel: Displacement | None = None
    """Largest displacement that the first pass searches [voxel]; absent: a quarter of its window."""
    smoothing_voxel: Annotated[float, Field(strict=True, ge=0, le=5)] = 0.5
    """Standard deviation of a Gaussian applied to the volumes before correlation, SMART's sieve included [voxel]; 0
    switches it off."""
    intensity_power: Annotated[float, Field(strict=True, gt=0, le=2)] = 0.5
    """Exponent applied to the smoothed volumes' intensities before correlation; 1 leaves them unchanged."""


class Tracking(Table):
    """Table ``[tracking]``: vectors of single particles beside the correlation; absent: none."""

    rounds: Annotated[int, Field(strict=True, ge=1, le=20)] = 5
    """Largest number of rounds in which particles are fitted to the images, removed where a camera does not confirm
    them, and added where light is left."""
    weakest: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.05
    """Least light of a particle in each camera that counts, as a share of the typical particle's."""


Nodes = Annotated[int, Field(strict=True, ge=1, le=bounds.MOST_NODES)]


class Network(Table):
    """Table ``[network]``: settings of the mapping of Eqs. 6-7 and of its labels."""

    hidden: Annotated[tuple[Nodes, ...], Field(min_length=1, max_length=bounds.MOST_LAYERS)] = (20,)
    """Number of nodes of each hidden layer."""
    epochs: Steps = 300
    """Largest number of training epochs; early stopping usually ends the training earlier."""
    seed: Seed = 0
    """Seed of the random split of the dots and of the initial weights."""
    estimator: Literal["lens_integral", "gaussian"] = "lens_integral"
    """Fit of the dots: a dot integrated over the microlenses, or the Gaussian of the paper."""
    baseline: Literal["none", "thin_lens"] = "thin_lens"
    """Mapping that the network corrects: none, as in the paper, or a thin lens fitted to the same dots, which is more
    accurate between the dots and outside the board."""

    @field_validator("hidden")
    @classmethod
    def _trainable(cls, hidden: tuple[int, ...]) -> tuple[int, ...]:
        layers = (5, *hidden, 2)
        if sum((before + 1) * after for before, after in itertools.pairwise(layers)) > bounds.MOST_PARAMETERS:
            raise ValueError(f"a network of at most {bounds.MOST_PARAMETERS} weights and biases")
        return hidden


class Compute(Table):
    """Table ``[compute]``: device, threads, memory and form of the weights."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the kernels; "auto" takes CUDA where a device is visible."""
    threads: Annotated[int, Field(strict=True, ge=1, le=1024)] | None = None
    """Number of CPU threads; absent: the cores available to the process."""
    weights: Literal["footprint", "count"] = "footprint"
    """Computation of the weights: integrated over voxel, microlens and pixel, or by counted rays (Eq. 10)."""
    weights_form: Literal["auto", "profiles", "pixels"] = "auto"
    """Storage of footprints: products of profiles (straight rays, square microlenses), single pixels (any optics), or
    for each camera the profiles if they agree with counted rays ("auto")."""
    memory_gib: Memory | None = None
    """Memory that the run may use [GiB]; absent: the available memory."""


class SelfCalibration(Table):
    """Table ``[self_calibration]``: correction for cameras that moved after the board was recorded."""

    pairs: Annotated[int, Field(strict=True, ge=0, le=bounds.MOST)] = 0
    """Number of pairs, evenly spread, whose particles correct the cameras' poses; 0 corrects nothing and warns of
    cameras that moved."""


SHARE_SIMULATED = 10
"""Number of pairs of a run for each one that is simulated, the pilot included."""
MOST_SIMULATED = 12
"""Largest number of pairs that "auto" simulates."""


class Bootstrap(Table):
    """Table ``[bootstrap]``: damping of the flow's fluctuations by ghosts, measured in simulated pairs."""

    pairs: Annotated[int, Field(strict=True, ge=0, le=bounds.MOST)] | Literal["auto"] = "auto"
    """Number of pairs that are simulated after a pilot, each at the cost of a recorded one; "auto" takes one for ten
    recorded pairs, the pilot included, at most 12 and none in runs of fewer than 20 pairs, 0 measures nothing."""

    def count(self, pairs: int) -> int:
        """Return the number of simulated pairs for a number of recorded ones."""
        if isinstance(self.pairs, int):
            return self.pairs
        return min(max(pairs // SHARE_SIMULATED - 1, 0), MOST_SIMULATED)


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
    image_flip: Literal["none", "horizontal", "vertical", "both"] = "none"
    """Mirroring of the camera's images."""

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


class CameraTable(NominalCamera):
    """Table ``[[camera]]``: nominal optics and calibration images of one camera."""

    white_image: PathText
    """Path of an image of an evenly lit white surface."""
    dark_image: PathText | None = None
    """Path of an image with the lens capped; absent: the gaps between microimages give the dark level."""
    background_image: PathText | None = None
    """Path, optionally with ``{frame}``, of an image of the scene lit by the laser, without particles; absent: the
    series of image pairs shows what stands still."""
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

    @field_validator("planes_mm")
    @classmethod
    def _distinct(cls, planes: tuple[float, ...]) -> tuple[float, ...]:
        if len(set(planes)) != len(planes):
            raise ValueError("a different depth for each plane")
        return planes


class Volume(Table):
    """Table ``[volume]``: the voxel grid, in the order (x, y, z)."""

    centre_mm: Point
    """Centre (x, y, z) of the volume [mm]."""
    size_mm: tuple[Length, Length, Length]
    """Size (x, y, z) of the volume, at least 4 voxels along each axis [mm]."""
    voxel_mm: Length
    """Edge of a voxel [mm]."""
    guard_mm: Thickness | tuple[Thickness, Thickness, Thickness] | Literal["auto"] = "auto"
    """Thickness of the guard layers beyond the volume's faces, one number or (x, y, z), which are reconstructed and cut
    away [mm]; "auto" measures in the particle images how far their light reaches and takes at least one voxel, 0
    reconstructs no guard layers."""


class HalfSpace(Table):
    """Solid of kind "half_space": everything behind a plane. Table ``[[volume.solid]]``, in scenes ``[[wall]]``."""

    kind: Literal["half_space"] = "half_space"
    point_mm: Point
    """A point (x, y, z) on the solid's surface [mm]."""
    normal: Direction
    """Direction (x, y, z) from the surface into the fluid, of any length."""

    def contains(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return which points (x, y, z) [mm] are behind the plane; the coordinates are broadcast against each other."""
        axes = zip(self.normal, (x, y, z), self.point_mm, strict=True)
        return np.asarray(sum(n * (at - point) for n, at, point in axes) < 0)


class Box(Table):
    """Solid of kind "box", its faces normal to x, y, z. Table ``[[volume.solid]]``, in scenes ``[[wall]]``."""

    kind: Literal["box"] = "box"
    centre_mm: Point
    """Centre (x, y, z) of the box [mm]."""
    size_mm: tuple[Length, Length, Length]
    """Edges (x, y, z) of the box [mm]."""

    def contains(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return which points (x, y, z) [mm] are within the faces; the coordinates are broadcast against each other."""
        axes = zip((x, y, z), self.centre_mm, self.size_mm, strict=True)
        within = [np.abs(at - centre) < size / 2 for at, centre, size in axes]
        return np.asarray(within[0] & within[1] & within[2])


Solid = Annotated[HalfSpace | Box, Field(discriminator="kind")]


class ExperimentVolume(Volume):
    """Table ``[volume]`` of an experiment: the voxel grid, and where it holds no fluid."""

    mask: PathText | None = None
    """Path of a NetCDF file, true or 1 where there is solid, over z, y, x with coordinates in mm; absent: none."""
    solid: Annotated[tuple[Solid, ...], Field(max_length=bounds.MOST_SOLIDS)] = ()
    """Solids in the volume, each a table."""


class Series(Table):
    """Instants of a time series, each an image of every camera."""

    instants: Annotated[int, Field(strict=True, ge=2, le=bounds.MOST)]
    """Number of recorded instants."""
    first: Annotated[int, Field(strict=True, ge=0, le=bounds.MOST)] = 0
    """Number of the first instant."""
    step: Count = 1
    """Vectors of instant k are measured from instants k and k + step."""

    @property
    def numbers(self) -> range:
        """Numbers of all instants."""
        return range(self.first, self.first + self.instants)


class Particles(Table):
    """Table ``[particles]``: the image pairs, or the time series."""

    images: PathText
    """Path of the particle images: with ``{camera}``, ``{pair}`` and ``{frame}`` for pairs, which count from 0, or
    ``{image}``, which is 2 pair for the first and 2 pair + 1 for the second frame; with ``{camera}`` and ``{instant}``
    for a time series."""
    pairs: Count | None = None
    """Number of image pairs; absent for a time series."""
    instants: Annotated[int, Field(strict=True, ge=2, le=bounds.MOST)] | None = None
    """Number of instants of a time series, each of which is the second image of one pair and the first of another."""
    first: Annotated[int, Field(strict=True, ge=0, le=bounds.MOST)] = 0
    """Number of the first instant of a time series."""
    step: Count = 1
    """Distance of the two instants that are correlated in a time series, ``dt_s`` apart: k and k + step."""
    frames: tuple[Name, Name] = ("a", "b")
    """Text for ``{frame}`` in the first and second image of a pair."""
    background: Literal["auto", "none", "minimum", "median"] = "auto"
    """Light that stands still, subtracted from the images: that of `background_image`, or what the series of pairs
    shows beyond chance ("auto"), the minimum or median of each pixel over the series, or nothing ("none")."""

    @field_validator("frames")
    @classmethod
    def _differ(cls, frames: tuple[str, str]) -> tuple[str, str]:
        if frames[0] == frames[1]:
            raise ValueError("two different frame names")
        return frames

    @model_validator(mode="after")
    def _pairs_or_series(self) -> Particles:
        if (self.pairs is None) == (self.instants is None):
            raise ValueError("either pairs or instants")
        if self.instants is None and {"first", "step"} & self.model_fields_set:
            raise ValueError("first and step only with instants")
        if self.instants is not None and "frames" in self.model_fields_set:
            raise ValueError("frames only with pairs; an instant has one image of each camera")
        if self.instants is not None and self.instants <= self.step:
            raise ValueError("more instants than step")
        return self

    @property
    def count(self) -> int:
        """Number of pairs; the last `step` instants of a series are the first of no pair."""
        return self.pairs if self.pairs is not None else (self.instants or 0) - self.step

    @property
    def series(self) -> Series | None:
        """The time series; None for image pairs."""
        if self.instants is None:
            return None
        return Series(instants=self.instants, first=self.first, step=self.step)


class ExperimentTable(Table):
    """The whole experiment file."""

    name: Name
    """Name of the experiment, title of its report."""
    dt_s: Interval
    """Time between the two frames of a pair, or between instants k and k + step of a time series [s]."""
    camera: Annotated[tuple[CameraTable, ...], Field(min_length=1, max_length=bounds.MOST_CAMERAS)]
    board: Board
    volume: ExperimentVolume
    particles: Particles
    smart: Smart = Smart()
    correlation: Correlation = Correlation()
    tracking: Tracking | None = None
    network: Network = Network()
    self_calibration: SelfCalibration = SelfCalibration()
    bootstrap: Bootstrap = Bootstrap()
    compute: Compute = Compute()
