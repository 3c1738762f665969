"""Stages the repository's Markdown for mkdocs, and adds what is generated from the code.

The pages link to each other as files do, also out of docs/. So the tree of what is linked is copied as it is, and the
site is built from the copy.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
STAGE = ROOT / "build" / "site-source"
_LINK = re.compile(r"\]\(([^)#\s]+)")
_MARKER = re.compile(r"<!-- api: (.+?) -->", re.DOTALL)
_FOREIGN = ("http:", "https:", "mailto:")


def on_config(config: Any) -> Any:
    """Copy every page of the navigation, and what these link to, and build from there."""
    shutil.rmtree(STAGE, ignore_errors=True)
    for page in _pages(config["nav"]):
        _stage(ROOT / page)
    config["docs_dir"] = str(STAGE)
    return config


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Replace the marker `<!-- api: NAME ... -->` by the documentation of these names."""
    return re.sub(
        r"<!-- api: (.+?) -->", lambda found: "\n\n".join(f"::: {name}" for name in found[1].split()), markdown
    )


def _pages(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    return [page for each in (nav.values() if isinstance(nav, dict) else nav) for page in _pages(each)]


def _stage(source: Path) -> None:
    target = STAGE / source.relative_to(ROOT)
    if target.exists() or not source.is_file():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(source, target)
    if source.suffix != ".md":
        return
    for link in _LINK.findall(source.read_text(encoding="utf-8")):
        linked = (source.parent / link).resolve()
        if not link.startswith(_FOREIGN) and linked.suffix != ".md" and linked.is_relative_to(ROOT):
            _stage(linked)
