"""A time series of tracers in a turbulent flow, and what `predicted_series` measures of a series.

The work on a series is counted in passes over the rays.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import imperfect_scenes
import numpy as np
import xarray as xr
from imperfections import BAD_VOXEL
from reconstruction_cases import TRACERS_FILE
from scipy import ndimage

from lfpiv import metrics
from lfpiv.geometry.grid import Grid
from lfpiv.reconstruction import frame as prepared_frame
from lfpiv.reconstruction.smart import ImageEquations
from lfpiv.simulation.flows import window_mean
from lfpiv.simulation.scene import Scene
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.update import Comparison

CUBE_MM = 8.0
"""Edge to which the cube is scaled."""
INSTANTS = 12
STEP = 4
"""Instants between the two that are correlated."""
VOXEL_MM = imperfect_scenes.VOXEL_MM
BLOB_VOXEL, BLUR_VOXEL = 0.7, 0.6
"""Standard deviation of a particle in the true volume, and of the blur that gives points that size [voxel]."""


def series_scene(scale: str, seed: int) -> Scene:
    """Return the rig of the case `imperfections` with ideal images, around the tracers."""
    tables = imperfect_scenes.ideal_tables(scale, seed)
    return Scene.model_validate(
        tables
        | {
            "name": "Rayleigh-Benard convection",
            "particles": tables["particles"] | {"instants": INSTANTS, "step": STEP},
            "flow": {
                "kind": "tracers",
                "file": str(TRACERS_FILE),
                "series": "positions",
                "size_mm": (CUBE_MM,) * 3,
                "box": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
                "as_given": True,
            },
        }
    )


@dataclass
class Counts:
    """Work on a series."""

    passes: float = 0.0
    """Passes over all rays: half of it is a projection, half a back-projection. A first guess is one."""


@contextmanager
def counted_reconstructions(cameras: int) -> Iterator[Counts]:
    """Count the work of SMART on images of all cameras in this process."""
    counts = Counts()

    def half(of: Any, self: ImageEquations, *arguments: Any) -> Any:
        counts.passes += 0.5 * (len(self.cameras) == cameras)
        return of(self, *arguments)

    def half_of(equations: ImageEquations, camera: int, ray_set: int) -> float:
        sets = 1 if ray_set == ALL else equations.cameras[camera].projector.ray_sets
        return 0.5 / sets / cameras * (len(equations.cameras) == cameras)

    def part(of: Any, self: ImageEquations, camera: int, ray_set: int, *arguments: Any) -> Any:
        counts.passes += half_of(self, camera, ray_set)
        return of(self, camera, ray_set, *arguments)

    def back(of: Any, self: ImageEquations, parts: Sequence[tuple[int, int]], *arguments: Any) -> Any:
        counts.passes += sum(half_of(self, *one) for one in parts)  # the comparisons are counted by themselves
        return of(self, parts, *arguments)

    def guess(of: Any, views: Sequence[Comparison], *arguments: Any, **part: Any) -> Any:
        of_all = sum(view.projector.ray_sets for view in views)
        share = 1 if part.get("subset") is None else len(part["subset"].parts) / of_all
        counts.passes += share * (len(views) == cameras)
        return of(views, *arguments, **part)

    with ExitStack() as patches:
        for owner, name, call in (
            (ImageEquations, "compare", half),
            (ImageEquations, "back_project", half),
            (ImageEquations, "compare_part", part),
            (ImageEquations, "exponent_of", back),
            (prepared_frame, "multiplicative_guess", guess),
        ):
            patches.enter_context(patch.object(owner, name, _wrapped(call, getattr(owner, name))))
        yield counts


def _wrapped(call: Any, original: Any) -> Any:
    """Return a function that calls `call` with the original one and its arguments."""

    @functools.wraps(original)
    def function(*arguments: Any, **options: Any) -> Any:
        return call(original, *arguments, **options)

    return function


def quality(volume: xr.DataArray, position_mm: np.ndarray, grid: Grid) -> float:
    """Return Q of a volume of points, after a blur, against blobs at the true positions."""
    truth = metrics.truth_volume(position_mm, None, grid, BLOB_VOXEL)
    blurred = ndimage.gaussian_filter(volume.values, BLUR_VOXEL, mode="constant")
    return float(metrics.reconstruction_quality(blurred, truth.values))


def judged(scene: Scene, number: int, vectors: xr.Dataset) -> dict[str, float]:
    """Compare the vectors of one instant with the mean displacement of all tracers over their windows."""
    edge = np.array(json.loads(vectors.attrs["settings"])["windows"][-1][::-1]) * VOXEL_MM
    z, y, x = np.meshgrid(*(vectors[axis].values for axis in "zyx"), indexing="ij")
    centres = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    exact = window_mean(scene.flow_of(number), centres, tuple(edge.tolist())).reshape(*x.shape, 3) / VOXEL_MM
    field, spread = (
        np.stack([vectors[f"{name}_{axis}"].values for axis in "xyz"], axis=-1)
        for name in ("displacement", "uncertainty")
    )
    valid, error = vectors["valid"].values.astype(bool), field - exact
    length, told = np.linalg.norm(error, axis=-1), valid & np.isfinite(spread).all(-1)
    interior = tuple(slice(1, -1) if edges > 2 else slice(None) for edges in valid.shape)
    return {
        "all": float(length.mean()),
        "interior": float(length[interior].mean()),
        "valid": 100 * float(valid.mean()),
        "within": 100 * float((np.abs(error[told]) <= 2 * spread[told]).mean()),
        "bad": 100 * float((length[valid] > BAD_VOXEL).mean()),
        "moved": float(np.linalg.norm(exact, axis=-1).mean()),
        "correlation": float(np.corrcoef(field[valid].ravel(), exact[valid].ravel())[0, 1]),
    }
