"""`follow`: particles of a time series from instant to instant, each predicted from its own past.

As in Shake-the-Box [1]_, a track that is known predicts where its particle is in the next instant. The prediction is a
candidate there, which the images must confirm as every other one. Further candidates are the particles that were linked
between two instants; those that no track predicts begin a track. A track ends where its particle is not found in two
successive instants.

.. [1] D. Schanz, S. Gesemann, A. Schröder, "Shake-The-Box: Lagrangian particle tracking at high particle image
   densities", Exp. Fluids 57 (2016) 70, doi:10.1007/s00348-016-2157-1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.linking import FIRST_SPREAD_VOXEL, NEIGHBOURS, matched, nearby
from lfpiv.tracking.trajectory import TELLING_TRACKS, Measured, Motion, State, fit_motion

LONGEST_GAP = 2
"""Largest distance between two successive instants in which the particle of a track is found."""
NEAR_VOXEL = 1.0
"""Distance within which two candidates are one [voxel]."""
FIRST_FIT = 4
"""Instants after which the motion of the particles is fitted first; it is fitted again each time they have doubled."""


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """What links between two instants show of the particles of one instant."""

    positions_voxel: np.ndarray
    """Positions of linked particles [voxel], shape (particle, 3)."""
    light: np.ndarray
    """Their light [counts], shape (particle,)."""
    moved_voxel: np.ndarray
    """Their velocity [voxel/instant], shape (particle, 3)."""
    valid: np.ndarray
    """Whether their link passed validation, shape (particle,), bool."""

    @classmethod
    def from_links(cls, tables: Sequence[tuple[xr.Dataset, int]], step: int) -> Candidates:
        """Return the particles of one instant from tables of links, each with its frame, 0 or 1, that is the instant.

        `step` is the number of instants between both frames.
        """
        positions, light, moved, valid = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros((0, 3))], [np.zeros(0, bool)]
        for table, frame in tables:
            middle = np.stack([table[axis].values for axis in "xyz"], axis=1) / float(table.attrs["voxel_mm"])
            shift = np.stack([table[f"displacement_{axis}"].values for axis in "xyz"], axis=1)
            positions.append(middle + (frame - 0.5) * shift)
            light.append(table["intensity"].values)
            moved.append(shift / step)
            valid.append(table["valid"].values)
        found = cls(
            positions_voxel=np.concatenate(positions),
            light=np.concatenate(light),
            moved_voxel=np.concatenate(moved),
            valid=np.concatenate(valid),
        )
        return found._without_copies()

    def _without_copies(self) -> Candidates:
        """Return the particles without duplicates of an earlier particle, or of a particle with a valid link."""
        order = np.argsort(~self.valid, kind="stable")
        pairs = cKDTree(self.positions_voxel[order]).query_pairs(NEAR_VOXEL) if len(order) else set()
        kept = np.ones(len(order), bool)
        for one, other in sorted(pairs):
            if kept[one]:
                kept[other] = False
        return self[np.sort(order[kept])]

    def __getitem__(self, chosen: np.ndarray) -> Candidates:
        return Candidates(
            positions_voxel=self.positions_voxel[chosen],
            light=self.light[chosen],
            moved_voxel=self.moved_voxel[chosen],
            valid=self.valid[chosen],
        )

    def velocity(self, positions_voxel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the velocity of the flow at places, and its standard deviation, shape (place, 3) [voxel/instant]."""
        places, moved = self.positions_voxel[self.valid], self.moved_voxel[self.valid]
        if len(places) > NEIGHBOURS:
            return nearby(places, moved, positions_voxel)
        usual = np.median(moved, axis=0) if len(moved) else np.zeros(3)
        spread = np.sqrt(FIRST_SPREAD_VOXEL**2 + (moved.var(axis=0) if len(moved) else np.zeros(3)))
        shape = positions_voxel.shape
        return np.broadcast_to(usual, shape), np.broadcast_to(spread, shape)


Look = Callable[[int, np.ndarray, np.ndarray], FoundParticles]
"""Confirms candidates in the images: (instant, positions (particle, 3) [voxel], light (particle,)) -> particles."""


@dataclass(frozen=True, kw_only=True)
class TrackedParticles:
    """Particles of a time series by track; every array has a row for each found particle, by track and then in time."""

    track: np.ndarray
    """Number of the track."""
    instant: np.ndarray
    """Number of the instant."""
    positions_voxel: np.ndarray
    """Position as it was found [voxel], shape (row, 3)."""
    errors_voxel: np.ndarray
    """Its standard errors as they were stated [voxel], shape (row, 3)."""
    light: np.ndarray
    """Light [counts]."""
    signal_to_noise: np.ndarray
    motion: Motion
    """How the particles move."""

    def measured(self, tracks: np.ndarray) -> Measured:
        """Return the positions of some tracks, of rising numbers, one after the other."""
        rows = np.isin(self.track, tracks)
        _, number = np.unique(self.track[rows], return_inverse=True)
        return Measured.from_rows(
            number, self.instant[rows].astype(float), self.positions_voxel[rows], self.errors_voxel[rows]
        )

    def refitted(self) -> TrackedParticles:
        """Return the same with the motion that the longest tracks show."""
        length = np.bincount(self.track)
        longest = np.argsort(-length, kind="stable")[:TELLING_TRACKS]
        return replace(self, motion=fit_motion(self.measured(np.sort(longest)), self.motion))


