"""The error for what a user can mend: a file, a key, an argument."""


class InputError(ValueError):
    """Bad input; the message names the file or key, what was expected, what was found and what to do.

    The command line prints it without a traceback and exits with status 2.
    """
