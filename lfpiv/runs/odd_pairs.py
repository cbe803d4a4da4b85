"""Find pairs of a run whose images do not belong together although those of others do, and refuse their vectors.

The volumes of such a pair explain its images worse than those of the other pairs do. Pairs that stand out are judged
as the first pair is, after all pairs are finished.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from lfpiv import warn
from lfpiv.results import netcdf
from lfpiv.results.pair_files import PairFiles
from lfpiv.results.particles import read_particles
from lfpiv.runs import belonging, pair_figures, pair_vectors, particles
from lfpiv.runs.moved_cameras import ShownParticles
from lfpiv.runs.pair import PairWork
from lfpiv.runs.pair_figures import PairFigures
from lfpiv.selfcalibration.belonging import ImageFit
from lfpiv.warn import Warning

log = logging.getLogger(__name__)

OUTLYING = 4.0
"""Residual above which a pair is judged [standard deviations of the run's pairs]."""
LEAST_SPREAD = 0.03
"""Least standard deviation of the logarithm of a run's residuals."""
LEAST_PAIRS = 4
"""Pairs from which their scatter is measured; of fewer the one with the largest residual is judged."""
MOST, EACH = 2, 20
"""Pairs that are judged at most: so many, and one more of so many pairs of the run."""
LOW, LOWER, LOW_AT, LOWER_AT = 25.0, 10.0, 0.674, 1.282
"""Percentiles that show mean and scatter of right pairs even where most are wrong, and their distances from the mean
[standard deviations]."""


def outlying(figures: Mapping[int, PairFigures]) -> list[int]:
    """Return the pairs whose volumes explain their images worse than is usual in the run, the worst first."""
    residual = {
        pair: float(np.log(max(history[-1] for history in one.residual.values())))
        for pair, one in figures.items()
        if one.residual and all(history and history[-1] > 0 for history in one.residual.values())
        if one.verdict != pair_vectors.UNLIKE_PARTICLES
    }
    if len(residual) < 2:
        return []
    low, lower = np.percentile(list(residual.values()), (LOW, LOWER))
    spread = max((low - lower) / (LOWER_AT - LOW_AT), LEAST_SPREAD)
    limit = low + LOW_AT * spread + OUTLYING * spread
    if len(residual) < LEAST_PAIRS:
        limit = min(residual.values()) + OUTLYING * LEAST_SPREAD
    return sorted((pair for pair, value in residual.items() if value > limit), key=residual.__getitem__, reverse=True)


def settle(
    figures: Mapping[int, PairFigures],
    files: Callable[[int], PairFiles],
    make_work: Callable[[], PairWork],
) -> list[int]:
    """Judge the pairs that stand out, and refuse those whose images do not belong together; return these.

    `figures` are those of the finished pairs, `make_work` returns the work on pairs with its weights.
    """
    odd = outlying(figures)
    if not odd:
        return []
    work = make_work()
    if work.weights is None or len(work.weights.cameras) < 2:
        return []
    fit, usual = ImageFit(work.weights), [pair for pair in figures if pair not in odd][:2]
    refused = []
    for pair in odd[: MOST + len(figures) // EACH]:
        shown = ShownParticles(work.experiment, work.weights.cameras, [pair, *usual])
        for warning in belonging.refusals_of(shown, fit, pair):
            name = work.experiment.name_of(pair)
            log.warning("%s: %s", name, replace(warning, pairs=(), instants=()).sentence)
            _refuse(files(pair), warning)
            refused.append(pair)
    return refused


def _refuse(files: PairFiles, warning: Warning) -> None:
    """Write the vectors of a pair, and its linked particles, again, none of them valid."""
    vectors, condensed = netcdf.read_vectors(files.vectors), netcdf.read_reconstruction(files.vectors)
    assert condensed is not None
    found = (*warn.from_text(vectors.attrs["warnings"]), warning)
    vectors = pair_vectors.refused(vectors, pair_vectors.UNLIKE_PARTICLES)
    vectors.attrs["warnings"] = warn.to_text(found)
    measured = pair_figures.measure(vectors, condensed, found)
    files.write_vectors(vectors, condensed, {"figures": measured.to_json()})
    if files.particles is not None and files.has_particles():
        files.write_particles(particles.refused(read_particles(files.particles)))
