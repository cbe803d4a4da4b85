"""
Images as experiments make them
===============================

Every table of imperfections of the simulator, one pair of pictures each: a crop of the ideal raw image on the left, and
of the same camera, seed and particles with the imperfection on the right. Counts are on one scale within a pair. The
truth of each is written beside the images.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tifffile

from lfpiv.simulation.scene import Scene
from lfpiv.simulation.simulator import simulate

camera = {
    "name": "left",
    "focal_length_mm": 100.0,
    "magnification": -1.0,
    "f_number": 4.0,
    "microlens_pitch_mm": 0.1,
    "microlens_focal_length_mm": 0.8,
    "pixel_um": 5.5,
    "sensor_width_px": 320,
    "sensor_height_px": 320,
    "nominal_angle_deg": 35.0,
}
ideal = {
    "name": "imperfections",
    "seed": 2,
    "dt_s": 1e-4,
    "camera": [camera],
    "board": {"dots": (4, 4), "spacing_mm": 0.4, "dot_diameter_mm": 0.08, "planes_mm": (-0.4, 0.4)},
    "volume": {"size_mm": (1.6, 1.6, 1.0), "voxel_mm": 0.1},
    "particles": {"per_microlens": 0.15, "sigma_mm": 0.02},
    "flow": {"kind": "uniform", "displacement_mm": (0.05, 0.0, 0.0)},
    "quality": {"particle_rays": 16_384, "dot_rays": 32_768, "pixel_rays": 64},
}
streak = {
    "centre_mm": (-0.3, 0.0, -0.6),
    "normal": (0.3, 0.0, 1.0),
    "along": (0.1, 1.0, 0.0),
    "length_mm": 5.0,
    "width_mm": 0.08,
    "edges": ("sharp", "gaussian"),
    "counts": 2500.0,
}
sheet = {"profile": "gaussian", "thickness_mm": 0.5, "power": (1.0, 0.6)}
wall = {"kind": "half_space", "point_mm": (0.0, 0.0, 0.0), "normal": (-1.0, 0.0, 0.0)}
stray = {"lens_counts": 250.0, "ambient_counts": 100.0, "variation": 0.3, "length_mm": 0.4}
sensor = {"gain_sd": 0.02, "column_sd_counts": 40.0, "dark_counts": 20.0, "hot_share": 0.002, "dead_share": 0.002}
errors = {"stage_z_sd_mm": 0.1, "tilt_sd_deg": 2.0, "dot_sd_mm": 0.02, "missing_share": 0.15, "uneven_light": 0.6}

first, second = "particles/left/pair_0000_a.tif", "particles/left/pair_0000_b.tif"
board, white = "board/left/plane_01.tif", "white/left.tif"
tiles = [
    ("brightness: each particle, unlike in each camera", first, {"brightness": {"camera_log_sd": 1.0}}),
    ("brightness: sizes of the particles", first, {"brightness": {"size_log_sd": 0.5}}),
    ("sheet: thin, Gaussian, second pulse at 0.6", second, {"sheet": sheet}),
    ("noise: 400 electrons at full scale", first, {"noise": {"full_well_e": 400.0, "read_noise": 6.0}}),
    ("stray_light: through the lens and ambient", first, {"stray_light": stray}),
    ("surface: a streak on a wall", first, {"surface": streak}),
    ("wall: half of the volume is solid", first, {"wall": wall}),
    ("sensor: columns, hot and dead pixels", first, {"sensor": sensor}),
    ("array: dead lenses, in the white image", white, {"array": {"dead_share": 0.03}}),
    ("array: pitch that drifts by 3 %", white, {"array": {"pitch_drift": (0.03, 0.03)}}),
    ("array: cat's eye", white, {"array": {"cats_eye": 0.8}}),
    ("board.errors: stage, tilt, scatter, light", board, {"board": ideal["board"] | {"errors": errors}}),
    (
        "camera.moved: by 0.1 mm and 3 degrees",
        first,
        {"camera": [camera | {"moved": {"shift_mm": (0.1, 0, 0), "roll_deg": 3.0}}]},
    ),
    (
        "everything at once",
        first,
        {
            "brightness": {"camera_log_sd": 0.7},
            "sheet": sheet,
            "stray_light": stray,
            "surface": streak,
            "wall": wall,
            "sensor": sensor,
            "array": {"dead_share": 0.03},
        },
    ),
]

with tempfile.TemporaryDirectory() as folder:

    def recorded(name, tables):
        """Simulate the scene with some tables and return its images."""
        out = simulate(Scene.model_validate(ideal | tables), Path(folder) / name).parent
        return {path: tifffile.imread(out / path) for path in (first, second, board, white)}

    plain = recorded("ideal", {})
    found = [recorded(str(number), tables)[path] for number, (_, path, tables) in enumerate(tiles)]

# %%
# Dead lenses, cat's eye and drift are shown in white images. A cat's eye narrows the microimages towards the corners; a
# drifting pitch moves them off the lattice. The board has errors of its stage, its dots and its light.

figure, grid = plt.subplots(5, 6, figsize=(13, 12.2), layout="constrained")
crops = {first: np.s_[90:230, 90:230], second: np.s_[90:230, 90:230], board: np.s_[:, :], white: np.s_[-140:, -140:]}
for number, ((title, path, _), image) in enumerate(zip(tiles, found, strict=True)):
    left, right = grid.reshape(-1, 2)[number]
    crop = crops[path]
    top = np.percentile(np.maximum(plain[path], image)[crop], 99.5)
    for axis, shown in ((left, plain[path]), (right, image)):
        axis.imshow(shown[crop], cmap="gray", vmin=0, vmax=top)
        axis.set(xticks=[], yticks=[])
    left.set_title(title, loc="left", fontsize="small")
for axis in grid.ravel()[2 * len(tiles) :]:
    axis.remove()
plt.show()
