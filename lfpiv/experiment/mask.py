"""Voxels without fluid: from the files and the solids that an experiment names, sampled onto its grid.

A voxel is masked if more than half of it is solid. Half-spaces and boxes are tested at the voxel's centre. A file is
interpolated linearly between its points and averaged over the voxel. Of a body that moves there is a file of each
frame. At the start these files are only looked at, and each is read when its frame is.
"""

from __future__ import annotations

import contextlib
import math
import string
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray as xr

from lfpiv import hdf5
from lfpiv.errors import InputError
from lfpiv.geometry.grid import AXES, Grid
from lfpiv.geometry.volume import solid_shares
from lfpiv.settings.volume import Box, HalfSpace, Solid

VARIABLE = "mask"
"""Name of the mask in a file with several variables."""
MOST_POINTS = 3 * 10**8
"""Largest number of points of a file."""
MOST_SAMPLES = 16
"""Largest number of samples along an edge of a voxel, for files with far smaller spacing."""


@dataclass(frozen=True, kw_only=True)
class Mask:
    """Where the volume of an experiment holds no fluid, in all frames or in each."""

    path: Path
    """The experiment file, from which the paths of masks start."""
    grid: Grid
    """Voxels of the experiment."""
    file: str | None
    """Path of a NetCDF file, or its pattern; None without one."""
    solid: tuple[Solid, ...]
    """Solids that stand still."""

    @property
    def moves(self) -> bool:
        """Whether frames have masks of their own."""
        return self.file is not None and any(
            field is not None for _, field, _, _ in string.Formatter().parse(self.file)
        )

    def file_of(self, fields: Mapping[str, Any]) -> Path:
        """Return the file of the frame with these fields of path patterns."""
        assert self.file is not None
        return self.path.parent / self.file.format(**fields)

    def flags(self, fields: Mapping[str, Any]) -> np.ndarray:
        """Return the flags of the voxels without fluid in a frame, shape (z, y, x).

        Raises
        ------
        InputError
            If a file is no mask, a mask or a solid does not meet the volume, or no fluid is left.
        """
        return self._read(fields) if self.moves else self._still

    def look_at(self, frames: Iterable[Mapping[str, Any]]) -> None:
        """Refuse a file of a frame that is missing, damaged, or of another form than the first one, which is read.

        Parameters
        ----------
        frames : iterable of mappings
            Fields of path patterns of each frame.

        Raises
        ------
        InputError
            As `flags`. The values of the other files are checked when they are read.
        """
        frames = iter(frames)
        first = next(frames)
        self.flags(first)
        if not self.moves:
            return
        start = self.file_of(first)
        known, seen = _layout(start), {start}
        for path in map(self.file_of, frames):
            if path not in seen:
                _require(path)
                if (found := _layout(path)) != known:
                    raise InputError(f"{path}: expected the variables and shapes of {start}, {known}, found {found}.")
                seen.add(path)

    @cached_property
    def _still(self) -> np.ndarray:
        return self._read({})

    @cached_property
    def _walls(self) -> np.ndarray:
        """Flags of the voxels in `solid`."""
        walls = np.zeros(self.grid.shape, bool)
        for number, one in enumerate(self.solid):
            inside = _inside(one, self.grid)
            if not inside.any():
                raise InputError(
                    f"{self.path}: volume.solid[{number}]: expected a {one.kind} that reaches into the volume, found "
                    "none of its voxels inside. Check its lengths [mm], or leave it out."
                )
            walls |= inside
        return walls

    def _read(self, fields: Mapping[str, Any]) -> np.ndarray:
        solid, source = self._walls, f"{self.path}: volume"
        if self.file is not None:
            file = self.file_of(fields)
            solid, source = solid | read_mask(file, self.grid, may_miss=self.moves), f"{file}"
        if solid.all():
            raise InputError(f"{source}: expected some fluid in the volume, found only solid. {_INVERTED}")
        return solid


_INVERTED = "True, and the side from which a half-space's normal points away, are solid: is a mask inverted?"


def _inside(solid: HalfSpace | Box, grid: Grid) -> np.ndarray:
    """Return the flags of the voxels whose centres are in a solid, shape (z, y, x)."""
    z, y, x = grid.axis_mm(0), grid.axis_mm(1)[:, None], grid.axis_mm(2)
    inside = np.empty(grid.shape, bool)
    for layer, depth in zip(inside, z, strict=True):  # layer by layer: distances take eight times the memory of flags
        layer[:] = solid.contains(x, y, depth)
    return inside


