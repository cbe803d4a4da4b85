"""Tables of the processing steps: SMART, correlation, tracking, network, computation."""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from lfpiv.settings import bounds
from lfpiv.settings.bounds import Flag, Memory, Seed, Steps
from lfpiv.settings.table import Table

SMALLEST_WINDOW = 4
"""Smallest edge of an interrogation window that holds a correlation peak [voxel]."""

Edge = Annotated[int, Field(strict=True, ge=SMALLEST_WINDOW, le=bounds.LARGEST_WINDOW)]
Window = Edge | tuple[Edge, Edge, Edge]

DEFAULT_WINDOWS = (32, 16, 12, 12)
"""Window edge of each pass where none is stated [voxel], cut to the volume along each axis."""


class Smart(Table):
    """Table ``[smart]``: settings of the reconstruction (Eq. 5)."""

    iterations: Steps = 14
    """Largest number of SMART iterations, passes over all rays; without `subsets` some 40 are needed. Fewer are made
    where further steps of the subsets would not improve the volume."""
    subsets: Annotated[int, Field(strict=True, ge=1, le=bounds.MOST_SUBSETS)] | Literal["auto"] = "auto"
    """Number of ordered subsets of the rays: 1 for plain SMART, or up to the rows of pixels across a microimage, 16 at
    most; where rows cannot be taken alone, the number of cameras or twice that. "auto" takes as many as
    possible and leaves them where they contradict each other; it takes 1 where only the pupil resolves depth, as of one
    camera."""
    relaxation: Annotated[float, Field(strict=True, gt=0, le=3)] = 1.0
    """Relaxation mu of Eq. 5; values near 3 diverge."""
    normalisation: Literal["column", "paper"] = "column"
    """Exponent of Eq. 5: divided by the voxel's column sum, or as printed with weights scaled to a maximum of 1."""
    accelerate: Flag = True
    """Whether Nesterov's momentum in the volume's logarithm reduces the number of iterations to the same limit."""
    floor_share: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.1
    """Lower limit of the noise floor, as a share of the images' brightness; 0 takes the measured noise."""
    intensity_cap: Annotated[float, Field(strict=True, ge=0, le=100)] | Literal["auto"] = "auto"
    """Upper limit of the images' counts, as a multiple of the median over the lit microimages of the brightest pixel; 0
    switches it off, "auto" does so where the images show equally bright particles, and takes 1 for other
    particles smaller than voxels and 2 for larger ones."""
    sieve_voxel: Annotated[float, Field(strict=True, ge=0, le=5)] | Literal["auto"] = "auto"
    """Standard deviation of the Gaussians that make up the volume [voxel]; 0 lets voxels vary freely, "auto" takes the
    particles' size from the images, or 0 where particles are smaller than voxels."""
    refinement: Annotated[float, Field(strict=True, ge=1, le=bounds.LARGEST_REFINEMENT)] | Literal["auto"] = "auto"
    """Edge of a voxel over the edge of the reconstructed voxels, from which the volume is then sampled; "auto"
    follows from the particles' size in the images, and is 1 where they are large enough."""
    tolerance: Annotated[float, Field(strict=True, ge=0, lt=1)] = 5e-4
    """Relative decrease of the misfit per iteration below which SMART stops; 0 runs all iterations."""
    estimate: Literal["auto", "correlation", "joint"] = "auto"
    """How the displacement of an image pair is estimated: from the correlation of two volumes, each reconstructed from
    its own images, or by a joint fit of one volume and its displacement to the images of both frames, which needs two
    or more cameras and three to four times the time. "auto" takes the joint fit where it can be used."""
    predict: Flag = False
    """Whether an instant of a time series starts from the one before, moved by the flow, and is corrected by those
    beside it; it takes fewer iterations."""

    def of_one_frame(self, refinement: float = 1.0) -> dict[str, Any]:
        """Return the settings of `lfpiv.reconstruct`, which reconstructs one frame.

        `refinement` is the edge of a voxel over the edge of a reconstructed voxel, in which the sieve is returned.
        """
        settings = self.model_dump(exclude={"estimate", "predict", "refinement"})
        sieve = settings["sieve_voxel"]
        return settings | {"sieve_voxel": sieve if sieve == "auto" else sieve * refinement}


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
    """Table ``[tracking]``: displacements of single particles; absent: none, or the defaults with a single camera."""

    rounds: Annotated[int, Field(strict=True, ge=1, le=20)] = 5
    """Largest number of rounds in which particles are fitted to the images, removed where a camera does not confirm
    them, and added where light is left."""
    weakest: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.05
    """Least light of a particle in each camera that counts, as a share of the typical particle's."""
    vectors: Literal["auto", "links", "correlation"] = "auto"
    """Whether a pair's vectors are means of its linked particles' flow, or come from correlation; "auto" takes links
    where a single camera is used, which resolves depth worse by correlation. State "links" for two and more cameras up
    to 0.2 particles per microlens."""

    def gives_vectors(self, cameras: int) -> bool:
        """Return whether links give the vectors of a rig with a number of cameras."""
        return self.vectors == "links" or (self.vectors == "auto" and cameras == 1)

    @property
    def search(self) -> dict[str, Any]:
        """The settings of the search for particles."""
        return self.model_dump(exclude={"vectors"})


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
    """Computation of the weights: integrated over voxel, microlens and pixel, or by counted rays (Eq. 10). "count" is
    for comparison with the paper, and for optics that footprints do not follow."""
    weights_form: Literal["auto", "profiles", "pixels"] = "auto"
    """Storage of footprints: products of profiles (straight rays, square microlenses), single pixels (any optics), or
    for each camera the profiles if they agree with counted rays ("auto")."""
    count_rays: Literal[1024, 2048, 4096, 8192, 16384, 32768, 65536, 131072] = 4096
    """Number of rays per voxel and camera of counted weights. Twice as many take twice the time and have some 0.6 times
    the noise."""
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
    """Number of pairs that are simulated after a pilot, each at the cost of a recorded pair; "auto" takes one for ten
    recorded pairs, the pilot included, at most 12, none in runs of fewer than 20 pairs and none with a joint fit, which
    hardly damps; 0 measures nothing."""

    def count(self, pairs: int) -> int:
        """Return the number of simulated pairs for a number of recorded ones."""
        if isinstance(self.pairs, int):
            return self.pairs
        return min(max(pairs // SHARE_SIMULATED - 1, 0), MOST_SIMULATED)
