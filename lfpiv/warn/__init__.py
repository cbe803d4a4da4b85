"""Warnings of a run, for the log, the summary, the report and the exit status.

A `Warning` holds a code, a subject and figures. Files store these three. `Warning.sentence` makes the text for people,
so that a reworded sentence does not break older files. The codes and their sentences are in `lfpiv.warn.sentences`.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import string
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from lfpiv import records
from lfpiv.records import RecordError
from lfpiv.warn.sentences import SENTENCES, Code

__all__ = [
    "NAMED_PAIRS",
    "SENTENCES",
    "Code",
    "FirstOfEachCode",
    "Gathering",
    "Span",
    "Warning",
    "collected",
    "from_list",
    "from_text",
    "gather",
    "name_pairs",
    "to_text",
    "warn",
]

NAMED_PAIRS = 5
"""Largest number of pairs that a sentence names one by one."""


@dataclass(frozen=True, kw_only=True)
class Warning:
    """One doubt about a result."""

    code: Code
    subject: str = ""
    """Object of the doubt, such as a camera, or "left, frame a"; empty for the whole run."""
    figures: Mapping[str, object] = field(default_factory=dict)
    """Numbers and names that the sentence shows."""
    pairs: tuple[int, ...] = ()
    """Numbers of the pairs it concerns; empty where it concerns no pair in particular."""
    instants: tuple[int, ...] = ()
    """Numbers of the instants of a series that it concerns, in place of pairs."""

    @property
    def sentence(self) -> str:
        """Sentence for people: subject, pairs and text."""
        heads = [part for part in (self.subject, name_pairs(self.pairs), name_pairs(self.instants, "instant")) if part]
        text = _Words().vformat(SENTENCES[self.code], (), self.figures)
        return f"{', '.join(heads)}: {text}" if heads else text

    def of_pair(self, pair: int) -> Warning:
        """Return the same warning about one pair; one about instants stays as it is."""
        return self if self.instants else replace(self, pairs=(pair,))

    def by_instant(self) -> Warning:
        """Return the same warning with its pairs named by their first instants, for a series."""
        return replace(self, pairs=(), instants=self.pairs) if self.pairs else self

    def to_json(self) -> dict[str, Any]:
        """Return the form that a file stores."""
        figures = {name: asdict(value) if isinstance(value, Span) else value for name, value in self.figures.items()}
        stored = {"code": self.code.value, "subject": self.subject, "figures": figures}
        numbers = {"pairs": list(self.pairs), "instants": list(self.instants)}
        return stored | {name: found for name, found in numbers.items() if found}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Warning:
        """Read the form that a file stores.

        Raises
        ------
        RecordError
            If it has another form, or its figures do not fit its sentence.
        """
        found = records.validate(_Stored, stored)
        numbers = {"pairs": found.pairs, "instants": found.instants}
        if found.code not in {known.value for known in Code}:
            values = ", ".join(f"{name} = {value}" for name, value in found.figures.items())
            text = f"{found.code} ({values})" if values else found.code
            return cls(code=Code.OTHER, subject=found.subject, figures={"text": text}, **numbers)
        figures = {name: math.nan if value is None else value for name, value in found.figures.items()}
        warning = cls(code=Code(found.code), subject=found.subject, figures=figures, **numbers)
        try:
            _ = warning.sentence
        except (KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
            raise RecordError(f"figures of the warning {found.code!r} do not fit it ({error})") from None
        return warning


@dataclass(frozen=True)
class Span:
    """Range of a figure over several pairs."""

    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class _Stored:
    """A warning as files store it."""

    code: str
    subject: str
    figures: Mapping[str, Span | int | float | str | bool | Sequence[int | float | str] | None]
    pairs: tuple[int, ...] = ()
    instants: tuple[int, ...] = ()


class _Words(string.Formatter):
    """Fill figures into a sentence: a span as "low to high", a share in percent."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Span):
            low, high = (self.format_field(end, format_spec) for end in (value.low, value.high))
            return low if low == high else f"{low} to {high}"
        if format_spec.startswith("percent"):
            return f"{100 * value:.{format_spec[7:] or 0}f}"
        return str(super().format_field(value, format_spec))


def to_text(warnings: Iterable[Warning]) -> str:
    """Return the JSON text that an attribute of a file stores."""
    return json.dumps([warning.to_json() for warning in warnings])


def from_text(text: str) -> tuple[Warning, ...]:
    """Read the JSON text that an attribute of a file stores; raise RecordError if it is no list of warnings."""
    return from_list(records.read_json(text))


def from_list(stored: Any) -> tuple[Warning, ...]:
    """Read the list of warnings that a record holds; raise RecordError if it is no list of warnings."""
    if not isinstance(stored, list):
        raise RecordError("expected a list of warnings")
    return tuple(map(Warning.from_json, stored))


