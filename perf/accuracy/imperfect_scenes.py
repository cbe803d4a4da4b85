"""Scenes of the case `imperfections`: a rig of its own that differs with the seed, and one scene for each row."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lfpiv.settings.experiment import ExperimentTable
from lfpiv.settings.rig import CameraTable
from lfpiv.simulation.scene import Scene

SIZE_MM = {"small": (4.6, 4.4, 2.4), "paper": (6.0, 5.6, 2.6)}
"""Size of the volume (x, y, z)."""
SENSOR_PX = {"small": (700, 840), "paper": (980, 1080)}
"""Rows and columns. They cover the volume and the board at 42 degrees."""
DOTS = {"small": (8, 8), "paper": (10, 10)}
"""Dots of the board. They cover the volume's face."""
PAIRS = {"small": 2, "paper": 3}
"""Pairs that are measured."""
SERIES = {"small": 8, "paper": 20}
"""Pairs that are recorded where what stands still is to be found in the series."""
VOXEL_MM = 0.1
PPM = 0.4
"""Particles per microlens of the volume's face."""
COUNTS = 300.0
"""Level of a pixel lit by one particle [count]."""
OPTICS = {
    "focal_length_mm": 85.0,
    "magnification": -0.9,
    "f_number": 4.2,
    "microlens_pitch_mm": 0.1,
    "microlens_focal_length_mm": 0.8,
    "pixel_um": 6.5,
}
READ_E = 2.0
"""Read-out noise of dim images [electron]; they have as many electrons per count as the others."""
PER_COUNT = 10_000 / 4095
"""Electrons per count."""
FACE_COUNTS = 775.0
"""Counts that the brightest thousandth of the ideal row's pixels exceed; dim rows are scaled from it."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row: what differs from the ideal images."""

    label: str
    """Name in tables."""
    tables: Mapping[str, Any] = field(default_factory=dict)
    """Tables of the scene that differ."""
    second: Mapping[str, Any] = field(default_factory=dict)
    """Keys of the second camera that differ."""
    series: bool = False
    """Whether a series of pairs is recorded."""
    keys: str = ""
    """Lines at the end of the experiment file."""
    needs: str = ""
    """Key of the experiment file without which the row is left out: of ``[[camera]]`` or ``[volume]``."""
    single: bool = True
    """Whether the row breaks one assumption only."""


def ideal_tables(scale: str, seed: int) -> dict[str, Any]:
    """Return the tables of the ideal row. Angles, poses and flow are drawn from the seed."""
    rng = np.random.default_rng([seed, 91])
    rows, columns = SENSOR_PX[scale]
    size = SIZE_MM[scale]
    cameras = []
    for name, side in (("upstream", 1), ("downstream", -1)):
        nominal = side * round(float(rng.uniform(30, 40)))
        cameras.append(
            OPTICS
            | {
                "name": name,
                "sensor_width_px": columns,
                "sensor_height_px": rows,
                "nominal_angle_deg": nominal,
                "true_yaw_deg": nominal + float(rng.uniform(-1, 1)),
                "true_pitch_deg": float(rng.uniform(-0.4, 0.4)),
                "true_roll_deg": float(rng.uniform(-0.4, 0.4)),
                "true_offset_mm": tuple(rng.uniform(-0.06, 0.06, 3).tolist()),
                "true_array_roll_deg": float(rng.uniform(-0.2, 0.2)),
                "true_array_offset_mm": tuple(rng.uniform(-0.05, 0.05, 2).tolist()),
                "vignetting": 0.1,
                "lens_gain_sd": 0.01,
            }
        )
    depth = size[2] / 2 + 0.3
    return {
        "name": "imperfections",
        "seed": seed,
        "dt_s": 1e-4,
        "camera": cameras,
        "board": {
            "dots": DOTS[scale],
            "spacing_mm": round((size[0] + 0.2) / (DOTS[scale][0] - 1), 2),
            "dot_diameter_mm": 0.1,
            "planes_mm": tuple(np.round(np.linspace(-depth, depth, 5), 2).tolist()),
        },
        "volume": {"size_mm": size, "voxel_mm": VOXEL_MM},
        "particles": {"per_microlens": PPM, "sigma_mm": 0.02},
        "flow": {
            "kind": "swirl",
            "axis": "y",
            "peak_mm": float(rng.choice([-1, 1]) * rng.uniform(0.14, 0.18)),
            "core_mm": 1.9,
            "axial_mm": float(rng.choice([-1, 1]) * rng.uniform(0.1, 0.14)),
            "axial_core_mm": 2.2,
            "centre_mm": (*rng.uniform(-0.6, 0.6, 2).tolist(), float(rng.uniform(-0.3, 0.3))),
        },
        "exposure": {"particle_counts": COUNTS},
        "quality": {"particle_rays": 16_384, "dot_rays": 65_536, "pixel_rays": 64},
    }


