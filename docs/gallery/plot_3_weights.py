"""
Weights of one voxel
====================

The weights of a voxel are the shares of its light that reach each pixel (Eq. 10; Fig. 10 of the paper draws those of
one voxel). `lfpiv.build_weights` integrates them in closed form; with ``method="count"`` it traces rays and counts
them, as the paper does. Counts have noise, so many rays are taken here.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import lfpiv
from lfpiv import metrics
from lfpiv.cli import demo

folder = Path("lfpiv-demo")
if not (folder / "report.html").exists():
    demo.run(folder)

calibration = lfpiv.load_calibration(folder / "calibration.h5")
grid = lfpiv.Grid.from_extent(centre_mm=(0.0, 0.0, 1.0), size_mm=(0.5, 0.5, 0.5), voxel_mm=0.1)
weights = lfpiv.build_weights(calibration, grid)
counted = lfpiv.build_weights(calibration, grid, "count", rays=131072)

voxel = (2, 2, 2)  # the middle one, at (0, 0, 1) mm
footprint, rays = weights.image("left", voxel), counted.image("left", voxel)
print(f"{(footprint > 0).sum()} pixels lit; all weights together {footprint.sum():.3f}")
print(f"apart by {100 * metrics.relative_l2(footprint, rays):.1f} % of the counted ones, the counts' noise included")

# %%
# A voxel away from the focal plane is seen through several microlenses, each of which shows a part of the pupil.

rows, columns = np.nonzero(footprint)
window = slice(rows.min() - 4, rows.max() + 5), slice(columns.min() - 4, columns.max() + 5)
extent = (window[1].start - 0.5, window[1].stop - 0.5, window[0].stop - 0.5, window[0].start - 0.5)
figure, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained", sharex=True, sharey=True)
largest = rays.max()
pictures = {"integrated": (footprint, "magma", 0, largest), "counted": (rays, "magma", 0, largest)}
pictures["difference"] = (footprint - rays, "RdBu_r", -largest / 5, largest / 5)
for axis, (title, (image, colours, low, high)) in zip(axes, pictures.items(), strict=True):
    shown = axis.imshow(image[window], cmap=colours, vmin=low, vmax=high, extent=extent)
    axis.set(title=title, xlabel="column [px]")
    figure.colorbar(shown, ax=axis, shrink=0.8)
axes[0].set_ylabel("row [px]")
plt.show()
