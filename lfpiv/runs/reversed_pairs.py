"""Find pairs whose flow runs against that of all others, and runs in which nothing moves.

The frames of the first are exchanged in every camera. Both frames of the others may show the same exposures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lfpiv.damping.bootstrap import evenly_spread
from lfpiv.runs.pair_figures import PairFigures
from lfpiv.warn import Code, Warning

MOST = 500
"""Largest number of pairs that are compared; of more, these are evenly spread."""
REFERENCE = 16
"""Largest number of pairs that make the flow which all others are compared with."""
ALIKE = 0.8
"""Least likeness of a run's pairs, median of the magnitudes: a flow that fluctuates so much may turn."""
LEAST_VALID = 0.5
"""Least share of valid vectors of a pair that is compared."""
STILL_VOXEL = 0.02
"""Movement below which nothing moves [voxel]: ideal rigs have errors of as much."""
FEW = 0.1
"""Largest share of reversed pairs, where it is more than one: a flow that oscillates has more."""


def reversed_pairs(figures: Mapping[int, PairFigures]) -> list[Warning]:
    """Return the warning about pairs whose flow runs against that of the others; empty without any.

    `figures` belong to the pairs with vectors.
    """
    likeness = _likeness(evenly_spread(list(figures), MOST), figures)
    if len(likeness) < 2 or np.median(np.abs(list(likeness.values()))) < ALIKE:
        return []
    negative = [pair for pair, value in likeness.items() if value < -ALIKE]
    if not negative:
        return []
    if len(likeness) == 2:
        return [Warning(code=Code.REVERSED, pairs=tuple(likeness), figures={"others": "each other"})]
    if len(negative) > max(1, FEW * len(likeness)):
        return []
    others = {"others": f"that of the other {len(likeness) - len(negative)}"}
    return [Warning(code=Code.REVERSED, pairs=tuple(negative), figures=others)]


def still(figures: Mapping[int, PairFigures]) -> list[Warning]:
    """Return the warning that nothing moves by `STILL_VOXEL`, in any pair or eighth of the volume; empty if it does."""
    moved = [
        max(one.moved_voxel, *np.abs(one.flow_voxel))
        for one in figures.values()
        if one.moved_voxel is not None and one.flow_voxel is not None
    ]
    if not moved or max(moved) >= STILL_VOXEL:
        return []
    return [Warning(code=Code.STILL, figures={"voxel": float(max(moved))})]


def _likeness(pairs: Sequence[int], figures: Mapping[int, PairFigures]) -> dict[int, float]:
    """Return the cosine of each pair's mean displacements with those that most pairs have, which are along them."""

    def field(pair: int) -> np.ndarray | None:
        one = figures[pair]
        if one.flow_voxel is None or one.valid_fraction < LEAST_VALID:
            return None
        found = np.array(one.flow_voxel)
        length = float(np.linalg.norm(found))
        return found / length if length > 0 else None

    chosen = {pair: known for pair in evenly_spread(list(pairs), REFERENCE) if (known := field(pair)) is not None}
    if not chosen:
        return {}
    fields = np.stack(list(chosen.values()))
    share = np.linalg.eigh(fields @ fields.T)[1][:, -1]  # of each in what they have in common, but for the sign
    common = share @ fields
    common *= np.sign(np.sum(np.sign(share))) or 1.0
    common /= np.linalg.norm(common)
    found = {}
    for pair in pairs:
        known = chosen[pair] if pair in chosen else field(pair)
        if known is not None:
            found[pair] = float(known @ common)
    return found
