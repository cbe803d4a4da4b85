"""How much smaller than the voxels of a volume those should be that are reconstructed.

A particle smaller than a voxel is no sum of voxels [1]_: what is left over in its images makes ghosts. The size of the
particles is measured in the images with the weights of a small part of the volume (`measure_size`), and the refinement
follows from it (`needed_refinement`). `Grid.refined` returns the grid to build the weights for, and `volume_on` samples
what is reconstructed on the voxels of the volume.

.. [1] R. M. Lewitt, "Alternatives to voxels for image representation in iterative reconstruction algorithms", Phys.
   Med. Biol. 37 (1992) 705-716, doi:10.1088/0031-9155/37/3/015.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lfpiv.calibration.camera import Calibration
from lfpiv.geometry.grid import Grid
from lfpiv.reconstruction.particle_size import ParticleSizer
from lfpiv.weights.operator import build_weights

LARGEST_PART = 40
"""Largest edge of the part of a volume whose weights measure the particles' size [voxel]."""
RESOLVED = 0.93
"""Least size of particles that voxels describe well, standard deviation [reconstructed voxel]."""
LARGEST = 2.0
"""Largest refinement that is asked for: eight times as many voxels."""
STEP = 0.05
"""Refinements are rounded to multiples of this."""


def measure_size(calibration: Calibration, grid: Grid, images: Sequence[Mapping[str, np.ndarray]]) -> float | None:
    """Measure the size of the particles before the weights of the volume are built.

    Parameters
    ----------
    grid : Grid
        The volume. The weights of its middle, at most `LARGEST_PART` voxels along each axis, are built, and those of as
        many coarse voxels for the light of the whole.
    images : sequence of dict
        Some frames: camera name -> image, shape (rows, columns) [counts], background subtracted, its noise included.

    Returns
    -------
    float or None
        Standard deviation of the particles [voxel of the grid], as of `ParticleSizer.size`: root mean square over the
        frames. None if it can be measured in none of them.
    """
    middle = _central(grid, min(LARGEST_PART * grid.voxel_mm, max(grid.shape) * grid.voxel_mm), grid.voxel_mm)
    weights, even = build_weights(calibration, middle, form="pixels"), None
    if max(grid.shape) > LARGEST_PART:
        longest_mm = max(grid.shape) * grid.voxel_mm
        coarse = build_weights(calibration, _central(grid, longest_mm, longest_mm / LARGEST_PART), form="pixels")
        even = coarse(np.ones(coarse.grid.shape, np.float32))
    sizer = ParticleSizer(weights, even)
    found = [size for image in images if (size := sizer.size(sizer.fluctuations(image))) is not None]
    return float(np.sqrt(np.mean(np.square(found)))) if found else None


def _central(grid: Grid, largest_mm: float, voxel_mm: float) -> Grid:
    """Return the middle of a grid, at most `largest_mm` along each axis, in voxels of another size."""
    x, y, z = grid.centre_mm.tolist()
    along_z, along_y, along_x = (max(min(n * grid.voxel_mm, largest_mm), voxel_mm) for n in grid.shape)
    return Grid.from_extent(centre_mm=(x, y, z), size_mm=(along_x, along_y, along_z), voxel_mm=voxel_mm)


def needed_refinement(size_voxel: float | None) -> float:
    """Return the edge of a voxel over that of the voxels to reconstruct that particles of a size need.

    Parameters
    ----------
    size_voxel : float or None
        Standard deviation of the particles [voxel], from `measure_size`; None for an unknown one.

    Returns
    -------
    float
        From 1 to `LARGEST`; 1 for particles of `RESOLVED` or more, and for an unknown size.

    Examples
    --------
    >>> needed_refinement(0.75), needed_refinement(1.2)
    (1.25, 1.0)
    """
    if size_voxel is None:
        return 1.0
    wanted = min(RESOLVED / max(size_voxel, RESOLVED / LARGEST), LARGEST)
    return round(max(1.0, STEP * round(wanted / STEP)), 2)
