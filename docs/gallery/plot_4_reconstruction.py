"""
Reconstruct a volume and look at it
===================================

Two images become one volume. Where the true particles are known, a look at them beside the volume shows which
spots are ghosts; the residual per iteration shows whether the images are explained.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import lfpiv
from lfpiv.cli import demo

folder = Path("lfpiv-demo")
if not (folder / "report.html").exists():
    demo.run(folder)

experiment = lfpiv.open_experiment(folder / "experiment" / "experiment.toml")
calibration = lfpiv.load_calibration(folder / "calibration.h5")
weights = lfpiv.build_weights(calibration, experiment.grid, form="profiles")

# %%
# The decoder knows which pixels lie between the microimages, where no light falls: their level is subtracted, their
# noise is the floor.

images, floor = {}, {}
for name, camera in calibration.cameras.items():
    image = experiment.particle_image(name, 0, "a")
    level, floor[name] = camera.decoder.background(image)
    images[name] = image - level

volume = lfpiv.reconstruct(weights, images, floor=floor)
bare = {"accelerate": False, "sieve_voxel": 0.0, "tolerance": 0.0}
diverging = lfpiv.reconstruct(weights, images, iterations=6, floor=floor, relaxation=3.0, **bare)
print("relaxation 1:", volume.attrs["stop"])
print("relaxation 3:", diverging.attrs["stop"])

# %%
# Brightest voxel along y and along z, with the true particles of the middle drawn as circles. Two views leave each
# particle a little long and some light where no particle is.

truth = np.load(folder / "experiment" / "truth" / "particles.npz")
first = truth["pair_0000_positions_mm"] - truth["pair_0000_displacement_mm"] / 2
slab = abs(first[:, 2]) < 0.25

figure, axes = plt.subplots(1, 3, figsize=(12, 3.9), layout="constrained")
near = volume.sel(z=slice(-0.25, 0.25))
high = float(np.percentile(volume, 99.9))
near.max("z").plot.imshow(ax=axes[0], cmap="gray", vmax=high, add_colorbar=False)
axes[0].plot(*first[slab, :2].T, "o", fillstyle="none", color="tab:orange", markersize=6, linewidth=0)
axes[0].set(title="|z| < 0.25 mm, along z", aspect="equal")
volume.sel(y=slice(-0.25, 0.25)).max("y").plot.imshow(ax=axes[1], cmap="gray", vmax=high, add_colorbar=False)
slab = abs(first[:, 1]) < 0.25
axes[1].plot(*first[slab][:, [0, 2]].T, "o", fillstyle="none", color="tab:orange", markersize=6, linewidth=0)
axes[1].set(title="|y| < 0.25 mm, along y", aspect="equal")
axes[2].plot(volume.attrs["residual"], "o-", label="relaxation 1")
axes[2].plot(diverging.attrs["residual"], "s--", label="relaxation 3")
axes[2].set(xlabel="iteration", ylabel="residual", title="what the volume leaves unexplained")
axes[2].legend()
plt.show()
