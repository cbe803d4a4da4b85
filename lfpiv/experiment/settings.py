"""The tables of an experiment file: every key, its range and its default, in one place."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

# Text where a number belongs is refused, and so is `true`; an integer is a good number. TOML's lists become tuples.
Number = Annotated[float, Field(strict=True)]
Whole = Annotated[int, Field(strict=True)]
Positive = Annotated[float, Field(strict=True, gt=0)]
Count = Annotated[int, Field(strict=True, ge=1)]
Flag = Annotated[bool, Field(strict=True)]

SMALLEST_WINDOW = 4
"""Smallest edge of an interrogation window [voxel]; smaller ones hold no peak."""

Edge = Annotated[int, Field(strict=True, ge=SMALLEST_WINDOW)]
Window = Edge | tuple[Edge, Edge, Edge]


class Table(BaseModel):
    """A table of the experiment file: frozen, unknown keys and infinite numbers refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Smart(Table):
    """Table ``[smart]``: the reconstruction (Eq. 5)."""

    iterations: Count = 40
    """Largest number of SMART iterations; `tolerance` usually ends them sooner."""
    relaxation: Annotated[float, Field(strict=True, gt=0, le=3)] = 1.0
    """Relaxation mu of Eq. 5. Values near 3 diverge."""
    normalisation: Literal["column", "paper"] = "column"
    """Exponent divided by the voxel's column sum, or Eq. 5 as printed with weights scaled to a maximum of 1."""
    accelerate: Flag = True
    """Nesterov's momentum in the volume's logarithm: the same limit in fewer iterations; the misfit never rises."""
    smoothing_voxel: Annotated[float, Field(strict=True, ge=0, le=5)] = 0.0
    """Standard deviation of the Gaussian smoothing after each iteration [voxel]; 0 switches it off."""
    floor_share: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.1
    """Least noise floor, as a share of the images' brightness; 0 takes the measured noise as it is."""
    sieve_voxel: Annotated[float, Field(strict=True, ge=0, le=5)] | Literal["auto"] = "auto"
    """Standard deviation of the Gaussians that the volume is a sum of [voxel]; 0 for voxels of any brightness, "auto"
    for what suits the particles, whose size the images tell: 0 where they are smaller than voxels."""
    active_share: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    """Voxels below this share of the first guess's brightest are left out; 0 keeps all."""
    tolerance: Annotated[float, Field(strict=True, ge=0, lt=1)] = 5e-4
    """Stop when an iteration lowers the misfit, a divergence, by less than this fraction; 0 runs all iterations."""
    motion_passes: Annotated[int, Field(strict=True, ge=0, le=10)] = 0
    """How often the motion is measured and both frames reconstructed anew from what they share along it: errors of
    displacement are smaller by about a sixth, and a wrong motion draws vectors along, which the uncertainty then tells.
    0: each frame by itself."""

    def of_one_frame(self) -> dict[str, Any]:
        """Return the settings of `lfpiv.reconstruct`, which knows one frame only."""
        return self.model_dump(exclude={"motion_passes"})


class Correlation(Table):
    """Table ``[correlation]``: volumes to vectors."""

    windows: Annotated[tuple[Window, ...], Field(min_length=1)] | None = None
    """Window of each pass [voxel], one edge or (z, y, x); absent: ``vectors.DEFAULT_WINDOWS``, cut to the volume."""
    overlap: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.5
    """Fraction by which neighbouring windows overlap."""
    max_displacement_voxel: Positive | None = None
    """Largest displacement the first pass looks for [voxel]; absent: a quarter of its window."""
    smoothing_voxel: Annotated[float, Field(strict=True, ge=0, le=5)] = 0.5
    """Standard deviation of a Gaussian applied to the volumes before correlation [voxel], less what SMART's sieve has
    smoothed; 0 switches it off."""
    intensity_power: Annotated[float, Field(strict=True, gt=0, le=2)] = 0.5
    """Power of the volumes' intensities that is correlated, after smoothing; 1 takes them as they are."""


class Network(Table):
    """Table ``[network]``: the mapping of Eqs. 6-7 and the labels it is trained on."""

    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (20,)
    """Nodes of each hidden layer."""
    epochs: Count = 300
    """Largest number of training epochs; early stopping usually ends sooner."""
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    """Seed of the random split and of the starting weights."""
    estimator: Literal["lens_integral", "gaussian"] = "lens_integral"
    """Dot centres: a dot integrated over the microlenses, or the Gaussian fit of the paper."""
    baseline: Literal["none", "thin_lens"] = "thin_lens"
    """Mapping the network corrects: nothing, as in the paper, or a thin lens fitted to the same dots, whose pose comes
    out of the fit: better between the dots, and far better outside the board."""


class Compute(Table):
    """Table ``[compute]``: where and with how much the work is done."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the kernels; "auto" takes CUDA where there is one."""
    threads: Annotated[int, Field(strict=True, ge=1, le=1024)] | None = None
    """CPU threads; absent: the cores this process may use."""
    weights: Literal["footprint", "count"] = "footprint"
    """Weights integrated over voxel, microlens and pixel, or counted rays (Eq. 10 as printed)."""
    weights_form: Literal["auto", "profiles", "pixels"] = "auto"
    """How footprints are stored: as products of profiles, for straight rays and square microlenses; pixel by pixel, for
    any optics; "auto": as profiles for each camera where counted rays say that they serve."""
    memory_gib: Positive | None = None
    """Memory the run may take [GiB]; absent: what the machine has available."""


