"""Figures of a finished pair: measured when its vectors are written, stored with them, and read for the summary.

The summary of thousands of pairs is built from these figures, without reading the arrays of any file.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv import files, warn
from lfpiv.joint.pair import Estimate
from lfpiv.prompt import movement
from lfpiv.records import RecordError, validate
from lfpiv.results import netcdf
from lfpiv.results.provenance import Marks
from lfpiv.warn import Code, Warning

log = logging.getLogger(__name__)

ByFrame = Mapping[str, Mapping[str, float]]
"""Frame -> camera -> figure."""


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Distribution of a velocity component over the valid vectors [m/s]; None without valid vectors."""

    mean: float | None
    sd: float | None
    min: float | None
    max: float | None


@dataclass(frozen=True, kw_only=True)
class JointFigures:
    """Outcome of the joint fit of a pair."""

    verdict: str
    fitted: bool
    rounds: int = 0
    misfit_ratio: float = 1.0
    """Misfit over that of the frames by themselves."""
    lossy: bool = False
    """Whether brightness differs between the frames, since particles are lost between them."""
    share: float = 0.0
    """Share of the valid vectors that are means of the fitted displacement; the correlation gives the others."""


@dataclass(frozen=True, kw_only=True)
class LinkFigures:
    """Process through the links of a pair whose means are its vectors."""

    number: int
    """Links that count."""
    form: str
    """``incompressible``, or ``independent`` components."""
    length: float
    """Length of the flow's structures [voxel]."""
    strength: float
    """Standard deviation of a component of the displacement about its mean, root mean square over x, y, z [voxel]."""
    scatter: float
    """Standard deviation of what the links do not resolve [voxel]."""


@dataclass(frozen=True, kw_only=True)
class PairFigures:
    """Figures of the vectors of a pair and of its volumes, in the form of an entry of the summary."""

    vectors: Sequence[int]
    """Number of vectors along z, y, x."""
    valid_fraction: float
    finite_fraction: float
    seen_fraction: float
    measurable_fraction: float
    """Part of the vectors that two cameras see and where there are particles."""
    verdict: str
    warnings: tuple[Warning, ...]
    """Warnings about the images."""
    reconstruction_s: float
    correlation_s: float
    velocity_m_per_s: Mapping[str, Spread]
    uncertainty_voxel: float | None
    """Median over the valid vectors."""
    peak_ratio: float | None
    """Median over the valid vectors."""
    masked_fraction: float = 0.0
    """Part of all vectors that are masked; the other parts are of those that are not."""
    unseeded_fraction: float = 0.0
    """Part of the volume that holds no particles."""
    moved_voxel: float | None = None
    """Median length of the displacements of the valid vectors; None where there are none."""
    flow_voxel: Sequence[float] | None = None
    """Mean displacement of the valid vectors, along x, y, z in each eighth of the volume, 0 where there are none."""
    joint: JointFigures | None = None
    """None without a joint fit."""
    links: LinkFigures | None = None
    """None where the vectors do not come from links."""
    residual: Mapping[str, Sequence[float]] | None = None
    """Frame -> residual before each iteration and after the last one."""
    structure: ByFrame | None = None
    camera_gain: ByFrame | None = None
    light_outside: ByFrame | None = None
    light: ByFrame | None = None
    stop: Mapping[str, str] | None = None
    """Frame -> why the iteration ended."""

    def moved(self, voxel_mm: float, dt_s: float) -> str:
        """Return in words how far and how fast particles move; "nothing to measure" without valid vectors."""
        if self.moved_voxel is None:
            return "nothing to measure"
        return movement(self.moved_voxel, voxel_mm, dt_s)

    @property
    def valid_share(self) -> float:
        """Part of the vectors that are valid, of those that can be."""
        return min(self.valid_fraction / self.measurable_fraction, 1.0) if self.measurable_fraction > 0 else 0.0

    @property
    def lost_unseeded(self) -> float:
        """Part of the vectors that are not valid because there are no particles."""
        return max(self.seen_fraction - self.measurable_fraction, 0.0)

    def unseeded_warning(self, pair: int) -> Warning:
        """Return the warning that a part of the volume holds no particles."""
        shares = {"share": self.unseeded_fraction, "lost": self.lost_unseeded}
        return Warning(code=Code.UNSEEDED, pairs=(pair,), figures=shares)

    def few_valid_warning(self, pair: int) -> Warning:
        """Return the warning that few vectors are valid."""
        return Warning(code=Code.FEW_VALID, pairs=(pair,), figures={"share": self.valid_share, "verdict": self.verdict})

    def to_json(self) -> dict[str, Any]:
        """Return the form that a file stores; figures that are not known are left out."""
        stored = asdict(self) | {"warnings": [warning.to_json() for warning in self.warnings]}
        return {name: value for name, value in stored.items() if name not in _OPTIONAL or value is not None}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> PairFigures:
        """Read the form that a file stores; raise RecordError if it has another form."""
        if not isinstance(stored, Mapping):
            raise RecordError("expected the figures of a pair")
        warnings = warn.from_list(stored.get("warnings", []))
        found = replace(validate(cls, {**stored, "warnings": []}), warnings=warnings)
        shares = (found.valid_fraction, found.finite_fraction, found.seen_fraction, found.masked_fraction)
        if not all(0 <= share <= 1 for share in shares):
            raise RecordError(f"expected shares from 0 to 1, found {shares}")
        return found


