"""Check before a run whether the images of its pairs are there and can be used."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from functools import partial

from lfpiv.errors import InputError
from lfpiv.experiment import recorded
from lfpiv.experiment.opening import CHECKED_PAIRS, check_pairs
from lfpiv.runs.invocation import Tried
from lfpiv.runs.pair_outcome import Outcome
from lfpiv.runs.pending_pairs import PendingPairs
from lfpiv.runs.run import Run
from lfpiv.warn import NAMED_PAIRS, name_pairs

log = logging.getLogger(__name__)


def check_images(run: Run, pending: PendingPairs) -> Tried | None:
    """Check the images of the next pairs and log those that cannot be used, unless `pending` is quiet.

    Return None if the pairs can be tried.

    If some pairs can be done, all are tried, and the others fail when their turn comes. If none of the pairs to do
    can be done, return their outcomes.

    Raises
    ------
    InputError
        If more pairs are stated than there are, or if the first pair cannot be used and no finished pair shows that
        the experiment file is right.
    """
    known = pending.ahead()
    _tell_missing(run, known)
    bad = dict(check_pairs(run.experiment, [pair for pair in known if not run.has_volumes(pair)]))
    whole = pending.whole and len(bad) == len(known)
    if bad and known[0] in bad and not _has_results(run):
        noun = run.experiment.noun
        others = "" if whole else f" To do the {noun}s after it, use --pairs {known[0] + 1}:."
        raise InputError(bad[known[0]] + others)
    if whole:
        tried = Tried(run.numbers)
        for pair, reason in bad.items():
            run.record(Outcome(pair=pair, reason=reason), tried)
        return tried
    if pending.quiet:  # said before
        return None
    for reason in list(dict.fromkeys(bad.values()))[:NAMED_PAIRS]:
        log.error("%s The other %ss will be done.", reason, run.experiment.noun)
    if len(bad) > NAMED_PAIRS:
        names = name_pairs(list(bad), run.experiment.noun)
        log.error("%d %ss have images that cannot be used: %s", len(bad), run.experiment.noun, names)
    return None


def _tell_missing(run: Run, known: Sequence[int]) -> None:
    """Refuse a run on pairs beyond the last one with images; log missing images that `known` does not tell of."""
    absent = recorded.missing(run.experiment)
    if absent is None:
        return
    first, end = run.numbers.start, absent.pairs_at_end
    beyond = any(pair in run.numbers and not _is_stored(run, pair) for pair in end)
    if beyond or (absent.counts_from_one and first == run.experiment.numbers.start):
        some = f" To do the {run.experiment.noun}s that are there, use --pairs {first}:{end.start}."
        raise InputError(absent.message() + (some if beyond and first < end.start else ""))
    told = set(known)
    within = (pair for gap in absent.gaps for pair in gap if pair in run.numbers and pair not in told)
    if end or any(not _is_stored(run, pair) for pair in within):
        log.warning("%s", absent.message())


def _is_stored(run: Run, pair: int) -> bool:
    """Return whether there is a file with the vectors of a pair."""
    return run.folder.vectors(pair).is_file()


def _has_results(run: Run) -> bool:
    """Return whether some pair of the experiment is finished; of many pairs with files the first are examined."""
    numbers = run.experiment.numbers
    vectors = run.folder.stored(numbers, vectors=True, volumes=False)
    volumes = run.folder.stored(numbers, vectors=False, volumes=True)
    stored = (pair for pair, one, other in zip(numbers, vectors, volumes, strict=True) if one or other)
    return any(map(partial(_is_finished, run), itertools.islice(stored, CHECKED_PAIRS)))


def _is_finished(run: Run, pair: int) -> bool:
    found = run.files(pair)
    return found.fitting_vectors() is not None or found.fitting_volumes() is not None
