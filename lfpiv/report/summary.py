"""Figures of ``summary.json`` that the report shows, validated once when the report is written.

Keys that the report does not show are ignored. Keys with a default are missing in runs that did not compute them.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from lfpiv_kernels.runtime import Device


class _Figures(BaseModel):
    model_config = ConfigDict(frozen=True)


class CameraFigures(_Figures):
    """Figures of a camera's calibration; None where the calibration has no such figure."""

    sigma_nor_test: float | None = None
    sigma_nor_stated: float | None = None
    dots_found: int | None = None
    dots_expected: int | None = None
    labels: int | None = None
    lens_array_rms_px: float | None = None
    lens_array_pitch_px: float | None = None
    lens_array_rotation_deg: float | None = None
    magnification: float | None = None
    turn_from_nominal_deg: float | None = None
    network_correction_pitch: float | None = None
    epochs: int | None = None
    training_s: float | None = None


class Movement(_Figures):
    """Correction of a camera by self-calibration."""

    shift_mm: tuple[float, float, float]
    rotation_deg: tuple[float, float, float]


class SelfCalibration(_Figures):
    """Disparity between the cameras before and after self-calibration, and the corrections."""

    pairs: tuple[int, ...]
    verdict: str = "corrected"
    disparity_before_voxel: float | None
    disparity_voxel: float | None
    movements: dict[str, Movement]


class WeightFigures(_Figures):
    """Method, memory and checks of the weights; empty where no weights were built."""

    method: str = ""
    memory_mib: float = 0.0
    form: dict[str, str] = {}
    count_check_l2: tuple[float, ...] = ()
    cameras: str = ""
    self_calibration: SelfCalibration | None = None


class Spread(_Figures):
    """Mean and standard deviation of a velocity component over the valid vectors [m/s]; None without valid vectors."""

    mean: float | None
    sd: float | None


class JointFigures(_Figures):
    """Outcome of the joint fit of a pair."""

    fitted: bool = False
    misfit_ratio: float = 1.0
    """Misfit over that of the frames by themselves."""
    share: float = 0.0
    """Share of the valid vectors that are means of the fitted displacement."""


class LinkFigures(_Figures):
    """Process through the links of a pair whose means are its vectors."""

    number: int
    """Links that count."""
    form: str
    """``incompressible``, or ``independent`` components."""
    length: float
    """Length of the flow's structures [voxel]."""


class ParticleFigures(_Figures):
    """Figures of the tracked particles of a pair."""

    found: tuple[int, ...]
    """Number of particles of each frame."""
    linked: int
    valid_links: int
    per_microlens: tuple[float, ...]
    """Particles per microlens of each frame."""
    sigma_voxel: tuple[float, ...]
    """Standard deviation of their Gaussian shape [voxel] of each frame."""


class PairFigures(_Figures):
    """Figures of a finished pair.

    ``residual`` and ``stop`` have the frames as keys; ``structure``, ``camera_gain``, ``light_outside`` and ``light``
    have frames and cameras.
    """

    number: int = Field(alias="pair")
    valid_fraction: float
    verdict: str
    velocity_m_per_s: dict[str, Spread]
    uncertainty_voxel: float | None
    peak_ratio: float | None
    moved_voxel: float | None = None
    joint: JointFigures | None = None
    links: LinkFigures | None = None
    residual: dict[str, tuple[float, ...]] = {}
    stop: dict[str, str] = {}
    structure: dict[str, dict[str, float]] = {}
    camera_gain: dict[str, dict[str, float]] = {}
    light_outside: dict[str, dict[str, float]] = {}
    light: dict[str, dict[str, float]] = {}
    particles: ParticleFigures | None = None
    """None without tracking."""


class TrackFigures(_Figures):
    """Figures of the tracks of single particles over a time series."""

    tracks: int
    """Tracks that are not left out."""
    rows: int
    """Their positions at all instants."""
    left_out: int


class Failure(_Figures):
    """A pair without result, and the reason."""

    pair: int
    reason: str


class AxisDamping(_Figures):
    """Damping of one component of the displacement by ghosts."""

    slope: float
    slope_error: float
    offset: float
    offset_error: float
    applied: bool
    alike: bool = True
    """False if simulated pairs are harder to measure than recorded ones."""
    raw_error: float | None = None
    """Expected root mean square error of raw vectors [voxel]; None where it is not known."""
    unbiased_error: float | None = None
    """The same of vectors without damping [voxel]."""


class DampingFigures(_Figures):
    """Damping by ghosts, of the axes x, y, z."""

    axes: dict[str, AxisDamping]
    """Empty if it could not be measured."""
    simulated: int
    reason: str = ""
    """Why it could not be measured."""


class DeviceFigures(_Figures):
    """Device of the kernels."""

    kind: str
    threads: int
    name: str = ""
    """Empty where the system does not say it."""
    memory_bytes: int | None = None
    """Memory of the GPU [byte]; None on the CPU."""
    driver: str = ""
    """Version of CUDA that the GPU's driver knows; empty on the CPU."""
    reason: str = ""
    """Why it was picked; empty if it was the one requested."""

    @property
    def sentence(self) -> str:
        """The same for people."""
        return Device(**{name: getattr(self, name) for name in type(self).model_fields}).sentence


class Summary(_Figures):
    """Content of ``summary.json`` as far as the report shows it."""

    device: DeviceFigures
    versions: dict[str, str]
    settings: dict[str, dict[str, Any]]
    timings_s: dict[str, float | None]
    peak_memory_mib: float | None
    calibration: dict[str, CameraFigures]
    weights: WeightFigures = WeightFigures()
    damping: DampingFigures | None = None
    """None if it was not measured."""
    tracks: TrackFigures | None = None
    """None without tracks."""
    pairs: tuple[PairFigures, ...]
    """Finished pairs; of very many an evenly chosen part."""
    pairs_finished: int
    """Number of all finished pairs."""
    failed: tuple[Failure, ...] = ()
    pairs_failed: int
    """Number of all failed pairs; `failed` lists the first of them."""
    valid_fraction: float | None
    warnings: tuple[str, ...]
    reused: tuple[str, ...]
