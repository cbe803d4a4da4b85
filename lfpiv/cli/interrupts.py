"""Ctrl-C and signals that end the command line: none is lost, whatever the program does when it comes.

Before and after a command a signal ends the process at once: nothing is half done. During a command it raises
KeyboardInterrupt. Libraries swallow some of these, for example with ``except:``. So a thread repeats the signal until
the interrupt is on its way out. The thread ends the process if the main thread does not answer, as in a long call of a
library. Files are written under other names, so none is damaged.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any, Literal

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
"""Signals that end a command. Those that the caller ignores stay ignored, as with ``nohup``."""

REPEAT_S = 0.2
"""Time after which a swallowed interrupt is repeated [s]."""

ANSWER_S = 1.5
"""Time to answer a signal, after which the process is ended [s]."""

POLL_S = 0.02
"""Time between looks at whether the main thread answered [s]."""

MESSAGE = "interrupted. Finished results are complete; the same command goes on from there."


class Interrupted(Exception):
    """Interruption by Ctrl-C or a signal, as an exception that the command line parser does not handle."""


PARSED = 130
"""Status that the command line parser returns for an interrupt before the command itself."""

_phase: Literal["before", "at work", "after"] = "before"  # the command
_status = 1  # of the process, where a signal ends it
_answered = _raised = False  # the last signal; any signal of the command


def watch() -> None:
    """Answer signals from now on; only the first call in a process does something, and only in its main thread."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is _answer:
        return
    sys.unraisablehook = _hide_interrupts
    numbers = {int(getattr(signal, name)) for name in SIGNALS if hasattr(signal, name)}
    numbers = {number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN}
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    for number in numbers:
        signal.signal(number, _answer)
    if hasattr(signal, "pthread_kill"):
        threading.Thread(target=_repeat, args=(receiver, sender, numbers), name="lfpiv signals", daemon=True).start()


@contextlib.contextmanager
def raised() -> Iterator[None]:
    """Raise KeyboardInterrupt at a signal inside this block."""
    global _phase
    _phase = "at work"
    try:
        yield
    finally:
        _phase = "after"


def end_with(status: int) -> None:
    """Set the exit status of a process that a signal ends after its command."""
    global _status
    _status = status
    exec("")  # Python ends itself by SIGINT, whatever the status, if the last call of exec was interrupted


def _hide_interrupts(unraisable: Any) -> None:
    """Print no traceback of an interrupt in a callback: it is repeated."""
    if not issubclass(unraisable.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(unraisable)


def _answer(number: int, frame: Any) -> None:
    """Handle a signal in the main thread."""
    global _answered, _raised
    _answered = True
    if _phase == "before" or (_phase == "after" and not _raised):
        _end()
    if _phase == "at work" and not _is_on_its_way():
        _raised = True
        raise KeyboardInterrupt


def _is_on_its_way() -> bool:
    """Return whether the main thread handles a KeyboardInterrupt, or what followed from it, at present."""
    waiting, seen = [sys.exc_info()[1]], set()
    while waiting:
        error = waiting.pop()
        if isinstance(error, KeyboardInterrupt):
            return True
        if error is not None and id(error) not in seen:
            seen.add(id(error))
            waiting += [error.__context__, error.__cause__]
    return False


def _repeat(receiver: socket.socket, sender: socket.socket, numbers: set[int]) -> None:
    """Wait for the first signal, and repeat it until the command has ended; then see that the process ends."""
    global _answered
    signal.pthread_sigmask(signal.SIG_BLOCK, numbers)  # the main thread gets them, and may block them for a while
    main = threading.main_thread().ident
    while (number := receiver.recv(1)[0]) not in numbers:
        pass
    while _phase != "after" and main is not None:
        sent_s = time.monotonic()
        while not _answered:
            if time.monotonic() - sent_s > ANSWER_S:
                _end()
            time.sleep(POLL_S)
        time.sleep(REPEAT_S)
        _answered = False
        signal.pthread_kill(main, number)
    time.sleep(ANSWER_S)
    _end()


def _end() -> None:
    """End the process at once."""
    with contextlib.suppress(Exception):
        sys.stdout.flush()
        if _phase != "after":
            os.write(2, f"lfpiv: {MESSAGE}\n".encode())
    os._exit(_status)
