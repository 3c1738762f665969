"""A small log, and the same as a ROS 2 bag."""

from __future__ import annotations

from typing import TYPE_CHECKING

import log_formats
import pytest
from log_builders import write_run

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("run") / "run.mcap")


@pytest.fixture(scope="module")
def db3(plain: Path) -> Path:
    (found,) = log_formats.bag2(plain, plain.with_name("bag2")).glob("*.db3")
    return found
