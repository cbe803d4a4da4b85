"""Time of a piece of work, and how it grows with the size of the work."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

Result = TypeVar("Result")


@dataclass(frozen=True)
class Cost:
    """Time of some work."""

    wall_s: float = 0.0
    """Time that passes [s]."""
    cpu_s: float = 0.0
    """Time of all threads on their cores [s]. Other programs on the machine change it little."""

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)

    def __sub__(self, other: Cost) -> Cost:
        """Subtract, to no less than nothing: small times scatter."""
        return Cost(max(self.wall_s - other.wall_s, 0.0), max(self.cpu_s - other.cpu_s, 0.0))

    def __mul__(self, factor: float) -> Cost:
        return Cost(self.wall_s * factor, self.cpu_s * factor)

    __rmul__ = __mul__


NOTHING = Cost()


def timed(work: Callable[[], Result]) -> tuple[Result, Cost]:
    """Do some work in this process; return its result and its cost."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, Cost(time.perf_counter() - wall, time.process_time() - cpu)


def grown(small: tuple[float, Cost], large: tuple[float, Cost], size: float) -> Cost:
    """Extrapolate a cost that is an affine function of the size of the work.

    Parameters
    ----------
    small, large : (float, Cost)
        Two sizes and their costs.
    size : float
        Size to extrapolate to, no less than the larger one.

    Returns
    -------
    Cost
        On the line through both costs; the larger one where the costs do not grow.

    Examples
    --------
    >>> grown((1.0, Cost(3.0, 2.0)), (2.0, Cost(5.0, 3.0)), 10.0)
    Cost(wall_s=21.0, cpu_s=11.0)
    """
    (near, one), (far, other) = small, large

    def line(a: float, b: float) -> float:
        slope = (b - a) / (far - near) if far > near else 0.0
        return b + slope * (size - far) if slope > 0 else max(a, b)

    return Cost(line(one.wall_s, other.wall_s), line(one.cpu_s, other.cpu_s))
