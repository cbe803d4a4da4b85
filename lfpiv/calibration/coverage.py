"""Tell how much of a volume the calibrated cameras see. Refuse a volume that a camera does not see."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lfpiv.calibration.camera import CalibratedCamera, Calibration
from lfpiv.errors import InputError
from lfpiv.geometry.grid import Grid

log = logging.getLogger(__name__)


SAMPLES = 8
"""Voxels along each axis that tell how much of a volume a camera sees."""


FEW = 0.5
"""Part of the volume below which a camera sees so little of it that a warning is due."""


SEEN_SHARE = 0.1
"""Least sum of a voxel's weights in a camera that sees it, as a share of the largest one in the volume: a tenth of the
pupil."""


LEAST_ALONE = 0.01
"""Part of the volume, seen by fewer than two cameras, above which a warning is due."""


def require_seen(path: Path, calibration: Calibration, grid: Grid) -> None:
    """Refuse a volume of which a calibrated camera sees nothing; warn where it sees less than half.

    Raises
    ------
    InputError
        Names the camera.
    """
    for camera in calibration.cameras.values():
        share = seen_share(camera, grid)
        if share == 0:
            raise InputError(
                f"{path}: volume: expected a volume in the view of every camera, found one around "
                f"{grid.centre_text()} of which camera {camera.name!r} sees nothing by its calibration. Check "
                "volume.centre_mm and size_mm against the board's extent."
            )
    for text in sight_warnings(calibration, grid):
        log.warning("%s", text)


def sight_warnings(calibration: Calibration, grid: Grid) -> list[str]:
    """Say of every calibrated camera that sees less than half of a volume how much it sees, and what two do not see."""
    sampled = {camera.name: _sees(camera, grid) for camera in calibration.cameras.values()}
    texts = [
        f"{name}: sees only about {100 * seen.mean():.0f} % of the volume"
        for name, seen in sampled.items()
        if seen.mean() < FEW
    ]
    if len(sampled) > 1:
        texts += _alone(np.sum(list(sampled.values()), 0), _sampled_axes(grid))
    return texts


def seen_share(camera: CalibratedCamera, grid: Grid) -> float:
    """Part of a volume's voxels of which some ray through the pupil meets a camera's sensor, by a sample of them."""
    return float(_sees(camera, grid).mean())


def _sampled_axes(grid: Grid) -> list[np.ndarray]:
    """Places of some planes of voxels along z, y, x [mm], the outer ones among them."""
    return [
        grid.axis_mm(axis)[np.unique(np.linspace(0, n - 1, SAMPLES).round().astype(int))]
        for axis, n in enumerate(grid.shape)
    ]


def _sees(camera: CalibratedCamera, grid: Grid) -> np.ndarray:
    """Whether some ray from a voxel through the pupil meets the sensor, for voxels on all of the sampled planes."""
    z, y, x = np.meshgrid(*_sampled_axes(grid), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    half = np.array(camera.optics.sensor_shape[::-1]) * camera.optics.pixel_mm / 2
    seen = np.zeros(len(points), bool)
    for u, v in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        pupil = np.tile(0.9 * camera.optics.pupil_radius_mm * np.array([u, v], float), (len(points), 1))
        seen |= (np.abs(camera.map(points, pupil)) <= half).all(1)
    return seen.reshape(x.shape)


def warn_alone(views: np.ndarray, grid: Grid, cameras: int) -> None:
    """Log a warning where voxels of a grid are seen by but one of several cameras; `views` counts them, (z, y, x)."""
    if cameras > 1:
        for text in _alone(views, [grid.axis_mm(axis) for axis in range(3)]):
            log.warning("%s", text)


def _alone(views: np.ndarray, axes_mm: Sequence[np.ndarray]) -> list[str]:
    """Say how much of a volume fewer than two cameras see, and where; `views` counts them at places along z, y, x."""
    seen = views >= 2
    if 1 - seen.mean() < LEAST_ALONE:
        return []
    where = "none of it is seen by two"
    if seen.any():
        reach = []
        for axis, name in ((2, "x"), (1, "y"), (0, "z")):
            inside = axes_mm[axis][seen.any(tuple({0, 1, 2} - {axis}))]
            reach.append(f"{name} {inside[0]:.3g} to {inside[-1]:.3g}")
        where = f"two see no more than {', '.join(reach)} mm"
    share = 100 * (1 - seen.mean())
    return [
        f"about {share:.0f} % of the volume is seen by fewer than two cameras; vectors there are not valid: {where}"
    ]
