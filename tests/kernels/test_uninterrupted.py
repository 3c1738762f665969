"""Ctrl-C in kernels: it ends the call, waits while a kernel is compiled, and never becomes another error."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
import pytest
from numba.core import event

import hsloc.kernels  # noqa: F401  # It has interrupts held back.

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")


@pytest.fixture
def _interrupts() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt, also where the parent of the tests has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@contextmanager
def _interrupted_after(seconds: float) -> Iterator[None]:
    """Another process interrupts this one: a thread could not while a kernel holds the interpreter's lock."""
    command = f"sleep {seconds}; kill -INT {os.getpid()}"
    with subprocess.Popen(["/bin/sh", "-c", command], start_new_session=True):
        yield


def _sums(values: np.ndarray, times: int) -> tuple[np.ndarray, int]:
    found = np.zeros(2)
    for k in range(times):
        for value in values:
            found[k % 2] += value * k % 7.0
    return found, times


@pytest.mark.usefixtures("_interrupts")
@pytest.mark.parametrize("nogil", [False, True])
def test_an_interrupted_kernel_that_returns_arrays_in_a_tuple_ends_with_keyboard_interrupt(nogil: bool) -> None:
    """The arrays' types are looked up after the kernel, in Python: the first signal is handled there."""
    kernel: Any = numba.njit(_sums, nogil=nogil)
    values = np.ones(1000)
    kernel(values, 1)
    began = time.perf_counter()
    kernel(values, 1000)
    a_second = int(1000 / (time.perf_counter() - began))
    with pytest.raises(KeyboardInterrupt), _interrupted_after(0.1):
        kernel(values, a_second)


@pytest.mark.usefixtures("_interrupts")
def test_an_interrupt_waits_until_a_kernel_is_compiled() -> None:
    """A compiler that was interrupted printed errors of its destructors, and may crash or never end."""
    main = threading.get_ident()
    ended: list[str] = []

    class Interrupt(event.Listener):
        def on_start(self, event: event.Event) -> None:
            signal.pthread_kill(main, signal.SIGINT)

        def on_end(self, event: event.Event) -> None:
            ended.append("compiled")

    kernel: Any = numba.njit(lambda x: x + 1)
    with event.install_listener("numba:compile", Interrupt()), pytest.raises(KeyboardInterrupt):
        kernel(1)
    assert ended == ["compiled"]
    assert kernel(1) == 2


def test_an_error_that_an_interrupt_has_caused_is_reported_as_an_interrupt() -> None:
    code = (
        "import hsloc.cli.main as main, hsloc.cli.replay as replay\n"
        "def run(arguments):\n"
        "    raise SystemError('returned a result with an exception set') from {cause}\n"
        "replay.run = run\n"
        "raise SystemExit(main.main(['replay', 'x.mcap']))\n"
    )
    interrupted, broken = (
        subprocess.run([sys.executable, "-c", code.format(cause=cause)], capture_output=True, text=True)
        for cause in ("KeyboardInterrupt()", "ValueError('x')")
    )
    assert (interrupted.returncode, interrupted.stderr) == (130, "hsloc: interrupted\n")
    assert broken.returncode == 1
    assert "SystemError" in broken.stderr
