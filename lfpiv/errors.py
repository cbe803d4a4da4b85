"""The errors that users meet: what they can mend in files, keys, arguments, on the disk or in a cluster."""


class InputError(ValueError):
    """Bad input; the message names the file or key, what was expected, what was found and what to do.

    The command line prints it without a traceback and exits with status 2.
    """


class StorageError(OSError):
    """Results cannot be written, for want of space or rights; the message names the file and says how to go on.

    What was written before is whole. The command line exits with status 1.
    """


class ClusterError(RuntimeError):
    """The scheduler that hands pairs to workers was lost in the middle of a run; the message says how to go on.

    What was finished before is whole. The command line exits with status 1.
    """
