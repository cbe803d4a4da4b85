"""Work units: pairs that one process works on one after the other, so that each instant of a series is needed once.

The second instant of a pair of a series is the first of the next pair, `step` further on. Pairs k, k + step,
k + 2 step, ... are linked. A process that goes along linked pairs holds two volumes at a time, whatever the step is.
For several processes they are cut into work units. A boundary pair lies between two work units: each stores the volume
of the instant that it shares with the pair, and the pair is correlated from the two files afterwards.

If each instant starts from the one before (`lfpiv.experiment.segments`), a process goes along k, k + 1, k + 2, ... and
holds `step` + 1 volumes. A work unit is then a whole segment, and each pair between two segments is a boundary pair.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from operator import length_hint
from typing import NamedTuple

from lfpiv.experiment.segments import segment_of

MOST_INSTANTS = 16
"""Largest number of instants of a work unit for one of several processes. A boundary pair costs two files; the loss of
a process costs the volumes in work, and results are announced at the end of a work unit."""
LEAST_UNITS = 2
"""Least number of work units for each process, if there are so many pairs: processes may differ in speed."""
CLUSTER_WORKERS = 64
"""Number of workers that a cluster is taken to have; workers may join it later."""


class WorkUnit(NamedTuple):
    """Pairs that one process works on one after the other. In a series each shares an instant with the one before."""

    pairs: tuple[int, ...]
    stored: tuple[int, ...] = ()
    """Instants of boundary pairs, whose volumes are stored for other processes."""
    boundary_pairs: tuple[int, ...] = ()
    """Pairs between this work unit and another one, which can be done when both are."""


def cut(pending: Iterable[int], step: int | None, workers: int) -> Iterator[WorkUnit]:
    """Yield work units for several processes: single pairs if `step` is None, else linked pairs of a series.

    Pairs are taken from `pending` as they are needed, in the order k, k + step, k + 2 step, ... Boundary
    pairs are in no work unit; each is named by the two beside it.
    """
    if step is None:
        yield from (WorkUnit((pair,)) for pair in pending)
        return
    source = iter(pending)
    most = max(min(MOST_INSTANTS, -(-length_hint(source) // (LEAST_UNITS * workers))), 2)
    linked, before = list[int](), list[int]()  # pairs not handed out yet, and the boundary pair before them
    for pair in source:
        if linked and pair != linked[-1] + step:
            yield from _cut(linked, step, most, before)
            linked, before = [], []
        linked.append(pair)
        if len(linked) == most + 2:  # two instants or more are left for the next work unit
            yield _unit(linked, 0, most, step, before)
            linked, before = linked[most:], [linked[most - 1]]
    if linked:
        yield from _cut(linked, step, most, before)


def _cut(linked: Sequence[int], step: int, most: int, before: Sequence[int]) -> Iterator[WorkUnit]:
    """Cut the last linked pairs into work units of at most `most` instants, of nearly equal length and two or more."""
    instants = len(linked) + 1
    count = max(min(-(-instants // most), instants // 2), 1)
    edges = [number * instants // count for number in range(count + 1)]
    for first, after in itertools.pairwise(edges):
        yield _unit(linked, first, after, step, before)


def _unit(linked: Sequence[int], first: int, after: int, step: int, before: Sequence[int]) -> WorkUnit:
    """Return the work unit of the instants `first` to `after` - 1 of linked pairs."""
    left = [linked[first - 1]] if first > 0 else list(before)
    right = [linked[after - 1]] if after <= len(linked) else []
    stored = [pair + step for pair in left] + right
    return WorkUnit(tuple(linked[first : after - 1]), tuple(stored), (*left, *right))


def cut_at_segments(pending: Iterable[int], step: int) -> Iterator[WorkUnit]:
    """Yield work units of a series whose instants are reconstructed one after the other: one for each segment.

    Pairs are taken from `pending` as they are needed, in ascending order. A pair between two segments is a boundary
    pair if the pairs within both need its instants anyway. Otherwise it belongs to the work unit of its first instant.
    """
    before = _Group()
    for segment, pairs in itertools.groupby(pending, segment_of):
        group = _Group.from_pairs(segment, pairs, step)
        if before.segment + 1 == segment:
            shared = {pair for pair in before.across if pair in before.instants and pair + step in group.instants}
            before.right = group.left = shared
        yield from before.units(step)
        before = group
    yield from before.units(step)


@dataclass(eq=False)
class _Group:
    """Pairs to do whose first instants are in one segment."""

    segment: int = -2
    within: list[int] = field(default_factory=list)
    """Pairs with both instants in the segment."""
    across: list[int] = field(default_factory=list)
    """Pairs whose second instant is in a later segment."""
    instants: set[int] = field(default_factory=set)
    """Instants of the pairs within the segment."""
    left: set[int] = field(default_factory=set)
    """Boundary pairs with the segment before."""
    right: set[int] = field(default_factory=set)
    """Boundary pairs with the segment after."""

    @classmethod
    def from_pairs(cls, segment: int, pairs: Iterable[int], step: int) -> _Group:
        """Sort the pairs whose first instants are in a segment."""
        group = cls(segment)
        for pair in pairs:
            (group.within if segment_of(pair + step) == segment else group.across).append(pair)
        group.instants = {instant for pair in group.within for instant in (pair, pair + step)}
        return group

    def units(self, step: int) -> Iterator[WorkUnit]:
        """Yield the work unit of the segment; none if there is no pair."""
        pairs = self.within + [pair for pair in self.across if pair not in self.right]
        if pairs:
            stored = sorted({pair + step for pair in self.left} | self.right)
            yield WorkUnit(tuple(pairs), tuple(stored), (*sorted(self.left), *sorted(self.right)))
