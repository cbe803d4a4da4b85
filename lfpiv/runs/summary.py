"""The machine-readable figures of a run, ``summary.json``."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from lfpiv import files, version
from lfpiv.experiment.experiment import Experiment
from lfpiv.results import netcdf
from lfpiv.runs import summary_warnings
from lfpiv.warn import Warning

if TYPE_CHECKING:
    from lfpiv.calibration.cameras import CalibratedCamera, Calibration
    from lfpiv.geometry.grid import Grid
    from lfpiv_kernels.runtime import Device

SCHEMA_VERSION = 1

CORRECTION_RAYS = 4000
"""Rays that tell the network's part in the mapping: their mean square is known to some percent."""

_STAGES = ("calibration", "network_training", "weights", "reconstruction", "correlation")


def build(
    *,
    experiment: Experiment,
    calibration: Calibration,
    calibration_path: Path,
    pairs: Sequence[Mapping[str, Any]],
    reconstructed: Sequence[Mapping[str, Any]],
    failed: Mapping[int, str],
    failed_earlier: Mapping[int, str],
    previous: Mapping[str, Any],
    weights_s: float | None,
    weights: Mapping[str, Any],
    workers: Mapping[str, Any],
    device: Device,
    warnings: Sequence[Warning],
    reused: Sequence[str],
) -> dict[str, Any]:
    """Put together the figures of everything a folder holds.

    ``timings_s`` says what the results in the folder took, read from the files themselves, so also where this
    invocation found them finished; the peak memory likewise. ``total`` is the time of this invocation.

    Parameters
    ----------
    experiment : Experiment
        What was run.
    calibration, calibration_path
        The calibration and its file.
    pairs : sequence of dict
        Figures of the finished pairs, from `pair_entry`.
    reconstructed : sequence of dict
        Number and warnings of pairs that have volumes and no vectors yet, from `volumes_entry`.
    failed, failed_earlier : dict
        Pair -> why it has no result: of this invocation, and of earlier ones.
    previous : dict
        Earlier summary of the folder, or nothing.
    weights_s, weights
        Seconds and figures of the weights; None and nothing where this invocation built none.
    workers : dict
        Processes that worked on pairs: how many, their threads and their peak memory.
    device : Device
        Where the kernels ran.
    warnings : sequence of Warning
        Warnings of this invocation. Warnings about results are read from the results, in every invocation.
    reused : sequence of str
        What was kept from an earlier invocation.

    Returns
    -------
    dict
        JSON-able content of ``summary.json``; ``total`` and the peak memory are filled in at the very end of a run.
    """
    reports = {name: _report(camera, experiment.grid) for name, camera in calibration.cameras.items()}
    earlier = previous.get("timings_s", {})
    timings = {
        "calibration": float(netcdf.read_attributes(calibration_path)["seconds"]),
        "network_training": sum(float(report.get("training_s", 0.0)) for report in reports.values()),
        "weights": weights_s if weights_s is not None else float(earlier.get("weights") or 0.0),
        "reconstruction": sum(pair["reconstruction_s"] for pair in pairs),
        "correlation": sum(pair["correlation_s"] for pair in pairs),
    }
    grid = experiment.grid
    weights = dict(weights) or previous.get("weights", {})
    found = [
        *summary_warnings.rig_warnings(calibration, grid),
        *map(Warning.from_json, weights.get("warnings", ())),
        *summary_warnings.image_warnings([*pairs, *reconstructed]),
        *summary_warnings.pair_warnings(pairs),
        *warnings,
    ]
    return {
        "schema_version": SCHEMA_VERSION,
        "experiment": {
            "name": experiment.name,
            "file": str(experiment.path),
            "dt_s": experiment.dt_s,
            "pairs": experiment.pairs,
            "volume_shape": list(grid.shape),
            "voxel_mm": grid.voxel_mm,
        },
        "device": {"kind": device.kind, "threads": device.threads, "reason": device.reason},
        "workers": dict(workers),
        "versions": version.versions(),
        "settings": {
            "smart": experiment.smart.model_dump(),
            "correlation": experiment.correlation.model_dump(),
            "network": experiment.network.model_dump(),
            "compute": experiment.compute.model_dump(),
        },
        "timings_s": {stage: timings[stage] for stage in _STAGES},
        "peak_memory_mib": None,
        "calibration": {name: _scalars(report) for name, report in reports.items()},
        "weights": weights,
        "pairs": list(pairs),
        "failed": sorted(
            [{"pair": pair, "reason": reason} for pair, reason in failed.items()]
            + [{"pair": pair, "reason": reason, "earlier": True} for pair, reason in failed_earlier.items()],
            key=lambda entry: entry["pair"],
        ),
        "valid_fraction": _mean(pair["valid_fraction"] for pair in pairs),
        "finite_fraction": _mean(pair["finite_fraction"] for pair in pairs),
        "warnings": list(dict.fromkeys(warning.sentence for warning in found)),
        "reused": list(reused),
    }


