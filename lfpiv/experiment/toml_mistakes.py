"""Explain why a text is not TOML: its line, what is wrong there, and what to write instead.

Each rule proposes another line for a frequent mistake. Its explanation is given only if that line is TOML, so that no
guess is wrong; otherwise the message says what the parser expected.
"""

from __future__ import annotations

import re
import sys
import unicodedata
from collections.abc import Callable, Iterator

from lfpiv.experiment import toml_values
from lfpiv.experiment.toml_values import Mistake

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SHOWN_LINE = 80
"""Most characters of a line in a message."""
LONGEST_LINE = 2000
"""Longest line that the rules look at [character]."""

INVISIBLE = re.compile("[\u200b\u200c\u200d\u2060\ufeff]")
"""Characters of no width, which text copied from pages holds."""
BLANKS = re.compile("[\u00a0\u2007\u202f\u3000]")
"""Blanks other than those of TOML."""

_PLACE = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")
_STATEMENT = re.compile(r"(?P<key>\s*[\w.-]+\s*)=(?P<value>.*)")
_HEADER = re.compile(r"\s*(?P<open>(?:\[\s*)+)(?P<name>[\w.-]+)(?P<close>(?:\s*\])*)\s*(?P<rest>.*)")
_STRING = re.compile(r'"[^"]*"')

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
        "line 7, `voxel_mm = 0,7`: expected a point in a decimal number, found a comma. Write 0.7."
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
            for mistake in rule(line):
                if mistake.mended != line and _parses(mistake.mended):
                    return f"{_line(lines, number)}: expected {mistake.expected}, found {mistake.found}. {mistake.way}"
    return f"{_line(lines, number)}: {_in_general(said, line, column)}"


def _place(text: str, message: str) -> tuple[int, int]:
    """Return line and column of an error, both counted from 0."""
    match = _PLACE.search(message)
    if match is None or match[1] is None:
        lines = text.splitlines() or [""]
        return len(lines) - 1, len(lines[-1])
    return int(match[1]) - 1, int(match[2]) - 1


def _line(lines: list[str], number: int) -> str:
    shown = lines[number].strip()
    shown = shown if len(shown) <= SHOWN_LINE else shown[: SHOWN_LINE - 3] + "..."
    return f"line {number + 1}, `{shown}`" if shown else f"line {number + 1}, which is empty"


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


def _unseen(line: str) -> Iterator[Mistake]:
    """Propose the line without characters that look like a blank or like nothing."""
    for pattern, new, way in ((BLANKS, " ", "Replace it by a blank."), (INVISIBLE, "", "Delete it.")):
        if match := pattern.search(line):
            name = f"{unicodedata.name(match[0])} in place {match.start() + 1}"
            yield Mistake("visible characters and plain blanks", name, way, pattern.sub(new, line))


def _backslash(line: str) -> Iterator[Mistake]:
    """Propose / in a path of Windows in double quotes."""
    first = next((text for text in _STRING.findall(line) if "\\" in text), None)
    if first is not None:
        slashes = _STRING.sub(lambda text: text[0].replace("\\", "/"), line)
        single = "" if "'" in first else f", or single quotes: '{first[1:-1]}'"
        found = "a backslash in double quotes, which begins a special character"
        yield Mistake("a path without backslashes", found, f"Use /: {first.replace(chr(92), '/')}{single}.", slashes)


def _comment(line: str) -> Iterator[Mistake]:
    """Propose # before a comment of another language."""
    match = re.fullmatch(r"(.*?(?:^|\s))(//|%|;|--|!|/\*)\s*([^=]*\S)\s*", line)
    if match:
        yield Mistake("# before a comment", match[2], f"Write # {match[3]}", f"{match[1]}# {match[3]}")


def _equals(line: str) -> Iterator[Mistake]:
    """Propose = between key and value, and a key without blanks."""
    match = re.fullmatch(r"(\s*[\w-]+)\s*(:=|==|=>|:)\s*(\S.*)", line)
    if match:
        yield Mistake("= between key and value", match[2], "Write key = value.", f"{match[1]} = {match[3]}")
    match = re.fullmatch(r"\s*(\w+(?:\s+\w+)+)\s*=(.*)", line)
    if match:
        key = "_".join(match[1].split())
        yield Mistake("a key without blanks", repr(match[1]), f"Is it {key}?", f"{key} ={match[2]}")
    match = re.fullmatch(r"(\s*[\w-]+)\s+([^\s=].*)", line)
    if match:
        yield Mistake("= between key and value", "none", "Write key = value.", f"{match[1]} = {match[2]}")


def _brackets(line: str) -> Iterator[Mistake]:
    """Propose a table where its brackets do not match."""
    match = _HEADER.fullmatch(line)
    if match is None or (match["rest"] and match["rest"][0] not in "#]"):
        return
    once, twice = f"[{match['name']}]", f"[[{match['name']}]]"
    found = re.sub(r"\s*#.*", "", line).strip()
    way = f"Write {once}, or {twice} for tables of which there are several, such as cameras."
    yield Mistake("the name of a table in one pair of brackets, or in two", found, way, once)


def _value(line: str) -> Iterator[Mistake]:
    """Propose a value in TOML's form."""
    match = _STATEMENT.fullmatch(line)
    if match is None:
        return
    key, text = match["key"], match["value"]
    bare = text if any(quote in text for quote in "\"'") else text.partition("#")[0]
    for mistake in toml_values.mistakes(bare.strip(), key.strip()):
        yield Mistake(mistake.expected, mistake.found, mistake.way, f"{key}= {mistake.mended}")


_RULES: tuple[Callable[[str], Iterator[Mistake]], ...] = (_unseen, _backslash, _brackets, _comment, _value, _equals)
