"""Time of a piece of work."""

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


NOTHING = Cost()


def timed(work: Callable[[], Result]) -> tuple[Result, Cost]:
    """Do some work in this process; return its result and its cost."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, Cost(time.perf_counter() - wall, time.process_time() - cpu)
