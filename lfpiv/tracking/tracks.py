"""`particle_tracks`: links of a time series joined to tracks over many instants.

Every link is that of one pair and does not depend on where a run began. Two links of successive pairs belong to one
track where the second begins where the first one ends.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from lfpiv.geometry.names import PARTICLE

JOINT_VOXEL = 0.5
"""Largest distance between the end of a link and the beginning of the next one [voxel]."""
GAP_VOXEL = 1.0
"""Largest distance between a particle that is predicted over a missing link and the next link [voxel]."""
INSTANT = "instant"


def particle_tracks(table: xr.Dataset, *, joint_voxel: float = JOINT_VOXEL, gap_voxel: float = GAP_VOXEL) -> xr.Dataset:
    """Join the links of a time series to tracks.

    Only valid links are joined. A missing link is bridged where the last velocity leads to the next one.

    Parameters
    ----------
    table : Dataset
        From `open_particles`, of a time series.
    joint_voxel : float
        Largest distance between the end of a link and the beginning of the next one [voxel].
    gap_voxel : float
        Largest distance of a link from the place predicted over one missing link [voxel]; 0 bridges none.

    Returns
    -------
    Dataset
        The table with ``track``, the number of each link's track, -1 for links that are not valid, and
        ``track_length``, its number of links.

    Raises
    ------
    ValueError
        If the table is not of a time series.
    """
    if INSTANT not in table:
        raise ValueError(f"table: expected the links of a time series with {INSTANT!r}, found {list(table.data_vars)}.")
    step, voxel_mm = int(table.attrs.get("step", 1)), float(table.attrs["voxel_mm"])
    middle = np.stack([table[axis].values for axis in "xyz"], axis=1) / voxel_mm
    moved = np.stack([table[f"displacement_{axis}"].values for axis in "xyz"], axis=1)
    instants, valid = table[INSTANT].values, table["valid"].values
    start, end = middle - moved / 2, middle + moved / 2
    track = np.full(len(instants), -1)
    heads: dict[int, np.ndarray] = {}
    count = 0
    for instant in np.unique(instants[valid]):
        here = np.flatnonzero(valid & (instants == instant))
        before = heads.get(int(instant) - step, np.zeros(0, int))
        skipped = heads.get(int(instant) - 2 * step, np.zeros(0, int))
        skipped = skipped[~np.isin(track[skipped], track[before])]
        for earlier, place, reach in ((before, end, joint_voxel), (skipped, end + moved, gap_voxel)):
            free = here[track[here] < 0]
            one, other = _mutual(place[earlier], start[free], reach)
            track[free[other]] = track[earlier[one]]
        new = here[track[here] < 0]
        track[new] = count + np.arange(len(new))
        count += len(new)
        heads[int(instant)] = here
    length = np.bincount(track[track >= 0], minlength=count)
    lengths = np.where(track >= 0, length[np.maximum(track, 0)] if count else 0, 0)
    about = {"units": "1", "long_name": "number of the track; -1: link that is not valid"}
    about_length = {"units": "1", "long_name": "links of the track"}
    return table.assign(track=(PARTICLE, track, about), track_length=(PARTICLE, lengths, about_length))


def _mutual(ends: np.ndarray, starts: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of an end and a start that are each other's nearest within a distance."""
    if not len(ends) or not len(starts) or reach <= 0:
        return np.zeros(0, int), np.zeros(0, int)
    distance, nearest = cKDTree(ends).query(starts)
    _, back = cKDTree(starts).query(ends)
    other = np.flatnonzero((back[nearest] == np.arange(len(starts))) & (distance <= reach))
    return nearest[other], other
