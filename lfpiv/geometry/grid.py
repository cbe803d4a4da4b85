"""Voxel grid of a volume, in millimetres, with its axes in the order (z, y, x)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

AXES = ("z", "y", "x")
"""Names of a volume's axes, in order."""

Layers = tuple[tuple[int, int], tuple[int, int], tuple[int, int]]
"""Numbers of layers of voxels below and above a grid along z, y, x."""

NO_LAYERS: Layers = ((0, 0), (0, 0), (0, 0))


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Regular grid of cubic voxels."""

    shape: tuple[int, int, int]
    """Voxel counts, order (z, y, x)."""
    voxel_mm: float
    """Voxel edge [mm]."""
    first_centre_mm: tuple[float, float, float]
    """Centre of voxel (0, 0, 0) [mm], order (z, y, x)."""

    def __post_init__(self) -> None:
        """Check the values; raise ValueError."""
        whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n >= 1 for n in self.shape)
        if not (len(self.shape) == 3 and whole):
            raise ValueError(f"shape: expected three whole numbers of voxels >= 1 (z, y, x), got {self.shape}.")
        if not (math.isfinite(self.voxel_mm) and self.voxel_mm > 0):
            raise ValueError(f"voxel_mm: expected a length > 0 mm, got {self.voxel_mm!r}.")
        if not (len(self.first_centre_mm) == 3 and all(map(math.isfinite, self.first_centre_mm))):
            raise ValueError(f"first_centre_mm: expected three finite lengths (z, y, x), got {self.first_centre_mm}.")

    @classmethod
    def from_extent(
        cls, *, centre_mm: tuple[float, float, float], size_mm: tuple[float, float, float], voxel_mm: float
    ) -> Grid:
        """Return a grid around a centre with n = round(size / voxel) voxels per axis.

        Parameters
        ----------
        centre_mm, size_mm : (float, float, float)
            Centre and size of the grid in the order (x, y, z) [mm].
        voxel_mm : float
            Voxel edge [mm].

        Raises
        ------
        ValueError
            If a value is not finite, `voxel_mm` is not above 0, or `size_mm` is less than a voxel.

        Examples
        --------
        >>> from lfpiv import Grid
        >>> grid = Grid.from_extent(centre_mm=(0, 0, 1), size_mm=(0.6, 0.4, 0.2), voxel_mm=0.1)
        >>> grid.shape
        (2, 4, 6)
        >>> grid.axis_mm(0).round(3).tolist()  # z
        [0.95, 1.05]
        """
        if not (math.isfinite(voxel_mm) and voxel_mm > 0):
            raise ValueError(f"voxel_mm: expected a length > 0 mm, got {voxel_mm!r}.")
        if not all(math.isfinite(size) and round(size / voxel_mm) >= 1 for size in size_mm):
            raise ValueError(f"size_mm: expected (x, y, z) of at least a voxel of {voxel_mm:g} mm each, got {size_mm}.")
        nx, ny, nz = (round(size / voxel_mm) for size in size_mm)
        x, y, z = (centre - (n - 1) / 2 * voxel_mm for centre, n in zip(centre_mm, (nx, ny, nz), strict=True))
        return cls(shape=(nz, ny, nx), voxel_mm=voxel_mm, first_centre_mm=(z, y, x))

    @property
    def size(self) -> int:
        """Number of voxels."""
        return math.prod(self.shape)

    def axis_mm(self, axis: int) -> np.ndarray:
        """Return the voxel centres along one axis (0: z, 1: y, 2: x) [mm]."""
        return self.first_centre_mm[axis] + self.voxel_mm * np.arange(self.shape[axis])

    @property
    def axes_mm(self) -> list[np.ndarray]:
        """The voxel centres along z, y and x [mm]."""
        return [self.axis_mm(axis) for axis in range(3)]

    def coordinates(self) -> dict[str, tuple[str, np.ndarray, dict[str, str]]]:
        """Return the voxel centres along z, y, x as coordinates of a DataArray [mm]."""
        return {name: (name, self.axis_mm(axis), {"units": "mm"}) for axis, name in enumerate(AXES)}

    def centres_mm(self) -> np.ndarray:
        """Return all voxel centres (x, y, z), in C order of the axes (z, y, x) [mm], shape (voxel, 3)."""
        z, y, x = np.meshgrid(*self.axes_mm, indexing="ij")
        return np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)

    def padded(self, layers: Layers) -> Grid:
        """Return the grid with layers of voxels added beyond its faces.

        Parameters
        ----------
        layers : three (int, int)
            Layers below and above the grid along z, y, x.

        Raises
        ------
        ValueError
            If a number of layers is not a whole number >= 0.

        Examples
        --------
        >>> from lfpiv import Grid
        >>> grid = Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.6, 0.4, 0.2), voxel_mm=0.1)
        >>> guarded = grid.padded(grid.layers((0, 0, 0.3)))
        >>> guarded.shape
        (8, 4, 6)
        >>> volume = np.ones(guarded.shape)
        >>> volume[grid.within(guarded)].shape
        (2, 4, 6)
        """
        flat = [count for pair in layers for count in pair]
        whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n >= 0 for n in flat)
        if not (len(layers) == 3 and len(flat) == 6 and whole):
            raise ValueError(f"layers: expected (below, above) along z, y, x in whole numbers >= 0, got {layers}.")
        z, y, x = (first - low * self.voxel_mm for first, (low, _) in zip(self.first_centre_mm, layers, strict=True))
        nz, ny, nx = (n + low + high for n, (low, high) in zip(self.shape, layers, strict=True))
        return Grid(shape=(nz, ny, nx), voxel_mm=self.voxel_mm, first_centre_mm=(z, y, x))

    def layers(self, thickness_mm: float | tuple[float, float, float]) -> Layers:
        """Return the whole layers of voxels that a thickness (x, y, z), or one of all faces, takes at least [mm]."""
        x, y, z = thickness_mm if isinstance(thickness_mm, tuple) else (thickness_mm,) * 3
        nz, ny, nx = (math.ceil(thickness / self.voxel_mm - 1e-6) for thickness in (z, y, x))
        return (nz, nz), (ny, ny), (nx, nx)

    def within(self, padded: Grid) -> tuple[slice, slice, slice]:
        """Return the slices of a padded grid that are this grid's voxels, along z, y, x."""
        first = [
            round((own - other) / self.voxel_mm)
            for own, other in zip(self.first_centre_mm, padded.first_centre_mm, strict=True)
        ]
        z, y, x = (slice(start, start + n) for start, n in zip(first, self.shape, strict=True))
        return z, y, x

    def refined(self, factor: float) -> Grid:
        """Return a grid of smaller voxels around the same centre that covers this one.

        Parameters
        ----------
        factor : float
            Edge of this grid's voxels over the edge of the smaller voxels, >= 1.

        Raises
        ------
        ValueError
            If the factor is not finite or below 1.

        Examples
        --------
        >>> from lfpiv import Grid
        >>> grid = Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.6, 0.4, 0.2), voxel_mm=0.1)
        >>> grid.refined(1.25).shape
        (3, 5, 8)
        """
        if not (math.isfinite(factor) and factor >= 1):
            raise ValueError(f"factor: expected a number >= 1, got {factor!r}.")
        if factor == 1:
            return self
        nz, ny, nx = (math.ceil(n * factor - 1e-6) for n in self.shape)
        edge, centre = self.voxel_mm / factor, self.centre_mm[::-1].tolist()
        z, y, x = (middle - (n - 1) / 2 * edge for middle, n in zip(centre, (nz, ny, nx), strict=True))
        return Grid(shape=(nz, ny, nx), voxel_mm=edge, first_centre_mm=(z, y, x))

    def nearest_in(self, other: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for each voxel of this grid the nearest one of another grid: an index of its volumes (`numpy.ix_`).

        Where this grid reaches beyond the other one, the voxels at its faces are taken.
        """
        places = [(self.axis_mm(k) - other.first_centre_mm[k]) / other.voxel_mm for k in range(3)]
        z, y, x = np.ix_(
            *(np.clip(np.rint(at), 0, n - 1).astype(int) for at, n in zip(places, other.shape, strict=True))
        )
        return z, y, x

    @property
    def centre_mm(self) -> np.ndarray:
        """Centre (x, y, z) of the volume, shape (3,) [mm]."""
        return np.array([self.axis_mm(axis)[[0, -1]].mean() for axis in (2, 1, 0)])

    def centre_text(self) -> str:
        """Return the centre (x, y, z) as text for messages."""
        centre = (round(value, 6) + 0.0 for value in self.centre_mm.tolist())
        return f"({', '.join(f'{value:g}' for value in centre)}) mm"
