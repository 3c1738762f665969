"""Ctrl-C that waits for the end of a call."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from hsloc.interrupts import interrupts_held_back


def test_an_interrupt_that_another_thread_takes_waits_too() -> None:
    """Blocked in the main thread alone, it came in the middle of starting a process, whose pipe then ended early."""
    before, end = signal.signal(signal.SIGINT, signal.default_int_handler), threading.Event()
    other = threading.Thread(target=end.wait)
    other.start()
    reached = False

    def interrupted() -> None:
        nonlocal reached
        with interrupts_held_back():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            reached = True

    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
        assert reached
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    finally:
        signal.signal(signal.SIGINT, before)
        end.set()
        other.join()
