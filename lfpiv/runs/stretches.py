"""Stretches: pairs that one process works on one after the other, so that each instant of a series is needed once.

The second instant of a pair of a series is the first of the next pair, `step` further on. Pairs k, k + step,
k + 2 step, ... form a chain. A process that goes along a chain holds two volumes at a time, whatever the step is. For
several processes a chain is cut into stretches. The pair at a seam lies between two stretches: both store the volume
of their instant at the seam, and the pair is correlated from the two files afterwards.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

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


def chains(todo: Sequence[int], step: int) -> Iterator[list[int]]:
    """Yield the parts of a series that hang together: pairs k, k + step, k + 2 step, ... as long as all are to do."""
    for rest in range(step):
        chain = list[int]()
        for pair in todo:
            if pair % step != rest:
                continue
            if chain and pair != chain[-1] + step:
                yield chain
                chain = []
            chain.append(pair)
        if chain:
            yield chain


def whole(todo: Sequence[int], step: int | None) -> Iterator[Stretch]:
    """Yield the stretches for one process: whole chains of a series, or single pairs if `step` is None."""
    if step is None:
        yield from (Stretch((pair,)) for pair in todo)
    else:
        yield from (Stretch(tuple(chain)) for chain in chains(todo, step))


def cut(todo: Sequence[int], step: int | None, workers: int) -> Iterator[Stretch]:
    """Yield stretches for several processes. The pairs at seams are in none; each is named by the two beside it."""
    if step is None:
        yield from whole(todo, None)
        return
    most = max(min(MOST_INSTANTS, -(-len(todo) // (LEAST_STRETCHES * workers))), 2)
    for chain in chains(todo, step):
        yield from _cut(chain, step, most)


def _cut(chain: Sequence[int], step: int, most: int) -> Iterator[Stretch]:
    """Cut a chain into stretches of at most `most` instants, of nearly equal length and two instants or more."""
    instants = len(chain) + 1
    count = max(min(-(-instants // most), instants // 2), 1)
    edges = [number * instants // count for number in range(count + 1)]
    for first, after in itertools.pairwise(edges):
        left = [chain[first - 1]] if first > 0 else []
        right = [chain[after - 1]] if after < instants else []
        stored = [pair + step for pair in left] + right
        yield Stretch(tuple(chain[first : after - 1]), tuple(stored), (*left, *right))
