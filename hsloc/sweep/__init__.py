"""Many runs: logs x configurations x seeds."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


def log_labels(names: Sequence[str]) -> list[str]:
    """What logs with these names are called in a table: without endings, each once."""
    counts: dict[str, int] = {}
    labels = []
    for name in names:
        label = name.split(".")[0] or "log"
        counts[label] = counts.get(label, 0) + 1
        labels.append(label if counts[label] == 1 else f"{label}-{counts[label]}")
    return labels
