"""Read the parts of a calibrated camera from its HDF5 group, and refuse what no calibration can have made.

A part of another form raises a `RecordError` that names it: arrays of another shape, numbers that are not finite,
records without an entry.
"""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np

from lfpiv import warn
from lfpiv.calibration.board.dots import BoardDots
from lfpiv.calibration.board.errors import BoardErrors
from lfpiv.calibration.network import Network
from lfpiv.calibration.quality import CalibrationQuality, LensArrayQuality
from lfpiv.calibration.thin_lens_model import ThinLensModel
from lfpiv.geometry.optics import LAYOUTS, LensLattice, Optics
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.records import RecordError, read_json, read_object, validate

ROTATION_ERROR = 1e-3
"""Largest departure of a stored rotation matrix from orthogonality."""

_DECODER = {
    "lens_index": ("i", 2),
    "pupil_mm": ("f", 2),
    "coverage": ("f", 0),
    "gain": ("f", 0),
    "smooth_gain": ("f", 0),
    "gaps": ("b", 0),
}  # kind of each array, and its values per pixel if they are several
_LABELS = {
    "pupil_mm": ("n", 2),
    "array_mm": ("n", 2),
    "std_mm": ("n",),
    "dot": ("n",),
    "rejected_dot": ("r",),
    "measured_dot": ("d",),
    "chief_mm": ("d", 2),
    "slope": ("d", 2, 2),
    "reduced_chi2": ("d",),
    "left_over_mm": ("part", "zone", 2),
    "points_mm": ("n", 3),
    "found": ("plane",),
    "expected": ("plane",),
    "rejected": ("plane",),
}  # shapes of the arrays; a letter or word stands for the same length everywhere
_BOARD = {
    "planes_mm": ("plane",),
    "plane": ("plane", 6),
    "plane_std": ("plane", 6),
    "dot_mm": ("dot", 2),
    "dot_std_mm": ("dot", 2),
}


def camera_names(file: h5py.File) -> list[str]:
    """Return the names of the cameras of a calibration file, in their order."""
    stored = np.atleast_1d(file.attrs["cameras"]).tolist()
    names = validate(list[str], stored)
    if not names or len(set(names)) != len(names) or set(names) != set(file["camera"]):
        raise RecordError(f"cameras: expected one group for each of {names}, found {sorted(file['camera'])}")
    return names


def read_camera(group: h5py.Group) -> dict[str, Any]:
    """Return the parts of a camera, by the names of the fields of `CalibratedCamera`."""
    optics = _optics(_values(group, "optics."))
    lattice = _lattice(_values(group, "lattice."))
    report = read_object(group.attrs["report"])
    warnings = read_json(group.attrs["warnings"]) if "warnings" in group.attrs else report.pop("warnings", [])
    return {
        "optics": optics,
        "lattice": lattice,
        "decoder": _decoder(group["decoder"], optics, lattice),
        "network": _network(_arrays(group["network"])) if "network" in group else None,
        "baseline": _baseline(_arrays(group["baseline"])) if "baseline" in group else None,
        "region_mm": _region(group["region_mm"][()]) if "region_mm" in group else None,
        "report": _report(report) if report else None,
        "warnings": warn.from_list(warnings),
        "dots": _dots(_arrays(group["dots"])) if "dots" in group else None,
        "test_errors": _numbers(group["test_errors"][()], "test_errors", 1) if "test_errors" in group else None,
    }


def read_board(group: h5py.Group) -> BoardErrors:
    """Return the errors of the board."""
    arrays = {name: array[()] for name, array in group.items()}
    _check_shapes(arrays, _BOARD, "board")
    for name in ("planes_mm", "plane", "dot_mm"):
        _require(np.isfinite(arrays[name]).all(), f"board.{name}: expected finite numbers")
    return BoardErrors(
        **arrays,
        corrected=tuple(validate(list[str], np.atleast_1d(group.attrs["corrected"]).tolist())),
        warnings=warn.from_text(group.attrs["warnings"]),
    )


def _require(right: Any, otherwise: str) -> None:
    if not right:
        raise RecordError(otherwise)


def _values(group: h5py.Group, prefix: str) -> dict[str, Any]:
    """Return the attributes whose names start with a prefix, as Python values."""
    found = {key[len(prefix) :]: value for key, value in group.attrs.items() if key.startswith(prefix)}
    return {
        key: value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value for key, value in found.items()
    }


def _arrays(group: h5py.Group) -> dict[str, Any]:
    return {key: value[()] for key, value in group.items()} | {
        key: validate(float, value.item()) for key, value in group.attrs.items()
    }