def follow(instants: Iterable[tuple[int, Candidates]], look: Look) -> TrackedParticles:
    """Follow the particles of a time series.

    Parameters
    ----------
    instants : iterable of tuple
        Number of each instant, rising, and the particles that links between two instants show there.
    look : callable
        Confirms candidates in the images of an instant: ``look(number, positions, light)`` returns `FoundParticles`.

    Returns
    -------
    TrackedParticles
        All particles that were found. They do not depend on the order of the candidates.
    """
    tracks = _Tracks()
    for count, (instant, candidates) in enumerate(instants):
        ahead = tracks.predicted(instant)
        positions, light = ahead.mean[..., 0], tracks.light
        free = _apart(positions, candidates.positions_voxel)  # what was found is better known than what is predicted
        positions = np.concatenate([candidates.positions_voxel, positions[free]])
        found = look(instant, positions, np.concatenate([candidates.light, light[free]]))
        tracks.go_on(instant, ahead, found, candidates)
        if count + 1 >= FIRST_FIT and (count + 1) & count == 0:
            tracks.motion = tracks.followed().refitted().motion
    return tracks.followed().refitted()


def _apart(positions: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the positions that are not near one of the others, shape (position,), bool."""
    if not (len(positions) and len(others)):
        return np.ones(len(positions), bool)
    distance, _ = cKDTree(others).query(positions)
    return distance > NEAR_VOXEL


@dataclass
class _Tracks:
    """The tracks that go on, and the particles of all."""

    motion: Motion = field(default_factory=Motion)
    begun: int = 0
    """Number of tracks that have begun."""
    numbers: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Numbers of the tracks that go on, shape (track,)."""
    state: State = field(default_factory=lambda: State(np.zeros((0, 3, 3)), np.zeros((0, 3, 3, 3))))
    """Their state at the last instant in which each was found."""
    seen: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """That instant, shape (track,)."""
    light: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Their light in that instant [counts], shape (track,)."""
    rows: list[tuple[np.ndarray, ...]] = field(default_factory=list)

    def predicted(self, instant: int) -> State:
        """End the tracks that were not found lately; return the states of the others at an instant."""
        alive = instant - self.seen <= LONGEST_GAP
        self.numbers, self.seen, self.light = self.numbers[alive], self.seen[alive], self.light[alive]
        self.state = self.state[alive]
        return self.state.after(self.motion, (instant - self.seen).astype(float)) if alive.any() else self.state

    def go_on(self, instant: int, ahead: State, found: FoundParticles, candidates: Candidates) -> None:
        """Continue tracks by the particles of an instant, and begin tracks with the others."""
        order = np.lexsort(found.positions_mm.T)  # the numbers of tracks do not depend on that of the candidates
        found = found[order]
        positions, errors = found.positions_mm / found.voxel_mm, found.errors_mm / found.voxel_mm
        noise = np.square(errors * self.motion.factor)
        spread = ahead.variance[..., 0, 0]
        old, known = matched(ahead.mean[..., 0], positions, (spread, noise), (self.light, found.light)).T
        corrected = ahead[old].measured(self.motion, positions[known], errors[known])
        self.state.mean[old], self.state.variance[old] = corrected.mean, corrected.variance
        self.seen[old], self.light[old] = instant, found.light[known]
        new = np.setdiff1d(np.arange(len(found)), known)
        numbers = self.begun + np.arange(len(new))
        chosen = np.concatenate([known, new])
        arrays = (positions, errors, found.light, found.signal_to_noise)
        track = np.concatenate([self.numbers[old], numbers])
        self.rows.append((track, np.full(len(chosen), instant), *(one[chosen] for one in arrays)))
        flow, flow_error = candidates.velocity(positions[new])
        self.state = self.state.joined(State.first(self.motion, positions[new], errors[new], flow, flow_error))
        self.numbers = np.concatenate([self.numbers, numbers])
        self.seen = np.concatenate([self.seen, np.full(len(new), instant)])
        self.light = np.concatenate([self.light, found.light[new]])
        self.begun += len(new)

    def followed(self) -> TrackedParticles:
        """Return the particles of all tracks."""
        empty = (np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
        track, instant, *others = (np.concatenate(one) for one in zip(empty, *self.rows, strict=True))
        order = np.lexsort((instant, track))
        names = ("positions_voxel", "errors_voxel", "light", "signal_to_noise")
        arrays = {name: one[order] for name, one in zip(names, others, strict=True)}
        return TrackedParticles(track=track[order], instant=instant[order], motion=self.motion, **arrays)
