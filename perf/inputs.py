"""Inputs of the cases: a rig, its grid and particles, and its weights as explicit matrices for the peers.

The rig has two cameras of Table 2 at +-45 degrees. Each maps by a thin lens and a small network, as after a
calibration. The sensor is just large enough for the volume.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy import sparse

from lfpiv.calibration.camera import CalibratedCamera, Calibration
from lfpiv.calibration.network import Network
from lfpiv.calibration.thin_lens_model import thin_lens_model
from lfpiv.geometry.grid import Grid
from lfpiv.geometry.optics import LensLattice, Optics


class _Camera(CalibratedCamera):
    @cached_property
    def gain(self):
        return np.ones(self.optics.sensor_shape, np.float32)


POSES = (
    ("cam1", 44.2, 0.05, (0.031, -0.022)),
    ("cam2", -45.9, -0.08, (-0.02, 0.04)),
    ("cam3", 1.1, 0.03, (0.01, 0.013)),
)
"""Name, angle about y and roll of the array [degree], and offset of the array [mm]."""


def rig(
    sensor: tuple[int, int], bent_mm: float = 0.0, cameras: int = 2, angles_deg: Sequence[float] = ()
) -> Calibration:
    """Make calibrated cameras, at other angles about y if any are given.

    `bent_mm` scales the network's output. About a third of it is of second order.
    """
    optics = Optics(
        focal_length_mm=100.0, magnification=-1.0, f_number=4.0, microlens_pitch_mm=0.1, pixel_mm=0.0055,
        microlens_focal_length_mm=0.8, sensor_shape=sensor,
    )  # fmt: skip
    calibrated = {}
    angles = angles_deg or [angle for _, angle, _, _ in POSES[:cameras]]
    for (name, _, roll, origin), angle in zip(POSES, angles, strict=False):
        rng, turn = np.random.default_rng(abs(int(angle))), np.radians(roll)
        x, y = 0.1 * np.cos(turn), 0.1 * np.sin(turn)
        network = Network(
            weights=(rng.normal(0, 0.3, (5, 20)), rng.normal(0, 0.3, (20, 2))),
            biases=(rng.normal(0, 0.5, 20), np.zeros(2)),
            input_centre=np.zeros(5),
            input_scale=np.array([7.0, 7.0, 7.0, optics.pupil_radius_mm, optics.pupil_radius_mm]),
            output_centre=np.zeros(2),
            output_scale=np.full(2, max(bent_mm, 1e-3)),
        )
        calibrated[name] = _Camera(
            name=name,
            optics=optics,
            lattice=LensLattice(origin_mm=origin, basis_mm=((x, -y), (y, x))),
            decoder=None,
            network=network,
            baseline=thin_lens_model(optics, angle),
        )
    return Calibration(calibrated)


def grid(scale: dict) -> Grid:
    return Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.1 * scale["voxels"],) * 3, voxel_mm=0.1)


def nonzeros(weights) -> int:
    """Count the weights above zero."""
    return sum(int(weights.projector(name).count_lit().sum(dtype=np.int64)) for name in weights.cameras)


def explicit(weights) -> dict[str, tuple[sparse.csr_array, sparse.csr_array]]:
    """Return each camera's weights as matrices (voxel, pixel) and (pixel, voxel), by rows: SciPy's fastest form."""
    matrices = {}
    for name in weights.cameras:
        blocks = weights.projector(name).blocks
        parts = [_rows_of(blocks, a, min(a + 2048, len(blocks.scale))) for a in range(0, len(blocks.scale), 2048)]
        matrix = sparse.vstack(parts, format="csr")
        matrices[name] = matrix, matrix.T.tocsr()
    return matrices


def _rows_of(blocks, first: int, last: int) -> sparse.csr_array:
    """Return the rows (voxel, pixel) of some voxels."""
    rays, profiles = blocks.microimages, blocks.form == "profiles"
    part = slice(blocks.first_block[first], blocks.first_block[last])
    height, width = blocks.height[part].astype(np.int64), blocks.width[part].astype(np.int64)
    size = width + height if profiles else width * height
    start = np.cumsum(size) - size + blocks.first_value[first]  # blocks lie one after the other
    block = np.repeat(np.arange(len(height)), width * height)
    row, column = np.divmod(
        np.arange(len(block)) - np.repeat(np.cumsum(width * height) - width * height, width * height), width[block]
    )
    if profiles:
        level = blocks.value[start[block] + column] * blocks.value[start[block] + width[block] + row].astype(np.float32)
    else:
        level = blocks.value[start[block] + width[block] * row + column].astype(np.float32)
    ray = blocks.ray[part][block] + row * rays.edge + column
    voxel = np.repeat(np.arange(last - first), np.diff(blocks.first_block[first : last + 1]))[block]
    lit = (level > 0) & (rays.share[ray] > 0)
    data = (level * blocks.scale[first + voxel] * rays.share[ray])[lit]
    index = voxel[lit], rays.pixel[ray[lit]]
    return sparse.csr_array((data, index), shape=(last - first, rays.sensor_shape[0] * rays.sensor_shape[1]))
