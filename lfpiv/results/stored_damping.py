"""The file ``bootstrap.json`` of a run: the damping by ghosts, and the vectors that it holds for.

The damping is stored once for all pairs, and readers take it off. So the files of the pairs stay as they were written,
those of finished pairs get the correction as well, and a run that is killed leaves none of them half done.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfpiv import files
from lfpiv.files import writing
from lfpiv.records import RecordError, digest, read_object, read_text, validate
from lfpiv.results import provenance
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
class _Content:
    settings_hash: str
    depends_on: str
    damping: dict[str, Any] | None
    pairs: tuple[int, ...]
    seconds: float
    reason: str
    digest: str


def read(path: Path) -> tuple[StoredDamping, Marks] | None:
    """Read the damping of a run, whether it fits or not, and its marks; None if it is missing or damaged.

    The log names a damaged file and the reason.
    """
    try:
        stored = read_object(read_text(path))
        found = validate(_Content, stored)
        if found.digest != digest(stored):
            raise RecordError("its entries are not those that were written: the digest differs")
        read_object(found.depends_on)
        damping = None if found.damping is None else Damping.from_json(found.damping)
        known = StoredDamping(damping=damping, pairs=found.pairs, seconds=found.seconds, reason=found.reason)
        return known, Marks(settings_hash=found.settings_hash, depends_on=found.depends_on)
    except FileNotFoundError:
        return None
    except RecordError as error:
        provenance.reject(path, str(error))
        return None


def write(found: StoredDamping, stamp: Stamp, path: Path) -> None:
    """Write the damping of a run, atomically."""
    damping = None if found.damping is None else found.damping.to_json()
    about = {"damping": damping, "pairs": list(found.pairs), "seconds": found.seconds, "reason": found.reason}
    content = files.plain({**stamp.attributes, **about})
    with writing(path):
        files.write_json({**content, "digest": digest(content)}, path)


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
