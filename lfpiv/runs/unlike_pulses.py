"""Find cameras whose second frames are too bright beside another camera: light of first frames may stay on them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lfpiv.damping.bootstrap import evenly_spread
from lfpiv.runs.pair_figures import PairFigures
from lfpiv.runs.reversed_pairs import MOST
from lfpiv.selfcalibration.belonging import CLEAR
from lfpiv.warn import Code, Warning

UNLIKE = 1.1
"""Least ratio of a camera's second frames over its first ones, relative to another camera, that is told. Sound rigs
whose mean is known to a fortieth have up to 1.04."""
FEWEST = 3
"""Least number of pairs."""


def unlike_pulses(figures: Mapping[int, PairFigures]) -> list[Warning]:
    """Return the warnings about cameras that show brighter second pulses than the camera with the dimmest ones.

    `figures` belong to the pairs with vectors. The mean over the pairs counts, and its standard error.
    """
    ratios = [known for pair in evenly_spread(list(figures), MOST) if (known := _ratios(figures[pair]))]
    if len(ratios) < FEWEST or any(known.keys() != ratios[0].keys() for known in ratios):
        return []
    cameras = list(ratios[0])
    logs = np.log([[known[name] for name in cameras] for known in ratios])
    dimmest = int(logs.mean(axis=0).argmin())
    found = []
    for name, own in zip(cameras, (logs - logs[:, [dimmest]]).T, strict=True):
        mean, error = float(own.mean()), float(own.std(ddof=1)) / np.sqrt(len(own))
        if mean > max(np.log(UNLIKE), CLEAR * error):
            about = {"ratio": float(np.exp(mean)), "other": cameras[dimmest]}
            found.append(Warning(code=Code.UNLIKE_PULSES, subject=name, figures=about))
    return found


def _ratios(figures: PairFigures) -> dict[str, float] | None:
    """Return the light of each camera's second image over its first one; None where it is not known."""
    if not figures.light:
        return None
    first, second = figures.light.values()
    if not all(first[name] > 0 and second[name] > 0 for name in first):
        return None
    return {name: second[name] / first[name] for name in first}
