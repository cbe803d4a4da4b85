"""Propose what the value of a key was meant to be where it is not TOML: numbers, text and lists in other forms."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Mistake:
    """A mistake as it may have been made, and the text without it."""

    expected: str
    found: str
    way: str
    """What to write, a sentence."""
    mended: str
    """The line or the value without the mistake. The mistake is certain only if this is TOML."""


NUMBER = r"[+-]?(?:0|[1-9]\d*)(?:\.\d+)?(?:[eE][+-]?\d+)?"
"""A number as TOML has it."""

_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")
_GROUPS = re.compile(r"[+-]?\d{1,3}(?:([ '\u2019\u00a0\u202f.,])\d{3})(?:\1\d{3})*(?:[.,]\d+)?")
_WITH_WORD = re.compile(r"(?P<number>[+-]?\d[\d.,]*(?:[eE][+-]?\d+)?)\s*(?P<word>[A-Za-z\u00b0\u00b5\u03bc%][\w/^%-]*)")
_QUOTES = str.maketrans(dict.fromkeys("\u201c\u201d\u201e\u201f\u00ab\u00bb\u2033", '"'))
_SINGLE_QUOTES = str.maketrans(dict.fromkeys("\u2018\u2019\u201a\u201b\u2039\u203a\u00b4\u2032", '"'))
_DASHES = str.maketrans(dict.fromkeys("\u2010\u2011\u2012\u2013\u2014\u2212", "-"))
_UNITS = {"mm": "mm", "um": "um", "s": "s", "deg": "degrees", "gib": "GiB", "voxel": "voxels", "px": "pixels"}
"""Units that the ends of keys state."""


def mistakes(value: str, key: str) -> Iterator[Mistake]:
    """Yield the mistakes that a value may have, those first that say most.

    Parameters
    ----------
    value : str
        What stands after ``=``, without a comment, on one line.
    key : str
        The key, whose end may state a unit.

    Yields
    ------
    Mistake
        `Mistake.mended` is the value without it.
    """
    for rule in _RULES:
        yield from rule(value, key)


def _curly_quotes(value: str, key: str) -> Iterator[Mistake]:
    for table in (_QUOTES, _QUOTES | _SINGLE_QUOTES):
        mended = value.translate(table)
        found = next((one for one, other in zip(value, mended, strict=True) if one != other), "")
        if found:
            name = unicodedata.name(found)
            yield Mistake("straight quotes", f"{found} ({name})", f"Write {mended}.", mended)


def _open_quote(value: str, key: str) -> Iterator[Mistake]:
    for quote in "\"'":
        if value.count(quote) == 1:
            if value.startswith(quote):
                yield Mistake(f"a closing {quote} after the text", "none", f"Write {value}{quote}.", value + quote)
            elif value.endswith(quote):
                yield Mistake(f"an opening {quote} before the text", "none", f"Write {quote}{value}.", quote + value)


def _decimal_comma(value: str, key: str) -> Iterator[Mistake]:
    if not _DECIMAL_COMMA.fullmatch(value):
        return
    before, _, after = value.partition(",")
    point = f"{before}.{after}"
    way = f"Use a point: {point}."
    if len(after) == 3 and before.lstrip("+-") not in ("", "0"):
        way = f"Use a point, {point}, or no separator for thousands, {before}{after}."
    if re.fullmatch("0|[1-9][0-9]*", after):
        way += f" Two values need brackets: [{before}, {after}]."
    yield Mistake("a point in a decimal number", "a comma", way, point)


def _thousands(value: str, key: str) -> Iterator[Mistake]:
    match = _GROUPS.fullmatch(value)
    if match is None or (match[1] in ".," and len(re.findall(r"[.,]", value)) < 2):
        return
    separator = match[1]
    number = value.replace(separator, "")
    way = f"Write {number.replace(',', '.')}."
    if separator in " ," and "." not in value and "0" not in {group[0] for group in value.split(separator)[1:]}:
        way += f" Several values need brackets: [{', '.join(value.split(separator))}]."
    yield Mistake("a number without separators", value, way, number.replace(",", "."))


def _word_behind(value: str, key: str) -> Iterator[Mistake]:
    """Propose a number without the unit or word after it, such as 50 for ``50 mm``."""
    match = _WITH_WORD.fullmatch(value)
    if match is None:
        return
    number, word = match["number"].replace(",", "."), match["word"]
    unit = _UNITS.get(key.rpartition("_")[2]) if "_" in key else None
    if unit is None:
        way = f'Write a number without a unit, such as {number}; text needs quotes: "{value}".'
    elif unit.startswith(word.rstrip(".")):
        way = f"Write {number}: the key states the unit."
    else:
        way = f"Write the number in {unit}, without the unit."
    yield Mistake("a number alone", f"{word!r} after it", way, number)


def _number_form(value: str, key: str) -> Iterator[Mistake]:
    """Propose TOML's form of ``.5``, ``5.``, ``05``, and of signs that are no ASCII characters."""
    plain = unicodedata.normalize("NFKC", value.translate(_DASHES))
    plain = re.sub(r"(?<=[+-])\s+", "", plain)
    match = re.fullmatch(r"([+-]?)(\d*)(?:([.])(\d*))?((?:[eE][+-]?\d+)?)", plain)
    if match is None or not (match[2] or match[4]):
        return
    whole, fraction = (match[2] or "0").lstrip("0") or "0", match[4] or "0"
    number = match[1] + whole + (f".{fraction}" if match[3] else "") + match[5]
    strange = next((one for one in value if ord(one) > 127), None)
    if strange is not None:
        found = f"{strange!r} ({unicodedata.name(strange, 'without a name')})"
        yield Mistake("a number in plain digits and signs", found, f"Write {number}.", number)
    elif number != value:
        expected = "a number without leading zeros" if match[2] and match[4] else "digits before and after the point"
        way = f"Write {number}."
        yield Mistake(expected if match[3] else "a number without leading zeros", repr(value), way, number)


