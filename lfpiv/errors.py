"""Errors that users can resolve: in files, keys or arguments, on the disk, or in a cluster."""


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
