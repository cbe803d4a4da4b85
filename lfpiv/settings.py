"""The optional tables of an experiment file: every setting a step has, its range and its default, in one place."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

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

    iterations: Count = 20
    """SMART iterations."""
    relaxation: Annotated[float, Field(strict=True, gt=0, le=3)] = 1.0
    """Relaxation mu of Eq. 5. Values near 3 diverge."""
    normalisation: Literal["column", "paper"] = "column"
    """Exponent divided by the voxel's column sum, or Eq. 5 as printed with weights scaled to a maximum of 1."""
    smoothing_voxel: Annotated[float, Field(strict=True, ge=0, le=5)] = 0.0
    """Standard deviation of the Gaussian smoothing after each iteration [voxel]; 0 switches it off."""
    tolerance: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    """Stop when an iteration lowers the image residual by less than this fraction; 0 runs all iterations."""


class Correlation(Table):
    """Table ``[correlation]``: volumes to vectors."""

    windows: Annotated[tuple[Window, ...], Field(min_length=1)] | None = None
    """Window of each pass [voxel], one edge or (z, y, x); absent: ``vectors.DEFAULT_WINDOWS``, cut to the volume."""
    overlap: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.5
    """Fraction by which neighbouring windows overlap."""
    max_displacement_voxel: Positive | None = None
    """Largest displacement the first pass looks for [voxel]; absent: a quarter of its window."""
    smoothing_voxel: Annotated[float, Field(strict=True, ge=0, le=5)] = 0.5
    """Standard deviation of a Gaussian applied to the volumes before correlation [voxel]; 0 switches it off."""
    intensity_power: Annotated[float, Field(strict=True, gt=0, le=2)] = 0.5
    """Power of the volumes' intensities that is correlated, after smoothing; 1 takes them as they are."""


class Network(Table):
    """Table ``[network]``: the mapping of Eqs. 6-7 and the labels it is trained on."""

    hidden: tuple[Count, ...] = (20,)
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
    memory_gib: Positive | None = None
    """Memory the run may take [GiB]; absent: what the machine has available."""
