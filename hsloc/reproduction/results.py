"""The results of `hsloc reproduce` on disk: report.md, results.json and the figures."""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING

from hsloc.atomic_write import write_text_atomically
from hsloc.errors import OutputError
from hsloc.evaluation.metrics import write_json
from hsloc.reproduction.figures import draw_figures
from hsloc.reproduction.tables import markdown

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from hsloc.reproduction.run import Reproduction


def write_results(
    reproduction: Reproduction, folder: Path, notes: Sequence[str] = (), *, overwrite: bool = False
) -> str:
    """Write everything into `folder`, whole or not at all; returns the text of report.md.

    Raises OutputError where the folder is there already (unless `overwrite`), or cannot be written.
    """
    if folder.exists() and not overwrite and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder}: exists already; choose another --out, or pass --overwrite")
    text = markdown(reproduction, notes)
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True)
        figures = [path for results in reproduction.materials for path in draw_figures(results, partial)]
        pictures = "".join(f"\n![{path.stem}]({path.name})\n" for path in figures)
        write_text_atomically(partial / "report.md", text + pictures)
        write_json(partial / "results.json", {**reproduction.to_dict(), "notes": list(notes)})
        if folder.exists():
            shutil.rmtree(folder)
        partial.rename(folder)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return text
