"""Ctrl-C in kernels: it ends a call with KeyboardInterrupt, and waits while a kernel is loaded or compiled.

Python runs a signal's handler when it next runs Python code. numba runs some inside a call: to load or compile a
kernel, where the compiler keeps its own state and the process may crash or never end; and to make arrays of what a
kernel returns, where the exception became a SystemError, a tuple being returned without one of its arrays.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from numba.core import serialize
from numba.core.dispatcher import Dispatcher

from hsloc.interrupts import interrupts_held_back

if TYPE_CHECKING:
    from collections.abc import Callable


def hold_back_interrupts() -> None:
    """Have Ctrl-C wait until a kernel is loaded or compiled, and come after a kernel's results are made."""
    if not hasattr(Dispatcher, "_compile_for_args"):
        return
    compile_for_args: Callable[..., Any] = Dispatcher._compile_for_args

    @functools.wraps(compile_for_args)
    def uninterrupted(self: Any, *args: Any, **keywords: Any) -> Any:
        with interrupts_held_back():
            return compile_for_args(self, *args, **keywords)

    setattr(Dispatcher, "_compile_for_args", uninterrupted)  # noqa: B010
    # An array's type is looked up by this function. functools.cache runs no Python code for what it has seen before.
    if hasattr(serialize, "_numba_unpickle"):
        setattr(serialize, "_numba_unpickle", functools.cache(serialize._numba_unpickle))  # noqa: B010
