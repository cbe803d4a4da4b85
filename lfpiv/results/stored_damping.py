"""The file ``bootstrap.json`` of a run: the damping by ghosts, and the vectors that it holds for.

The damping is stored once for all pairs, and readers take it off. So the files of the pairs stay as they were written,
those of finished pairs get the correction as well, and a run that is killed leaves none of them half done.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfpiv.records import read_object, validate
from lfpiv.results import provenance, stored_outcome
from lfpiv.results.provenance import Marks, Stamp
from lfpiv.velocity.damping import Damping

FILE = "bootstrap.json"
"""Name of the file in the folder of a run."""


@dataclass(frozen=True, kw_only=True)
class StoredDamping:
    """Damping of a run."""

    damping: Damping | None
    """None if simulated pairs did not show it."""
    pairs: tuple[int, ...]
    """Recorded pairs whose flow and particles were imitated."""
    seconds: float
    """Time that the measurement took [s]."""
    reason: str = ""
    """Why it could not be measured."""

    def to_json(self) -> dict[str, Any]:
        """Return the form that the file and the summary store."""
        known = {"axes": {}, "simulated": 0} if self.damping is None else self.damping.to_json()
        return {**known, "pairs": list(self.pairs), "seconds": self.seconds, "reason": self.reason}


@dataclass(frozen=True, kw_only=True)
class _Entries:
    damping: dict[str, Any] | None
    pairs: tuple[int, ...]
    seconds: float
    reason: str


def read(path: Path) -> tuple[StoredDamping, Marks] | None:
    """Read the damping of a run, whether it fits or not, and its marks; None if it is missing or damaged."""
    return stored_outcome.read(path, _parse)


def _parse(content: dict[str, Any]) -> StoredDamping:
    found = validate(_Entries, content)
    damping = None if found.damping is None else Damping.from_json(found.damping)
    return StoredDamping(damping=damping, pairs=found.pairs, seconds=found.seconds, reason=found.reason)


def write(found: StoredDamping, stamp: Stamp, path: Path) -> None:
    """Write the damping of a run, atomically."""
    damping = None if found.damping is None else found.damping.to_json()
    entries = {"damping": damping, "pairs": found.pairs, "seconds": found.seconds, "reason": found.reason}
    stored_outcome.write(entries, stamp, path)


def of_vectors(path: Path, depends_on: Mapping[str, Any]) -> Damping | None:
    """Return the damping in a file that holds for vectors, given the parts of their stamp; None if there is none.

    All parts must be equal but `provenance.OF_PAIR`.
    """
    found = read(path)
    if found is None:
        return None
    stored = read_object(found[1].depends_on)
    same = all(stored.get(name) == part for name, part in depends_on.items() if name not in provenance.OF_PAIR)
    return found[0].damping if same and depends_on else None
