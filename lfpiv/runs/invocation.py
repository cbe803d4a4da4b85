"""Results of the steps of one invocation, the input of its summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lfpiv.runs.belonging import Agreement
from lfpiv.runs.moved_cameras import SelfCalibrationFigures
from lfpiv.runs.pair_outcome import Outcome
from lfpiv.warn import Warning

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration


@dataclass(frozen=True, kw_only=True)
class Calibrated:
    """The calibration of a run."""

    calibration: Calibration
    seconds: float
    """Time that it took when it was made [s]."""
    reused: bool
    """Whether an earlier invocation made it."""


@dataclass(frozen=True, kw_only=True)
class WeightsFigures:
    """Figures of the weights and of the cameras' positions, for the summary."""

    method: str
    memory_mib: float
    seconds: float
    """Time that building them took [s]."""
    warnings: tuple[Warning, ...]
    agreement: Agreement
    forms: Mapping[str, str]
    """Camera -> form of its weights; empty for counted weights."""
    cuts: Mapping[str, Sequence[int]]
    """Camera -> parts of a voxel along z, y, x; empty for counted weights."""
    profile_errors: Mapping[str, Sequence[float]]
    """Camera -> relative errors of profiles against counted rays; empty for counted weights."""
    count_errors: Mapping[str, Sequence[float]]
    """Camera -> relative errors of the weights against a converged count of rays."""
    self_calibration: SelfCalibrationFigures | None

    def to_json(self) -> dict[str, Any]:
        """Return the form that the summary stores."""
        stored: dict[str, Any] = {
            "method": self.method,
            "memory_mib": self.memory_mib,
            "warnings": [warning.to_json() for warning in self.warnings],
        }
        if self.self_calibration is not None:
            stored["self_calibration"] = self.self_calibration.to_json()
        stored["cameras"] = self.agreement.sentence
        stored["refusals"] = [warning.to_json() for warning in self.agreement.refusals]
        if (disparity := self.agreement.disparity) is not None:
            stored |= {"disparity_voxel": disparity.voxel, "disparity_pair": disparity.pairs[0]}
            stored["disparity_std_voxel"] = disparity.std_voxel
        stored["count_check_l2"] = [error for errors in self.count_errors.values() for error in _rounded(errors)]
        if self.method == "footprint":
            stored |= {"form": dict(self.forms), "cuts": dict(self.cuts)}
            stored["profiles_check_l2"] = {name: _rounded(errors) for name, errors in self.profile_errors.items()}
        return stored


def _rounded(errors: Sequence[float]) -> list[float]:
    return [round(error, 4) for error in errors]


@dataclass(frozen=True, kw_only=True)
class Workers:
    """Processes that worked on pairs."""

    count: int | None
    """None for the workers of a cluster."""
    threads: int | None
    """CPU threads of each; None for as many as the cluster grants."""
    peak_memory_mib: float | None = None
    """Largest memory that one of several workers held."""


MOST_FAILED = 10_000
"""Largest number of failed pairs whose reasons are kept; the others are counted."""


class Tried:
    """Outcomes of the pairs that an invocation tried: one byte per pair, and the reasons of the failed ones."""

    def __init__(self, numbers: range = range(0)):
        self._numbers, self._tried = numbers, bytearray(len(numbers))
        self.failed: dict[int, str] = {}
        """Pair -> why it failed, of the first `MOST_FAILED`."""
        self.failures = 0
        """Number of all failed pairs."""
        self.peak_memory_mib = 0.0
        """Largest memory that a worker process held."""

    def add(self, outcome: Outcome) -> None:
        """Keep the outcome of one pair."""
        self._tried[self._numbers.index(outcome.pair)] = 1
        self.peak_memory_mib = max(self.peak_memory_mib, outcome.peak_memory_mib)
        if outcome.reason:
            self.failures += 1
            if len(self.failed) < MOST_FAILED:
                self.failed[outcome.pair] = outcome.reason

    def __contains__(self, pair: int) -> bool:
        return pair in self._numbers and bool(self._tried[self._numbers.index(pair)])


@dataclass(frozen=True, kw_only=True)
class Invocation:
    """Results of one invocation."""

    tried: Tried = field(default_factory=Tried)
    """Outcomes of the pairs that were tried."""
    weights: WeightsFigures | None = None
    """None if no weights were built."""
    workers: Workers | None = None
    """None if no pair was tried."""
    settled: int | None = None
    """Pairs that were finished when pairs that stand out were looked for; None if they were not."""
    reused: tuple[str, ...] = ()
    """Results of earlier invocations, named for the summary."""
    warnings: Sequence[Warning] = ()
    """Warnings of the run itself; warnings about results are stored with the results."""
