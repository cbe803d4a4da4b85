"""Start `lfpiv studio` as users do, and wait for what its page shows."""

import subprocess
import sys
import time
from contextlib import contextmanager


@contextmanager
def served(*arguments):
    """Start `lfpiv studio` and yield the address of its page."""
    command = [sys.executable, "-m", "lfpiv", "studio", *map(str, arguments), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline()
            assert line.startswith("studio: "), process.stderr.read()
            yield line.split()[1]
        finally:
            process.terminate()


def until(condition, seconds=20):
    """Wait until a condition holds and return its value."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "the page does not show what is expected"
        time.sleep(0.05)
    return found