def read(path: Path) -> dict[str, Any]:
    """Read an earlier summary; nothing where there is none or it cannot be read."""
    try:
        found = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) and found.get("schema_version") == SCHEMA_VERSION else {}


def _report(camera: CalibratedCamera, grid: Grid) -> dict[str, Any]:
    """Figures of a camera's calibration, and of the network's part in it over the volume."""
    texts = [warning.sentence for warning in camera.warnings]
    return dict(camera.report) | {"warnings": texts, "network_correction_pitch": network_correction(camera, grid)}


def network_correction(camera: CalibratedCamera, grid: Grid) -> float | None:
    """Root mean square of what the network adds to the thin lens over a volume [microlens pitch].

    Rays through the whole pupil from a sample of the voxels; None without a thin lens, where the network is all.
    """
    if camera.network is None or camera.baseline is None:
        return None
    rng = np.random.default_rng(0)
    points = np.stack([rng.choice(grid.axis_mm(axis), CORRECTION_RAYS) for axis in (2, 1, 0)], axis=1)
    radius = camera.optics.pupil_radius_mm * np.sqrt(rng.random(CORRECTION_RAYS))
    angle = 2 * np.pi * rng.random(CORRECTION_RAYS)
    pupil = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    correction = camera.network(np.hstack([points, pupil]))
    return float(np.sqrt((correction**2).sum(1).mean()) / camera.lattice.pitch_mm)


def pair_entry(number: int, path: Path, marks: Mapping[str, Any]) -> dict[str, Any]:
    """Figures of a finished pair, from the marks of its file: thousands of files are not read as a whole."""
    if "figures" in marks:
        figures = json.loads(marks["figures"])
    else:
        figures = files.plain(pair_figures(netcdf.read_vectors(path), netcdf.read_reconstruction(path)))
    return {"pair": number, "file": path.name, **figures}


def volumes_entry(number: int, marks: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the warnings of a pair whose vectors are not there yet, from the marks of its volumes."""
    found = [warning.to_json() for mark in marks for warning in summary_warnings.stored_warnings(mark)]
    return {"pair": number, "warnings": found}


def pair_figures(vectors: xr.Dataset, reconstruction: xr.Dataset | None) -> dict[str, Any]:
    """Figures of a pair's vectors and of what is left of its volumes; stored with the vectors."""
    valid = vectors["valid"].values
    finite = np.isfinite(vectors["u"].values) & np.isfinite(vectors["v"].values) & np.isfinite(vectors["w"].values)
    result: dict[str, Any] = {
        "vectors": list(vectors["u"].shape),
        "valid_fraction": float(valid.mean()),
        "finite_fraction": float(finite.mean()),
        "seen_fraction": float(vectors.attrs.get("seen_fraction", 1.0)),
        "verdict": str(vectors.attrs["verdict"]),
        "warnings": [warning.to_json() for warning in summary_warnings.stored_warnings(vectors.attrs)],
        "reconstruction_s": float(vectors.attrs["reconstruction_s"]),
        "correlation_s": float(vectors.attrs["correlation_s"]),
        "velocity_m_per_s": {name: _spread(vectors[name], valid & finite) for name in ("u", "v", "w")},
        "uncertainty_voxel": _median(vectors["uncertainty"].values[valid]),
        "peak_ratio": _median(vectors["peak_ratio"].values[valid]),
    }
    if "motion" in vectors.attrs:
        from lfpiv.reconstruction.motion import Motion

        result["motion"] = {
            "verdict": str(vectors.attrs["motion"]),
            "followed": vectors.attrs["motion"] == Motion.FOLLOWED.value,
            "valid_fraction": np.atleast_1d(vectors.attrs["motion_valid"]).tolist(),
        }
    if reconstruction is not None:
        frames = [str(frame) for frame in reconstruction["frame"].values]
        history = reconstruction["residual"].values
        result["residual"] = {frame: row[np.isfinite(row)].tolist() for frame, row in zip(frames, history, strict=True)}
        for name in netcdf.OF_IMAGES:
            if name in reconstruction:
                cameras = [str(camera) for camera in reconstruction["camera"].values]
                result[name] = {
                    frame: dict(zip(cameras, map(float, row), strict=True))
                    for frame, row in zip(frames, reconstruction[name].values, strict=True)
                }
        result["stop"] = {frame: str(stop) for frame, stop in zip(frames, reconstruction["stop"].values, strict=True)}
    return result


def _spread(values: xr.DataArray, valid: np.ndarray) -> dict[str, float | None]:
    good = values.values[valid]
    if good.size == 0:
        return {"mean": None, "sd": None, "min": None, "max": None}
    return {"mean": float(good.mean()), "sd": float(good.std()), "min": float(good.min()), "max": float(good.max())}


def _median(values: np.ndarray) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else None


def _mean(values: Iterable[float]) -> float | None:
    values = list(values)
    return float(np.mean(values)) if values else None


def _scalars(report: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers and short texts of a camera's report; arrays belong to the calibration file."""
    return {key: files.plain(value) for key, value in report.items() if not isinstance(value, np.ndarray)}
