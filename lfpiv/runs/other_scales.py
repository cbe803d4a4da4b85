"""Find pairs in which one camera's counts stand on another scale than in the run's other pairs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lfpiv.damping.bootstrap import evenly_spread
from lfpiv.lightfield.particle_signal import NOISE
from lfpiv.runs.pair_figures import PairFigures
from lfpiv.runs.reversed_pairs import MOST
from lfpiv.warn import Code, Warning, gather

OTHER_SCALE = 8.0
"""Least ratio of a camera's counts to the other cameras' counts, over its usual value in the run, that is told."""


def other_scales(figures: Mapping[int, PairFigures]) -> list[Warning]:
    """Return the warnings about cameras whose counts, beside the other cameras', are unlike what most pairs have.

    `figures` belong to the pairs with vectors. Of two cameras either may have changed, so the first one is named beside
    the other. Of two pairs either may be the usual one, so nothing is said.
    """
    brightness = {pair: known for pair in evenly_spread(list(figures), MOST) if (known := _brightness(figures[pair]))}
    cameras = list(next(iter(brightness.values()), {}))
    if len(brightness) < 3 or len(cameras) < 2:
        return []
    levels = np.log([[known[name] for name in cameras] for known in brightness.values()])
    levels -= np.median(levels, axis=0)
    found = []
    for pair, level in zip(brightness, levels, strict=True):
        for at, name in enumerate(cameras[:1] if len(cameras) == 2 else cameras):
            change = level[at] - np.median(np.delete(level, at))
            if abs(change) > np.log(OTHER_SCALE):
                figures_told = {
                    "others": " and ".join(other for other in cameras if other != name),
                    "how": "high" if change > 0 else "low",
                    "ratio": float(np.exp(abs(change))),
                }
                found.append(Warning(code=Code.OTHER_SCALE, subject=name, pairs=(pair,), figures=figures_told))
    return gather(found)


def _brightness(figures: PairFigures) -> dict[str, float] | None:
    """Return the brightness of each camera, geometric mean of the frames; None where it is not measured."""
    gains, structure = figures.camera_gain or {}, figures.structure or {}
    if not gains or min((min(one.values()) for one in structure.values()), default=0.0) < NOISE:
        return None
    logs = {name: np.mean([np.log(frame[name]) for frame in gains.values()]) for name in next(iter(gains.values()))}
    return {name: float(np.exp(value)) for name, value in logs.items()}
