"""Pairs that an invocation has to do, found one after the other, so that a million pairs need no list.

Pairs without a file of results come first. A file that is there is verified when its turn comes, after them.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator

from lfpiv.experiment.opening import CHECKED_PAIRS
from lfpiv.progress import StepProgress
from lfpiv.warn import NAMED_PAIRS, name_pairs

log = logging.getLogger(__name__)

MOST_NAMED = 10_000
"""Largest number of finished pairs that are named one by one."""


class PendingPairs:
    """Iterator over the selected pairs whose results are missing or do not fit.

    `length_hint` of it is the number of pairs that may yet come.

    Parameters
    ----------
    numbers : range
        The selected pairs.
    stored : bytearray
        For each of them, 1 if its results have a file, 0 otherwise.
    changes : callable
        Takes a pair; returns the names of the settings that its results do not fit, None if they fit.
    progress : callable
        Called with the fraction of the files that are verified.
    step : int
        Step of a time series. Pairs k, k + step, k + 2 step, ... come one after the other, because they share instants.
    noun : str
        Name of what has a number, for messages.
    """

    def __init__(
        self,
        numbers: range,
        stored: bytearray,
        changes: Callable[[int], list[str] | None],
        progress: StepProgress,
        *,
        step: int = 1,
        noun: str = "pair",
    ):
        self._numbers, self._stored, self._changes, self._progress = numbers, stored, changes, progress
        self._step, self._noun = step, noun
        self._missing, self._examined, self._total = stored.count(0), 0, stored.count(1)
        self._finished: tuple[list[int], int] = [], 0
        self._changed: dict[str, tuple[list[int], int]] = {}
        self._ahead = deque[int]()
        self._left = len(numbers)
        self._source = self._search()
        self.whole = False
        """Whether all pairs to do are known."""
        self.quiet = False
        """Log nothing."""

    def __iter__(self) -> Iterator[int]:
        return self

    def __next__(self) -> int:
        if self._ahead:
            return self._ahead.popleft()
        return next(self._source)

    def __length_hint__(self) -> int:
        return len(self._ahead) + self._left

    @property
    def finished(self) -> tuple[list[int], int]:
        """The first finished pairs, and the number of all that were found so far."""
        return self._finished

    def ahead(self, most: int = CHECKED_PAIRS) -> list[int]:
        """Return the next pairs to do without taking them; empty only if there is none.

        All are known afterwards if there are few. Of many, this looks for `most` without a file. If all have a file, it
        verifies files until one does not fit.
        """
        few = self._total <= most
        while len(self._ahead) < most and (few or self._missing or not self._ahead):
            if (pair := next(self._source, None)) is None:
                break
            self._ahead.append(pair)
        if self.whole:
            self._ahead = deque(sorted(self._ahead, key=lambda pair: (self._numbers.index(pair) % self._step, pair)))
        self._tell_changes()
        return list(self._ahead)

    def _places(self) -> Iterator[tuple[int, int]]:
        """Yield place and number of the pairs, in the order in which they are done."""
        for rest in range(self._step):
            for place in range(rest, len(self._numbers), self._step):
                yield place, self._numbers[place]

    def _search(self) -> Iterator[int]:
        for place, pair in self._places():
            if not self._stored[place]:
                self._missing, self._left = self._missing - 1, self._left - 1
                yield pair
        if self._total > CHECKED_PAIRS and not self.quiet:
            text = "%d of %d %ss have results, which are verified now"
            log.info(text, self._total, len(self._numbers), self._noun)
        for place, pair in self._places():
            if not self._stored[place]:
                continue
            changes = self._changes(pair)
            self._examined, self._left = self._examined + 1, self._left - 1
            if self._total > CHECKED_PAIRS:
                self._progress(self._examined / self._total)
            if changes is None:
                self._finished = _counted(self._finished, pair, most=MOST_NAMED)
            else:
                if changes:
                    reason = ", ".join(changes)
                    self._changed[reason] = _counted(self._changed.get(reason, ([], 0)), pair, most=NAMED_PAIRS)
                yield pair
        self.whole = True
        kept = self._finished[1]
        if kept and not self.quiet:
            text = "%d of %d %ss: finished before with the same settings, kept"
            log.info(text, kept, len(self._numbers), self._noun)
        self._tell_changes()

    def _tell_changes(self) -> None:
        if not self.quiet:
            for reason, (first, count) in self._changed.items():
                log.info("%s changed: %s made again", reason, name_pairs(first, self._noun, count))
        self._changed.clear()


def _counted(known: tuple[list[int], int], pair: int, most: int) -> tuple[list[int], int]:
    """Count one more pair, and keep its number if it is among the first."""
    first, count = known
    if count < most:
        first.append(pair)
    return first, count + 1
