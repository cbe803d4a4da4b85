"""Compare the vectors of a simulated experiment with its true flow, and write the report's section on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.geometry.grid import AXES
from lfpiv.geometry.names import COMPONENTS
from lfpiv.quantities import quantity, scale_of
from lfpiv.report import flow, markup
from lfpiv.report.flow import Quantity, View
from lfpiv.report.line_panels import BAND
from lfpiv.report.markup import number, percent
from lfpiv.report.slice_panels import slice_panel
from lfpiv.report.svg import INK, SERIES, new_panel, spread_ticks, style, to_svg
from lfpiv.results import netcdf
from lfpiv.velocity.settings import CorrelationSettings

if TYPE_CHECKING:
    from lfpiv.simulation.scene import Scene

MOST_COMPARED = 4_000
"""About the largest number of vectors that are compared; of more, every n-th along x and y."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Measured vectors beside the true flow, which is averaged over the windows of the last correlation pass."""

    vectors: xr.Dataset
    """The measured vectors."""
    true_voxel: np.ndarray
    """True displacements (x, y, z) [voxel], shape (3, z, y, x)."""

    @property
    def _inner(self) -> tuple[slice, ...]:
        """Return slices (z, y, x) without the outermost layer, whose windows have neighbours on one side only."""
        return tuple(slice(1, -1) if self.vectors.sizes[axis] > 2 else slice(None) for axis in AXES)

    @cached_property
    def _errors(self) -> np.ndarray:
        """Return measured minus true displacement of all inner vectors [voxel], shape (3, vector)."""
        measured = np.stack([self.vectors[f"displacement_{axis}"].values for axis in "xyz"])
        return (measured - self.true_voxel)[(slice(None), *self._inner)].reshape(3, -1)

    @property
    def error_voxel(self) -> np.ndarray:
        """Return measured minus true displacement of the inner vectors that are numbers [voxel], shape (3, vector)."""
        return self._errors[:, np.isfinite(self._errors).all(0)]

    @property
    def length_voxel(self) -> np.ndarray:
        """Return the lengths of these errors [voxel], shape (vector,)."""
        return np.asarray(np.linalg.norm(self.error_voxel, axis=0))

    @property
    def largest_voxel(self) -> float:
        """Return the largest true displacement of the inner vectors [voxel]."""
        return float(np.linalg.norm(self.true_voxel[(slice(None), *self._inner)], axis=0).max())

    @property
    def covered(self) -> np.ndarray | None:
        """Return the share of errors of valid inner vectors within `BAND` stated deviations, shape (3,), or None."""
        if "uncertainty" not in self.vectors:
            return None
        stated = np.where(self.vectors["valid"], self.vectors["uncertainty"], np.nan)[self._inner].ravel()
        known = np.isfinite(stated) & np.isfinite(self._errors).all(0)
        return (np.abs(self._errors[:, known]) <= BAND * stated[known]).mean(1) if known.any() else None


