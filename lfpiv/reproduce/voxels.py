"""Voxels that the cases reconstruct, as in a run: a layer beyond each face, and as fine as the particles demand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import NO_LAYERS, Grid, Layers
from lfpiv.geometry.resampling import volume_on
from lfpiv.reconstruction.refinement import measure_size, needed_refinement
from lfpiv.reconstruction.volume import reconstruct
from lfpiv.reproduce import store
from lfpiv.reproduce.rigs import Rig
from lfpiv.settings.processing import Smart
from lfpiv.weights.operator import Weights

LAYERS: Layers = ((1, 1), (1, 1), (1, 1))
"""Layers beyond the faces: the least of a run. No light comes from beyond the volumes of these cases."""


@dataclass(frozen=True)
class Voxels:
    """Voxels to reconstruct for a volume."""

    volume: Grid
    """The voxels on which volumes are judged and correlated."""
    layers: Layers = NO_LAYERS
    """Layers of voxels beyond its faces."""
    refinement: float = 1.0
    """Edge of its voxels over the edge of reconstructed voxels."""
    particle_voxel: float = 0.0
    """Size of the particles, standard deviation [voxel of the volume]."""

    @property
    def grid(self) -> Grid:
        """Grid of the reconstructed voxels."""
        return self.volume.padded(self.layers).refined(self.refinement)

    @property
    def text(self) -> str:
        """Sentences that tell what was reconstructed, for the page of a case."""
        return (
            f"Volumes are reconstructed as in a run, on voxels of {self.grid.voxel_mm:.3g} mm with a layer beyond each "
            f"face. They are judged on voxels of {self.volume.voxel_mm:g} mm."
        )

    def weights(self, rig: Rig, mapping: str) -> Weights:
        """Build the weights of the reconstructed voxels; see `Rig.weights` for the mapping."""
        built = rig.weights(self.grid, mapping, particle_voxel=self.particle_voxel * self.refinement)
        built.volume = self.volume
        return built

    def reconstruct(
        self,
        weights: Weights,
        images: Mapping[str, np.ndarray],
        smart: Smart,
        *,
        first: np.ndarray | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> xr.DataArray:
        """Reconstruct images without background, and return the voxels of the volume, shape (z, y, x) [counts].

        `first` is a first guess on the reconstructed voxels.
        """
        found = reconstruct(weights, images, first=first, progress=progress, **smart.of_one_frame(self.refinement))
        return volume_on(found, self.volume)


def demanded(
    rig: Rig, volume: Grid, path: Path, settings: Mapping[str, Any], images: Callable[[], Mapping[str, np.ndarray]]
) -> Voxels:
    """Return the voxels that a run with the default settings reconstructs for a volume.

    Parameters
    ----------
    rig : Rig
        The cameras, with the network's mapping.
    path : Path
        File that keeps the measured size of the particles.
    settings : mapping
        Everything that the images depend on, JSON-able.
    images : callable
        Returns the images in which the size is measured: camera -> (rows, columns) [count].
    """

    def measure() -> dict[str, float]:
        size = measure_size(rig.calibration, volume, [images()])
        return {"size": 0.0 if size is None else size, "refinement": needed_refinement(size)}

    found = store.cached_arrays(path, settings, measure)
    return Voxels(volume, LAYERS, float(found["refinement"]), float(found["size"]))
