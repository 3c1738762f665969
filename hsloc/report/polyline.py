"""Paths for pictures: as fine as can be seen, however long the run was."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_BLOCK = 4096
_BREAK = (float("nan"), float("nan"))


def pieces_of(xy: Floats, finest: float) -> list[Floats]:
    """A path (n, 2) in pieces (m, 2) where NaN breaks it, without points closer than `finest` to the last one kept.

    Distances are taken along the axes; the first and the last point of a piece are always kept.
    """
    pieces: list[list[tuple[float, float]]] = [[]]
    last = _BREAK
    for x, y in _points(xy):
        piece = pieces[-1]
        if x != x or y != y:
            if piece:
                _end(piece, last)
                pieces.append([])
            continue
        last = (x, y)
        if not piece or abs(x - piece[-1][0]) + abs(y - piece[-1][1]) >= finest:
            piece.append(last)
    if pieces[-1]:
        _end(pieces[-1], last)
    return [np.array(piece) for piece in pieces if piece]


def joined(pieces: list[Floats]) -> Floats:
    """The pieces as one path again, NaN between them."""
    gap = np.array([_BREAK])
    parts = [part for piece in pieces for part in (piece, gap)]
    return np.concatenate(parts[:-1]) if parts else gap[:0]


def _end(piece: list[tuple[float, float]], last: tuple[float, float]) -> None:
    if piece[-1] != last:
        piece.append(last)


def _points(xy: Floats) -> Iterator[tuple[float, float]]:
    """Block by block: all points of a long run as Python's numbers would take ten times their memory."""
    for at in range(0, len(xy), _BLOCK):
        yield from xy[at : at + _BLOCK].tolist()
