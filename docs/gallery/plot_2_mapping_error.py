"""
Calibration, and where its mapping is wrong
===========================================

A calibration maps object points and pupil points to the microlens array. On a simulated rig the true rays are known, so
its error can be drawn over the volume. Beside it: direct ray tracing through an ideal lens at angles that are a degree
off, as in the paper, on top of what the nominal ones are off.
"""

import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import lfpiv
from lfpiv.cli import demo
from lfpiv.simulation.scene import true_mapping

folder = Path("lfpiv-demo")
if not (folder / "report.html").exists():
    demo.run(folder)

experiment = lfpiv.open_experiment(folder / "experiment" / "experiment.toml")
calibration = lfpiv.load_calibration(folder / "calibration.h5")  # or lfpiv.calibrate(experiment): half a minute
ray_tracing = lfpiv.thin_lens(experiment, angle_error_deg=1.0)
for name, camera in calibration.cameras.items():
    print(f"{name}: {camera.report.dots_found} dots, sigma_nor {camera.report.sigma_nor_test:.4f} pitch")

# %%
# The error is the distance, on the array, between the mapped and the true ray, mean over the pupil, in microlens
# pitches.

truth = json.loads((folder / "experiment" / "truth" / "spec.json").read_text())
true_rays = {camera["name"]: true_mapping(camera) for camera in truth["camera"]}
grid = experiment.grid
x, z = np.meshgrid(grid.axis_mm(2), grid.axis_mm(0))
points = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
radius = experiment.cameras[0].optics.pupil_radius_mm
pupil = radius * np.array([(0, 0), (0.8, 0), (-0.8, 0), (0, 0.8), (0, -0.8), (0.5, 0.5), (-0.5, -0.5)])


def error_pitch(camera):
    """Mean error over the pupil at each point of the slice y = 0."""
    rays = np.repeat(points, len(pupil), axis=0), np.tile(pupil, (len(points), 1))
    miss = camera.map(*rays) - true_rays[camera.name](*rays)
    return np.linalg.norm(miss, axis=1).reshape(*x.shape, len(pupil)).mean(-1) / camera.optics.microlens_pitch_mm


figure, axes = plt.subplots(2, 2, figsize=(9, 5.4), layout="constrained", sharex=True, sharey=True)
for line, (title, mapping) in zip(axes, {"network": calibration, "ray tracing": ray_tracing}.items(), strict=True):
    for axis, camera in zip(line, mapping.cameras.values(), strict=True):
        error = error_pitch(camera)
        shown = axis.pcolormesh(grid.axis_mm(2), grid.axis_mm(0), error, cmap="viridis")
        axis.set(title=f"{title}, {camera.name}: mean {error.mean():.4f}", aspect="equal")
        figure.colorbar(shown, ax=axis, label="error [pitch]")
for axis in axes[-1]:
    axis.set_xlabel("x [mm]")
for axis in axes[:, 0]:
    axis.set_ylabel("z [mm]")
plt.show()

# %%
# The same on the board: outlines of the dots' light as each mapping predicts it, over a raw image of the board away
# from focus. Good outlines hold the dots, in all planes; the others miss them, the more so the farther from the middle.

plane = 0
image = experiment.board_image("left", plane)
dots = np.array([(i - 3, j - 3) for j in range(7) for i in range(7)]) * experiment.board.spacing_mm
dots = np.column_stack([dots, np.full(len(dots), experiment.board.planes_mm[plane])])
angle = np.linspace(0, 2 * np.pi, 40)
rim = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
optics = experiment.cameras[0].optics

figure, axes = plt.subplots(1, 2, figsize=(9, 4.3), layout="constrained", sharex=True, sharey=True)
for axis, (title, mapping) in zip(axes, {"network": calibration, "ray tracing": ray_tracing}.items(), strict=True):
    axis.imshow(np.sqrt(np.clip(image - np.median(image), 0, None)), cmap="gray")
    for dot in dots:
        array = mapping.cameras["left"].map(np.tile(dot, (len(rim), 1)), rim)
        outline = optics.sensor_px(array + (array - rim) * optics.sensor_per_pupil)  # Eq. 9
        axis.plot(*outline.T, color="tab:orange", linewidth=0.9)
    axis.set(title=title, xlabel="column [px]", xlim=(330, 740), ylim=(480, 60))
axes[0].set_ylabel("row [px]")
plt.show()
