"""Layers of a picture of vectors, made with PyVista."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Container, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pyvista as pv
import xarray as xr
from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

import lfpiv

MOVING_ARROWS = 1500
"""Arrows that are drawn in time while something moves."""
LONGEST_LINE, LINES, MOVING_LINES = 4.0, 200.0, 40.0
"""Longest streamline, and all of them together at rest and while something moves, in diagonals of the volume."""

DERIVED: dict[tuple[str, ...], Callable[[xr.Dataset], xr.Dataset]] = {
    tuple(f"vorticity_{part}" for part in ("magnitude", *"xyz")): lambda vectors: lfpiv.derived.vorticity(vectors),
    ("q_criterion",): lambda vectors: lfpiv.derived.q_criterion(vectors).to_dataset(),
    ("divergence",): lambda vectors: lfpiv.derived.divergence(vectors).to_dataset(),
}
"""Fields that are derived of vectors -> what derives them together."""
BASIC = ("u", "v", "w", "valid", "uncertainty")
"""Fields that a grid always has."""


def field_at(results: xr.Dataset, moment: str) -> xr.Dataset:
    """Return the vectors of one pair or instant, or a statistic over all of them: "mean" or "fluctuations"."""
    dimension = "instant" if "instant" in results.dims else "pair"
    if moment == "mean":
        return lfpiv.statistics.mean(results)
    if moment == "fluctuations":
        spread, stresses = lfpiv.statistics.rms(results), lfpiv.statistics.reynolds_stresses(results)
        energy = lfpiv.statistics.turbulent_kinetic_energy(results).rename("turbulent_kinetic_energy")
        return xr.merge([lfpiv.statistics.mean(results), spread, stresses, energy], compat="override")
    if int(moment) not in results[dimension].values:
        raise ValueError(f"{dimension} {moment}: expected one of these results, found none. Choose another.")
    return results.sel({dimension: int(moment)})


def names_of(vectors: xr.Dataset) -> list[str]:
    """Return the names of the fields of vectors, and of those that are derived of them."""
    fields = [str(name) for name, item in vectors.data_vars.items() if set(item.dims) == set("zyx")]
    return ["speed", *fields, *(itertools.chain(*DERIVED) if min(vectors.sizes[axis] for axis in "xyz") > 2 else ())]


def grid_of(vectors: xr.Dataset, names: Iterable[str] | None = None) -> pv.ImageData:
    """Return `BASIC` fields of vectors and others, by default all, as point data on an even grid [mm]."""
    axes = [np.asarray(vectors[axis], float) for axis in "xyz"]
    steps = [np.ptp(axis) / (len(axis) - 1) if len(axis) > 1 else 1.0 for axis in axes]
    grid = pv.ImageData(dimensions=[len(axis) for axis in axes], spacing=steps, origin=[axis[0] for axis in axes])
    add_fields(grid, vectors, [*BASIC, *(names_of(vectors) if names is None else names)])
    grid["velocity"] = np.column_stack([grid[name] for name in "uvw"])
    grid["speed"] = np.linalg.norm(grid["velocity"], axis=1)
    return grid


def add_fields(grid: pv.ImageData, vectors: xr.Dataset, names: Iterable[str]) -> None:
    """Read or derive fields that a grid does not have yet; vectors keep what was read of them."""
    missing = {*names} & {*names_of(vectors)} - {*grid.array_names}
    fields = {**read(vectors, missing).data_vars}
    for derived, call in DERIVED.items():
        fields |= {**call(read(vectors, BASIC)).data_vars} if missing & {*derived} else {}
    for name, field in fields.items():
        grid[str(name)] = np.ascontiguousarray(field.transpose("z", "y", "x"), np.float32).ravel()


def read(vectors: xr.Dataset, names: Container[str]) -> xr.Dataset:
    """Return some of the vectors' variables, in memory."""
    with ThreadPoolExecutor(1) as here:  # dask, where it is installed, would import its clusters to find none
        return vectors[[name for name in vectors.data_vars if str(name) in names]].load(scheduler=here)


def trusted(grid: pv.ImageData, replaced: bool, uncertainty: float | None) -> pv.ImageData:
    """Return a grid whose fields are NaN where vectors are replaced, or more uncertain than a limit [voxel]."""
    hidden = np.zeros(grid.n_points, bool)
    if replaced and "valid" in grid.point_data:
        hidden |= grid["valid"] < 0.5
    if uncertainty is not None and "uncertainty" in grid.point_data:
        hidden |= ~(grid["uncertainty"] <= uncertainty)
    if not hidden.any():
        return grid
    shown = grid.copy(deep=False)
    for name, values in grid.point_data.items():
        if name != "valid":
            shown[name] = np.where(hidden.reshape(-1, *[1] * (values.ndim - 1)), np.float32(np.nan), values)
    return shown


def slim(grid: pv.ImageData, *names: str) -> pv.ImageData:
    """Return a grid with some of the fields, since filters spend their time on all of them."""
    some = pv.ImageData(dimensions=grid.dimensions, spacing=grid.spacing, origin=grid.origin)
    for name in names:
        some[name] = grid[name]
    return some


