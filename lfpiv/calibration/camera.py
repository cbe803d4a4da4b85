"""A calibrated camera, the calibration of a rig, and their HDF5 file.

The mapping of a camera is (x, y, z, u, v) -> (s, t) [mm] (Eqs. 6-7): a network, a thin lens, or the sum of both.
"""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np

from lfpiv import hdf5
from lfpiv.calibration import stored
from lfpiv.calibration.board.dots import BoardDots
from lfpiv.calibration.board.errors import BoardErrors
from lfpiv.calibration.network import Network
from lfpiv.calibration.quality import CalibrationQuality, LensArrayQuality
from lfpiv.calibration.thin_lens_model import ThinLensModel
from lfpiv.errors import DamagedFile, InputError
from lfpiv.geometry.optics import LensLattice, Optics
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.microimage_layout import microimages_of
from lfpiv.lightfield.standing_light import StandingLight
from lfpiv.prompt import Card, Shown, count, number, times
from lfpiv.version import SOURCE, history
from lfpiv.warn import Warning
from lfpiv_kernels.rays import mapping
from lfpiv_kernels.weights.microimages import Microimages

SCHEMA_VERSION = 4
"""Version of the calibration file's form."""

HEAD = ("camera", "pixels (rows, columns)", "microlenses", "mapping", "dots found", "error [pitch]", "warnings")
"""Header of the cameras' rows at a prompt; the error is that of held-out dots, Eq. 8."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class CalibratedCamera(Shown):
    """One camera: its microlens array, its light-field decoder and its ray mapping."""

    name: str
    optics: Optics
    lattice: LensLattice
    decoder: LightFieldDecoder
    """Pupil point, coverage, gain and background of each pixel."""
    network: Network | None = None
    """Network of Eqs. 6-7, (x, y, z, u, v) -> (s, t) [mm], or its correction to `baseline`. None for DRT."""
    baseline: ThinLensModel | None = None
    """Thin lens that the network corrects, or None."""
    region_mm: np.ndarray | None = None
    """Lower and upper corner (x, y, z) of the box around the board's dots [mm], shape (2, 3). None for DRT."""
    report: LensArrayQuality | None = None
    """Figures of quality. A `CalibrationQuality` for a camera calibrated with a board."""
    warnings: tuple[Warning, ...] = ()
    """Doubts about the calibration."""
    dots: BoardDots | None = None
    """Measured dots and the labels that the mapping was fitted to."""
    test_errors: np.ndarray | None = None
    """Error of each held-out label [microlens pitch], shape (n,)."""
    standing: StandingLight | None = None
    """Light that stands still in the particle images, or None. It belongs to a run and is not stored here."""

    def card(self) -> Card:
        """Return what matters of the camera, for people."""
        return Card(f"Calibrated camera {self.name!r}", table=(HEAD, self.cells()))

    def cells(self) -> tuple[str, ...]:
        """Return the camera's row under `HEAD`."""
        parts = [("thin lens", self.baseline), ("network", self.network)]
        report, of_board = self.report, isinstance(self.report, CalibrationQuality)
        return (
            self.name,
            times(self.optics.sensor_shape),
            self.lattice.layout if report is None else f"{self.lattice.layout}, {report.lenses:,}",
            " + ".join(name for name, part in parts if part is not None) or "own",
            f"{report['dots_found']} of {report['dots_expected']}" if report is not None and of_board else "-",
            number(report["sigma_nor_test"], ".4f") if report is not None and of_board else "-",
            ", ".join(warning.code.name.lower() for warning in self.warnings) or "none",
        )

    def with_standing(self, standing: StandingLight) -> CalibratedCamera:
        """Return the camera with light that stands still in its images, and without gain in unusable pixels."""
        return replace(self, standing=standing)

    @cached_property
    def gain(self) -> np.ndarray:
        """White-image gain of every pixel, 0 where standing light makes it unusable, shape (rows, columns), float32."""
        return self.white_gain if self.standing is None else self.white_gain * ~self.standing.unusable

    @cached_property
    def white_gain(self) -> np.ndarray:
        """White-image gain of every pixel, shape (rows, columns), float32.

        The board's dots show which part of the white image's variance from pixel to pixel is pixel response. All of it
        counts as noise without a board, and with the Gaussian estimator, which does not measure that part.
        """
        share = 0.0 if self.dots is None else self.dots.response_share
        return self.decoder.shrunk_gain(0.0 if math.isnan(share) else share)

    @cached_property
    def microimages(self) -> Microimages:
        """Layout of the sensor's pixels by microimage, as the projector reads them."""
        return microimages_of(self.optics, self.lattice)

    def map(self, points_mm: np.ndarray, pupil_mm: np.ndarray) -> np.ndarray:
        """Trace rays to the microlens array (Eqs. 6-7).

        Parameters
        ----------
        points_mm : array_like, shape (n, 3)
            Object points (x, y, z) [mm].
        pupil_mm : array_like, shape (n, 2)
            Points where the rays cross the pupil of the main lens, (u, v) [mm].

        Returns
        -------
        ndarray, shape (n, 2), float64
            Positions where they meet the microlens array, (s, t) [mm].

        Raises
        ------
        ValueError
            If the shapes are not (n, 3) and (n, 2).
        """
        points, pupil = np.asarray(points_mm, float), np.asarray(pupil_mm, float)
        if points.ndim != 2 or points.shape[1] != 3 or pupil.shape != (len(points), 2):
            raise ValueError(
                f"points_mm, pupil_mm: expected shapes (n, 3) and (n, 2), got {points.shape} and {pupil.shape}."
            )
        rays = np.zeros((len(points), 2)) if self.baseline is None else self.baseline(points, pupil)
        return rays if self.network is None else rays + self.network(np.hstack([points, pupil]))

    def map_fan(self, points_mm: np.ndarray, pupil_mm: np.ndarray) -> np.ndarray:
        """Trace a fan of rays from every point, in single precision on the device in use.

        Parameters
        ----------
        points_mm : ndarray, shape (n, 3)
            Object points (x, y, z) [mm].
        pupil_mm : ndarray, shape (k, 2)
            Pupil points (u, v) [mm], the same for every object point.

        Returns
        -------
        ndarray, shape (n, k, 2), float32
            Positions where the rays meet the microlens array, (s, t) [mm].
        """
        if self.network is None:
            rays = np.repeat(points_mm, len(pupil_mm), axis=0), np.tile(pupil_mm, (len(points_mm), 1))
            return self.map(*rays).astype(np.float32).reshape(len(points_mm), len(pupil_mm), 2)
        arrays = self.network.to_arrays() | ({} if self.baseline is None else self.baseline.to_arrays())
        points, pupil = (np.ascontiguousarray(array, np.float32) for array in (points_mm, pupil_mm))
        return mapping.evaluate(arrays, points, pupil)

    def moved(self, rotation: np.ndarray, shift_mm: np.ndarray) -> CalibratedCamera:
        """Return the camera after a rigid movement.

        The new camera maps a point x as this camera maps ``rotation x + shift``. The result is exact: the first layer
        of the network and the pose of the thin lens take up the movement.

        Parameters
        ----------
        rotation : ndarray, shape (3, 3)
            Rotation matrix.
        shift_mm : ndarray, shape (3,)
            Shift along x, y, z [mm].
        """
        network, baseline = self.network, self.baseline
        if network is not None:
            matrix, shift = np.eye(5), np.append(shift_mm, [0.0, 0.0])
            matrix[:3, :3] = rotation
            network = network.of_affine_inputs(matrix, shift)
        if baseline is not None:
            baseline = replace(
                baseline, rotation=baseline.rotation @ rotation, offset_mm=rotation.T @ (baseline.offset_mm - shift_mm)
            )
        return replace(self, network=network, baseline=baseline)


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Shown):
    """The calibrated cameras of a rig. Made by `calibrate`, `load_calibration` or `thin_lens`."""

    cameras: dict[str, CalibratedCamera]
    """Cameras by name."""
    board: BoardErrors | None = None
    """Errors of the board that the calibration corrected. None without a board."""

    def card(self) -> Card:
        """Return what matters of the calibration, for people."""
        facts = []
        if self.board is not None:
            facts.append(("errors of the board", ", ".join(self.board.corrected) or "none found"))
        table = (HEAD, *(camera.cells() for camera in self.cameras.values()))
        return Card(f"Calibration of {count(len(self.cameras), 'camera')}", tuple(facts), table)

    def save(self, path: str | Path | io.BytesIO) -> None:
        """Write the calibration to an HDF5 file, and seal it. Overwrite an older file."""
        with h5py.File(path, "w") as file:
            file.attrs["schema_version"] = SCHEMA_VERSION
            file.attrs.update({"source": SOURCE, "history": history()})
            file.attrs["cameras"] = list(self.cameras)
            for name, camera in self.cameras.items():
                _write_camera(file.create_group(f"camera/{name}"), camera)
            if self.board is not None:
                _write_board(file.create_group("board"), self.board)
        hdf5.seal(path if isinstance(path, io.BytesIO) else Path(path))


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration that `Calibration.save` wrote.

    Parameters
    ----------
    path : str or Path
        The HDF5 file.

    Raises
    ------
    InputError
        If the file is missing, damaged or of another schema version.
    """
    path = Path(path)
    try:
        with hdf5.opened(path) as file:
            _require_schema(file, path)
            cameras = {
                name: CalibratedCamera(name=name, **stored.read_camera(file[f"camera/{name}"]))
                for name in stored.camera_names(file)
            }
            return Calibration(cameras, board=stored.read_board(file["board"]) if "board" in file else None)
    except DamagedFile as error:
        raise DamagedFile(path, error.reason, "Calibrate again") from None
    except FileNotFoundError:
        raise InputError(
            f"{path}: expected a calibration file, could not read it: there is no such file; calibrate again."
        ) from None


def _write_board(group: h5py.Group, board: BoardErrors) -> None:
    for name, value in vars(board).items():
        if isinstance(value, np.ndarray):
            group.create_dataset(name, data=value, **hdf5.options(value.shape, zipped=False))
    group.attrs["corrected"] = list(board.corrected)
    group.attrs["warnings"] = json.dumps([warning.to_json() for warning in board.warnings])


def _write_camera(group: h5py.Group, camera: CalibratedCamera) -> None:
    for name, value in vars(camera.optics).items():
        group.attrs[f"optics.{name}"] = value
    for name, value in vars(camera.lattice).items():
        group.attrs[f"lattice.{name}"] = value
    group.attrs["report"] = json.dumps({} if camera.report is None else camera.report.to_json())
    group.attrs["warnings"] = json.dumps([warning.to_json() for warning in camera.warnings])
    for name, value in (("region_mm", camera.region_mm), ("test_errors", camera.test_errors)):
        if value is not None:
            group.create_dataset(name, data=value, **hdf5.options(np.shape(value), zipped=False))
    for label, part in (("decoder", camera.decoder), ("dots", camera.dots)):
        if part is not None:
            for item in fields(part):
                value = getattr(part, item.name)
                if isinstance(value, np.ndarray):
                    group.create_dataset(f"{label}/{item.name}", data=value, **hdf5.options(value.shape))
                elif isinstance(value, int | float):
                    group.require_group(label).attrs[item.name] = value
    for label, model in (("network", camera.network), ("baseline", camera.baseline)):
        for name, value in ({} if model is None else model.to_arrays()).items():
            group.create_dataset(f"{label}/{name}", data=value, **hdf5.options(value.shape, zipped=False))


def _require_schema(file: h5py.File, path: Path) -> None:
    """Refuse a file of another schema."""
    version = np.ravel(file.attrs.get("schema_version", 0))
    if version.size != 1 or version.dtype.kind not in "iu" or version[0] != SCHEMA_VERSION:
        found = str(file.attrs.get("schema_version"))[:40]
        raise InputError(
            f"{path}: expected a calibration of schema version {SCHEMA_VERSION}, found {found}; calibrate again."
        )
