"""What is compressed as one stream, a file or a message: how it begins, and how it is read."""

from __future__ import annotations

import bz2
import gzip
import lzma
from typing import IO, TYPE_CHECKING, BinaryIO, cast

if TYPE_CHECKING:
    from pathlib import Path

GZIP, ZSTD, BZIP2, XZ, LZ4 = b"\x1f\x8b", b"\x28\xb5\x2f\xfd", b"BZh", b"\xfd7zXZ\0", b"\x04\x22\x4d\x18"
STREAMS = (GZIP, ZSTD, BZIP2, XZ, LZ4)
"""How what is compressed as one stream begins."""


def opened(source: Path | BinaryIO, head: bytes) -> IO[bytes]:
    """What a source holds that is compressed by gzip, bzip2, xz or lz4, as its first bytes say.

    zstd is not among them: it has options that depend on what is read. Each library raises errors of its own.
    """
    if head.startswith(LZ4):
        import lz4.frame

        return cast("IO[bytes]", lz4.frame.open(source))
    if head.startswith(GZIP):
        return cast("IO[bytes]", gzip.open(source))
    return bz2.open(source) if head.startswith(BZIP2) else lzma.open(source)
