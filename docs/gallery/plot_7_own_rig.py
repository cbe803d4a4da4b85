"""
Simulate a rig of one's own
===========================

Before a rig is bought or built: describe it, simulate its board, calibrate it from the images and see how well it would
do. Here one small camera looks at 30 degrees through a glass window of 5 mm, which no ideal lens describes. The same
scene as a TOML file goes to ``lfpiv simulate``.
"""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import lfpiv
from lfpiv.simulation.scene import Scene, true_mapping
from lfpiv.simulation.simulator import simulate

camera = {
    "name": "left",
    "focal_length_mm": 100.0,
    "magnification": -1.0,
    "f_number": 4.0,
    "microlens_pitch_mm": 0.1,
    "microlens_focal_length_mm": 0.8,
    "pixel_um": 8.0,
    "sensor_width_px": 500,
    "sensor_height_px": 500,
    "nominal_angle_deg": 30.0,
    "true_yaw_deg": 31.2,
    "true_array_roll_deg": 0.1,
}
window = {"point_mm": (0.0, 0.0, 30.0), "normal": (0.0, 0.0, 1.0), "thickness_mm": 5.0, "index": 1.5}
scene = Scene.model_validate(
    {
        "name": "my rig",
        "dt_s": 1e-4,
        "camera": [camera],
        "window": [window],
        "board": {"dots": (6, 6), "spacing_mm": 0.5, "dot_diameter_mm": 0.1, "planes_mm": (-1.0, -0.5, 0.0, 0.5, 1.0)},
        "volume": {"size_mm": (2.5, 2.5, 1.5), "voxel_mm": 0.1},
        "particles": {"per_microlens": 0.3},
        "flow": {"kind": "uniform", "displacement_mm": (0.1, 0.0, 0.0)},
    }
)
folder = tempfile.TemporaryDirectory()
experiment = lfpiv.open_experiment(simulate(scene, Path(folder.name) / "rig"))

# %%
# Calibrate with a network on a fitted thin lens (the default), and look at both.

calibration = lfpiv.calibrate(experiment)
seen = calibration.cameras["left"]
print(f"{seen.report.dots_found} of {seen.report.dots_expected} dots")
print(f"sigma_nor: {seen.report.sigma_nor_test:.4f} pitch")

rng = np.random.default_rng(0)
points = rng.uniform(-1, 1, (4000, 3)) * (1.25, 1.25, 1.0)
pupil = seen.optics.pupil_radius_mm * rng.uniform(-0.7, 0.7, (len(points), 2))
true = true_mapping(scene.camera[0])(points, pupil)
mappings = {
    "ideal lens at the stated angle": lfpiv.thin_lens(experiment).cameras["left"].map(points, pupil),
    "fitted lens": seen.baseline(points, pupil),
    "fitted lens and network": seen.map(points, pupil),
}
errors = {name: np.linalg.norm(rays - true, axis=1) / seen.optics.microlens_pitch_mm for name, rays in mappings.items()}

figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
axes[0].imshow(np.sqrt(experiment.board_image("left", 3)), cmap="gray")
axes[0].set(title="the board through the window", xlabel="column [px]", ylabel="row [px]")
bins = np.geomspace(1e-4, 30, 80)
for name, error in errors.items():
    axes[1].hist(error, bins, histtype="step", linewidth=1.6, label=f"{name}: mean {error.mean():.4f}")
axes[1].set(xscale="log", xlabel="error [microlens pitch]", ylabel="rays")
axes[1].legend(fontsize="small")
plt.show()
folder.cleanup()
