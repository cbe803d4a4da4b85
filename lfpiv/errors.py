"""Errors that users can resolve: in files, keys or arguments, on the disk, or in a cluster."""

from __future__ import annotations


class InputError(ValueError):
    """Bad input; the message names the file or key, what was expected, what was found and what to do.

    The command line prints it without a traceback and exits with status 2.
    """


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
