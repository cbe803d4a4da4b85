"""The error for what a user can mend: a file, a key, an argument."""


class InputError(ValueError):
    """Bad input; the message names the file or key, what was expected, what was found and what to do.

    The command line prints it without a traceback and exits with status 2.
    """


class StorageError(OSError):
    """Results cannot be written, for want of space or rights; the message names the file and says how to go on.

    What was written before is whole. The command line exits with status 1.
    """