class Gathering:
    """Warnings of many pairs, merged as they arrive. Memory: 8 bytes per pair and kind of warning."""

    def __init__(self) -> None:
        self._groups: dict[tuple[Code, str, tuple[tuple[str, str], ...]], _Group] = {}

    def add(self, warnings: Iterable[Warning]) -> None:
        """Merge some warnings with those that are there."""
        for warning in warnings:
            fixed = ((name, value if isinstance(value, str) else "") for name, value in warning.figures.items())
            key = (warning.code, warning.subject, tuple(sorted(fixed)))
            if key not in self._groups:
                self._groups[key] = _Group(warning)
            self._groups[key].add(warning)

    def join(self, other: Gathering) -> None:
        """Merge the warnings of another one with those that are there."""
        for key, group in other._groups.items():
            if key in self._groups:
                self._groups[key].join(group)
            else:
                self._groups[key] = group

    def merged(self) -> list[Warning]:
        """Return the merged warnings, sorted by code."""
        order = list(Code)
        return [group.merged() for _, group in sorted(self._groups.items(), key=lambda item: order.index(item[0][0]))]


class _Group:
    """Warnings of equal code, subject and texts."""

    def __init__(self, first: Warning):
        self.first, self.count = first, 0
        self.pairs, self.instants = array("q"), array("q")
        self.spans: dict[str, tuple[Any, Any]] = {}
        """Figure -> lowest and highest number."""
        self.unlike = set[str]()
        """Figures that are no number in some warning."""

    def add(self, warning: Warning) -> None:
        self.count += 1
        _extend(self.pairs, warning.pairs)
        _extend(self.instants, warning.instants)
        for name in self.first.figures:
            value = warning.figures[name]
            if isinstance(value, (int, float)):
                low, high = self.spans.get(name, (value, value))
                self.spans[name] = min(low, value), max(high, value)
            else:
                self.unlike.add(name)

    def join(self, other: _Group) -> None:
        self.count += other.count
        _extend(self.pairs, other.pairs)
        _extend(self.instants, other.instants)
        self.unlike |= other.unlike
        for name, (low, high) in other.spans.items():
            own = self.spans.get(name, (low, high))
            self.spans[name] = min(own[0], low), max(own[1], high)

    def merged(self) -> Warning:
        figures: dict[str, object] = dict(self.first.figures)
        if self.count > 1:
            figures |= {name: Span(*span) for name, span in self.spans.items() if name not in self.unlike}
        pairs, instants = tuple(dict.fromkeys(self.pairs)), tuple(sorted({*self.instants}))
        return replace(self.first, figures=figures, pairs=pairs, instants=instants)


def _extend(known: array[int], numbers: Iterable[int]) -> None:
    """Add numbers, but none that equals the last."""
    for number in numbers:
        if not known or number != known[-1]:
            known.append(number)


def gather(warnings: Iterable[Warning]) -> list[Warning]:
    """Merge warnings of equal code, subject and texts: their pairs in one, their numbers as ranges. Sorted by code."""
    found = Gathering()
    found.add(warnings)
    return found.merged()


def name_pairs(pairs: Sequence[int], noun: str = "pair", count: int | None = None) -> str:
    """Name the first pairs, or what else the noun says, and count the others; empty for none.

    `count` is the number of all, where `pairs` are the first ones. Default: all are given.
    """
    count = len(pairs) if count is None else count
    if not count:
        return ""
    names = ", ".join(map(str, pairs[:NAMED_PAIRS]))
    more = f" and {count - NAMED_PAIRS} more" if count > NAMED_PAIRS else ""
    return f"{noun}{'s' if count > 1 else ''} {names}{more}"


_collected: ContextVar[list[Warning] | None] = ContextVar("collected", default=None)


def warn(log: logging.Logger, warning: Warning) -> None:
    """Log a warning, and hand it to the innermost `collected` block, once."""
    found = _collected.get()
    if not isinstance(found, _Quiet):
        log.warning("%s", warning.sentence)
    if found is not None and warning not in found:
        found.append(warning)


class _Quiet(list[Warning]):
    """Warnings that are collected and not logged."""


@dataclass(frozen=True)
class FirstOfEachCode:
    """Log the warnings of many pairs: only the first of each code. The summary names all pairs."""

    log: logging.Logger
    logged: set[Code] = field(default_factory=set)
    """Codes that were logged; grows with each call."""

    def __call__(self, warnings: Iterable[Warning]) -> None:
        """Log the warnings whose codes are new."""
        new = [warning for warning in warnings if warning.code not in self.logged]
        for warning in gather(new):
            self.log.warning("%s", warning.sentence)
        self.logged.update(warning.code for warning in new)


@contextlib.contextmanager
def collected(quiet: bool = False) -> Iterator[list[Warning]]:
    """Collect the warnings of a block in a list, at any log level. A block inside another one has its own list.

    With `quiet` they are not logged.
    """
    found: list[Warning] = _Quiet() if quiet else []
    token = _collected.set(found)
    try:
        yield found
    finally:
        _collected.reset(token)
