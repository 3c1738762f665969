"""A localiser that certifies its matches passes the proofs on, and they reach metrics.json."""

from __future__ import annotations

import json
from typing import Any

import pytest

from hsloc.cli.main import main


@pytest.mark.parametrize("flags", [["--certify"], ["--matcher", "exact"], ["--matcher", "icp", "--certify"]], ids=str)
def test_each_match_of_a_replay_has_a_certificate(recordings: Any, tmp_path: Any, flags: Any) -> None:
    out = tmp_path / "out"
    command = ["replay", str(recordings / "office.mcap"), "--end", "8", "--quiet", "--out", str(out), *flags]
    assert main(command) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    found = metrics["certificates"]
    assert found["scans"] == metrics["scans"]["by_status"]["matched"]
    assert found["optimal"] == 1.0
    assert found["median_gap"] <= 0.01 + 1e-9


def test_without_being_asked_nothing_is_certified(recordings: Any, tmp_path: Any) -> None:
    out = tmp_path / "out"
    assert main(["replay", str(recordings / "office.mcap"), "--end", "4", "--quiet", "--out", str(out)]) == 0
    assert "certificates" not in json.loads((out / "metrics.json").read_text())


def test_the_command_that_repeats_the_run_certifies_as_well(recordings: Any, tmp_path: Any) -> None:
    out = tmp_path / "out"
    main(["replay", str(recordings / "office.mcap"), "--end", "4", "--quiet", "--certify", "--out", str(out)])
    assert "localiser.certify=true" in (out / "config.yaml").read_text()
