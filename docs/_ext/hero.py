"""Draw the picture at the top of the README: raw image, views, particles and velocities of a simulated ring vortex.

    python docs/_ext/hero.py --out docs/_static/hero.png [--results DIR]

`hero_scene.toml` is simulated and measured first, unless `--results` holds that.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from skimage.measure import marching_cubes

import lfpiv
from lfpiv import derived
from lfpiv.runs import pipeline
from lfpiv.simulation.scene import open_scene
from lfpiv.simulation.simulator import simulate

SCENE = Path(__file__).with_name("hero_scene.toml")
WINDOWS = "\n[correlation]\nwindows = [24, 16, 12, 12]\noverlap = 0.75\n"
RAW_PX, ZOOM_PX = 420, 66
"""Edges of the raw image that is shown, and of the part that is enlarged [pixel]."""
VIEWS = (-0.55, 0.0, 0.55)
"""Places of the views on the pupil along u [radius]."""
LEVEL = 0.5
"""Vorticity of the drawn surface [largest one]."""
SLAB = 6
"""Number of layers of the volume whose largest intensities are shown."""
BRIGHT = 99.7
"""Percentile of an image that is drawn white."""
STRIDE = 2
"""Every how manyth vector is drawn along x and z."""
FINER = 4
"""Number of points of the drawn surface per vector, along each axis."""


def draw(results: Path, path: Path) -> None:
    """Draw the picture from the results of a run."""
    experiment = lfpiv.open_experiment(results / "experiment" / "experiment.toml")
    calibration = lfpiv.load_calibration(results / "calibration.h5")
    name = next(iter(calibration.cameras))
    camera, image = calibration.cameras[name], experiment.particle_image(name, 0, experiment.frames[0])
    vectors = lfpiv.open_results(results).isel(pair=0)
    (volume_path,) = sorted((results / "volumes").glob("*_a.nc"))
    with xr.open_dataset(volume_path, engine="h5netcdf") as stored:
        volume = stored["intensity"].load()
    figure = Figure(figsize=(13, 4.0), facecolor="white")
    FigureCanvasAgg(figure)
    _raw(figure.add_axes((0.002, 0.03, 0.2555, 0.83)), image)
    radius = camera.optics.pupil_radius_mm
    for number, place in enumerate(VIEWS):
        axes = figure.add_axes((0.268, 0.03 + 0.28 * (2 - number), 0.13, 0.27))
        view, _ = camera.decoder.sub_aperture(image, (place * radius, 0.0))
        _grey(axes, np.nan_to_num(view).T)
        axes.text(0.03, 0.06, f"u = {place:+.2f} R", color="white", fontsize=8, transform=axes.transAxes)
    _volume_panel(figure, volume)
    _flow(figure.add_axes((0.655, -0.06, 0.345, 1.02), projection="3d"), vectors)
    for x, text in (
        (0.13, "raw plenoptic image"),
        (0.333, "views through the pupil"),
        (0.51, "reconstructed particles"),
        (0.83, "velocities and vorticity of a ring vortex, coloured by w"),
    ):
        figure.text(x, 0.93, text, ha="center", fontsize=11.5)
    figure.savefig(path, dpi=110)


def _grey(axes: Axes, image: np.ndarray) -> None:
    axes.imshow(image, cmap="gray", vmin=np.median(image), vmax=np.percentile(image, BRIGHT), interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])


def _raw(axes: Axes, image: np.ndarray) -> None:
    """Show the middle of a raw image, and microimages of its brightest particle enlarged in a corner."""
    top, left = (edge // 2 - RAW_PX // 2 for edge in image.shape)
    part = image[top : top + RAW_PX, left : left + RAW_PX]
    _grey(axes, part)
    around = part[ZOOM_PX : RAW_PX - ZOOM_PX, ZOOM_PX : RAW_PX - ZOOM_PX]
    row, column = np.unravel_index(around.argmax(), around.shape)
    row, column = row + ZOOM_PX // 2, column + ZOOM_PX // 2
    axes.add_patch(Rectangle((column, row), ZOOM_PX, ZOOM_PX, fill=False, ec="#ffb454", lw=1.2))
    inset = axes.inset_axes((0.54, 0.54, 0.45, 0.45))
    _grey(inset, part[row : row + ZOOM_PX, column : column + ZOOM_PX])
    for spine in inset.spines.values():
        spine.set(color="#ffb454", linewidth=1.5)


def _volume_panel(figure: Figure, volume) -> None:
    """Show the volume's largest intensities along z and along y."""
    x, y, z = (volume[axis].values for axis in "xyz")
    width = 0.2
    slabs = {axis: slice(volume.sizes[axis] // 2 - SLAB // 2, volume.sizes[axis] // 2 + SLAB // 2) for axis in "zy"}
    above, below = (volume.isel({axis: slabs[axis]}).max(axis).values for axis in "zy")
    low = 0.83 * len(z) / (len(z) + len(y))
    for bottom, share, shown, vertical, label in (
        (0.03 + low + 0.01, 0.82 - low, above, y, "y"),
        (0.03, low, below, z, "z"),
    ):
        axes = figure.add_axes((0.41, bottom, width, share))
        extent = (x[0], x[-1], vertical[0], vertical[-1])
        axes.imshow(
            np.sqrt(shown), cmap="magma", extent=extent, origin="lower", vmax=np.sqrt(np.percentile(shown, BRIGHT))
        )
        axes.text(0.02, 0.95, f"x, {label}", color="white", fontsize=8, va="top", transform=axes.transAxes)
        axes.set_xticks([])
        axes.set_yticks([])


def _flow(axes, vectors) -> None:
    """Draw the far half of a surface of equal vorticity, coloured by w, and the vectors of the middle plane."""
    curl = derived.vorticity(vectors)["vorticity_magnitude"]
    x, y, z = (vectors[axis].values for axis in "xyz")
    plane = len(y) // 2
    finer = {
        axis: np.linspace(own[0], own[-1], FINER * len(own)) for axis, own in zip("xyz", (x, y[plane:], z), strict=True)
    }
    smooth = curl.fillna(0).interp(finer, method="cubic").transpose("z", "y", "x").values
    steps = [finer[axis][1] - finer[axis][0] for axis in "zyx"]
    points, faces, _, _ = marching_cubes(smooth, LEVEL * smooth.max(), spacing=steps)
    points += [finer[axis][0] for axis in "zyx"]
    along = vectors["w"].interp(
        {axis: ("point", points[:, number]) for number, axis in enumerate("zyx")}, kwargs={"fill_value": None}
    )
    largest = float(np.abs(vectors["w"]).max())
    colours = Normalize(-largest, largest)(along.values[faces].mean(1))
    corners = points[faces][:, :, ::-1]
    surface = Poly3DCollection(
        corners,
        facecolors=colormaps["coolwarm"](colours),
        shade=True,
        lightsource=LightSource(225, 40),
        antialiased=False,
    )
    axes.add_collection3d(surface)
    middle = vectors.isel(y=plane, x=slice(None, None, STRIDE), z=slice(None, None, STRIDE))
    grid = np.meshgrid(middle.x, middle.z)
    speed = float(np.sqrt(middle.u**2 + middle.v**2 + middle.w**2).max())
    length = 0.2 * (x[-1] - x[0]) / speed
    parts = [length * middle[name].values for name in "uvw"]
    axes.quiver(
        grid[0], np.full_like(grid[0], float(middle.y)), grid[1], *parts, color="#222", lw=1.1, arrow_length_ratio=0.35
    )
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[0], y[-1])
    axes.set_zlim(z[0], z[-1])
    axes.set_box_aspect([own[-1] - own[0] for own in (x, y, z)], zoom=1.35)
    axes.view_init(28, -68)
    axes.set_axis_off()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="the picture, a PNG file")
    parser.add_argument("--results", type=Path, help="folder of the simulated experiment and its results")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        results = options.results or Path(scratch)
        measure(results)
        draw(results, options.out)
    return 0


def measure(results: Path) -> None:
    """Simulate the scene and run all steps on it, unless that is done."""
    experiment = results / "experiment" / "experiment.toml"
    if not experiment.exists():
        simulate(open_scene(SCENE), experiment.parent)
        experiment.write_text(experiment.read_text("utf-8") + WINDOWS, "utf-8")
    pipeline.run(experiment, results, keep_volumes=True)


if __name__ == "__main__":
    sys.exit(main())
