"""`Reconstruction`: a volume by SMART, how well its projections match the images, and why the iteration stopped."""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES, Grid
from lfpiv.geometry.volume import MASKED, VIEWS
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv_kernels.correlation import deform, light

SMOOTHING_VOXEL = 0.7
"""Standard deviation of the Gaussian that smooths volumes before they are compared [voxel]: about the size of a
particle."""


class SmartStop(enum.Enum):
    """Why the iteration ended; the text is the advice."""

    DONE = "all iterations asked for were done"
    CONVERGED = "misfit no longer falls by more than the tolerance"
    ENOUGH = "more steps by subsets of the rays would not improve the volume"
    ITERATION_LIMIT = "iteration limit reached: raise smart.iterations if the misfit still falls"
    DIVERGED = "misfit rises: lower smart.relaxation"


@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """Volume of one frame; figures of cameras are by camera name."""

    grid: Grid
    volume: np.ndarray
    """Particle intensity [counts per unit weight], shape (z, y, x), float32."""
    views: np.ndarray | None
    """Number of cameras that see each voxel, shape (z, y, x). None for one camera, or if two see every voxel."""
    solid: np.ndarray | None
    """True for voxels without fluid, shape (z, y, x); None without a mask."""
    residual: tuple[float, ...]
    """||I - P|| / ||I|| before each iteration and after the last."""
    misfit: tuple[float, ...]
    """Kullback-Leibler divergence that SMART lowers [counts], before each iteration and after the last."""
    stop: SmartStop
    floor: dict[str, float]
    """Noise floor [counts]."""
    camera_gain: dict[str, float]
    """Brightness relative to the brightest camera."""
    light_outside: dict[str, float]
    """Part of an image's light in pixels that no voxel lights."""
    light: dict[str, float]
    """Sum of an image in pixels that voxels light [counts]."""
    sieve_voxel: float
    """Standard deviation of the sieve that was used [voxel]."""
    intensity_cap: float
    """Limit of the counts that was used, as a multiple of the typical peak; 0 for none."""
    settings: SmartSettings
    unlike: float | None = None
    """How much the cameras ask for unlike light, see `lfpiv.reconstruction.unlike_light`; None if it was not asked."""

    @property
    def blurred(self) -> np.ndarray:
        """The volume smoothed by the size of a particle, in which frames are compared, float32."""
        return light.smoothed(self.volume, SMOOTHING_VOXEL)

    @cached_property
    def spline(self) -> np.ndarray:
        """Spline coefficients of the smoothed volume, by which it is moved to other frames, float32."""
        return deform.spline_coefficients(self.blurred)

    @property
    def iterations(self) -> int:
        """Number of iterations that were done."""
        return len(self.residual) - 1

    def continued_by(self, after: Reconstruction) -> Reconstruction:
        """Return a later reconstruction that started from this one, with the history of both.

        It keeps the earlier reason to stop, unless the later result diverged: the later run is short by design.
        """
        stop = after.stop if after.stop is SmartStop.DIVERGED else self.stop
        residual, misfit = self.residual[:-1] + after.residual, self.misfit[:-1] + after.misfit
        return replace(after, residual=residual, misfit=misfit, stop=stop)

    def to_dataarray(self) -> xr.DataArray:
        """Return the volume with its coordinates [mm] and all figures as attributes, see `lfpiv.reconstruct`."""
        coordinates: dict[str, Any] = dict(self.grid.coordinates())
        if self.views is not None:
            about = {"units": "1", "long_name": "number of cameras that see the voxel"}
            coordinates[VIEWS] = (AXES, self.views, about)
        if self.solid is not None:
            coordinates[MASKED] = (AXES, self.solid, {"long_name": "no fluid in the voxel"})
        settings = self.settings
        attributes = {
            "long_name": "particle intensity",
            "units": "counts",
            "voxel_mm": self.grid.voxel_mm,
            "residual": list(self.residual),
            "misfit": list(self.misfit),
            "stop": self.stop.value,
            "iterations": self.iterations,
            "relaxation": settings.relaxation,
            "floor": list(self.floor.values()),
            "intensity_cap": self.intensity_cap,
            "camera_gain": list(self.camera_gain.values()),
            "light_outside": list(self.light_outside.values()),
            "light": list(self.light.values()),
            "normalisation": settings.normalisation,
            "accelerate": int(settings.accelerate),
            "sieve_voxel": self.sieve_voxel,
            **({} if self.unlike is None else {"unlike": round(self.unlike, 4)}),
        }
        return xr.DataArray(self.volume, dims=AXES, coords=coordinates, name="intensity", attrs=attributes)