def slice_at(grid: pv.ImageData, axis: str, at_mm: float, colour: str) -> pv.DataSet:
    """Return the plane normal to an axis at a place [mm], with the field that colours it."""
    origin = list(grid.center)
    low, high = grid.bounds[2 * "xyz".index(axis) :][:2]
    origin["xyz".index(axis)] = min(max(at_mm, low + 1e-9), high - 1e-9)
    return slim(grid, colour).slice(normal=axis, origin=origin)


def surface(grid: pv.ImageData, field: str, level: float, colour: str) -> pv.PolyData:
    """Return the surface on which a field has a level, with the field that colours it."""
    some = slim(grid, field, colour)
    for name in {field, colour}:
        if np.isnan(grid[name]).any():
            some[name] = np.nan_to_num(grid[name], nan=float(np.nanmin(grid[name], initial=0.0)))
    edges = vtkFlyingEdges3D()  # with normals, in a quarter of the time of `contour`
    edges.SetInputData(some)
    edges.SetInputArrayToProcess(0, 0, 0, 0, field)
    edges.SetInterpolateAttributes(True)
    edges.SetValue(0, level)
    edges.Update()
    return pv.wrap(edges.GetOutput())


def arrows(
    grid: pv.ImageData, every: int, length: float, colour: str, flagged: bool = False, moving: bool = False
) -> pv.PolyData:
    """Return arrows on every n-th vector, or on replaced ones; the fastest is `length` of their distances long."""
    step = every
    while moving and np.prod([-(-n // step) for n in grid.dimensions]) > MOVING_ARROWS:
        step += every
    index = [np.arange((n - 1) % step // 2, n, step) for n in grid.dimensions]
    places = np.stack(np.meshgrid(*index, indexing="ij"), axis=-1).reshape(-1, 3)
    chosen = places @ np.cumprod([1, *grid.dimensions[:2]])
    good = grid["valid"][chosen] > 0.5 if "valid" in grid.point_data else np.ones(len(chosen), bool)
    kept = (good != flagged) & np.isfinite(grid["speed"][chosen])
    if not kept.any():
        return pv.PolyData()
    cloud = pv.PolyData((grid.origin + places[kept] * grid.spacing).astype(np.float32))
    for name in {"velocity", "speed", colour}:
        cloud[name] = grid[name][chosen[kept]]
    fastest = float(np.nanmax(grid["speed"], initial=0.0)) or 1.0
    factor = length * every * min(grid.spacing) / fastest
    return cloud.glyph(
        orient="velocity", scale="speed", factor=factor, geom=pv.Arrow(tip_resolution=5, shaft_resolution=4)
    )


def stream_lines(grid: pv.ImageData, seeds: int, colour: str, moving: bool) -> pv.PolyData:
    """Return streamlines from a number of points in the volume; shorter ones while something moves."""
    filled = slim(grid, colour)
    filled["velocity"] = np.nan_to_num(grid["velocity"])
    low, high = np.array(grid.bounds[::2]), np.array(grid.bounds[1::2])
    places = low + (high - low) * np.random.default_rng(0).random((seeds, 3))
    longest = grid.length * min(LONGEST_LINE, (MOVING_LINES if moving else LINES) / seeds)
    return filled.streamlines_from_source(
        pv.PolyData(places), vectors="velocity", integration_direction="both", max_length=longest
    )


def cloud_of(name: str, results: str, moment: str) -> pv.PolyData | None:
    """Return the "particles" or "tracks" of a run at a moment; None for particles of a statistic."""
    number = int(moment) if moment.isdigit() else None
    if name == "tracks":
        return track_lines(lfpiv.open_tracks(results), number)
    return None if number is None else points_of(lfpiv.open_particles(results, pairs=(number, number + 1)))


def points_of(table: xr.Dataset, good: np.ndarray | None = None) -> pv.PolyData:
    """Return particles, the valid or other good entries, as points, coloured by their speed [m/s] where it is known."""
    if good is None:
        good = table["valid"].values if "valid" in table else np.ones(table.sizes["particle"], bool)
    cloud = pv.PolyData(np.column_stack([table[name].values[good] for name in "xyz"]).astype(np.float32))
    if "u" in table:
        cloud["speed"] = np.sqrt(sum(table[name].values[good] ** 2 for name in "uvw")).astype(np.float32)
    return cloud


def track_lines(table: xr.Dataset, until: int | None) -> pv.PolyData:
    """Return the tracks of particles as lines, up to an instant if it is given."""
    good = table["valid"].values.astype(bool)
    if until is not None and "instant" in table:
        good &= table["instant"].values <= until
    ends = np.flatnonzero(np.diff(table["track"].values[good])) + 1
    parts = [part for part in np.split(np.arange(good.sum()), ends) if len(part) > 1]
    lines = np.concatenate([[len(part), *part] for part in parts]) if parts else None
    cloud = points_of(table, good)
    tracks = pv.PolyData(cloud.points, lines=lines)
    tracks.point_data.update(cloud.point_data)
    return tracks
