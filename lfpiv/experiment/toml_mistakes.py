"""Explain why a text is not TOML: its line, what is wrong there, and what to write instead.

Each rule mends a frequent mistake by a pattern. It is told only if the mended line is TOML, so that no guess is wrong.
Otherwise the message says what the parser expected.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Sequence

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SHOWN_LINE = 80
"""Most characters of a line in a message."""
LONGEST_LINE = 2000
"""Longest line that the rules look at [character]."""

_PLACE = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_PLAIN = {
    "Invalid value": "expected a number, text in quotes, true, false, or a list in brackets after =, found {found}",
    "Expected '=' after a key in a key/value pair": "expected the form key = value",
    "Invalid statement": "expected the form key = value, a [table] in brackets, or a comment after #",
    "Invalid initial character for a key part": "expected the name of a table, or of a key",
    "Expected newline": "expected the end of the line after the value, found {found}. Put text in quotes",
    "Unclosed array": "expected a comma between two values of a list, or its closing bracket ], found {found}",
    "Unclosed inline table": "expected a comma between two keys in braces, or the closing brace }}",
    'Expected "\'"': "expected a closing ' in the line where the text begins",
    "Illegal character '\\n'": "expected a closing quote in the line where the text begins",
    "Cannot declare": "expected each table once. Several of one name have two brackets each, as [[camera]] has",
    "Cannot overwrite": "expected each key and table once, found one before already. Remove one of them",
}
"""What the parser's messages mean, by how they begin, for people who do not know its terms."""


def explain(text: str, error: tomllib.TOMLDecodeError) -> str:
    """Return a message about the first mistake of a text.

    Parameters
    ----------
    text : str
        The text, which is not TOML.
    error : TOMLDecodeError
        What the parser says of it.

    Returns
    -------
    str
        "line 7, `voxel_mm = 0,7`: expected a point in a decimal number. Write `voxel_mm = 0.7`."
    """
    lines, said = text.splitlines() or [""], _PLACE.sub("", str(error))
    number, column = _place_of(error, lines)
    if said == 'Expected "\'"':  # the parser looks for it until the end of the text
        number = next((at for at, line in enumerate(lines) if line.count("'") % 2 and not _parses(line)), number)
    line = lines[number]
    where = f"line {number + 1}, " + (_shown(line) if line.strip() else "which is empty")
    if len(line) <= LONGEST_LINE and not _parses(line) and (way := _mended(line)) is not None:
        return f"{where}: expected {way}"
    found = repr(line[column:].strip()[:20]) if line[column:].partition("#")[0].strip() else "none"
    known = (plain.format(found=found) for start, plain in _PLAIN.items() if said.startswith(start))
    return f"{where}: {next(known, said[:1].lower() + said[1:])}."


def _place_of(error: tomllib.TOMLDecodeError, lines: Sequence[str]) -> tuple[int, int]:
    """Return the line and the column that the parser names, from 0; it names none at the end of the text."""
    place = _PLACE.search(str(error))
    if place is None or place[1] is None:
        return len(lines) - 1, 0
    return min(int(place[1]), len(lines)) - 1, int(place[2]) - 1


def _mended(line: str) -> str | None:
    """Return what the first rule that mends a line expects; None if none does."""
    for pattern, expected, meant in _RULES:
        changed = (re.sub(pattern, new, line) for new in ((meant,) if callable(meant) else meant))
        if mended := [_shown(one) for one in dict.fromkeys(changed) if one != line and _parses(one)]:
            return expected if expected.endswith(".") else f"{expected}. Write {', or '.join(mended)}."
    return None


def _shown(line: str) -> str:
    text = line.strip()
    return f"`{text if len(text) <= SHOWN_LINE else text[: SHOWN_LINE - 3] + '...'}`"


def _parses(text: str) -> bool:
    try:
        tomllib.loads(text)
    except (ValueError, RecursionError):
        return False
    return True


New = str | Callable[[re.Match[str]], str]
Rule = tuple[str, str, Iterable[New] | Callable[[re.Match[str]], str]]
"""A pattern, what is expected in its place, and what may have been meant. A sentence is told as it is."""


def _value(value: str, expected: str, *meant: New) -> Rule:
    """Return a rule for the value of a key, group 2; group 1 is all before it, the last group all after it."""
    return rf"^(\s*[\w.-]+\s*=\s*){value}(\s*(?:#.*)?)$", expected, meant


def _within(pattern: str, new: str) -> Callable[[re.Match[str]], str]:
    """Replace a pattern in the value of a match."""
    return lambda match: match[1] + re.sub(pattern, new, match[2]) + match[match.re.groups]


