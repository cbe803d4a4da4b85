"""Explain why a text is not TOML: its line, what is wrong there, and what to write instead.

Each rule mends a frequent mistake by a pattern. It is told only if the mended line is TOML, so that no guess is wrong.
Otherwise the message says what the parser expected.
"""

from __future__ import annotations

import re
import sys
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SHOWN_LINE = 80
"""Most characters of a line in a message."""
LONGEST_LINE = 2000
"""Longest line that the rules look at [character]."""

_PLACE = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_STATEMENT = re.compile(r"(?P<key>\s*[\w.-]+\s*)=(?P<value>.*)")
_HEADER = re.compile(r"\s*(?P<open>(?:\[\s*)+)(?P<name>[\w.-]+)(?P<close>(?:\s*\])*)\s*(?P<rest>.*)")

_PLAIN = {
    "Invalid value": "expected a number, text in quotes, true, false, or a list in brackets after =",
    "Expected '=' after a key in a key/value pair": "expected the form key = value",
    "Invalid statement": "expected the form key = value, a [table] in brackets, or a comment after #",
    "Invalid initial character for a key part": "expected the name of a table, or of a key",
    "Unclosed array": "expected a comma between two values of a list, or its closing bracket ]",
    "Unclosed inline table": "expected a comma between two keys in braces, or the closing brace }",
    'Expected "\'"': "expected a closing ' in the line where the text begins",
    "Illegal character '\\n'": "expected a closing quote in the line where the text begins",
}
"""What the parser's messages mean, for people who do not know its terms."""


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
        "line 7, `voxel_mm = 0,7`: expected a point in a decimal number, found a comma. Write `voxel_mm = 0.7`."
    """
    said, (number, column) = _PLACE.sub("", str(error)), _place(text, str(error))
    lines = text.splitlines() or [""]
    number = min(number, len(lines) - 1)
    if said == 'Expected "\'"':  # the parser looks for it until the end of the text
        number, column = _open_single_quote(lines, number), 0
    if said == "Unclosed array":
        start = _start_of_list(lines, number)
        if start < number and (closed := _left_open(lines, start, number)):
            return f"{_line(lines, start)}: {closed}"
    if (twice := _twice(lines, number)) and said.startswith("Cannot"):
        return f"{_line(lines, number)}: {twice}"
    line = lines[number]
    if len(line) <= LONGEST_LINE and not _parses(line):
        for rule in _RULES:
            if advice := rule.advice(line):
                return f"{_line(lines, number)}: {advice}"
    return f"{_line(lines, number)}: {_in_general(said, line, column)}"


def _place(text: str, message: str) -> tuple[int, int]:
    """Return line and column of an error, both counted from 0."""
    match = _PLACE.search(message)
    if match is None or match[1] is None:
        lines = text.splitlines() or [""]
        return len(lines) - 1, len(lines[-1])
    return int(match[1]) - 1, int(match[2]) - 1


def _line(lines: list[str], number: int) -> str:
    shown = _shown(lines[number])
    return f"line {number + 1}, {shown}" if shown != "``" else f"line {number + 1}, which is empty"


def _shown(line: str) -> str:
    text = line.strip()
    return f"`{text if len(text) <= SHOWN_LINE else text[: SHOWN_LINE - 3] + '...'}`"


def _parses(text: str) -> bool:
    try:
        tomllib.loads(text)
    except (ValueError, RecursionError):
        return False
    return True


def _in_general(said: str, line: str, column: int) -> str:
    """Return what the parser says in plain words, with the character at which it stopped."""
    rest = line[column:].strip()
    rest = "" if rest.startswith("#") else rest
    if rest and ord(rest[0]) > 127:
        name = unicodedata.name(rest[0], "without a name")
        return f"found the character {rest[0]!r} ({name}) outside quotes. Replace it, or put text in quotes."
    if said.startswith("Expected newline or end of document"):
        found = repr(rest if len(rest) <= 20 else rest[:17] + "...")
        return f"expected the end of the line after the value, found {found}. Text needs quotes, a list brackets."
    if said in ("Invalid value", "Unclosed array") and not rest:
        return "expected a value after =, found none." if said == "Invalid value" else f"{_PLAIN[said]}."
    plain = _PLAIN.get(said, said[:1].lower() + said[1:])
    return f"{plain}, found {rest[:17]!r}." if said == "Invalid value" else f"{plain}."


# -- lists of several lines and tables that stand twice ----------------------------------------------------------------


def _open_single_quote(lines: list[str], number: int) -> int:
    """Return the first line up to one in which a text begins with a single quote and does not end."""
    statements = (
        at for at in range(number + 1) if (match := _STATEMENT.fullmatch(lines[at])) and "'" in match["value"]
    )
    return next((at for at in statements if len(lines[at]) <= LONGEST_LINE and not _parses(lines[at])), number)


def _start_of_list(lines: list[str], number: int) -> int:
    """Return the line in which the statement begins whose list is open in a line."""
    opened = (back for back in range(number, -1, -1) if re.match(r"\s*[\w.-]+\s*=\s*\[", lines[back]))
    return next(opened, number)


def _left_open(lines: list[str], start: int, number: int) -> str:
    """Return the advice for a list that another statement follows before its bracket is closed; "" for another."""
    looks_new = _STATEMENT.fullmatch(lines[number]) or lines[number].lstrip().startswith("[")
    if looks_new and _parses("\n".join([*lines[start:number], "]"])):
        return "expected the closing bracket ] of the list that begins here, found none. Add it."
    return ""


def _twice(lines: list[str], number: int) -> str:
    """Return the advice for a table or a key that stands before already; "" if there is none."""
    header = _HEADER.fullmatch(lines[number])
    if header is not None:
        name = header["name"]
        for before in range(number):
            other = _HEADER.fullmatch(lines[before])
            if other is not None and other["name"] == name:
                return (
                    f"expected each table once, found [{name}] in line {before + 1} already. Keep one, with all keys. "
                    "Tables of which there may be several have two brackets each, as [[camera]] has."
                )
        return ""
    statement = _STATEMENT.fullmatch(lines[number])
    for before in range(number - 1, -1, -1):
        if statement is None or _HEADER.fullmatch(lines[before]):
            break
        other = _STATEMENT.fullmatch(lines[before])
        if other is not None and other["key"].strip() == statement["key"].strip():
            return f"expected each key of a table once, found it in line {before + 1} already. Remove one of them."
    return ""


# -- rules for one line ------------------------------------------------------------------------------------------------

New = str | Callable[[re.Match[str]], str]
"""What takes the place of a match: a template, or what it returns."""


@dataclass(frozen=True)
class _Rule:
    """A mistake of one line, and what may have been meant."""

    pattern: str
    expected: str
    found: str
    """A template of the match; empty for its character that is not ASCII."""
    meant: tuple[New, ...]
    way: str = ""
    """What to do where no line can be proposed."""

    def advice(self, line: str) -> str:
        """Return what was expected, what was found and what to write; "" if the line has not this mistake."""
        match = re.search(self.pattern, line)
        if match is None:
            return ""
        lines = dict.fromkeys(re.sub(self.pattern, new, line) for new in self.meant)
        mended = [one for one in lines if one != line and _parses(one)]
        if not mended:
            return ""
        strange = next((one for one in match[0] if ord(one) > 127), " ")
        found = match.expand(self.found) or f"{strange!r} ({unicodedata.name(strange, 'without a name')})"
        way = self.way or f"Write {', or '.join(map(_shown, mended))}."
        return f"expected {self.expected}, found {found}. {way}"


def _without(pattern: str, new: str = "") -> Callable[[re.Match[str]], str]:
    """Replace a pattern in the value of a match of `_KEY` and `_END`."""
    return lambda match: match[1] + re.sub(pattern, new, match[2]) + match[match.re.groups]


def _quoted(match: re.Match[str]) -> str:
    """Put quotes around what is no number in a list."""
    parts = (part.strip() for part in match[2].split(","))
    listed = ", ".join(part if _parses(f"a = {part}") else f'"{part}"' for part in parts)
    return f"{match[1]}[{listed}]{match[3]}"


def _plain_numbers(match: re.Match[str]) -> str:
    text = re.sub(r"(?<![\d.])\.(?=\d)", "0.", match[2])
    text = re.sub(r"(?<=\d)\.(?!\d)", ".0", text)
    return match[1] + re.sub(r"(?<![\d.])0+(?=\d)", "", text) + match[3]


def _value(value: str, *rest: str | tuple[New, ...]) -> _Rule:
    """Return a rule for the value of a key; in it group 1 is all before the value, the last group all after it."""
    return _Rule(rf"^(\s*[\w.-]+\s*=\s*){value}(\s*(?:#.*)?)$", *rest)  # type: ignore[arg-type]


_UNIT = r"\s*([A-Za-z\u00b0\u00b5\u03bc%][\w/^%-]*)"
_NUMBER = r"[+-]?\d[\d.,]*(?:[eE][+-]?\d+)?"
_UNITLESS = "Write the number alone, in the unit that the key states; other text needs quotes."
_RULES = (
    _Rule("[\u00a0\u2007\u202f\u3000]", "plain blanks", "", (" ",)),
    _Rule("[\u200b\u200c\u200d\u2060\ufeff]", "visible characters", "", ("",)),
    _Rule("[\u201c\u201d\u201e\u201f\u00ab\u00bb\u2033]", "straight quotes", "", ('"',)),
    _Rule("[\u201c\u201d\u201e\u201f\u2018\u2019\u201a\u201b\u2039\u203a\u00b4]", "straight quotes", "", ('"',)),
    _Rule("[\u2010-\u2014\u2212]", "a plain minus sign", "", ("-",)),
    _Rule(
        r'"[^"]*\\[^"]*"',
        "a path without backslashes",
        "a backslash in double quotes, which begins a special character",
        (lambda match: match[0].replace("\\", "/"), lambda match: f"'{match[0][1:-1]}'"),
    ),
    _Rule(
        r"^\s*(\[+\s*([\w.-]+)[\s\]]*)(#.*)?$",
        "the name of a table in one pair of brackets, or in two where there are several, such as cameras",
        r"\1",
        (r"[\2]", r"[[\2]]"),
    ),
    _Rule(r"(^|\s)(//|%|;|--|!|/\*)\s*([^=]*\S)\s*$", "# before a comment", r"\2", (r"\1# \3",)),
    _value(r"([({])(.*)[)}]", "a list in square brackets", r"\2", (r"\1[\3]\4",)),
    _value(
        r"\[([^\]]*;[^\]]*)\]",
        "commas between the values of a list",
        "semicolons",
        (lambda match: f"{match[1]}[{match[2].replace(',', '.').replace(';', ',')}]{match[3]}",),
    ),
    _value(
        r"\[([^\],]*)\]",
        "commas between the values of a list",
        "blanks",
        (lambda match: f"{match[1]}[{', '.join(match[2].split())}]{match[3]}",),
    ),
    _value(r"(\[[^\]]*\])\s*([^\s#].*?)", "a list alone", r"'\3' after it", (r"\1\2\4",)),
    _value(r"(\[[^\]#]*)", "a closing bracket ] after the list", "none", (r"\1\2]\3",)),
    _value(r"([+-]?\d{1,3}([ '\u2019.])\d{3}(?:\3\d{3})*)", "a number without separators", r"\2", (_without(r"\D"),)),
    _value(r"(\d{1,3}(?:,\d{3}){2,})", "a number without separators", r"\2", (_without(","), r"\1[\2]\3")),
    _value(r"(\d{1,3},\d{3})", "a point in a decimal number", "a comma", (_without(",", "."), _without(","))),
    _value(r"([+-]?\d+,\d+)", "a point in a decimal number", "a comma", (_without(",", "."), r"\1[\2]\3")),
    _value(r"([^\[\](){}\"'#=]*,[^\[\](){}\"'#=]*?)", "a list in brackets", "none", (r"\1[\2]\3",)),
    _value(
        rf"(\(?{_NUMBER}(?:\s*[*/^]+\s*\(?{_NUMBER}\)?)+)",
        "one number",
        r"the calculation \2",
        ("a = 1",),
        "Write its result.",
    ),
    _value(rf"({_NUMBER}){_UNIT}", "a number alone", r"'\3' after it", ("a = 1",), _UNITLESS),
    _value(rf"\[([^\]\"']*?\d{_UNIT}[^\]\"']*)\]", "a number alone", r"'\3' after it", ("a = 1",), _UNITLESS),
    _value(r"([^\"'#A-Za-z]+?)", "digits before and after the point, and no leading zeros", r"\2", (_plain_numbers,)),
    _value(
        r"([tT]rue|TRUE|[fF]alse|FALSE)", "true or false in small letters", r"\2", (lambda match: match[0].lower(),)
    ),
    _value(r"((?i:yes|no|on|off))", "true or false", r"\2", ("a = 1",), "Write one of them; text needs quotes."),
    _value(
        r"((?i:none|null|nil))", "a value", r"\2", ("a = 1",), "Leave the key out to state none; text needs quotes."
    ),
    _value(r"(.*?)\s*([;,])", "the end of the line after the value", r"\3", (r"\1\2\4",)),
    _value(
        r"((?=[^#]*[A-Za-z])[^\s\"'\[\],#=(][^\"'\[\],#=]*?)",
        "a number, or text in quotes",
        r"\2",
        (lambda match: f'{match[1]}"{match[2]}"'.replace("\\", "/") + match[3],),
    ),
    _value(r"\[([^\]\"'{}]*[A-Za-z][^\]\"'{}]*)\]", "text in quotes", r"\2", (_quoted,)),
    _value(r"((\"|')[^\"']*)", r"a closing quote after the text", "none", (r"\1\2\3\4",)),
    _value(r"([^\"']*(\"|'))", r"an opening quote before the text", "none", (r"\1\3\2\4",)),
    _Rule(r"^(\s*[\w-]+)\s*(:=|==|=>|:)\s*(\S.*)$", "= between key and value", r"\2", (r"\1 = \3",)),
    _Rule(
        r"^\s*(\w+(?:\s+\w+)+)\s*=",
        "a key without blanks",
        r"'\1'",
        (lambda match: f"{'_'.join(match[1].split())} =",),
    ),
    _Rule(r"^(\s*[\w-]+)\s+([^\s=].*)$", "= between key and value", "none", (r"\1 = \2",)),
)
