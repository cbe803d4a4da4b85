"""
Correlate two volumes
=====================

Two synthetic volumes of the same particles, moved by a vortex, and their displacement by `lfpiv.correlate`. The
particles are drawn as Gaussian blobs, so nothing but the correlation is at work, and the truth is known.
"""

import matplotlib.pyplot as plt
import numpy as np

import lfpiv
from lfpiv import metrics
from lfpiv.simulation.flows import Swirl, window_mean

grid = lfpiv.Grid.from_extent(centre_mm=(0.0, 0.0, 0.0), size_mm=(6.4, 6.4, 3.2), voxel_mm=0.1)
flow = Swirl(peak_mm=0.4, core_mm=1.6, axis="z")

rng = np.random.default_rng(1)
particles = rng.uniform(-1, 1, (5000, 3)) * (3.2, 3.2, 1.6)
displacement = flow(particles)
volumes = [metrics.truth_volume(particles + side * displacement / 2, None, grid, 0.7) for side in (-1, 1)]

# %%
# Coarse windows find where the particles went, small ones resolve the vortex. A single pass of small windows cannot see
# as far as the particles move, and finds too few of them: many vectors fail the validation.

good = lfpiv.correlate(*volumes, windows=(24, 16, 12, 12), dt_s=1e-4)
bad = lfpiv.correlate(*volumes, windows=(8,), dt_s=1e-4)


def error_voxel(vectors):
    """Length of each vector's error against the flow's mean over its window."""
    z, y, x = np.meshgrid(vectors.z, vectors.y, vectors.x, indexing="ij")
    centres = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    truth = window_mean(flow, centres, 1.2) / grid.voxel_mm
    found = np.stack([vectors[f"displacement_{axis}"].values.ravel() for axis in "xyz"], axis=1)
    return np.linalg.norm(found - truth, axis=1).reshape(z.shape)


for name, vectors in {"four passes": good, "one pass of 8": bad}.items():
    share, error = float(vectors.valid.mean()), error_voxel(vectors).mean()
    print(f"{name}: {100 * share:.0f} % valid, mean error {error:.3f} voxel; {vectors.attrs['verdict']}")

# %%
# Arrows: measured displacement at mid-depth, in its true length; colour: its error.

figure, axes = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained", sharex=True, sharey=True)
for axis, (name, vectors) in zip(axes, {"four passes": good, "one pass of 8": bad}.items(), strict=True):
    middle = vectors.sizes["z"] // 2
    slice_, error = vectors.isel(z=middle), error_voxel(vectors)[middle]
    arrows = axis.quiver(
        slice_.x, slice_.y, slice_.displacement_x, slice_.displacement_y, error,
        cmap="viridis", clim=(0, 1), angles="xy", scale_units="xy", scale=1 / grid.voxel_mm,
    )  # fmt: skip
    axis.set(title=name, xlabel="x [mm]", aspect="equal")
axes[0].set_ylabel("y [mm]")
figure.colorbar(arrows, ax=axes, label="error [voxel]")
plt.show()
