"""
Fit both frames and the flow at once
====================================

Both frames of a pair show the same particles, moved by one flow. Fitted together, as `lfpiv run` does with two and more
cameras, they give smaller errors than two volumes that are correlated (`smart.estimate = "correlation"`), and a field
between the vectors. It takes several times as long.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import lfpiv
from lfpiv.cli import demo
from lfpiv.simulation.flows import window_mean
from lfpiv.simulation.scene import open_scene

folder = Path("lfpiv-demo")
if not (folder / "report.html").exists():
    demo.run(folder)

experiment = lfpiv.open_experiment(folder / "experiment" / "experiment.toml")
rig = lfpiv.prepare(experiment, lfpiv.load_calibration(folder / "calibration.h5"))
light = rig.light(0)
images, floor = [one.images for one in light], [one.noise for one in light]

# %%
# Both answers from the same images. The volumes of a joint fit hold its displacement, from which `joint_vectors` takes
# the means over the windows, and `joint_field` what lies between them.

settings = {"floor": floor, "grid": experiment.grid, **rig.smart}
ways = ("correlation", "joint")
volumes = {way: lfpiv.reconstruct_pair(rig.weights, images, estimate=way, **settings) for way in ways}
windows = {"dt_s": experiment.dt_s, **rig.correlation}
correlated = lfpiv.correlate(*volumes["correlation"], **windows)
fitted = lfpiv.joint_vectors(volumes["joint"], **windows)
field = lfpiv.joint_field(volumes["joint"], fitted)

# %%
# The error of each vector against the mean of the true flow over its window of 12 voxels.

flow = open_scene(Path(demo.__file__).with_name("demo_scene.toml")).flow_of(0)
voxel_mm = experiment.grid.voxel_mm


def error_voxel(vectors, edge_voxel):
    """Length of each error against the mean of the flow over cubes."""
    z, y, x = np.meshgrid(vectors.z, vectors.y, vectors.x, indexing="ij")
    centres = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    truth = window_mean(flow, centres, edge_voxel * voxel_mm) / voxel_mm
    found = np.stack([vectors[f"displacement_{axis}"].values.ravel() for axis in "xyz"], axis=1)
    return np.linalg.norm(found - truth, axis=1).reshape(z.shape)


for name, vectors in {"correlation": correlated, "joint fit": fitted}.items():
    print(f"{name}: mean error {error_voxel(vectors, 12)[vectors.valid.values].mean():.3f} voxel")

# %%
# The vectors' errors in the middle plane, and the vorticity there: derivatives of the fitted field itself, in place of
# differences of neighbouring vectors.

figure, axes = plt.subplots(1, 3, figsize=(12, 4.6), layout="constrained", sharex=True, sharey=True)
middle = correlated.sizes["y"] // 2
for axis, (name, vectors) in zip(axes, {"correlation": correlated, "joint fit": fitted}.items(), strict=False):
    error, plane = error_voxel(vectors, 12)[:, middle], vectors.isel(y=middle)
    arrows = axis.quiver(plane.x, plane.z, plane.u, plane.w, error, cmap="viridis", clim=(0, 0.3), angles="xy")
    axis.set(title=name, xlabel="x [mm]", aspect="equal")
plane = field.sel(y=float(correlated.y[middle]), method="nearest")
vorticity = axes[2].contourf(plane.x, plane.z, plane.vorticity_y.where(plane.valid) / 1000, levels=9, cmap="RdBu_r")
axes[2].set(title="field of the joint fit", xlabel="x [mm]", aspect="equal")
axes[0].set_ylabel("z [mm]")
below = {"location": "bottom", "shrink": 0.6}
figure.colorbar(arrows, ax=axes[:2], label="error [voxel]", **below)
figure.colorbar(vorticity, ax=axes[2], label="vorticity [1000/s]", **below)
plt.show()
