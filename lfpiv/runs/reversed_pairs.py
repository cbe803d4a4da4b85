"""Find pairs whose flow runs against that of all others: their frames are exchanged in every camera."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from lfpiv.errors import InputError
from lfpiv.reconstruction.bootstrap import evenly_spread
from lfpiv.warn import Code, Warning

log = logging.getLogger(__name__)

MOST = 500
"""Largest number of pairs that are compared; of more, these are evenly spread."""
REFERENCE = 16
"""Largest number of pairs that make the flow which all others are compared with."""
ALIKE = 0.8
"""Least likeness of a run's pairs, median of the magnitudes: a flow that fluctuates so much may turn."""
LEAST_VALID = 0.5
"""Least share of valid vectors of a pair that is compared."""
FEW = 0.1
"""Largest share of reversed pairs, where it is more than one: a flow that oscillates has more."""


def reversed_pairs(pairs: Sequence[int], read: Callable[[int], xr.Dataset]) -> list[Warning]:
    """Return the warning about pairs whose flow runs against that of the others; empty without any.

    Parameters
    ----------
    pairs : sequence of int
        Pairs with vectors.
    read : callable
        Returns the vectors of a pair; raises InputError if they cannot be read.
    """
    likeness = _likeness(evenly_spread(list(pairs), MOST), read)
    if len(likeness) < 2 or np.median(np.abs(list(likeness.values()))) < ALIKE:
        return []
    negative = [pair for pair, value in likeness.items() if value < -ALIKE]
    if not negative:
        return []
    figures = {"others": f"that of the other {len(likeness) - len(negative)}"}
    if len(likeness) == 2:
        return [Warning(code=Code.REVERSED, pairs=tuple(likeness), figures={"others": "each other"})]
    if len(negative) > max(1, FEW * len(likeness)):
        return []
    return [Warning(code=Code.REVERSED, pairs=tuple(negative), figures=figures)]


def _likeness(pairs: Sequence[int], read: Callable[[int], xr.Dataset]) -> dict[int, float]:
    """Return the cosine of each pair's displacements with those that most pairs have, which are along them."""

    def field(pair: int) -> np.ndarray | None:
        try:
            vectors = read(pair)
        except InputError as error:
            log.debug("flow of pair %d is not compared: %s", pair, error)
            return None
        valid = vectors["valid"].values
        if valid.mean() < LEAST_VALID:
            return None
        parts = [np.where(valid, vectors[f"displacement_{axis}"].values, 0) for axis in "xyz"]
        found = np.stack(parts).ravel().astype(np.float64)
        length = float(np.linalg.norm(found))
        return found / length if length > 0 else None

    chosen = {pair: known for pair in evenly_spread(list(pairs), REFERENCE) if (known := field(pair)) is not None}
    if len({known.shape for known in chosen.values()}) != 1:
        return {}
    fields = np.stack(list(chosen.values()))
    share = np.linalg.eigh(fields @ fields.T)[1][:, -1]  # of each in what they have in common, but for the sign
    common = share @ fields
    common *= np.sign(np.sum(np.sign(share))) or 1.0
    common /= np.linalg.norm(common)
    found = {}
    for pair in pairs:
        known = chosen[pair] if pair in chosen else field(pair)
        if known is not None and known.shape == common.shape:
            found[pair] = float(known @ common)
    return found
