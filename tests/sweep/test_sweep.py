"""Sweeps: any executor, resumable, one run's end is not the others', Ctrl-C leaves what is finished."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from paths import RECORDINGS
from processes import in_session
from waiting import LIMIT_S, until

import hsloc.sweep.runs as sweeping
from hsloc.cli.main import main
from hsloc.config import Config
from hsloc.log import ReadOptions
from hsloc.run_metrics import RunMetrics
from hsloc.sweep.parallel import _interruptible, _options, _Pool, sweep_in_processes
from hsloc.sweep.runs import DONE, FAILED, SKIPPED, Outcome, SweepRun, plan, run_key, sweep
from hsloc.sweep.table import COLUMNS, as_csv, as_json, as_markdown, as_text, rows

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

OFFICE, HALL = RECORDINGS / "office.mcap", RECORDINGS / "hall.mcap"
SHORT = ReadOptions(end_s=3.0)
DEFAULT = {"default": Config()}


class Bomb:
    """Ends the process that unpickles it, as a defect in compiled code does."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[int]]:
        return os._exit, (3,)


def sweep_in_threads(runs: list[SweepRun], folder: Path, **options: Callable[..., Any]) -> list[Outcome]:
    with ThreadPoolExecutor(2) as executor:
        return sweep(runs, folder, executor, **options)


def states(outcomes: list[Outcome]) -> list[str]:
    return [outcome.state for outcome in outcomes]


def test_a_plan_is_all_combinations_with_names_of_their_own() -> None:
    configs = {"default": Config(), "icp": Config(matcher="icp")}
    runs = plan([OFFICE, [OFFICE, HALL], HALL], configs, range(2), read=SHORT)
    names = [item.name for item in runs]
    assert names[:4] == ["office-default-seed0", "office-default-seed1", "office-icp-seed0", "office-icp-seed1"]
    assert names[4] == "office-2-default-seed0"
    assert len(set(names)) == 12
    assert runs[4].request.logs == (OFFICE, HALL)
    assert runs[3].request.seed == 1
    assert runs[3].request.config.matcher == "icp"


def test_finished_runs_are_known_again_and_others_are_not(tmp_path: Path) -> None:
    runs = plan([OFFICE, HALL], DEFAULT, read=SHORT)
    seen: list[Any] = []
    first = sweep_in_threads(runs, tmp_path, progress=seen.append)
    assert states(first) == [DONE, DONE]
    assert {outcome.run.name for outcome in seen} == {item.name for item in runs}
    assert first[0].metrics == RunMetrics.read(tmp_path / "office-default-seed0" / "metrics.json")
    written = (tmp_path / "office-default-seed0" / "report.html").stat().st_mtime_ns
    second = sweep_in_threads(runs, tmp_path)
    assert states(second) == [SKIPPED, SKIPPED]
    assert second[0].metrics == first[0].metrics
    assert (tmp_path / "office-default-seed0" / "report.html").stat().st_mtime_ns == written
    (tmp_path / "hall-default-seed0" / "metrics.json").write_text("{")
    changed = plan([OFFICE, HALL], {"default": replace(Config(), matcher="icp")}, read=SHORT)
    assert states(sweep_in_threads(runs, tmp_path)) == [SKIPPED, DONE]
    assert states(sweep_in_threads(changed, tmp_path)) == [DONE, DONE]


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 1},
        {"read": ReadOptions(end_s=4.0)},
        {"config": Config(matcher="icp")},
        {"unknown_start": True},
        {"logs": (HALL,)},
        {"mode": "slam"},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_whatever_decides_a_run_is_in_its_key(changes: dict[str, Any]) -> None:
    (item,) = plan([OFFICE], DEFAULT, read=SHORT)
    assert run_key(item.request) == run_key(replace(item.request))
    assert run_key(replace(item.request, **changes)) != run_key(item.request)