_DISPLACEMENTS = ("displacement_x", "displacement_y", "displacement_z")
_OPTIONAL = ("residual", *netcdf.OF_IMAGES, "stop")


def read_figures(path: Path, marks: Marks) -> PairFigures:
    """Return the figures of a finished pair from the marks of its vectors; files without figures are measured."""
    if marks.figures is not None:
        try:
            return PairFigures.from_json(marks.figures)
        except RecordError as error:
            log.warning("%s: its figures have another form, measured again: %s", path, error)
    measured = measure(netcdf.read_vectors(path), netcdf.read_reconstruction(path), marks.warnings)
    return PairFigures.from_json(files.plain(measured.to_json()))


def measure(vectors: xr.Dataset, condensed: xr.Dataset | None, warnings: Iterable[Warning]) -> PairFigures:
    """Measure the figures of a pair from its vectors and, if known, its volumes from `netcdf.build_reconstruction`."""
    valid = vectors["valid"].values
    finite = np.isfinite(vectors["u"].values) & np.isfinite(vectors["v"].values) & np.isfinite(vectors["w"].values)
    fluid = ~vectors["masked"].values if "masked" in vectors else np.ones_like(valid)
    known = {} if condensed is None else _of_volumes(condensed)
    return PairFigures(
        vectors=list(vectors["u"].shape),
        valid_fraction=float(valid[fluid].mean()) if fluid.any() else 0.0,
        finite_fraction=float(finite[fluid].mean()) if fluid.any() else 0.0,
        masked_fraction=float(1 - fluid.mean()),
        measurable_fraction=float(vectors.attrs.get("measurable_fraction", vectors.attrs.get("seen_fraction", 1.0))),
        unseeded_fraction=float(vectors.attrs.get("unseeded_fraction", 0.0)),
        seen_fraction=float(vectors.attrs.get("seen_fraction", 1.0)),
        verdict=str(vectors.attrs["verdict"]),
        warnings=tuple(warnings),
        reconstruction_s=float(vectors.attrs["reconstruction_s"]),
        correlation_s=float(vectors.attrs["correlation_s"]),
        velocity_m_per_s={name: _spread(vectors[name].values[valid & finite]) for name in ("u", "v", "w")},
        moved_voxel=_median(np.sqrt(sum(vectors[name].values[valid & finite] ** 2 for name in _DISPLACEMENTS))),
        flow_voxel=flow_in_eighths(vectors, valid & finite),
        uncertainty_voxel=_median(vectors["uncertainty"].values[valid]),
        peak_ratio=_median(vectors["peak_ratio"].values[valid]),
        joint=_joint(vectors.attrs) if "estimate" in vectors.attrs else None,
        links=LinkFigures(**json.loads(vectors.attrs["links"])) if "links" in vectors.attrs else None,
        **known,
    )


def flow_in_eighths(vectors: xr.Dataset, counts: np.ndarray) -> list[float]:
    """Return the mean displacements of the vectors that count in eighths of the volume, to four digits."""
    halves = [(slice(0, -(-n // 2)), slice(n // 2, n)) for n in counts.shape]
    means = []
    for name, part in product(_DISPLACEMENTS, product(*halves)):
        chosen = vectors[name].values[part][counts[part]]
        means.append(round(float(chosen.mean()), 4) if len(chosen) else 0.0)
    return means


def _joint(attributes: Mapping[str, Any]) -> JointFigures:
    fitted = attributes["estimate"] == Estimate.JOINT.value
    if not fitted:
        return JointFigures(verdict=str(attributes["estimate"]), fitted=False)
    return JointFigures(
        verdict=str(attributes["estimate"]),
        fitted=True,
        rounds=int(attributes["rounds"]),
        misfit_ratio=float(attributes["misfit_ratio"]),
        lossy=bool(attributes["lossy"]),
        share=float(attributes["joint_fraction"]),
    )


def _of_volumes(condensed: xr.Dataset) -> dict[str, Any]:
    frames = [str(frame) for frame in condensed["frame"].values]
    histories = zip(frames, condensed["residual"].values, strict=True)
    found: dict[str, Any] = {"residual": {frame: row[np.isfinite(row)].tolist() for frame, row in histories}}
    for name in [name for name in netcdf.OF_IMAGES if name in condensed]:
        cameras = [str(camera) for camera in condensed["camera"].values]
        rows = zip(frames, condensed[name].values, strict=True)
        found[name] = {frame: dict(zip(cameras, map(float, row), strict=True)) for frame, row in rows}
    found["stop"] = {frame: str(stop) for frame, stop in zip(frames, condensed["stop"].values, strict=True)}
    return found


def _spread(values: np.ndarray) -> Spread:
    if values.size == 0:
        return Spread(mean=None, sd=None, min=None, max=None)
    return Spread(mean=float(values.mean()), sd=float(values.std()), min=float(values.min()), max=float(values.max()))


def _median(values: np.ndarray) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else None