def _calculation(value: str, key: str) -> Iterator[Mistake]:
    if re.fullmatch(rf"\(?{NUMBER}(?:\s*(?:[*/^]|\*\*)\s*\(?{NUMBER}\)?)+", value):
        yield Mistake("one number", f"the calculation {value}", "Write its result.", "1")


def _word(value: str, key: str) -> Iterator[Mistake]:
    """Propose TOML's form of words that other languages know, and quotes for text."""
    if value.lower() in ("true", "false"):
        yield Mistake("true or false in small letters", value, f"Write {value.lower()}.", value.lower())
    elif value.lower() in ("yes", "no", "on", "off"):
        yield Mistake("true or false", value, f'Write one of them; text needs quotes: "{value}".', "true")
    elif value.lower() in ("none", "null", "nil"):
        yield Mistake("a value", value, f'Leave the key out to state none; text needs quotes: "{value}".', "0")
    elif re.fullmatch(r"[^\s\"'\[\],#=(][^\"'\[\],#=]*", value) and re.search(r"[A-Za-z]", value):
        quoted = value.replace("\\", "/")
        yield Mistake("a number, or text in quotes", value, f'Text needs quotes: "{quoted}".', f'"{quoted}"')


def _end_mark(value: str, key: str) -> Iterator[Mistake]:
    if value[-1:] in (";", ","):
        rest = value[:-1].rstrip()
        yield Mistake("the end of the line after the value", value[-1], f"Write {rest}.", rest)


def _list_form(value: str, key: str) -> Iterator[Mistake]:
    """Propose a list in brackets, with commas, and with nothing behind it."""
    if value[:1] in ("(", "{") and value[-1:] in (")", "}"):
        mended = f"[{value[1:-1]}]"
        yield Mistake("a list in square brackets", value[0], f"Write {mended}.", mended)
    if "," in value and value[:1] not in ("[", "{", "("):
        decimals = ", and decimals with a point" if re.search(r"\d,\d", value) else ""
        way = f"Write [{value}]{decimals}."
        yield Mistake("a list in brackets", "none", way, f"[{value}]")
    if not value.startswith("["):
        return
    inner, closed, behind = value[1:].partition("]")
    if closed and behind.strip():
        found = f"{behind.strip()!r} after it"
        yield Mistake("a list alone", found, "Keys state their units; remove what stands behind.", f"[{inner}]")
    if not closed:
        yield Mistake("a closing bracket ] after the list", "none", f"Write {value}].", f"{value}]")
    for mark, name in ((";", "semicolons"), (None, "blanks")):
        parts = inner.split(mark)
        if len(parts) > 1 and closed and (mark or "," not in inner):
            mended = f"[{', '.join(part.strip().replace(',', '.') for part in parts)}]"
            yield Mistake("commas between the values of a list", name, f"Write {mended}.", mended)


def _entries(value: str, key: str) -> Iterator[Mistake]:
    """Propose a list of which each entry is in TOML's form."""
    if not (value.startswith("[") and value.endswith("]")) or any(one in value[1:-1] for one in "[]{}\"'"):
        return
    parts = [part.strip() for part in value[1:-1].split(",")]
    for rule in (_word_behind, _number_form, _calculation, _word):
        found = [next(rule(part, key), None) for part in parts]
        first = next((one for one in found if one is not None), None)
        if first is not None:
            mended = ", ".join(part if one is None else one.mended for part, one in zip(parts, found, strict=True))
            way = first.way if rule in (_word_behind, _calculation) else f"Write [{mended}]."
            yield Mistake(first.expected, first.found, way, f"[{mended}]")


_RULES: tuple[Callable[[str, str], Iterator[Mistake]], ...] = (
    *(_curly_quotes, _open_quote, _thousands, _decimal_comma, _word_behind, _number_form, _calculation),
    *(_end_mark, _list_form, _entries, _word),
)
