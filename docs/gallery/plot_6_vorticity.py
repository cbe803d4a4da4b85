"""
Vorticity of a measured flow
============================

Vectors of a run as one dataset, and fields derived from them: vorticity, and the divergence, which is nothing but
measurement error in an incompressible flow.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import lfpiv
from lfpiv import derived
from lfpiv.cli import demo

folder = Path("lfpiv-demo")
if not (folder / "report.html").exists():
    demo.run(folder)

results = lfpiv.open_results(folder)
print(dict(results.sizes), "pairs:", results.pair.values)

# %%
# The coordinate `valid` of a derived field marks the values that depend on measured vectors only.

vectors = results.isel(pair=0)
curl, divergence = derived.vorticity(vectors), derived.divergence(vectors)
sure = curl.where(curl.valid)
print(f"vorticity up to {float(sure.vorticity_magnitude.max()):.0f} 1/s")
print(f"divergence {float(divergence.where(divergence.valid).std()):.0f} 1/s (standard deviation)")

# %%
# The ring vortex cut across: vorticity of opposite sign left and right, and the flow between along -z.

middle = vectors.sizes["y"] // 2
slice_ = vectors.isel(y=middle)
figure, axis = plt.subplots(figsize=(8, 3.2), layout="constrained")
across = curl.vorticity_y.isel(y=middle)
across.plot.contourf(ax=axis, levels=15, cmap="RdBu_r", cbar_kwargs={"label": "vorticity [1/s]"})
axis.quiver(slice_.x, slice_.z, slice_.u, slice_.w, angles="xy")
axis.set(xlabel="x [mm]", ylabel="z [mm]", aspect="equal", title=f"y = {float(slice_.y):.2f} mm")
plt.show()
