"""Signals that end the command line: swallowed by a library, in a long call, before and after a command."""

import signal
import subprocess
import sys

import pytest

from lfpiv_kernels.libraries import interrupts_kept

FRAME = """
import hashlib, os, signal, sys, time
from lfpiv.cli import interrupts
interrupts.watch()
def end(number=signal.SIG{name}):
    os.kill(os.getpid(), number)
    time.sleep(0.01)
{body}
"""
SWALLOWED = """
try:
    with interrupts.raised():
        try:
            end()
        except BaseException:
            print("swallowed", flush=True)
        while True:
            time.sleep(0.01)
except KeyboardInterrupt:
    print("ended")
"""
CLEANED_UP = """
try:
    with interrupts.raised():
        try:
            end()
        finally:
            time.sleep(3 * interrupts.REPEAT_S)
            print("cleaned up", flush=True)
except KeyboardInterrupt:
    print("ended")
"""
IN_A_LONG_CALL = """
with interrupts.raised():
    print("calls", flush=True)
    os.spawnlp(os.P_NOWAIT, "sh", "sh", "-c", f"sleep 0.2; kill -s {name} {{os.getpid()}}")
    hashlib.pbkdf2_hmac("sha256", b"", b"", 1 << 30)
"""
BEFORE = "end()"
AFTER = """
with interrupts.raised():
    pass
interrupts.end_with(3)
end()
"""
SECONDS = 60


@pytest.mark.parametrize("name", ["INT", "TERM"])
@pytest.mark.parametrize(
    ("body", "status", "written", "said"),
    [
        (SWALLOWED, 0, "swallowed ended", ""),
        (CLEANED_UP, 0, "cleaned up ended", ""),
        (IN_A_LONG_CALL, 1, "calls", "interrupted"),
        (BEFORE, 1, "", "interrupted"),
        (AFTER, 3, "", ""),
    ],
)
def test_no_signal_is_lost(name, body, status, written, said):
    done = subprocess.run(
        [sys.executable, "-c", FRAME.format(name=name, body=body.format(name=name))],
        capture_output=True,
        text=True,
        timeout=SECONDS,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert (done.returncode, done.stdout.split()) == (status, written.split()), done.stderr
    assert done.stderr.startswith("lfpiv: interrupted" if said else "") and (said or not done.stderr)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_during_an_import_are_answered_after_it(number):
    def answer(number, frame):
        raise KeyboardInterrupt

    before, went_on = signal.signal(number, answer), False
    try:
        with pytest.raises(KeyboardInterrupt):
            with interrupts_kept():
                signal.raise_signal(number)
                went_on = True
        assert went_on and signal.getsignal(number) is answer
    finally:
        signal.signal(number, before)
