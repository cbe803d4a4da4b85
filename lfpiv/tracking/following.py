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
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.linking import FIRST_SPREAD_VOXEL, NEIGHBOURS, matched, nearby
from lfpiv.tracking.trajectory import Measured, Motion, State, fit_motion

LONGEST_GAP = 2
"""Largest number of instants from one in which the particle of a track is found to the next one."""
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
    def of(cls, tables: Sequence[tuple[xr.Dataset, int]], step: int) -> Candidates:
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
        """Return the particles without those that an earlier one, or one with a valid link, stands for."""
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
class Followed:
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

    @property
    def measured(self) -> Measured:
        """Positions of the tracks one after the other."""
        return Measured.of(self.track, self.instant.astype(float), self.positions_voxel, self.errors_voxel)


def follow(instants: Iterable[tuple[int, Candidates]], look: Look) -> Followed:
    """Follow the particles of a time series.

    Parameters
    ----------
    instants : iterable of tuple
        Number of each instant, rising, and the particles that links between two instants show there.
    look : callable
        Confirms candidates in the images of an instant: ``look(number, positions, light)`` returns `FoundParticles`.

    Returns
    -------
    Followed
        All particles that were found. They do not depend on the order of the candidates.
    """
    tracks = _Tracks()
    for count, (instant, candidates) in enumerate(instants):
        ahead = tracks.predicted(instant)
        positions, light = ahead.mean[..., 0], tracks.light[tracks.alive]
        free = _apart(positions, candidates.positions_voxel)  # what was found is better known than what is predicted
        positions = np.concatenate([candidates.positions_voxel, positions[free]])
        found = look(instant, positions, np.concatenate([candidates.light, light[free]]))
        tracks.go_on(instant, ahead, found, candidates)
        if count + 1 >= FIRST_FIT and (count + 1) & count == 0:
            tracks.motion = fit_motion(tracks.followed().measured, tracks.motion)
    followed = tracks.followed()
    tracks.motion = fit_motion(followed.measured, tracks.motion)
    return tracks.followed()


def _apart(positions: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the positions that are not near one of the others, shape (position,), bool."""
    if not (len(positions) and len(others)):
        return np.ones(len(positions), bool)
    distance, _ = cKDTree(others).query(positions)
    found: np.ndarray = distance > NEAR_VOXEL
    return found


@dataclass
class _Tracks:
    """Tracks that have begun, and those that go on."""

    motion: Motion = field(default_factory=Motion)
    state: State = field(default_factory=lambda: State(np.zeros((0, 3, 3)), np.zeros((0, 3, 3, 3))))
    """State of all tracks at the last instant in which each was found."""
    seen: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """That instant."""
    light: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Light of each track in that instant [counts]."""
    alive: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Numbers of the tracks that go on."""
    rows: list[tuple[np.ndarray, ...]] = field(default_factory=list)

    def predicted(self, instant: int) -> State:
        """Return the states at an instant of the tracks that go on."""
        self.alive = self.alive[instant - self.seen[self.alive] <= LONGEST_GAP]
        if not len(self.alive):
            return self.state[self.alive]
        return self.state[self.alive].after(self.motion, (instant - self.seen[self.alive]).astype(float))

    def go_on(self, instant: int, ahead: State, found: FoundParticles, candidates: Candidates) -> None:
        """Continue tracks by the particles of an instant, and begin tracks with the others."""
        order = np.lexsort(found.positions_mm.T)  # the numbers of tracks do not depend on that of the candidates
        found = found[order]
        positions, errors = found.positions_mm / found.voxel_mm, found.errors_mm / found.voxel_mm
        noise = np.square(errors * self.motion.factor)
        spread = np.einsum("taii->tai", ahead.variance)[..., 0]
        pairs = matched(ahead.mean[..., 0], positions, (spread, noise), (self.light[self.alive], found.light))
        old, known = self.alive[pairs[:, 0]], pairs[:, 1]
        corrected = ahead[pairs[:, 0]].measured(self.motion, positions[known], errors[known])
        self.state.mean[old], self.state.variance[old] = corrected.mean, corrected.variance
        self.seen[old], self.light[old] = instant, found.light[known]
        new = np.setdiff1d(np.arange(len(found)), known)
        begun = len(self.seen) + np.arange(len(new))
        flow, flow_error = candidates.velocity(positions[new])
        self.state = self.state.joined(State.first(self.motion, positions[new], errors[new], flow, flow_error))
        self.seen = np.concatenate([self.seen, np.full(len(new), instant)])
        self.light = np.concatenate([self.light, found.light[new]])
        self.alive = np.concatenate([self.alive, begun])
        chosen = np.concatenate([known, new])
        arrays = (positions, errors, found.light, found.signal_to_noise)
        self.rows.append(
            (np.concatenate([old, begun]), np.full(len(chosen), instant), *(one[chosen] for one in arrays))
        )

    def followed(self) -> Followed:
        """Return the particles of all tracks."""
        empty = (np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
        track, instant, *others = (np.concatenate(one) for one in zip(empty, *self.rows, strict=True))
        order = np.lexsort((instant, track))
        names = ("positions_voxel", "errors_voxel", "light", "signal_to_noise")
        arrays = {name: one[order] for name, one in zip(names, others, strict=True)}
        return Followed(track=track[order], instant=instant[order], motion=self.motion, **arrays)
