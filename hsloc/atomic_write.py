"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
from typing import TYPE_CHECKING

from hsloc.errors import OutputError, not_written

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import BinaryIO


def is_there(path: Path) -> bool:
    """Whether a file or folder to be written exists already; raises `OutputError` where that cannot be found out."""
    try:
        return path.exists()
    except OSError as error:
        raise OutputError(not_written(path, error)) from error


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let `write` fill a file beside `path`, then move it there: a reader never sees half a file.

    Raises `OutputError` where the folder is missing or not writable.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with beside.open("wb") as stream:
            write(stream)
        beside.replace(path)
    except OSError as error:
        raise OutputError(not_written(path, error)) from error
    finally:
        # Gone already after a good run; after a bad one nothing half-written may stay behind.
        with contextlib.suppress(OSError):
            beside.unlink()


def write_text_atomically(path: Path, text: str) -> None:
    """Write UTF-8 text with `\\n` line ends, whole or not at all; raises `OutputError`."""
    write_atomically(path, lambda stream: stream.write(text.encode("utf-8")))


@contextlib.contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A folder beside `folder` to write into, which takes its name, and its place, when the block ends well.

    Raises `OutputError` where it cannot be written.
    """
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        yield partial
        if folder.exists():
            shutil.rmtree(folder)
        partial.rename(folder)
    except OSError as error:
        raise OutputError(not_written(folder, error)) from error
    except OutputError as error:  # Of a file in it: there is no such folder any more.
        raise OutputError(str(error).replace(str(partial), str(folder))) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
