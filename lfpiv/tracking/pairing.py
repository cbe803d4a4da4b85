"""Particles of two frames at once: what one frame shows tells the other one where to look.

A particle that is found in one frame only is a candidate in the other one, at the place to which the links nearby lead
it, with the light that it has in each camera. It must be confirmed there as every other one. Prediction from one
instant to the next is that of Shake-the-Box [1]_, here in both directions.

.. [1] D. Schanz, S. Gesemann, A. Schröder, "Shake-The-Box: Lagrangian particle tracking at high particle image
   densities", Exp. Fluids 57 (2016) 70, doi:10.1007/s00348-016-2157-1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from lfpiv.tracking.finding import ParticleSearch
from lfpiv.tracking.fit import Fit
from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.linking import FIRST_SPREAD_VOXEL, Links, linked
from lfpiv.tracking.refinement import Cloud

EXCHANGES = 2
"""How often both frames tell each other where to look."""
REPLACED_VOXEL = 1.0
"""Distance from a candidate within which a particle without a link gives way to it [voxel]."""


def exchange(
    search: ParticleSearch,
    fits: Sequence[Fit],
    vectors: xr.Dataset | None = None,
    *,
    spread_voxel: float = FIRST_SPREAD_VOXEL,
) -> tuple[FoundParticles, FoundParticles]:
    """Look in each of two frames for the particles that are only found in the other one.

    Parameters
    ----------
    search : ParticleSearch
        Search for particles of the rig.
    fits : sequence of Fit
        From `ParticleSearch.fit`, of both frames; they are changed.
    vectors : Dataset, optional
        Displacement field of the pair; see `link_particles`.
    spread_voxel : float
        Standard deviation of true displacements about it [voxel].

    Returns
    -------
    first, second : FoundParticles
        Particles of both frames. Without links enough to tell the flow they are those of each frame by itself.
    """
    first, second = (search.particles(fit) for fit in fits)
    for _ in range(EXCHANGES):
        links = linked(first, second, vectors, spread_voxel=spread_voxel)
        if not links.flow.known:
            break
        numbers = [search.reported(fit) for fit in fits]
        clouds = [_predicted(fits, numbers, links, frame) for frame in (0, 1)]
        for frame, cloud in enumerate(clouds):
            if len(cloud):
                replaced = np.zeros(len(fits[frame].cloud), bool)
                near, _ = cKDTree(cloud.positions_mm).query(fits[frame].cloud.positions_mm)
                replaced = near < REPLACED_VOXEL * first.voxel_mm
                replaced[numbers[frame][links.pairs[links.valid, frame]]] = False
                search.add(fits[frame], cloud, replaced)
        first, second = (search.particles(fit) for fit in fits)
    return first, second


def _predicted(fits: Sequence[Fit], numbers: Sequence[np.ndarray], links: Links, frame: int) -> Cloud:
    """Return the particles that have no link in the other frame, where they are in this one."""
    other = 1 - frame
    alone = fits[other].cloud[numbers[other][links.unlinked(other, len(numbers[other]))]]
    moved = links.flow(alone.positions_mm) if frame else links.flow.back(alone.positions_mm)
    here, there = (fits[one].cloud.light[numbers[one][links.pairs[links.valid, one]]] for one in (frame, other))
    ratio = np.median(here / np.maximum(there, 1e-9), axis=0)  # power of the pulses
    return Cloud(positions_mm=alone.positions_mm + moved, light=alone.light * ratio)
