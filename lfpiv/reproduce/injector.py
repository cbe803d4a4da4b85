"""The paper's experimental rig (Table 2, section 5), simulated: two misaligned cameras about 40 degrees apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lfpiv.progress import Progress
from lfpiv.reproduce.rigs import VOXEL_MM, Rig, calibrated_rig, table2_scene
from lfpiv.simulation.scene import Scene

SENSOR_PX = {"small": (1728, 2208), "paper": (2208, 2752)}
"""Rows and columns. At "small" the sensor is just large enough for the smaller volume."""
PLANES_MM = tuple(np.arange(-6.0, 6.5, 1.0).tolist())
"""Depths of the board, 1 mm apart."""
MISALIGNMENTS = (
    {
        "true_yaw_deg": 20.6,
        "true_pitch_deg": 0.3,
        "true_roll_deg": -0.2,
        "true_offset_mm": (0.06, -0.04, 0.08),
        "true_array_roll_deg": 0.06,
        "true_array_offset_mm": (0.021, -0.014),
    },
    {
        "true_yaw_deg": -19.3,
        "true_pitch_deg": -0.2,
        "true_roll_deg": 0.3,
        "true_offset_mm": (-0.05, 0.07, -0.06),
        "true_array_roll_deg": -0.05,
        "true_array_offset_mm": (-0.033, 0.027),
    },
)
"""True poses of the two cameras and of their microlens arrays. The calibration does not know them."""


def experimental_scene(scale: str, seed: int) -> Scene:
    """Return Table 2's experimental column: 4.54 um pixels and two cameras at 20 degrees to either side.

    The cameras deviate from their nominal poses, and their images have shot and read-out noise. A board of 7 x 7 dots
    0.5 mm apart is recorded at every millimetre from -6 to 6 mm.
    """
    rows, columns = SENSOR_PX[scale]
    sensor = {"pixel_um": 4.54, "sensor_width_px": columns, "sensor_height_px": rows}
    faults = {"vignetting": 0.1, "lens_gain_sd": 0.01}
    cameras = (
        {**sensor, "nominal_angle_deg": angle, **faults, **misalignment}
        for angle, misalignment in zip((20.0, -20.0), MISALIGNMENTS, strict=True)
    )
    return table2_scene(
        "table 2, experiment",
        seed,
        cameras,
        board={"dots": (7, 7), "spacing_mm": 0.5, "planes_mm": PLANES_MM},
        dt_s=1.0,
        volume={"size_mm": (3.0, 3.0, 12.0), "voxel_mm": VOXEL_MM},
        particles={"count": 8},
    )


def experimental_rig(folder: Path, scale: str, seed: int, progress: Progress) -> Rig:
    """Return the calibrated rig of `experimental_scene`, see `calibrated_rig`."""
    return calibrated_rig(experimental_scene(scale, seed), folder, progress)
