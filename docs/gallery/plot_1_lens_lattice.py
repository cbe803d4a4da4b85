"""
Microlens array of a white image
================================

The white image shows every microlens as a round spot, the image of the main lens's pupil. `lfpiv.find_lens_array` puts
a lattice through the spots' centres. In a good fit every cross sits in the middle of its spot, in the corners of the
sensor as in the middle.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import lfpiv
from lfpiv.cli import demo

folder = Path("lfpiv-demo")
if not (folder / "report.html").exists():
    demo.run(folder)

experiment = lfpiv.open_experiment(folder / "experiment" / "experiment.toml")
camera, white = experiment.cameras[0], experiment.white("left")
array = lfpiv.find_lens_array(white, nominal_pitch_px=camera.optics.microimage_pitch_px)
print(f"{len(array.centres_px)} microimages, pitch {array.pitch_px:.4f} px, rotation {array.rotation_deg:.3f} degrees")
print(f"{array.measured} measured, {array.rms_px:.4f} px rms off the lattice")

# %%
# What goes wrong where centres are merely assumed: the pitch of the microlenses instead of that of their images, which
# is 0.4 % larger, and an array that is not rotated. In the sensor's middle all seems well. In the corners every pixel's
# place on the pupil is off, which bends every ray.

rows, columns = white.shape
pitch = camera.optics.microlens_pitch_mm / camera.optics.pixel_mm
assumed = array.origin_px + pitch * array.index

figure, axes = plt.subplots(2, 2, figsize=(7.5, 7.5), layout="constrained")
edge = int(7 * pitch)
corners = {"middle": ((rows - edge) // 2, (columns - edge) // 2), "corner": (rows - edge, columns - edge)}
for line, (title, centres) in zip(axes, {"measured": array.centres_px, "assumed": assumed}.items(), strict=True):
    for axis, (place, (row, column)) in zip(line, corners.items(), strict=True):
        axis.imshow(white, cmap="gray")
        axis.plot(*centres.T, "+", color="tab:orange", markersize=9)
        axis.set(xlim=(column, column + edge), ylim=(row + edge, row), title=f"{title}, {place}")
for axis in axes[-1]:
    axis.set_xlabel("column [px]")
for axis in axes[:, 0]:
    axis.set_ylabel("row [px]")
plt.show()
