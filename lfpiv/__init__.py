"""Multi-camera light-field particle image velocimetry: raw plenoptic images in, 3D velocity volumes out.

Public names load their module on first use, so that importing the package starts no device and reads no heavy library.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what the names below stand for
    from lfpiv import derived as derived
    from lfpiv import metrics as metrics
    from lfpiv import statistics as statistics
    from lfpiv.calibration import Calibration, calibrate, load_calibration, thin_lens
    from lfpiv.errors import InputError
    from lfpiv.experiment import Experiment, open_experiment
    from lfpiv.export import export_results
    from lfpiv.lensarray import LensArray, find_lens_array
    from lfpiv.motion import reconstruct_pair
    from lfpiv.pipeline import run
    from lfpiv.report import write_report
    from lfpiv.results import open_results
    from lfpiv.rig import Grid, LensLattice, Optics
    from lfpiv.selfcalibration import self_calibrate
    from lfpiv.vectors import correlate
    from lfpiv.volume import reconstruct
    from lfpiv.weights import build_weights

__version__ = "0.1.0"

_MODULES = {
    "Calibration": "lfpiv.calibration",
    "Experiment": "lfpiv.experiment",
    "Grid": "lfpiv.rig",
    "InputError": "lfpiv.errors",
    "LensArray": "lfpiv.lensarray",
    "LensLattice": "lfpiv.rig",
    "Optics": "lfpiv.rig",
    "build_weights": "lfpiv.weights",
    "calibrate": "lfpiv.calibration",
    "correlate": "lfpiv.vectors",
    "export_results": "lfpiv.export",
    "find_lens_array": "lfpiv.lensarray",
    "load_calibration": "lfpiv.calibration",
    "open_experiment": "lfpiv.experiment",
    "open_results": "lfpiv.results",
    "reconstruct": "lfpiv.volume",
    "reconstruct_pair": "lfpiv.motion",
    "run": "lfpiv.pipeline",
    "self_calibrate": "lfpiv.selfcalibration",
    "thin_lens": "lfpiv.calibration",
    "write_report": "lfpiv.report",
}

_SUBMODULES = ("derived", "metrics", "statistics")
"""Modules that are public as a whole, such as `lfpiv.metrics`."""

__all__ = [
    "Calibration",
    "Experiment",
    "Grid",
    "InputError",
    "LensArray",
    "LensLattice",
    "Optics",
    "build_weights",
    "calibrate",
    "correlate",
    "export_results",
    "find_lens_array",
    "load_calibration",
    "open_experiment",
    "open_results",
    "reconstruct",
    "reconstruct_pair",
    "run",
    "self_calibrate",
    "thin_lens",
    "write_report",
]


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
    return sorted([*globals(), *_SUBMODULES, *__all__])
