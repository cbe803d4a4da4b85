"""The owner of Taichi's and Warp's state, in processes of its own: what one process may do only once."""

import subprocess
import sys

import pytest

FORKED = """
import os, sys
os.close(2)
from lfpiv_kernels import runtime
assert runtime.start("cpu", threads=2).kind == "cpu"
child = os.fork()
if child:
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
for ask in (runtime.device, lambda: runtime.run_chunks(8, print)):
    try:
        ask()
    except RuntimeError as error:
        print(error, flush=True)
    else:
        os._exit(1)
os._exit(0)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no fork there")
def test_kernels_start_without_standard_error_and_a_forked_process_says_that_it_has_none():
    """Its threads stayed in the process it was forked from, so kernels there would never end."""
    done = subprocess.run([sys.executable, "-c", FORKED], stdout=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 0, done.stdout
    assert done.stdout.count("'spawn' or 'forkserver'") == 2