def _optics(stored: dict[str, Any]) -> Optics:
    optics = validate(Optics, stored)
    lengths = {name: value for name, value in vars(optics).items() if isinstance(value, float)}
    for name, value in lengths.items():
        _require(np.isfinite(value) and (value > 0 or name == "magnification"), f"optics.{name}: found {value}")
    _require(optics.magnification != 0, "optics.magnification: found 0")
    _require(min(optics.sensor_shape) > 0, f"optics.sensor_shape: found {optics.sensor_shape}")
    _require(optics.layout in LAYOUTS, f"optics.layout: found {optics.layout[:40]!r}")
    return optics


def _lattice(stored: dict[str, Any]) -> LensLattice:
    lattice = validate(LensLattice, stored)
    _require(lattice.layout in LAYOUTS, f"lattice.layout: found {lattice.layout[:40]!r}")
    _require(np.isfinite([*lattice.origin_mm, *np.ravel(lattice.basis_mm)]).all(), "lattice: expected finite numbers")
    _require(lattice.pitch_mm > 0, "lattice: its vectors are parallel")
    return lattice


def _decoder(group: h5py.Group, optics: Optics, lattice: LensLattice) -> LightFieldDecoder:
    for name, (kind, values) in _DECODER.items():
        expected = (*optics.sensor_shape, values) if values else optics.sensor_shape
        found = group[name]
        _require(found.shape == expected, f"decoder.{name}: expected the shape {expected}, found {found.shape}")
        _require(found.dtype.kind == kind, f"decoder.{name}: found {found.dtype}")
    arrays = _arrays(group)
    for name, value in arrays.items():
        _require(np.isfinite(np.sum(value, dtype=float)), f"decoder.{name}: expected finite numbers")
    return LightFieldDecoder(optics=optics, lattice=lattice, **arrays)


def _network(arrays: dict[str, Any]) -> Network:
    network = Network.from_arrays(arrays)
    for name, value in network.to_arrays().items():
        _require(np.isfinite(value).all(), f"network.{name}: expected finite numbers")
    _require((network.sizes[0], network.sizes[-1]) == (5, 2), f"network: found layers of {network.sizes} nodes")
    # a correction that explains nothing is shrunk to 0: its output scale is 0, and that is no damage
    _require((network.input_scale != 0).all(), "network: the scale of an input is 0")
    return network


def _baseline(arrays: dict[str, Any]) -> ThinLensModel:
    lens = ThinLensModel.from_arrays(arrays)
    for name, value in lens.to_arrays().items():
        _require(np.isfinite(value).all(), f"baseline.{name}: expected finite numbers")
    error = np.abs(lens.rotation @ lens.rotation.T - np.eye(3)).max()
    _require(error < ROTATION_ERROR, "baseline: its rotation is no rotation")
    return lens


def _region(stored: np.ndarray) -> np.ndarray:
    region = _numbers(stored, "region_mm", 2)
    _require(region.shape == (2, 3) and (region[0] <= region[1]).all(), "region_mm: expected two corners of a box")
    return region


def _report(stored: dict[str, Any]) -> LensArrayQuality:
    return validate(CalibrationQuality if "sigma_nor_test" in stored else LensArrayQuality, stored)


def _dots(arrays: dict[str, Any]) -> BoardDots:
    _check_shapes(arrays, _LABELS, "dots")
    for name in ("pupil_mm", "array_mm", "points_mm"):
        _require(np.isfinite(arrays[name]).all(), f"dots.{name}: expected finite numbers")
    return BoardDots(**arrays)


def _numbers(stored: Any, name: str, dimensions: int) -> np.ndarray:
    values = np.asarray(stored)
    right = values.dtype.kind in "fiu" and values.ndim == dimensions and np.isfinite(values).all()
    _require(right, f"{name}: expected finite numbers in {dimensions} dimensions")
    return values


def _check_shapes(arrays: dict[str, Any], expected: dict[str, tuple[int | str, ...]], place: str) -> None:
    """Check the shapes of arrays; a word stands for the same length in all of them."""
    lengths: dict[int | str, int] = {}
    for name, dimensions in expected.items():
        _require(name in arrays, f"{place}.{name}: missing")
        shape = np.shape(arrays[name])
        _require(np.asarray(arrays[name]).dtype.kind in "fiub", f"{place}.{name}: expected numbers")
        _require(len(shape) == len(dimensions), f"{place}.{name}: found the shape {shape}")
        for length, dimension in zip(shape, dimensions, strict=True):
            known = dimension if isinstance(dimension, int) else lengths.setdefault(dimension, length)
            _require(length == known, f"{place}.{name}: found the shape {shape}, expected {known} along {dimension}")
