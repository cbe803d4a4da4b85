"""Stretches: pairs that one process works on one after the other, so that each instant of a series is needed once.

The second instant of a pair of a series is the first of the next pair, `step` further on. Pairs k, k + step,
k + 2 step, ... form a chain. A process that goes along a chain holds two volumes at a time, whatever the step is. For
several processes a chain is cut into stretches. The pair at a seam lies between two stretches: both store the volume
of their instant at the seam, and the pair is correlated from the two files afterwards.

If each instant starts from the one before (`lfpiv.experiment.segments`), a process goes along k, k + 1, k + 2, ... and
holds `step` + 1 volumes. A stretch is then a whole segment, with a seam for each pair between two segments.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from operator import length_hint
from typing import NamedTuple

from lfpiv.experiment.segments import segment_of

MOST_INSTANTS = 16
"""Largest number of instants of a stretch for one of several processes. A seam costs two files; the loss of a process
costs the volumes in work, and results are announced at the end of a stretch."""
LEAST_STRETCHES = 2
"""Least number of stretches for each process, if there are so many pairs: processes may differ in speed."""
CLUSTER_WORKERS = 64
"""Number of workers that a cluster is taken to have; workers may join it later."""


class Stretch(NamedTuple):
    """Pairs that one process works on one after the other. In a series each shares an instant with the one before."""

    pairs: tuple[int, ...]
    stored: tuple[int, ...] = ()
    """Instants at seams, whose volumes are stored for other processes."""
    seams: tuple[int, ...] = ()
    """Pairs at the seams, which can be done when this stretch and the one beyond the seam are done."""


def cut(pending: Iterable[int], step: int | None, workers: int) -> Iterator[Stretch]:
    """Yield stretches for several processes: single pairs if `step` is None, else parts of the chains of a series.

    Pairs are taken from `pending` as they are needed, in the order k, k + step, k + 2 step, ... The pairs at seams are
    in no stretch; each is named by the two beside it.
    """
    if step is None:
        yield from (Stretch((pair,)) for pair in pending)
        return
    source = iter(pending)
    most = max(min(MOST_INSTANTS, -(-length_hint(source) // (LEAST_STRETCHES * workers))), 2)
    chain, before = list[int](), list[int]()  # pairs that are not handed out yet, and the pair at the seam before them
    for pair in source:
        if chain and pair != chain[-1] + step:
            yield from _cut(chain, step, most, before)
            chain, before = [], []
        chain.append(pair)
        if len(chain) == most + 2:  # two instants or more are left for the next stretch
            yield _stretch(chain, 0, most, step, before)
            chain, before = chain[most:], [chain[most - 1]]
    if chain:
        yield from _cut(chain, step, most, before)


def _cut(chain: Sequence[int], step: int, most: int, before: Sequence[int]) -> Iterator[Stretch]:
    """Cut the end of a chain into stretches of at most `most` instants, of nearly equal length and two or more."""
    instants = len(chain) + 1
    count = max(min(-(-instants // most), instants // 2), 1)
    edges = [number * instants // count for number in range(count + 1)]
    for first, after in itertools.pairwise(edges):
        yield _stretch(chain, first, after, step, before)


def _stretch(chain: Sequence[int], first: int, after: int, step: int, before: Sequence[int]) -> Stretch:
    """Return the stretch of the instants `first` to `after` - 1 of a chain."""
    left = [chain[first - 1]] if first > 0 else list(before)
    right = [chain[after - 1]] if after <= len(chain) else []
    stored = [pair + step for pair in left] + right
    return Stretch(tuple(chain[first : after - 1]), tuple(stored), (*left, *right))


def cut_at_segments(pending: Iterable[int], step: int) -> Iterator[Stretch]:
    """Yield stretches of a series whose instants are reconstructed one after the other: one for each segment.

    Pairs are taken from `pending` as they are needed, in ascending order. A pair between two segments is at a seam if
    the pairs within both need its instants anyway. Otherwise it belongs to the stretch of its first instant.
    """
    before = _Group()
    for segment, pairs in itertools.groupby(pending, segment_of):
        group = _Group.of(segment, pairs, step)
        if before.segment + 1 == segment:
            seams = {pair for pair in before.across if pair in before.instants and pair + step in group.instants}
            before.right, group.left = seams, seams
        yield from before.stretches(step)
        before = group
    yield from before.stretches(step)


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
    """Pairs at the seam with the segment before."""
    right: set[int] = field(default_factory=set)
    """Pairs at the seam with the segment after."""

    @classmethod
    def of(cls, segment: int, pairs: Iterable[int], step: int) -> _Group:
        """Sort the pairs whose first instants are in a segment."""
        group = cls(segment)
        for pair in pairs:
            (group.within if segment_of(pair + step) == segment else group.across).append(pair)
        group.instants = {instant for pair in group.within for instant in (pair, pair + step)}
        return group

    def stretches(self, step: int) -> Iterator[Stretch]:
        """Yield the stretch of the segment; none if there is no pair."""
        pairs = self.within + [pair for pair in self.across if pair not in self.right]
        if pairs:
            stored = sorted({pair + step for pair in self.left} | self.right)
            yield Stretch(tuple(pairs), tuple(stored), (*sorted(self.left), *sorted(self.right)))