def read_mask(path: Path, grid: Grid, *, may_miss: bool = False) -> np.ndarray:
    """Read a mask from a NetCDF file and sample it onto a grid: true for voxels that are more than half solid.

    The file has one variable, or one named ``mask``, over z, y, x with coordinates [mm], evenly spaced or not: true, or
    1, where there is solid; false, or 0, where there is fluid. Beyond the file's points there is fluid. A body that
    moves `may_miss` the volume in some frames.

    Raises
    ------
    InputError
        If the file cannot be read or is no such mask, lies beside the volume, or marks no voxel.
    """
    mask = _load(path)
    try:
        values = solid_shares(mask.values, str(mask.name))
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    for number, axis in enumerate(AXES):
        nodes, voxels = mask[axis].values, grid.axis_mm(number)
        low, high = nodes[0] - _half_step(nodes, 0), nodes[-1] + _half_step(nodes, -1)
        if not (low < voxels[-1] + grid.voxel_mm / 2 and high > voxels[0] - grid.voxel_mm / 2):
            raise InputError(
                f"{path}: expected a mask that overlaps the volume, {axis} from {voxels[0]:g} to {voxels[-1]:g} mm, "
                f"found {axis} from {nodes[0]:g} to {nodes[-1]:g}. Are its coordinates in mm, in the board's frame?"
            )
        values = np.moveaxis(np.tensordot(_sampling(nodes, voxels, grid.voxel_mm), values, (1, number)), 0, number)
    solid: np.ndarray = values > 0.5
    if not (may_miss or solid.any()):
        raise InputError(
            f"{path}: expected some solid (true) in the volume, found only fluid there. Check the mask's coordinates "
            "[mm], or leave volume.mask out."
        )
    return solid


def _load(path: Path) -> xr.DataArray:
    """Return the mask in a file, its coordinates rising."""
    _require(path)
    with _reading(path) as engine, xr.open_dataset(path, engine=engine) as opened:
        points = sum(variable.size for variable in opened.variables.values())
        if points > MOST_POINTS:
            raise InputError(f"{path}: expected at most {MOST_POINTS:.0e} points, found {points:.1e}.")
        stored = opened.load()
    names = [str(name) for name in stored.data_vars]
    if VARIABLE not in names and len(names) != 1:
        found = ", ".join(names) or "none"
        raise InputError(f"{path}: expected one variable, or one named {VARIABLE!r}, found {found}.")
    mask = stored[VARIABLE if VARIABLE in names else names[0]]
    if set(mask.dims) != set(AXES) or mask.ndim != 3 or any(axis not in mask.coords for axis in AXES):
        raise InputError(
            f"{path}: expected {mask.name!r} over z, y, x with coordinates [mm], found "
            f"{dict(mask.sizes)} with coordinates {list(map(str, mask.coords))}."
        )
    for axis in AXES:
        unit, nodes = mask[axis].attrs.get("units", "mm"), mask[axis].values
        steps = np.diff(nodes) if nodes.dtype.kind in "fiu" else np.array([0.0])
        if unit != "mm" or not ((steps > 0).all() or (steps < 0).all()):
            raise InputError(
                f"{path}: expected coordinates {axis} in mm that rise or fall throughout, found {unit}, "
                f"{np.array2string(nodes, threshold=6, edgeitems=2)}."
            )
    return mask.transpose(*AXES).sortby(list(AXES))


def _layout(path: Path) -> dict[str, tuple[int, ...]]:
    """Return the shape of each variable in a file without reading values, some 40 times as fast as by `_load`."""
    with _reading(path) as engine:
        if engine == "scipy":
            with xr.open_dataset(path, engine=engine) as opened:
                return {str(name): values.shape for name, values in opened.variables.items()}
        with h5py.File(path) as file:
            return {str(name): values.shape for name, values in file.items() if isinstance(values, h5py.Dataset)}


def _require(path: Path) -> None:
    if not path.is_file():
        raise InputError(f"{path}: expected the NetCDF file of volume.mask, found no such file. Check the path.")


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[str]:
    """Yield xarray's engine for a file; name one that cannot be read in the error."""
    try:
        yield hdf5.netcdf_engine(path)
    except InputError:
        raise
    except Exception as error:  # readers raise exceptions of many types on damaged files
        reason = " ".join(str(error).split())[:100]
        raise InputError(f"{path}: expected a NetCDF file, found one that cannot be read ({reason}).") from None


def _half_step(nodes: np.ndarray, end: int) -> float:
    """Return half the distance of the outermost points at one end (0 or -1) [mm]; 0 for a single point."""
    return float(abs(np.diff(nodes)[end])) / 2 if len(nodes) > 1 else 0.0


def _sampling(nodes: np.ndarray, voxels: np.ndarray, voxel_mm: float) -> np.ndarray:
    """Return the matrix from values at a file's points to their means over voxels along an axis, (voxel, point).

    Half a step beyond the outermost points the value is theirs, farther out it is 0.
    """
    finest = float(np.diff(nodes).min()) if len(nodes) > 1 else voxel_mm
    count = min(max(1, math.ceil(voxel_mm / finest)), MOST_SAMPLES)
    within = ((np.arange(count) + 0.5) / count - 0.5) * voxel_mm
    matrix = np.zeros((len(voxels), len(nodes)))
    low, high = nodes[0] - _half_step(nodes, 0), nodes[-1] + _half_step(nodes, -1)
    for offset in within:
        at = voxels + offset
        inside = (at >= low) & (at <= high) if len(nodes) > 1 else np.abs(at - nodes[0]) <= voxel_mm / 2
        hats = np.stack([np.interp(at, nodes, unit) for unit in np.eye(len(nodes))], axis=1)
        matrix += hats * inside[:, None] / count
    return matrix
