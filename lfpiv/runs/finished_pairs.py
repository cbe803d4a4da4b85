"""Figures of all finished pairs of a run, in a temporary file: the memory holds 8 bytes per pair."""

from __future__ import annotations

import json
import tempfile
from array import array
from collections.abc import Iterator, Mapping
from pathlib import Path

from lfpiv import files
from lfpiv.files import MIB, writing
from lfpiv.runs.pair_figures import PairFigures

IN_MEMORY_BYTES = 4 * MIB
"""Largest size that is held in memory instead of a file [byte]."""

_ABSENT = -1


class FinishedPairs(Mapping[int, PairFigures]):
    """Pair -> its figures, in the order of the pairs.

    Parameters
    ----------
    numbers : range
        All pairs of the experiment.
    folder : Path
        Folder of the temporary file. The file has no name there and ends with the process.
    """

    def __init__(self, numbers: range, folder: Path):
        self._numbers, self._folder, self._count = numbers, folder, 0
        self._places = array("q", [_ABSENT]) * len(numbers)
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES, dir=str(folder))
        self._end = 0

    def add(self, pair: int, figures: PairFigures) -> None:
        """Store the figures of a pair, in place of earlier ones.

        Raises
        ------
        StorageError
            If the disk is full.
        """
        line = json.dumps(files.plain(figures.to_json())).encode() + b"\n"
        with writing(self._folder / "summary.json"):
            self._file.seek(self._end)
            self._file.write(line)
        place = self._numbers.index(pair)
        self._count += self._places[place] == _ABSENT
        self._places[place] = self._end
        self._end += len(line)

    def clear(self) -> None:
        """Forget all pairs."""
        self._places = array("q", [_ABSENT]) * len(self._numbers)
        self._count = self._end = 0

    def __getitem__(self, pair: int) -> PairFigures:
        if pair not in self:
            raise KeyError(pair)
        self._file.seek(self._places[self._numbers.index(pair)])
        return PairFigures.from_json(json.loads(self._file.readline()))

    def __contains__(self, pair: object) -> bool:
        return pair in self._numbers and self._places[self._numbers.index(pair)] != _ABSENT  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[int]:
        return (pair for pair, place in zip(self._numbers, self._places, strict=True) if place != _ABSENT)

    def __len__(self) -> int:
        return self._count
