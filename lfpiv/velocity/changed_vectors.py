"""`with_displacement`: measured vectors with displacements of another estimate."""

from __future__ import annotations

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.geometry.names import COMPONENTS


def with_displacement(vectors: xr.Dataset, displacement: np.ndarray, deviation: np.ndarray) -> xr.Dataset:
    """Return vectors with other displacements and standard deviations, and the velocities that follow.

    Parameters
    ----------
    vectors : Dataset
        From `lfpiv.correlate`.
    displacement, deviation : ndarray, shape (z, y, x, 3)
        Displacement along (z, y, x) and its standard deviation [voxel].

    Returns
    -------
    Dataset
        Other variables and all attributes are kept. Velocities [m/s] change where the vectors have some.
    """
    changed = {"uncertainty": np.sqrt((deviation**2).sum(-1))}
    for k, axis in enumerate(AXES):
        changed[f"displacement_{axis}"] = displacement[..., k]
        changed[f"uncertainty_{axis}"] = deviation[..., k]
        if "dt_s" in vectors.attrs:
            metres = np.asarray(vectors.attrs["voxel_mm"])[k] * 1e-3 / vectors.attrs["dt_s"]
            changed[COMPONENTS[axis]] = displacement[..., k] * metres
    return vectors.assign({name: vectors[name].copy(data=one.astype(np.float32)) for name, one in changed.items()})