class SelfCalibration(Table):
    """Table ``[self_calibration]``: correction of the calibration for cameras that moved since the board."""

    pairs: Annotated[int, Field(strict=True, ge=0)] = 0
    """Pairs whose first frames tell by their particles how the cameras stand, evenly spread over all; 0: nothing is
    corrected, and a warning says where it should be."""


class NominalCamera(Table):
    """Keys of ``[[camera]]`` that a data sheet and the plan of the rig give; scenes of the simulator have them too."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    """Name in file names and messages: letters, digits, '_', '-' and '.'."""
    focal_length_mm: Positive
    """Focal length of the main lens [mm]."""
    magnification: Number
    """Magnification of the main lens, not 0; the sign does not matter."""
    f_number: Positive
    """f-number of the main lens as it was set."""
    microlens_pitch_mm: Positive
    """Distance of neighbouring microlenses [mm]."""
    microlens_focal_length_mm: Positive
    """Focal length of the microlenses [mm]; the sensor lies that far behind them."""
    pixel_um: Positive
    """Pixel pitch of the sensor [um]."""
    microlens_layout: Literal["square", "hexagonal"] = "square"
    """Arrangement of the microlenses."""
    nominal_angle_deg: Annotated[float, Field(strict=True, ge=-180, le=180)]
    """Angle of the camera about y, to some ten degrees [degree]: names the board's dots, never enters the mapping."""
    image_flip: Literal["none", "horizontal", "vertical", "both"] = "none"
    """How the camera's images are mirrored."""

    @field_validator("magnification")
    @classmethod
    def _not_zero(cls, value: float) -> float:
        if value == 0:
            raise ValueError("a number other than 0")
        return value


class CameraTable(NominalCamera):
    """Table ``[[camera]]``: nominal optics and images of one camera."""

    white_image: Annotated[str, Field(min_length=1)]
    """Path of an image of an evenly lit white surface, which shows every microlens."""
    dark_image: Annotated[str, Field(min_length=1)] | None = None
    """Path of an image with the lens capped; absent: the gaps between the microimages give the dark level."""


class Board(Table):
    """Table ``[board]``: the dot board and the depths it was recorded at."""

    dots: tuple[Annotated[int, Field(strict=True, ge=2)], Annotated[int, Field(strict=True, ge=2)]]
    """Dots along x and y."""
    spacing_mm: Positive
    """Distance of neighbouring dots [mm]."""
    dot_diameter_mm: Positive
    """Diameter of a dot [mm]."""
    planes_mm: Annotated[tuple[Number, ...], Field(min_length=2)]
    """Depth z of each plane [mm]."""
    images: Annotated[str, Field(min_length=1)]
    """Path with ``{camera}`` and ``{plane}``, planes counted from 0."""

    @field_validator("planes_mm")
    @classmethod
    def _distinct(cls, planes: tuple[float, ...]) -> tuple[float, ...]:
        if len(set(planes)) != len(planes):
            raise ValueError("a different depth for each plane")
        return planes

    @model_validator(mode="after")
    def _dots_apart(self) -> Board:
        if self.dot_diameter_mm >= self.spacing_mm:
            raise ValueError("dot_diameter_mm smaller than spacing_mm")
        return self


class Volume(Table):
    """Table ``[volume]``: the grid to reconstruct on; (x, y, z) order."""

    centre_mm: tuple[Number, Number, Number]
    """Centre (x, y, z) of the volume [mm]."""
    size_mm: tuple[Positive, Positive, Positive]
    """Size (x, y, z) of the volume [mm]; at least 4 voxels along each axis."""
    voxel_mm: Positive
    """Edge of a voxel [mm]."""


class Particles(Table):
    """Table ``[particles]``: the image pairs."""

    images: Annotated[str, Field(min_length=1)]
    """Path with ``{camera}``, ``{pair}`` and ``{frame}``, pairs counted from 0."""
    pairs: Count
    """Number of image pairs."""
    frames: tuple[Annotated[str, Field(min_length=1)], Annotated[str, Field(min_length=1)]] = ("a", "b")
    """What ``{frame}`` stands for in the first and in the second image of a pair."""

    @field_validator("frames")
    @classmethod
    def _differ(cls, frames: tuple[str, str]) -> tuple[str, str]:
        if frames[0] == frames[1]:
            raise ValueError("two different frame names")
        return frames


class ExperimentTable(Table):
    """The whole file."""

    name: Annotated[str, Field(min_length=1)]
    """Title of the report."""
    dt_s: Positive
    """Time between the two frames of a pair [s]."""
    camera: Annotated[tuple[CameraTable, ...], Field(min_length=1)]
    board: Board
    volume: Volume
    particles: Particles
    smart: Smart = Smart()
    correlation: Correlation = Correlation()
    network: Network = Network()
    self_calibration: SelfCalibration = SelfCalibration()
    compute: Compute = Compute()
