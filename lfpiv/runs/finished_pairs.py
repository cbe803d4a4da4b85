"""Figures of all finished pairs of a run, in a temporary file: the memory holds 8 bytes per pair, 24 per image."""

from __future__ import annotations

import hashlib
import json
import tempfile
from array import array
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

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
        self._images = array("Q")  # pair, hash of the path, hash of the content of each image

    def add(self, pair: int, figures: PairFigures, images: Iterable[tuple[str, str]] = ()) -> None:
        """Store the figures of a pair, in place of earlier ones, and which images it was made from: path and digest.

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
        for image in images:
            self._images.extend((pair, *map(_number, image)))

    def clear(self) -> None:
        """Forget all pairs."""
        self._places = array("q", [_ABSENT]) * len(self._numbers)
        self._count = self._end = 0
        self._images = array("Q")

    def copies(self) -> dict[int, int]:
        """Return the pairs with an image that equals one of another path, each with the first pair that has it."""
        pair, path, content = np.array(self._images, np.uint64).reshape(-1, 3).T
        order = np.lexsort((path, pair, content))
        pair, path, content = pair[order], path[order], content[order]
        first = np.flatnonzero(np.append(True, content[1:] != content[:-1])[: len(content)])
        original = np.repeat(first, np.diff(np.append(first, len(content))))
        again = np.flatnonzero((path != path[original]) & (pair != pair[original]))
        return dict(sorted(((int(pair[item]), int(pair[original[item]])) for item in again), reverse=True))

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


def _number(text: str) -> int:
    """Return 64 bits of a hash."""
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")
