"""Import Taichi without losing an interrupt. Every other module takes `ti` from here.

Taichi's import has ``except:`` clauses, which swallow a KeyboardInterrupt. So signals are only noted meanwhile.
"""

import contextlib
import signal
import threading
from collections.abc import Iterator

NOTED = ("SIGINT", "SIGTERM", "SIGHUP")
"""Signals that people and schedulers end a program with."""


@contextlib.contextmanager
def interrupts_kept() -> Iterator[None]:
    """Note signals that Python answers, and let it answer them at the end of the block."""
    if threading.current_thread() is not threading.main_thread():  # others get no signals
        yield
        return
    noted: list[int] = []
    numbers = [getattr(signal, name) for name in NOTED if hasattr(signal, name)]
    before = {number: known for number in numbers if callable(known := signal.getsignal(number))}
    for number in before:
        signal.signal(number, lambda number, frame: noted.append(number))
    try:
        yield
    finally:
        for number, known in before.items():
            signal.signal(number, known)
        if noted:
            signal.raise_signal(noted[0])


with interrupts_kept():
    import taichi as ti

__all__ = ["interrupts_kept", "ti"]