def test_the_bytes_of_all_files_are_in_the_key(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    charts: dict[str, Any] = {name: tmp_path / f"{name}.yaml" for name in ("map", "align_to")}
    log.write_bytes(b"one")
    images = [path.with_suffix(".pgm") for path in charts.values()]
    for image, yaml in zip(images, charts.values(), strict=True):
        image.write_bytes(b"P5")
        numbers = "resolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
        yaml.write_text(f"image: {image.name}\n{numbers}")
    others: dict[str, Any] = {name: tmp_path / name for name in ("relations", "reference", "calibration")}
    for path in others.values():
        path.write_text("lidars: {/scan: {x: 0.1}}\n")
    (item,) = plan([log], DEFAULT, **charts, **others)
    keys = [run_key(item.request)]
    files = (log, *images, *charts.values(), *others.values())
    for path in files:
        path.write_bytes(path.read_bytes() + b"\n")
        keys.append(run_key(item.request))
    assert len(set(keys)) == len(files) + 1


def test_what_goes_wrong_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken.mcap").write_bytes(b"garbage" * 99)
    (tmp_path / "out" / "hall-default-seed0").mkdir(parents=True)
    (tmp_path / "out" / "hall-default-seed0" / "thesis.tex").write_text("do not lose me")
    runs = plan([tmp_path / "missing.mcap", tmp_path / "broken.mcap", HALL, OFFICE], DEFAULT, read=SHORT)
    outcomes = sweep_in_threads(runs, tmp_path / "out")
    assert states(outcomes) == [FAILED, FAILED, FAILED, DONE]
    assert "missing.mcap: no such file" in outcomes[0].error
    assert "is not an MCAP" in outcomes[1].error
    assert "exists already" in outcomes[2].error
    assert (tmp_path / "out" / "hall-default-seed0" / "thesis.tex").exists()

    def defect(request: Any, progress: Any = None) -> None:
        raise ZeroDivisionError("a defect of ours")

    monkeypatch.setattr(sweeping, "run", defect)
    (outcome,) = sweep_in_threads(plan([OFFICE], DEFAULT, [7]), tmp_path / "out")
    assert outcome.state == FAILED
    assert outcome.error.startswith("ZeroDivisionError: a defect of ours (see ")
    assert "defect" in (tmp_path / "out" / "office-default-seed7.error.txt").read_text()


@pytest.mark.unmeasured
def test_a_run_that_ends_its_process_ends_no_other(tmp_path: Path) -> None:
    runs = plan([OFFICE], DEFAULT, range(3), read=SHORT)
    runs[1] = replace(runs[1], request=replace(runs[1].request, labels=(Bomb(),)))  # type: ignore[arg-type]
    reported: list[Any] = []
    outcomes = sweep_in_processes(runs, tmp_path, 2, reported.append)
    assert states(outcomes) == [DONE, FAILED, DONE]
    assert outcomes[1].error.startswith("the process ended: ")
    assert len(reported) == 3
    assert "NUMBA_NUM_THREADS" not in os.environ


def test_the_table_in_four_forms(tmp_path: Path) -> None:
    outcomes = sweep_in_threads(plan([OFFICE, tmp_path / "missing.mcap"], DEFAULT, read=SHORT), tmp_path)
    good, bad = json.loads(as_json(rows(outcomes)))
    assert tuple(good) == COLUMNS
    assert good["ape_m"] == outcomes[0].metrics.errors.ape.trans_part.rmse
    assert good["localised"] == 1.0
    assert good["verdict"] == "good"
    assert good["rpe_m"] is not None
    assert (bad["state"], bad["ape_m"]) == ("failed", None)
    table = list(csv.DictReader(io.StringIO(as_csv(rows(outcomes)))))
    assert [row["run"] for row in table] == ["office-default-seed0", "missing-default-seed0"]
    assert float(table[0]["ape_m"]) == good["ape_m"]
    lines = as_text(rows(outcomes)).splitlines()
    assert "APE rmse [m]" in lines[0]
    assert "relations, mean [m]" not in lines[0]
    assert lines[-1].startswith("missing-default-seed0: ")
    markdown = as_markdown(rows(outcomes)).splitlines()
    assert markdown[0].split("|")[1:4] == [" run                   ", " state  ", " verdict "]
    assert markdown[-1] == f"- {lines[-1]}"


def command(capsys: pytest.CaptureFixture[str], *argv: Path | str) -> tuple[int, str, str]:
    code = main(["sweep", *(str(word) for word in argv)])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_the_command_varies_the_named_parameters(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [OFFICE, "--out", tmp_path, "--end", "1.5", "--seeds", "5", "--vary", "hide.budget=100,200", "--json"]
    code, out, err = command(capsys, *arguments)  # type: ignore[arg-type]
    assert (code, err) == (0, "")
    names = [row["run"] for row in json.loads(out)]
    assert names == [f"office-hide.budget={n}-seed5" for n in (100, 200)]
    assert "budget: 200" in (tmp_path / names[1] / "config.yaml").read_text()
    assert json.loads((tmp_path / "sweep.json").read_text()) == json.loads(out)
    page = (tmp_path / "sweep.html").read_text()
    assert all(f'href="{name.replace("=", "%3D")}/report.html"' in page for name in names)
    assert page.count('class="verdict ') == 2
    code, out, _ = command(capsys, *arguments[:-1], "--csv")  # type: ignore[arg-type]
    assert (code, out) == (0, (tmp_path / "sweep.csv").read_text())
    assert {row["state"] for row in csv.DictReader(io.StringIO(out))} == {"skipped"}
    code, out, _ = command(capsys, *arguments[:-1])  # type: ignore[arg-type]
    assert re.search(r"\| office \| hide\.budget=200 \| +1 good \| APE rmse [\d.]+ cm, [\d.]+° \|", out)
    assert out.rstrip().splitlines()[-1] in (tmp_path / "sweep.md").read_text()
    code, out, err = command(capsys, OFFICE, tmp_path / "missing.mcap", "--out", tmp_path, "--end", "3")
    assert code == 1
    assert "1 of 2 runs failed" in err


@pytest.mark.parametrize(
    ("words", "code", "expected"),
    [
        (["--seeds", "9-0"], 2, "not a list of seeds"),
        (["--seeds", "x"], 2, "not a list of seeds"),
        (["--jobs", "0"], 2, "whole number of 1 or more"),
        (["--vary", "hide.budgets=1"], 1, "there is no parameter hide.budgets; did you mean hide.budget?"),
        (["--vary", "hide.budget=many"], 1, "must be of type int"),
        (["--vary", "hide.budget"], 1, "is not KEY=V1,V2"),
        (["--config", "nowhere.yaml"], 1, "nowhere.yaml: no such configuration"),
    ],
)
def test_mistakes_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, expected: str
) -> None:
    try:
        status: object = main(["sweep", str(OFFICE), "--out", str(tmp_path / "out"), *words])
    except SystemExit as stop:
        status = stop.code
    assert status == code
    assert expected in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "out").exists()


