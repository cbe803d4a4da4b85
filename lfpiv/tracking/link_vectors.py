"""`vectors_from_links`: vectors of a pair from its linked particles, in place of the correlation's.

One camera sees depth through the pupil alone, and its volumes are long in depth. Correlation finds depth displacements
with errors of half a voxel there. The links of single particles, a process through them, and its means over the windows
(`lfpiv.tracking.flow_process`) find them several times as precisely where seeding is thin.
"""

from __future__ import annotations

import json

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.velocity.changed_vectors import with_displacement
from lfpiv.velocity.coverage import LEAST_SEEDED
from lfpiv.velocity.cross_correlation import verdict_of
from lfpiv.velocity.settings import CorrelationSettings

LEAST_LINKS = 40
"""Least number of valid links that tell the length and the strength of a flow."""
LEAST_LINKED = 0.65
"""Least share of the found particles that are linked. Ghosts in two frames have no partners, and mislead links."""
LARGEST_VOXEL = 1.0
"""Largest standard deviation of a valid vector [voxel]."""


def vectors_from_links(vectors: xr.Dataset, links: xr.Dataset) -> xr.Dataset:
    """Return the vectors of a pair as means over the windows of a process through its links.

    Parameters
    ----------
    vectors : Dataset
        From `correlate`, with coordinates [mm]. Its windows are taken.
    links : Dataset
        From `link_particles`. Those that are not valid do not enter.

    Returns
    -------
    Dataset
        `vectors` with other velocities, displacements and standard deviations. A vector is ``valid`` where half of the
        window's fluid holds particles and the standard deviation of each component is at most `LARGEST_VOXEL`. It is
        finite where nothing is masked. The attribute ``links`` is JSON: ``number`` of links, ``form``
        ("incompressible" or "independent"), ``length`` and ``strength`` of the flow's fluctuations, ``scatter`` of
        structures that the links do not resolve [voxel]. With fewer than `LEAST_LINKS` valid links, or if fewer than
        `LEAST_LINKED` of the found particles are linked, `vectors` is returned as it is.

    Raises
    ------
    ValueError
        If the datasets are not of the same voxels or have no coordinates in mm.
    """
    from lfpiv.tracking.flow_process import FlowProcess  # scikit-learn takes a second to import

    edges = np.atleast_1d(np.asarray(vectors.attrs.get("voxel_mm", ()), float))
    edge = float(links.attrs["voxel_mm"])
    if not (len(edges) and np.allclose(edges, edge, rtol=1e-6)):
        raise ValueError(f"links: expected links in voxels of {edges.tolist()} mm, as the vectors, got {edge:g} mm.")
    valid = links["valid"].values.astype(bool)
    if valid.sum() < LEAST_LINKS or links.attrs["linked"] < LEAST_LINKED * np.mean(links.attrs["found"]):
        return vectors
    places, moved, error = (
        np.stack([links[f"{name}{axis}"].values[valid] for axis in "xyz"], axis=1).astype(float)
        for name in ("", "displacement_", "uncertainty_")
    )
    process = FlowProcess.fitted(places / edge, moved, error)
    centres = np.stack(np.meshgrid(*(vectors[axis].values for axis in AXES), indexing="ij"), axis=-1)[..., ::-1] / edge
    window = CorrelationSettings.from_vectors(vectors).windows[-1]
    mean, deviation = process.means(centres.reshape(-1, 3), np.asarray(window[::-1], float))
    deviation *= np.maximum(np.sqrt(np.mean(np.square(process.left_out()), axis=0)), 1)
    return _merged(vectors, mean.reshape(centres.shape), deviation.reshape(centres.shape)).assign_attrs(
        links=json.dumps(
            {
                "number": int(valid.sum()),
                "form": "incompressible" if process.covariance.incompressible else "independent",
                "length": round(float(process.covariance.length), 2),
                "strength": round(float(np.sqrt(np.mean(np.square(process.covariance.strength)))), 3),
                "scatter": round(float(process.covariance.scatter), 3),
            }
        )
    )


def _merged(vectors: xr.Dataset, mean: np.ndarray, deviation: np.ndarray) -> xr.Dataset:
    """Return vectors with other displacements and standard deviations, shape (z, y, x, 3) along x, y, z [voxel]."""
    fluid = ~vectors["masked"].values
    measurable = fluid & (vectors["seeded_share"].values >= LEAST_SEEDED)
    valid = measurable & (deviation <= LARGEST_VOXEL).all(-1)
    known, stated = np.where(fluid, 1.0, np.nan)[..., None], np.where(valid, 1.0, np.nan)[..., None]
    found = with_displacement(vectors, (mean * known)[..., ::-1], (deviation * stated)[..., ::-1])
    for name in ("uncertainty", *(f"uncertainty_{axis}" for axis in AXES)):
        found[name].attrs["long_name"] = found[name].attrs["long_name"].split(":")[0] + ": of the linked particles"
    shares = [float(valid[part].mean()) if part.any() else 0.0 for part in (fluid, measurable)]
    verdict = verdict_of(shares[1]).value
    return found.assign(valid=vectors["valid"].copy(data=valid)).assign_attrs(valid_fraction=shares[0], verdict=verdict)
