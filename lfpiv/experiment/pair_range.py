"""Which pairs a caller chooses: the number of the first, and the number after the last."""

from __future__ import annotations

from numbers import Integral
from typing import Any

from lfpiv.errors import InputError


def pair_range(pairs: Any) -> tuple[int, int | None]:
    """Return the number of the first pair and the number after the last; None for the end.

    Parameters
    ----------
    pairs : sequence of two, or None
        Numbers that a caller gives; None stands for all pairs.

    Raises
    ------
    InputError
        If `pairs` is neither None nor two whole numbers, of which the second may be None.
    """
    if pairs is None:
        return 0, None
    given = tuple(pairs) if isinstance(pairs, (tuple, list)) else ()
    if len(given) == 2 and isinstance(given[0], Integral) and isinstance(given[1], (Integral, type(None))):
        return int(given[0]), None if given[1] is None else int(given[1])
    raise InputError(
        "pairs: expected two whole numbers, the first pair and the next after the last, such as (0, 10), or (4, None) "
        f"for all from 4 on, found {pairs!r}."
    )