def test_interrupted_sweeps_keep_what_is_finished(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [OFFICE, "--out", tmp_path / "out", "--seeds", "0-30", "--end", "3"]
    process = subprocess.Popen(
        [sys.executable, "-m", "hsloc.cli.main", "sweep", *map(str, words)],
        stderr=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
        # Whoever runs the tests in the background has interrupts ignored, which children inherit.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    until((tmp_path / "out" / "office-default-seed0" / "sweep_key.json").exists, "the first run is finished")
    os.kill(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 130
    assert b"Traceback" not in stderr
    finished = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert "office-default-seed0" in finished
    assert len(finished) < 20
    assert all((tmp_path / "out" / name / "metrics.json").exists() for name in finished), finished
    code, out, _ = command(capsys, OFFICE, "--out", tmp_path / "out", "--seeds", "0", "--end", "3", "--json")
    assert (code, json.loads(out)[0]["state"]) == (0, "skipped")


def test_an_interrupted_sweep_ends_with_its_threads() -> None:
    """One that closed its pipe when the program ended made a traceback now and then."""
    before = set(threading.enumerate())
    with pytest.raises(KeyboardInterrupt), _interruptible(_Pool(1, **_options())) as pool:  # noqa: PT012
        pool.submit(time.sleep, 1.0)
        raise KeyboardInterrupt
    left = set(threading.enumerate()) - before
    assert not [each for each in left if not each.daemon]


@pytest.mark.unmeasured
@pytest.mark.parametrize("after_s", [0.0, 1.0, 2.3])
def test_an_interrupt_ends_a_sweep_with_one_line(tmp_path: Path, after_s: Any) -> None:
    """Workers that were still importing ended in tracebacks of 60 to 97 lines."""
    command = [sys.executable, "-m", "hsloc.cli.main", "sweep", str(OFFICE), str(HALL), "--seeds", "0-9", "--jobs", "2"]
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "out")], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        start_new_session=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    until(lambda: len(in_session(process.pid)) > 1, "the first worker is started")
    time.sleep(after_s)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode in (130, -signal.SIGINT)  # a shell reports 130 for both
    assert err == "hsloc: interrupted\n"
