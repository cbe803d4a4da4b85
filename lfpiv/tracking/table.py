"""Tables of linked particles as datasets: what the file of a pair's particles holds."""

from __future__ import annotations

import numpy as np
import xarray as xr

from lfpiv.geometry.names import COMPONENTS, PARTICLE
from lfpiv.tracking.found import FoundParticles


def link_table(
    first: FoundParticles, second: FoundParticles, links: np.ndarray, valid: np.ndarray, *, dt_s: float
) -> xr.Dataset:
    """Return the table of linked particles.

    Parameters
    ----------
    first, second : FoundParticles
        Particles of both frames.
    links : ndarray, shape (link, 2)
        Numbers of the first and the second particle of each link.
    valid : ndarray, shape (link,), bool
        Links that passed validation.
    dt_s : float
        Time between the frames [s].

    Returns
    -------
    Dataset
        Over ``particle``: ``x``, ``y``, ``z`` midway between the frames [mm], ``u``, ``v``, ``w`` [m/s],
        ``displacement_x``, ``_y``, ``_z`` and ``uncertainty_x``, ``_y``, ``_z``, their standard errors [voxel],
        ``intensity`` [counts], ``residual``, ``signal_to_noise``, ``valid``, and ``first`` and
        ``second``, the numbers of the particle among those found in both frames. Attributes: figures of both frames.
    """
    a, b = links.T if len(links) else (np.zeros(0, int), np.zeros(0, int))
    voxel_mm = first.voxel_mm
    middle = (first.positions_mm[a] + second.positions_mm[b]) / 2
    moved = (second.positions_mm[b] - first.positions_mm[a]) / voxel_mm
    error = np.sqrt(np.square(first.errors_mm[a]) + np.square(second.errors_mm[b])) / voxel_mm
    data = {
        axis: (middle[:, k], "mm", f"position along {axis}, midway between the frames") for k, axis in enumerate("xyz")
    }
    for k, (axis, name) in enumerate(COMPONENTS.items()):
        data[name] = (moved[:, k] * voxel_mm * 1e-3 / dt_s, "m/s", f"velocity along {axis}")
        data[f"displacement_{axis}"] = (moved[:, k], "voxel", f"displacement along {axis}")
        data[f"uncertainty_{axis}"] = (error[:, k], "voxel", f"standard error of the displacement along {axis}")
    data["intensity"] = ((first.light[a] + second.light[b]) / 2, "counts", "light of the particle, mean of the cameras")
    residual = np.sqrt((np.square(first.residual[a]) + np.square(second.residual[b])) / 2)
    data["residual"] = (residual, "1", "root mean square of the weighted residuals of its pixels; 1 for noise alone")
    ratio = np.minimum(first.signal_to_noise[a], second.signal_to_noise[b])
    data["signal_to_noise"] = (ratio, "1", "light over its standard error, least of the cameras and frames")
    for name, number in (("first", a), ("second", b)):
        data[name] = (number, "1", f"number of the particle among those found in the {name} frame")
    data["valid"] = (np.asarray(valid, bool), "1", "true: agrees with its neighbours")
    return xr.Dataset(
        {name: (PARTICLE, values, {"units": unit, "long_name": text}) for name, (values, unit, text) in data.items()},
        {PARTICLE: (PARTICLE, np.arange(len(a)), {"long_name": "number of the particle in this pair"})},
        {
            "title": "velocities of single particles",
            "dt_s": dt_s,
            "voxel_mm": voxel_mm,
            "found": [len(first), len(second)],
            "linked": len(a),
            "valid_links": int(np.sum(valid)),
            "explained": [first.explained, second.explained],
            "crowding": [first.crowding, second.crowding],
            "hidden": [first.hidden, second.hidden],
            "per_microlens": [first.per_microlens, second.per_microlens],
            "sigma_voxel": [first.sigma_voxel, second.sigma_voxel],
        },
    )
