"""Multi-camera light-field particle image velocimetry: raw plenoptic images in, 3D velocity volumes out.

Public names load their module on first use, so that importing the package starts no device and reads no heavy library.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from lfpiv.version import __version__ as __version__

if TYPE_CHECKING:  # the public names, for type checkers
    from lfpiv import derived as derived
    from lfpiv import metrics as metrics
    from lfpiv import statistics as statistics
    from lfpiv.calibration.camera import Calibration as Calibration
    from lfpiv.calibration.camera import load_calibration as load_calibration
    from lfpiv.calibration.cameras import calibrate as calibrate
    from lfpiv.calibration.cameras import thin_lens as thin_lens
    from lfpiv.damping.bootstrap import measure_damping as measure_damping
    from lfpiv.errors import InputError as InputError
    from lfpiv.experiment.experiment import Experiment as Experiment
    from lfpiv.experiment.opening import open_experiment as open_experiment
    from lfpiv.geometry.grid import Grid as Grid
    from lfpiv.geometry.optics import LensLattice as LensLattice
    from lfpiv.geometry.optics import Optics as Optics
    from lfpiv.geometry.resampling import volume_on as volume_on
    from lfpiv.joint.field import joint_field as joint_field
    from lfpiv.joint.pair import reconstruct_pair as reconstruct_pair
    from lfpiv.joint.vectors import joint_vectors as joint_vectors
    from lfpiv.lightfield.lens_array import LensArray as LensArray
    from lfpiv.lightfield.lens_array import find_lens_array as find_lens_array
    from lfpiv.planning.campaign import plan as plan
    from lfpiv.reconstruction.volume import reconstruct as reconstruct
    from lfpiv.report.page import write_report as write_report
    from lfpiv.results.export import export_results as export_results
    from lfpiv.results.particles import open_particles as open_particles
    from lfpiv.results.reader import open_field as open_field
    from lfpiv.results.reader import open_results as open_results
    from lfpiv.results.track_files import open_tracks as open_tracks
    from lfpiv.runs.measurement import Rig as Rig
    from lfpiv.runs.measurement import measure_pair as measure_pair
    from lfpiv.runs.measurement import prepare as prepare
    from lfpiv.runs.pipeline import run as run
    from lfpiv.selfcalibration.movements import self_calibrate as self_calibrate
    from lfpiv.tracking.finding import find_particles as find_particles
    from lfpiv.tracking.link_vectors import vectors_from_links as vectors_from_links
    from lfpiv.tracking.linking import link_particles as link_particles
    from lfpiv.velocity.cross_correlation import correlate as correlate
    from lfpiv.weights.operator import build_weights as build_weights

_MODULES = {
    "Calibration": "lfpiv.calibration.camera",
    "Experiment": "lfpiv.experiment.experiment",
    "Grid": "lfpiv.geometry.grid",
    "InputError": "lfpiv.errors",
    "LensArray": "lfpiv.lightfield.lens_array",
    "LensLattice": "lfpiv.geometry.optics",
    "Optics": "lfpiv.geometry.optics",
    "Rig": "lfpiv.runs.measurement",
    "build_weights": "lfpiv.weights.operator",
    "calibrate": "lfpiv.calibration.cameras",
    "correlate": "lfpiv.velocity.cross_correlation",
    "export_results": "lfpiv.results.export",
    "find_lens_array": "lfpiv.lightfield.lens_array",
    "find_particles": "lfpiv.tracking.finding",
    "joint_field": "lfpiv.joint.field",
    "joint_vectors": "lfpiv.joint.vectors",
    "link_particles": "lfpiv.tracking.linking",
    "load_calibration": "lfpiv.calibration.camera",
    "measure_damping": "lfpiv.damping.bootstrap",
    "measure_pair": "lfpiv.runs.measurement",
    "open_experiment": "lfpiv.experiment.opening",
    "open_field": "lfpiv.results.reader",
    "open_results": "lfpiv.results.reader",
    "open_particles": "lfpiv.results.particles",
    "open_tracks": "lfpiv.results.track_files",
    "plan": "lfpiv.planning.campaign",
    "prepare": "lfpiv.runs.measurement",
    "reconstruct": "lfpiv.reconstruction.volume",
    "reconstruct_pair": "lfpiv.joint.pair",
    "run": "lfpiv.runs.pipeline",
    "self_calibrate": "lfpiv.selfcalibration.movements",
    "thin_lens": "lfpiv.calibration.cameras",
    "vectors_from_links": "lfpiv.tracking.link_vectors",
    "volume_on": "lfpiv.geometry.resampling",
    "write_report": "lfpiv.report.page",
}

_SUBMODULES = ("derived", "metrics", "statistics")
"""Modules that are public as a whole, such as `lfpiv.metrics`."""

__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    """Load the module of a public name on first use."""
    if name in _SUBMODULES:
        return importlib.import_module(f"lfpiv.{name}")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(["__version__", *_SUBMODULES, *__all__])
