"""Compare a volume with what the calibrated cameras see, and with the region in which they are calibrated.

A volume that one camera does not see at all is refused. Parts that too few cameras see, or that lie outside the
calibrated region, become warnings.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lfpiv.calibration.camera import CalibratedCamera, Calibration
from lfpiv.errors import InputError
from lfpiv.geometry.grid import Grid
from lfpiv.warn import Code, Warning

log = logging.getLogger(__name__)

SAMPLES = 8
"""Voxels sampled along each axis of a volume."""
PUPIL_PART = 0.9
"""Distance of the sampled rays from the pupil's centre [pupil radius]."""
LEAST_SEEN = 0.5
"""Part of the volume seen by a camera below which a warning is due."""
SEEN_SHARE = 0.1
"""Least sum of a voxel's weights in a camera that sees it, relative to the largest sum in the volume."""
FITTED = 0.01
"""Tolerance at the edge of the calibrated region [voxel].

A volume may end at the stated dots, and the fit of the board moves dots by micrometres.
"""
LEAST_UNPAIRED = 0.01
"""Part of the volume seen by fewer than two cameras above which a warning is due."""


def require_seen(path: Path, calibration: Calibration, grid: Grid) -> None:
    """Refuse a volume that a calibrated camera does not see. Warn where a camera sees less than half of it.

    Raises
    ------
    InputError
        Names `path`, the experiment file, and the camera.
    """
    for camera in calibration.cameras.values():
        share = seen_share(camera, grid)
        if share == 0:
            raise InputError(
                f"{path}: volume: expected a volume in the view of every camera, found one around "
                f"{grid.centre_text()} that camera {camera.name!r}, as calibrated, does not see. Check "
                "volume.centre_mm and size_mm against the board's extent."
            )
    for warning in sight_warnings(calibration, grid):
        log.warning("%s", warning.sentence)


def sight_warnings(calibration: Calibration, grid: Grid) -> list[Warning]:
    """Warn of each camera that sees less than half of a volume, and of parts that fewer than two cameras see."""
    sampled = {camera.name: _sees(camera, grid) for camera in calibration.cameras.values()}
    warnings = [
        Warning(code=Code.OUTSIDE_SIGHT, subject=name, figures={"share": float(seen.mean())})
        for name, seen in sampled.items()
        if seen.mean() < LEAST_SEEN
    ]
    if len(sampled) > 1:
        warnings += _seen_by_one(np.sum(list(sampled.values()), 0), _sampled_axes(grid))
    return warnings


def seen_share(camera: CalibratedCamera, grid: Grid) -> float:
    """Return the part of a volume's voxels that a camera sees, from a sample of the voxels.

    A camera sees a voxel if some ray from it through the pupil meets the sensor.
    """
    return float(_sees(camera, grid).mean())


def _sampled_axes(grid: Grid) -> list[np.ndarray]:
    """Return positions of some voxels along z, y, x [mm], the outermost voxels included."""
    return [
        grid.axis_mm(axis)[np.unique(np.linspace(0, n - 1, SAMPLES).round().astype(int))]
        for axis, n in enumerate(grid.shape)
    ]


def _sees(camera: CalibratedCamera, grid: Grid) -> np.ndarray:
    """Return whether a camera sees each of the sampled voxels, shape (z, y, x)."""
    z, y, x = np.meshgrid(*_sampled_axes(grid), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    half = np.array(camera.optics.sensor_shape[::-1]) * camera.optics.pixel_mm / 2
    seen = np.zeros(len(points), bool)
    for u, v in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        pupil = np.tile(PUPIL_PART * camera.optics.pupil_radius_mm * np.array([u, v], float), (len(points), 1))
        seen |= (np.abs(camera.map(points, pupil)) <= half).all(1)
    return seen.reshape(x.shape)


def warn_seen_by_one(camera_counts: np.ndarray, grid: Grid, cameras: int) -> None:
    """Log a warning where only one of several cameras sees voxels. `camera_counts` has the shape (z, y, x)."""
    if cameras > 1:
        for warning in _seen_by_one(camera_counts, grid.axes_mm):
            log.warning("%s", warning.sentence)


def _seen_by_one(camera_counts: np.ndarray, axes_mm: Sequence[np.ndarray]) -> list[Warning]:
    """Warn of the part of a volume that fewer than two cameras see. `axes_mm` are the positions along z, y, x."""
    seen = camera_counts >= 2
    if 1 - seen.mean() < LEAST_UNPAIRED:
        return []
    where = "none of it is seen by two"
    if seen.any():
        reach = []
        for axis, name in ((2, "x"), (1, "y"), (0, "z")):
            inside = axes_mm[axis][seen.any(tuple({0, 1, 2} - {axis}))]
            reach.append(f"{name} {inside[0]:.3g} to {inside[-1]:.3g}")
        where = f"two see no more than {', '.join(reach)} mm"
    return [Warning(code=Code.SEEN_BY_ONE, figures={"share": float(1 - seen.mean()), "where": where})]


def warn_outside(calibration: Calibration, grid: Grid) -> None:
    """Log a warning for every camera whose calibrated region does not hold all voxels of a grid."""
    for warning in outside_warnings(calibration, grid):
        log.warning("%s", warning.sentence)


def outside_warnings(calibration: Calibration, grid: Grid) -> list[Warning]:
    """Warn of every camera whose calibrated region does not hold all voxels of a grid.

    The region is the box around the board's dots, half a voxel and `FITTED` wider on each side.
    """
    warnings = []
    for camera in calibration.cameras.values():
        if camera.region_mm is None:
            continue
        inside, distance = 1.0, 0.0
        for axis in range(3):
            centres = grid.axis_mm(2 - axis)
            low, high = camera.region_mm[:, axis]
            over = np.maximum(np.maximum(low - centres, centres - high) - (0.5 + FITTED) * grid.voxel_mm, 0.0)
            inside *= float((over == 0).mean())
            distance = float(np.hypot(distance, over.max()))
        if inside == 1:
            continue
        low, high = camera.region_mm
        box = ", ".join(f"{name} {a:g} to {b:g}" for name, a, b in zip("xyz", low, high, strict=True))
        advice = "shrink the volume or use a larger board or more planes"
        if camera.baseline is None:
            advice += ', or set network.baseline = "thin_lens": a network without a thin lens extrapolates badly'
        figures = {"share": 1 - inside, "region": box, "distance_mm": distance, "advice": advice}
        warnings.append(Warning(code=Code.OUTSIDE_CALIBRATION, subject=camera.name, figures=figures))
    return warnings
