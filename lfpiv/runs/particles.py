"""Particles of a pair: found in the images of both frames, linked with the pair's vectors as predictor."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from lfpiv.experiment.recording import Frame
from lfpiv.results.pair_files import PairVolumes
from lfpiv.runs.frame_light import FrameLight
from lfpiv.tracking.finding import ParticleSearch
from lfpiv.tracking.fit import Fit
from lfpiv.tracking.link_vectors import LEAST_LINKED
from lfpiv.tracking.linking import link_particles
from lfpiv.tracking.pairing import exchange
from lfpiv.warn import Code, Warning

HIDDEN, HIDDEN_ONE = 0.5, 0.14
"""Warn if a larger share of the particles overlaps others in all cameras, or in all but one. The second share is that
of a single camera."""
LEAST_FOUND = 20
"""Least number of particles in a frame that this share is judged by."""


@dataclass
class FrameFits:
    """Particles that are fitted to each frame by itself.

    In a series the second frame of a pair is the first one of another pair. So its particles are kept until then.
    """

    last: tuple[Frame, Fit] | None = None
    """Second frame of the last pair, and its particles found without candidates from the first frame."""

    def of_pair(self, search: ParticleSearch, light: Sequence[FrameLight], volumes: PairVolumes) -> list[Fit]:
        """Return the particles of both frames of a pair, which the caller may change."""
        known, fits = self.last, list[Fit]()
        for frame, volume in zip(light, volumes.volumes, strict=True):
            if known is not None and known[0] == frame.frame:
                fits.append(known[1])
            else:
                fits.append(search.fit(frame.images, volume, noise=frame.noise, clipped=frame.clipped or None))
        self.last = light[1].frame, copy.copy(fits[1])
        return fits


def track(
    search: ParticleSearch, fits: FrameFits, light: Sequence[FrameLight], volumes: PairVolumes, vectors: xr.Dataset
) -> tuple[xr.Dataset, list[Warning]]:
    """Find and link the particles of a pair.

    Parameters
    ----------
    search : ParticleSearch
        Search for particles of the rig.
    fits : FrameFits
        Particles of the pair before.
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
    first, second = exchange(search, fits.of_pair(search, light, volumes), vectors)
    table = link_particles(first, second, vectors, dt_s=float(vectors.attrs["dt_s"]))
    return table, [*crowded_warnings(table, len(search.weights.cameras)), *unlinked_warnings(table)]


def refused(table: xr.Dataset) -> xr.Dataset:
    """Mark all links of a pair as not valid."""
    return table.assign(valid=xr.zeros_like(table["valid"])).assign_attrs(valid_links=0)


def crowded_warnings(table: xr.Dataset, cameras: int) -> list[Warning]:
    """Warn if particle images overlap in too many cameras."""
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
