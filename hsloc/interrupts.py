"""Ctrl-C that waits, for calls that must not end in the middle, and Ctrl-C that is not lost."""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def interrupts_held_back() -> Iterator[None]:
    """Hold back Ctrl-C until the end; processes that are started meanwhile have SIGINT blocked.

    The mask of this thread alone does not do: another thread (of the BLAS, for one) takes the signal, and Python
    raises KeyboardInterrupt in the main thread all the same. There the handler is replaced as well.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    in_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT) if in_main else None
    held: list[int] = []

    def note(number: int, _: Any) -> None:
        held.append(number)

    if handler is not None:
        signal.signal(signal.SIGINT, note)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if handler is not None:
            signal.signal(signal.SIGINT, handler)
        if held:
            signal.raise_signal(signal.SIGINT)


def interrupt_again(ignored: sys.UnraisableHookArgs) -> None:
    """A `sys.unraisablehook` for programs: Ctrl-C that came in a callback, where Python ignores it, comes once more.

    While modules are imported there are many callbacks: a command went on for minutes as if nothing had been.
    """
    if ignored.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(ignored)
        return
    later = threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGINT))
    later.daemon = True
    later.start()
