"""The caches of kernels and fonts: filled in the background, once for each version."""

from __future__ import annotations

import json
import os
import sys
from typing import TYPE_CHECKING, Any

import pytest
from waiting import until

import hsloc.cli.main as program
from hsloc_service.execution.warm_up import WarmUp, main, stamp

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

SLOW = """#!{python}
import json, os, sys, time
found = {{"argv": sys.argv[1:], "variables": dict(os.environ), "nice": os.nice(0)}}
open("{report}.part", "w").write(json.dumps(found))
os.rename("{report}.part", "{report}")
time.sleep(600)
"""


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The server's own cache of kernels, which is empty."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.delenv("MPLCONFIGDIR", raising=False)
    return tmp_path / "numba"


def test_a_process_of_low_priority_that_is_given_no_token_fills_them_and_ends_with_the_server(
    kernels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script, report = tmp_path / "python", tmp_path / "report.json"
    script.write_text(SLOW.format(python=sys.executable, report=report))
    script.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(script))
    monkeypatch.setenv("HSLOC_TOKEN", "secret")
    warm_up = WarmUp(tmp_path)
    warm_up.start()
    until(report.exists, "the process has begun")
    found: dict[str, Any] = json.loads(report.read_text())
    warm_up.stop()
    assert warm_up._process is not None
    assert warm_up._process.returncode is not None
    assert found["argv"] == ["-P", "-m", "hsloc_service.execution.warm_up"]
    assert found["nice"] == min(os.nice(0) + 15, 19)
    assert found["variables"]["NUMBA_CACHE_DIR"] == str(kernels)
    assert found["variables"]["MPLCONFIGDIR"] == str(tmp_path / "matplotlib")
    assert "HSLOC_TOKEN" not in found["variables"]
    assert kernels.stat().st_mode & 0o777 == 0o700


def test_of_a_version_that_has_filled_them_nothing_is_started(kernels: Path, tmp_path: Path) -> None:
    kernels.mkdir()
    stamp(kernels).touch()
    warm_up = WarmUp(tmp_path)
    warm_up.start()
    assert warm_up._process is None
    warm_up.stop()


def test_a_cache_that_cannot_be_made_is_a_line_in_the_log(
    kernels: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    kernels.write_text("a file")
    warm_up = WarmUp(tmp_path)
    with caplog.at_level("INFO", logger="hsloc.service"):
        warm_up.start()
    assert warm_up._process is None
    assert "warm_up.error" in caplog.messages


@pytest.mark.parametrize("failing", [None, "record", "replay"])
def test_they_are_full_when_a_log_was_localised_and_mapped(
    failing: str | None, kernels: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[Any] = []

    def run(argv: Sequence[str]) -> int:
        ran.append(program.build_parser().parse_args(argv))
        return 1 if argv[0] == failing else 0

    kernels.mkdir()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(kernels))
    monkeypatch.setattr(program, "main", run)
    assert main() == (0 if failing is None else 1)
    assert stamp(kernels).exists() is (failing is None)
    assert [(each.unknown_start, each.mode) for each in ran[1:]] == [(True, None), (None, "slam")]
    assert [str(each.log[0]) for each in ran[1:]] == [ran[0].out] * 2