def rows(scale: str) -> dict[str, Row]:
    """Return the rows of the table by key, the ideal one first."""
    size = SIZE_MM[scale]
    thick = size[2]
    around = {"per_microlens": PPM, "sigma_mm": 0.02}
    bright, sizes = {"camera_log_sd": 1.0}, {"camera_log_sd": 1.0, "size_log_sd": 0.35}
    sheet30 = {"profile": "top_hat", "thickness_mm": 1.3 * thick}
    sheet = {"profile": "gaussian", "thickness_mm": (1.33 * thick, 1.25 * thick), "power": (1.0, 0.6)}
    streak = {
        "centre_mm": (-0.2 * size[0], 0.0, -0.6 * thick),
        "normal": (0.25, 0.0, 1.0),
        "along": (0.15, 1.0, 0.0),
        "length_mm": 4 * size[1],
        "width_mm": 0.08,
        "edges": ("sharp", "gaussian"),
        "counts": 6000.0,
    }
    laser = {"power": (1.0, 0.9), "power_sd": 0.02}
    stray = other_light(streak, COUNTS) | {"sheet": laser}
    wall = {"kind": "half_space", "point_mm": (0.0, 0.0, 0.0), "normal": (-1.0, 0.0, 0.0)}
    solid = '[[volume.solid]]\nkind = "half_space"\npoint_mm = [0.0, 0.0, 0.0]\nnormal = [-1.0, 0.0, 0.0]\n'
    errors = {
        "stage_z_sd_mm": 0.01,
        "stage_xy_sd_mm": 0.005,
        "tilt_sd_deg": 0.2,
        "dot_sd_mm": 0.003,
        "missing_share": 0.04,
        "uneven_light": 0.3,
    }
    array = {"dead_share": 0.004, "pitch_drift": (0.001, -0.0007), "cats_eye": 0.15}
    moved = {"moved": {"shift_mm": (0.03, 0.04, 0.0)}}
    beyond = {"sheet": sheet30, "particles": around | {"margin_mm": (0.5, 0.5, 0.15 * thick)}}
    gaussian = {"sheet": sheet, "particles": around | {"margin_mm": (0.5, 0.5, 0.5 * thick)}}
    everything = {
        "brightness": {"camera_log_sd": 0.7, "size_log_sd": 0.25},
        **gaussian,
        "array": array,
        "board": {"errors": errors},
        **(dimmed := dim(100.0)),
        **other_light(streak, dimmed["exposure"]["particle_counts"]),
    }
    return {
        "ideal": Row(label="ideal images"),
        "bright05": Row(
            label="brightness differs by camera, log-normal 0.5", tables={"brightness": {"camera_log_sd": 0.5}}
        ),
        "bright10": Row(label="the same, 1.0", tables={"brightness": bright}),
        "sizes": Row(label="the same, 1.0, and sizes of the particles 0.7", tables={"brightness": sizes}),
        "sheet30": Row(label="sheet 30 % thicker than the volume", tables=beyond),
        "sheet": Row(label="Gaussian sheet wider than the volume, pulses 1 and 0.6", tables=gaussian),
        "streak": Row(label="saturated streak on a wall", tables={"surface": streak, "sheet": laser}),
        "stray": Row(label="stray light, streak, fixed pattern, hot pixels", tables=stray),
        "series": Row(label="the same in a series of pairs", tables=stray, series=True),
        "background": Row(
            label="the same with background images",
            tables=stray | {"background": {"averaged": 10}},
            needs="background_image",
        ),
        "e35": Row(label="35 electrons at the peak", tables=dim(35.0)),
        "e20": Row(label="20 electrons at the peak", tables=dim(20.0)),
        "half": Row(label="half of the volume is solid", tables={"wall": wall}),
        "masked": Row(label="the same, stated in the experiment", tables={"wall": wall}, keys=solid, needs="solid"),
        "board": Row(label="imperfect board", tables={"board": {"errors": errors}}),
        "array": Row(label="dead lenses, drifting pitch, cat's eye", tables={"array": array}),
        "moved": Row(label="a camera moved by 0.05 mm", second=moved),
        "all": Row(label="everything together", tables=everything, second=moved, single=False),
        "all_series": Row(
            label="everything together in a series", tables=everything, second=moved, series=True, single=False
        ),
    }


def other_light(streak: Mapping[str, Any], counts: float) -> dict[str, Any]:
    """Return stray light, a streak and a sensor's pattern, in proportion to the light of the particles."""
    return {
        "stray_light": {"lens_counts": 0.1 * counts, "ambient_counts": 0.02 * counts, "variation": 0.3},
        "surface": dict(streak) | {"counts": 4.0 * counts},
        "sensor": {
            "gain_sd": 0.01,
            "column_sd_counts": 0.013 * counts,
            "dark_counts": 0.01 * counts,
            "dark_log_sd": 0.3,
            "hot_share": 1.5e-4,
        },
    }


def dim(electrons: float) -> dict[str, Any]:
    """Return the tables of particle images with so many electrons in the brightest thousandth of the pixels."""
    return {
        "exposure": {"particle_counts": COUNTS * electrons / PER_COUNT / FACE_COUNTS},
        "noise": {"read_noise": READ_E / PER_COUNT},
    }


def supported(row: Row) -> bool:
    """Return whether the experiment file has the key that a row needs."""
    volume = ExperimentTable.model_fields["volume"].annotation
    return not row.needs or row.needs in CameraTable.model_fields or row.needs in volume.model_fields


def scene(row: Row, scale: str, seed: int) -> Scene:
    """Return the scene of a row."""
    tables = ideal_tables(scale, seed)
    for name, table in row.tables.items():
        mapping = isinstance(table, Mapping) and name in tables
        tables[name] = tables[name] | table if mapping else table
    tables["camera"][1] = tables["camera"][1] | row.second
    tables["particles"] = tables["particles"] | {"pairs": SERIES[scale] if row.series else PAIRS[scale]}
    return Scene.model_validate(tables)
