"""Particles of a pair: found in the images of both frames, linked with the pair's vectors as predictor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from lfpiv.results.pair_files import PairVolumes
from lfpiv.runs.frame_light import FrameLight
from lfpiv.tracking.finding import ParticleSearch
from lfpiv.tracking.linking import link_particles
from lfpiv.tracking.pairing import exchange
from lfpiv.warn import Code, Warning

HIDDEN, HIDDEN_ONE = 0.5, 0.14
"""Share of particles that fewer than two cameras see alone above which particles are mixed up; the second of those that
a single camera does not see alone."""
LEAST_LINKED = 0.65
"""Least share of the found particles that are linked, without a warning. Ghosts in two frames have no partners."""
LEAST_FOUND = 20
"""Least number of particles in a frame that this share is judged by."""


def track(
    search: ParticleSearch, light: Sequence[FrameLight], volumes: PairVolumes, vectors: xr.Dataset
) -> tuple[xr.Dataset, list[Warning]]:
    """Find and link the particles of a pair.

    Parameters
    ----------
    search : ParticleSearch
        Search for particles of the rig.
    light : sequence of FrameLight
        Images of both frames.
    volumes : PairVolumes
        Volumes of both frames, whose peaks are the first candidates.
    vectors : Dataset
        Vectors of the pair.

    Returns
    -------
    table : Dataset
        Linked particles.
    warnings : list of Warning
        Doubts whether particles can be told apart.
    """
    fits = [
        search.fit(frame.images, volume, noise=frame.noise, clipped=frame.clipped or None)
        for frame, volume in zip(light, volumes.volumes, strict=True)
    ]
    first, second = exchange(search, fits, vectors)
    table = link_particles(first, second, vectors, dt_s=float(vectors.attrs["dt_s"]))
    return table, [*crowded_warnings(table, len(search.weights.cameras)), *unlinked_warnings(table)]


def crowded_warnings(table: xr.Dataset, cameras: int) -> list[Warning]:
    """Return a warning if too few cameras see particles alone for particles to be told apart."""
    share, limit = float(np.max(table.attrs["hidden"])), HIDDEN_ONE if cameras == 1 else HIDDEN
    if share <= limit:
        return []
    figures = {"share": share, "limit": limit, "per_microlens": float(np.mean(table.attrs["per_microlens"]))}
    return [Warning(code=Code.CROWDED, figures=figures)]


def unlinked_warnings(table: xr.Dataset) -> list[Warning]:
    """Return a warning if few of the found particles have a partner in the other frame."""
    found = float(np.mean(table.attrs["found"]))
    if found < LEAST_FOUND or (share := float(table.attrs["linked"]) / found) >= LEAST_LINKED:
        return []
    return [Warning(code=Code.UNLINKED, figures={"share": share, "limit": LEAST_LINKED})]
