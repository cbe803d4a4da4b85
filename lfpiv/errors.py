"""Errors that users can resolve: in files, keys or arguments, on the disk, or in a cluster."""

from __future__ import annotations

import unicodedata

LONGEST_MESSAGE = 600
"""Most characters of the message of an `InputError`."""

_HEAD = 400
"""Characters of a longer message that are kept in front of its end."""

_CONTROL = ("Cc", "Cs", "Zl", "Zp")
"""Categories of Unicode that a terminal obeys, or that cannot be encoded."""

_REORDER = frozenset("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""Characters that reorder the text around them."""


def printable(text: str, keep: str = "") -> str:
    r"""Return a text with control characters, lone surrogates and marks of text direction escaped.

    Parameters
    ----------
    text : str
        Text that may hold parts of files or names of files.
    keep : str
        Characters that stay, such as line breaks.

    Examples
    --------
    >>> from lfpiv.errors import printable
    >>> print(printable("a\x1b[31m\n"))
    a\x1b[31m\n
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        character.encode("unicode_escape").decode("ascii")
        if character not in keep and (character in _REORDER or unicodedata.category(character) in _CONTROL)
        else character
        for character in text
    )


class InputError(ValueError):
    """Bad input; the message names the file or key, what was expected, what was found and what to do.

    The command line prints it without a traceback and exits with status 2. The message is one line of at most
    `LONGEST_MESSAGE` characters: line breaks become blanks, control characters are escaped, and the middle of a longer
    text is left out.
    """

    def __init__(self, message: str = "") -> None:
        text = printable(" ".join(message.splitlines()))
        if len(text) > LONGEST_MESSAGE:
            text = f"{text[:_HEAD]} ... {text[_HEAD + 5 - LONGEST_MESSAGE :]}"
        super().__init__(text)


class StorageError(OSError):
    """Results cannot be written, because space or rights are missing; the message names the file and how to continue.

    Files that were written before are complete. The command line exits with status 1.
    """


class ClusterError(RuntimeError):
    """The scheduler that distributes pairs to workers was lost during a run; the message says how to continue.

    Results that were finished before are complete. The command line exits with status 1.
    """


class DamagedFile(InputError):
    """A stored result that cannot be relied on; the message names the file and the reason.

    A run makes the result again. What only reads results ends with this error.
    """

    def __init__(self, path: object, reason: str, remedy: str = "Remove it and run again"):
        self.path, self.reason, self.remedy = str(path), " ".join(reason.split())[:300], remedy
        super().__init__(f"{self.path}: expected a finished file, found a damaged one ({self.reason}). {remedy}.")

    def __reduce__(self) -> tuple[type[DamagedFile], tuple[str, str, str]]:
        return type(self), (self.path, self.reason, self.remedy)
