"""Ctrl-C that waits for the end of a call."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
import weakref

import pytest
from waiting import LIMIT_S

from hsloc.interrupts import interrupt_again, interrupts_held_back


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


def test_an_interrupt_in_a_callback_comes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    class Held:
        pass

    def called(_: object) -> None:
        signal.raise_signal(signal.SIGINT)  # as if it came from the terminal just now

    monkeypatch.setattr(sys, "unraisablehook", interrupt_again)
    held = Held()
    reference = weakref.ref(held, called)
    # Python leaves it ignored where its parent did, as a shell does for what it starts in the background.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):  # noqa: PT012
            del held
            time.sleep(LIMIT_S)
    finally:
        signal.signal(signal.SIGINT, before)
    assert reference() is None


def test_other_exceptions_of_callbacks_are_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Bad:
        def __del__(self) -> None:
            raise ValueError("of the destructor")

    monkeypatch.setattr(sys, "unraisablehook", interrupt_again)
    Bad()
    assert "of the destructor" in capsys.readouterr().err