def compare(vectors: xr.Dataset, scene: Scene, pair: int) -> Comparison:
    """Compare vectors with the flow of a scene.

    Parameters
    ----------
    vectors : Dataset
        Vectors of a pair, or of an instant and the one after it.
    pair : int
        Number of the pair or instant.

    Raises
    ------
    InputError
        If the file of the flow cannot be read.
    """
    from lfpiv.simulation.flows import window_mean

    edges = np.asarray(vectors.attrs["voxel_mm"], float)
    z, y, x = np.meshgrid(*(vectors[axis].values for axis in AXES), indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    a, b, c = np.array(CorrelationSettings.from_vectors(vectors).windows[-1][::-1]) * edges
    true = window_mean(scene.flow_of(pair), points, (a, b, c)) / edges
    return Comparison(vectors=vectors, true_voxel=true.T.reshape(3, *z.shape))


def section(experiment: Experiment, vectors: Mapping[int, Path]) -> str:
    """Return the section on the first pair of a simulated experiment, as HTML.

    It is empty for experiments without truth, and where no vector can be compared. Where the truth cannot be read it
    says why.
    """
    folder = experiment.path.parent / "truth"
    if not vectors or not (folder / "spec.json").is_file():
        return ""
    from lfpiv.simulation.scene import stored_scene  # with the kernels of the simulator, which take seconds

    pair = next(iter(vectors))
    try:
        scene = stored_scene(folder)
        found = compare(_thinned(netcdf.read_vectors(vectors[pair])), scene, pair)
    except (InputError, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        return _head() + markup.paragraph(f"The truth of this simulated experiment cannot be read: {reason}")
    if not found.error_voxel.size:
        return ""
    name = experiment.name_of(pair)
    return "\n".join([_head(), markup.paragraph(_sentence(found, name)), _figure(found, name)])


def _head() -> str:
    return '<h2 id="truth">Against the true flow</h2>'


def _thinned(vectors: xr.Dataset) -> xr.Dataset:
    """Return every n-th vector along x and y: about `MOST_COMPARED`, which are compared quickly."""
    step = int(np.ceil(np.sqrt(max(vectors["u"].size / MOST_COMPARED, 1))))
    return vectors.isel({axis: slice(None, None, step) for axis in "xy"})


def _sentence(found: Comparison, name: str) -> str:
    """State the mean error and the largest true displacement, in voxels and as velocities."""
    mean, largest, voxel = float(found.length_voxel.mean()), found.largest_voxel, flow.voxel_velocity(found.vectors)
    text = (
        f"This experiment is simulated, so its flow is known. The vectors of {name} are off by {number(mean, 2)} voxel "
        f"({quantity(mean * voxel, 'm/s', 2)}) on average, where the flow moves by up to {number(largest, 1)} voxel "
        f"({quantity(largest * voxel, 'm/s', 2)})."
    )
    return f"{text} The true flow is averaged over the windows of the correlation; the outermost vectors do not count."


def _figure(found: Comparison, name: str) -> str:
    """Draw measured and true vectors in a slice, and along a line; tabulate the errors of the components."""
    measured = found.vectors
    kinds, view = flow.describe(measured), flow.best_view(measured)
    true = _true_fields(found, kinds)
    fields = flow.shown(measured, kinds)
    place = view.place[view.normal]
    panels = [
        slice_panel(part, kinds, view.normal, place, "speed", "arrows", like=fields, title=title)
        for part, title in ((fields, "measured"), (true, "true"))
    ]
    panels.append(_profile(fields, true, kinds, view, flow.voxel_velocity(measured) * kinds["speed"].factor))
    text = (
        f"{name.capitalize()}: measured and true vectors in one slice, with the same colours and scale of arrows, and "
        f"the velocity along a line in it. Marks are measured, bars are ± {BAND:g} stated standard deviations, lines "
        f"are true."
    )
    return markup.figure(panels, text) + _table(found)


def _true_fields(found: Comparison, kinds: dict[str, Quantity]) -> xr.Dataset:
    """Return the true velocity as `flow.shown` returns the measured one."""
    voxel = flow.voxel_velocity(found.vectors) * kinds["speed"].factor
    parts = dict(zip("uvw", voxel * found.true_voxel, strict=True))
    parts["speed"] = np.linalg.norm(np.stack(list(parts.values())), axis=0)
    shape, masked = found.true_voxel.shape[1:], flow.masked_of(found.vectors)
    flags = {"valid": (AXES, np.ones(shape, bool)), "masked": (AXES, masked)}
    fields = {name: (AXES, values) for name, values in parts.items()}
    return xr.Dataset(fields | flags, {axis: found.vectors[axis].variable for axis in AXES})


def _profile(fields: xr.Dataset, true: xr.Dataset, kinds: dict[str, Quantity], view: View, voxel: float) -> str:
    """Draw measured and true velocity along the line of a view; `voxel` is the velocity of one voxel."""
    across = {axis: place for axis, place in view.place.items() if axis != view.along}
    line, truth = fields.isel(across), true.isel(across)
    position = line[view.along].values
    error = BAND * voxel * line["uncertainty"].where(line["valid"]).values if "uncertainty" in line else None
    panel, axes = new_panel(3.4)
    axes.axhline(0, color=INK, linewidth=0.6)
    for k, name in enumerate("uvw"):
        axes.plot(position, truth[name].values, "-", color=SERIES[k], lw=1.4)
        values = np.where(line["masked"].values, np.nan, line[name].values)
        axes.errorbar(position, values, error, fmt="o", color=SERIES[k], ms=3.5, elinewidth=0.8, capsize=0, label=name)
    where = ", ".join(f"{axis} = {number(float(fields[axis][place]), 2)} mm" for axis, place in sorted(across.items()))
    unit = kinds["speed"].unit
    axes.margins(y=0.15)
    style(axes, title=where, xlabel=f"{view.along} [mm]", ylabel=f"velocity [{unit}]", legend=True)
    axes.get_legend().set_ncols(3)  # in the room above the marks
    spread_ticks(axes)
    return to_svg(panel, f"Measured and true velocity along {view.along} at {where}.")


def _table(found: Comparison) -> str:
    """Tabulate the errors of each component."""
    voxel, error, covered = flow.voxel_velocity(found.vectors), found.error_voxel, found.covered
    rms = np.sqrt((error**2).mean(axis=1))
    speed = scale_of(float(rms.max()) * voxel, "m/s")
    rows = [
        [
            f"{COMPONENTS[axis]}, along {axis}",
            number(float(error[k].mean()), 3),
            number(float(rms[k]), 3),
            f"{rms[k] * voxel * speed.factor:.3g}",
            markup.NONE if covered is None else percent(float(covered[k])),
        ]
        for k, axis in enumerate("xyz")
    ]
    titles = [
        "component",
        "mean error [voxel]",
        "rms error [voxel]",
        f"rms error [{speed.unit}]",
        f"within {BAND:g} stated deviations",
    ]
    text = (
        "Where uncertainties fit, 95 % of the errors lie within two stated standard deviations. A larger share says "
        "that the vectors are better than stated."
    )
    table = markup.table(titles, rows, caption="Errors of each component")
    return table + (markup.paragraph(text, "quiet") if covered is not None else "")