def _digits(match: re.Match[str]) -> str:
    """Add zeros around points, and remove those that lead."""
    text = re.sub(r"(?<=\d)\.(?!\d)", ".0", re.sub(r"(?<![\d.])\.(?=\d)", "0.", match[2]))
    return match[1] + re.sub(r"(?<![\d.])0+(?=\d)", "", text) + match[match.re.groups]


def _semicolons(match: re.Match[str]) -> str:
    """Take commas for points, and semicolons for commas."""
    return match[1] + match[2].replace(",", ".").replace(";", ",") + match[match.re.groups]


_RIGHT = "a = 1"  # for what only its writer can mend
_NUMBER = r"[+-]?\d[\d.,]*(?:[eE][+-]?\d+)?"
_UNIT = r"\s*[A-Za-z\u00b0\u00b5\u03bc%][\w/^%-]*"
_ALONE = "a number alone, in the unit that the key states; other text needs quotes."
_RULES: tuple[Rule, ...] = (
    ("[\u00a0\u2007\u202f\u3000]", "plain blanks", (" ",)),
    ("[\u200b-\u200d\u2060\ufeff]", "visible characters", ("",)),
    ("[\u201c-\u201f\u00ab\u00bb\u2033]", "straight quotes", ('"',)),
    ("[\u2018-\u201f\u2039\u203a\u00b4]", "straight quotes", ('"',)),
    ("[\u2010-\u2014\u2212]", "a plain minus sign", ("-",)),
    (
        r'"([^"]*\\[^"]*)"',
        "a path without backslashes, which begin special characters in double quotes",
        (lambda match: match[0].replace("\\", "/"), r"'\1'"),
    ),
    (
        r"^\s*(\[+\s*([\w.-]+)[\s\]]*)(#.*)?$",
        "the name of a table in one pair of brackets, or in two where there are several, such as cameras",
        (r"[\2]", r"[[\2]]"),
    ),
    (r"(^|\s)(//|%|;|--|!|/\*)\s*([^=]*\S)\s*$", "# before a comment", (r"\1# \3",)),
    _value(r"[({](.*)[)}]", "a list in square brackets", r"\1[\2]\3"),
    _value(r"(\[[^\]]*;[^\]]*\])", "commas between values, and points in numbers", _semicolons),
    _value(r"(\[[^\],]*\])", "commas between the values of a list", _within(r"(?<=[^\s\[])\s+(?=[^\s\]])", ", ")),
    _value(r"(\[[^\]#]*)", "a closing bracket ] after the list", r"\1\2]\3"),
    _value(r"(\d{1,3}([ '\u2019.])\d{3}(?:\3\d{3})*)", "a number without separators", _within(r"\D", "")),
    _value(r"(\d{1,3}(?:,\d{3}){2,})", "a number without separators", _within(",", ""), r"\1[\2]\3"),
    _value(r"([+-]?\d+,\d+)", "a point in a decimal number", _within(",", "."), _within(",", ""), r"\1[\2]\3"),
    _value(r"([^\[\](){}\"'#=]*,[^\[\](){}\"'#=]*?)", "a list in brackets", r"\1[\2]\3"),
    _value(rf"(\(?{_NUMBER}(?:\s*[*/^]+\s*\(?{_NUMBER}\)?)+)", "one number, not a calculation.", _RIGHT),
    _value(rf"({_NUMBER}{_UNIT})", _ALONE, _RIGHT),
    _value(rf"(\[[^\]\"']*?\d{_UNIT}[^\]\"']*\]|\[[^\]]*\]{_UNIT})", _ALONE, _RIGHT),
    _value(r"([^\"'#A-Za-z]+?)", "digits before and after the point, and no leading zeros", _digits),
    _value(r"(True|TRUE|False|FALSE)", "true or false in small letters", lambda m: m[0].lower()),
    _value(r"((?i:yes|no|on|off))", "true or false; other text needs quotes.", _RIGHT),
    _value(r"((?i:none|null|nil))", "a value. Leave the key out to state none; text needs quotes.", _RIGHT),
    _value(r"(.*?)\s*[;,]", "the end of the line after the value", r"\1\2\3"),
    _value(r"((?=[^#]*[A-Za-z])[^\s\"'\[\],#=(][^\"'\[\],#=]*?)", "a number, or text in quotes", r'\1"\2"\3'),
    _value(r"((\"|')[^\"']*)", "a closing quote after the text", r"\1\2\3\4"),
    (r"^(\s*[\w-]+)\s*(?::=|==|=>|:|\s(?==*[^=]))\s*(\S.*)$", "= between key and value", (r"\1 = \2",)),
    (r"^\s*(\w+(?:\s+\w+)+)\s*=", "a key without blanks", lambda m: f"{'_'.join(m[1].split())} ="),
)
