"""Sweeps in parts and on a cluster: which part does what, and one table that is the same as on one machine."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import signal
import subprocess
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from paths import RECORDINGS, ROOT
from ruamel.yaml import YAML

from hsloc.cli.main import build_parser, main
from hsloc.config import Config
from hsloc.errors import HslocError, LogError, OutputError
from hsloc.sweep import parallel
from hsloc.sweep.parallel import Shard, merge, parse_shard, plan_hash, write_shard
from hsloc.sweep.remote import RemoteLog, UrlFolder, remote_logs
from hsloc.sweep.runs import DONE, FAILED, SKIPPED, Outcome, SweepRun, finished, plan, sweep
from hsloc.sweep.table import as_parquet

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

OFFICE, HALL = RECORDINGS / "office.mcap", RECORDINGS / "hall.mcap"
EXAMPLES = ROOT / "examples" / "fleet"


@pytest.mark.parametrize(
    ("text", "environment", "expected"),
    [
        ("0/4", {}, Shard(0, 4)),
        ("3/4", {"JOB_COMPLETION_INDEX": "1"}, Shard(3, 4)),
        ("auto/4", {"JOB_COMPLETION_INDEX": "3"}, Shard(3, 4)),
        ("auto", {"AWS_BATCH_JOB_ARRAY_INDEX": "2", "AWS_BATCH_JOB_ARRAY_SIZE": "3"}, Shard(2, 3)),
        ("auto", {"SLURM_ARRAY_TASK_ID": "4", "SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_COUNT": "4"}, Shard(3, 4)),
        (
            "auto",
            {
                "SLURM_ARRAY_TASK_ID": "5",
                "SLURM_ARRAY_TASK_MIN": "1",
                "SLURM_ARRAY_TASK_STEP": "2",
                "SLURM_ARRAY_TASK_COUNT": "4",
            },
            Shard(2, 4),
        ),
    ],
)
def test_a_shard_is_named_or_found_in_an_array_job(text: str, environment: Mapping[str, str], expected: Shard) -> None:
    assert parse_shard(text, environment) == expected


@pytest.mark.parametrize(
    ("text", "environment", "reason"),
    [
        ("4/4", {}, "shard 4 of 4 does not exist; the first is 0, the last 3"),
        ("1", {}, "is not I/N"),
        ("1/-2", {}, "is not I/N"),
        ("auto/x", {"JOB_COMPLETION_INDEX": "0"}, "is not auto/N"),
        ("auto/2", {}, "none of them is set; give I/N"),
        ("auto", {"JOB_COMPLETION_INDEX": "0"}, "give auto/N"),
        ("auto/2", {"JOB_COMPLETION_INDEX": "0", "SLURM_ARRAY_TASK_ID": "1"}, "several of them are set"),
        ("auto/2", {"JOB_COMPLETION_INDEX": "first"}, "JOB_COMPLETION_INDEX is 'first', which is not a number"),
    ],
)
def test_a_shard_that_cannot_be_meant_is_refused(text: str, environment: Mapping[str, str], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse_shard(text, environment)


def outcomes(part: list[SweepRun], state: str = DONE) -> list[Outcome]:
    return [Outcome(item, state, Path(item.name), error="broken" if state == FAILED else "") for item in part]


def test_every_run_is_in_one_shard_and_the_merged_table_is_in_order(tmp_path: Path) -> None:
    runs = plan([OFFICE, HALL], {"default": Config()}, range(5))
    here, there = tmp_path / "here", tmp_path / "there"
    for folder in (here, there):
        folder.mkdir()
    shards = [Shard(index, 12) for index in range(12)]  # more shards than runs: two of them are empty
    assert sorted(item.name for shard in shards for item in shard.part(runs)) == sorted(item.name for item in runs)
    for shard in shards:
        write_shard(here if shard.index % 2 else there, shard, runs, outcomes(shard.part(runs)))
    write_shard(here, shards[0], runs, outcomes(shards[0].part(runs), FAILED))  # once more, on another machine
    write_shard(here, shards[1], runs, outcomes(shards[1].part(runs), SKIPPED))  # once more in the same folder
    table = merge([here, there])
    assert [(row["run"], row["state"]) for row in table] == [(item.name, DONE) for item in runs]
    assert merge([there, here]) == table
    with pytest.raises(HslocError, match=r"here: shards 2, 4, 6, 8, 10 of 12 are missing; run them first"):
        merge([here])
    with pytest.raises(HslocError, match="no tables of shards"):
        merge([tmp_path])


def test_parts_of_different_sweeps_are_not_mixed(tmp_path: Path) -> None:
    one, other = plan([OFFICE], {"default": Config()}, range(2)), plan([OFFICE], {"default": Config()}, range(2, 4))
    assert plan_hash(one) == plan_hash(plan([Path("elsewhere") / OFFICE.name], {"default": Config()}, range(2)))
    write_shard(tmp_path, Shard(0, 2), one, outcomes(one[:1]))
    path = write_shard(tmp_path, Shard(1, 2), other, outcomes(other[1:]))
    with pytest.raises(HslocError, match=r"sweep-shard-1-of-2.json: is of another sweep than .*sweep-shard-0-of-2"):
        merge([tmp_path])
    text = path.read_text()
    for damaged in ("{", "[]", "{}", text.replace('"run"', '"ran"'), text.replace('"of": 2', '"of": 0')):
        path.write_text(damaged)
        with pytest.raises(HslocError, match=r"sweep-shard-1-of-2.json: is not the table of a shard"):
            merge([tmp_path])


@pytest.fixture
def in_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs in threads of this process: new ones would import and compile everything for each call of the command."""

    def sweep_in_threads(runs: list[SweepRun], folder: Path, jobs: int, progress: Any) -> list[Outcome]:
        with ThreadPoolExecutor(jobs) as executor:
            return sweep(runs, folder, executor, progress)

    monkeypatch.setattr(parallel, "sweep_in_processes", sweep_in_threads)


def rows_of(path: Path) -> list[dict[str, Any]]:
    """The rows of a table without what differs from run to run."""
    return [{**row, "seconds": 0, "times_real_time": 0} for row in json.loads(path.read_text())]


@pytest.mark.usefixtures("in_threads")
def test_shards_of_the_command_make_the_same_table_as_one_sweep(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = [str(OFFICE), str(HALL), str(tmp_path / "missing.mcap")]
    common = ["sweep", *logs, "--end", "1.5", "-q"]
    assert main([*common, "--out", str(tmp_path / "one")]) == 1  # one log is missing
    monkeypatch.setenv("JOB_COMPLETION_INDEX", "0")
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / HALL.name).symlink_to(HALL)
    assert main([*common, "--out", f"file://{tmp_path}/parts", "--shard", "auto/2"]) == 1
    common[2] = f"file://{tmp_path}/logs/*.mcap"
    assert main([*common, "--out", f"file://{tmp_path}/parts", "--shard", "1/2"]) == 0
    assert not (tmp_path / "parts" / "sweep.csv").exists()
    monkeypatch.chdir(tmp_path / "parts")
    assert main([*common, "--out", ".", "--shard", "1/2"]) == 0  # the same shard once more
    assert main(["sweep", "--merge", "--out", "."]) == 1
    assert rows_of(tmp_path / "parts" / "sweep.json") == rows_of(tmp_path / "one" / "sweep.json")
    for path in (tmp_path / "one" / "hall-default-seed0").glob("[jmt]*[.jt][sux]*"):
        assert (
            path.name == "timings.json"
            or path.read_bytes() == (tmp_path / "parts" / path.parent.name / path.name).read_bytes()
        )
    capsys.readouterr()
    assert main(["sweep", "--out", "."]) == 2
    assert capsys.readouterr().err == "hsloc sweep: error: no log is given (see hsloc sweep --help)\n"


@pytest.mark.usefixtures("in_threads")
def test_a_run_at_a_url_is_done_again_where_the_log_has_changed_or_it_is_not_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = shutil.copy(HALL, tmp_path)
    words = ["sweep", f"file://{tmp_path}/*.mcap", "--end", "1", "--out", f"file://{tmp_path}/out", "-q", "--json"]

    def state() -> str:
        assert main(words) == 0
        return str(json.loads(capsys.readouterr().out)[0]["state"])

    assert state() == DONE
    os.utime(log, (1, 1))
    assert [state(), state()] == [DONE, SKIPPED]
    folder = tmp_path / "out" / "hall-default-seed0"
    assert not list(folder.glob(".*"))
    for name in ("timings.json", "sweep_key.json"):
        (folder / name).unlink()  # a machine failed while it wrote
        assert (
            finished(plan(remote_logs(words[1]), {"default": Config()})[0], UrlFolder(f"file://{tmp_path}/out"), "")
            is None
        )
    if (content := as_parquet(table := json.loads((tmp_path / "out" / "sweep.json").read_text()))) is not None:
        parquet = pytest.importorskip("pyarrow.parquet")
        assert parquet.read_table(io.BytesIO(content)).to_pylist() == table


def test_urls_that_cannot_be_used_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def error_of(*words: str) -> str:
        assert main(["sweep", *words, "-q"]) == 1
        return capsys.readouterr().err.removeprefix("hsloc: error: ").splitlines()[-1]

    out = ["--out", f"file://{tmp_path}/out"]
    assert error_of(f"file://{tmp_path}/*.mcap", *out) == f"file://{tmp_path}/*.mcap: no log is there"
    assert error_of(f"file://{tmp_path}/no.mcap", *out) == f"file://{tmp_path}/no.mcap: not found"
    assert "Protocol not known: nothing" in error_of("nothing://x/*.mcap", *out)
    (tmp_path / "file").touch()
    assert "cannot be written" in error_of(str(OFFICE), "--end", "1", "--out", f"file://{tmp_path}/file/out")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    with pytest.raises(OutputError, match="is in use for something else"):
        UrlFolder(f"file://{tmp_path}/out").replace(tmp_path, "metrics.json")
    assert (tmp_path / "out" / "thesis.tex").exists()
    log = remote_logs(f"file://{OFFICE}")[0]
    with pytest.raises(LogError, match="it changed while it was read"):
        RemoteLog(log.url, (replace(log.files[0], size=1),)).fetch()


def test_a_folder_of_an_object_store_is_a_log(tmp_path: Path) -> None:
    fs = pytest.importorskip("fsspec").filesystem("memory")
    fs.pipe({"/bucket/logs/run/a.db3": b"one", "/bucket/logs/run/metadata.yaml": b"two", "/bucket/logs/b.mcap": b"b"})
    run = remote_logs("memory://bucket/logs/run")[0]
    assert [file.path for file in run.files] == ["a.db3", "metadata.yaml"]
    assert [log.name for log in remote_logs("memory://bucket/logs/*")] == ["b.mcap", "run"]
    folder = run.fetch()
    assert [(path.name, path.read_text()) for path in sorted(folder.iterdir())] == [
        ("a.db3", "one"), ("metadata.yaml", "two"),
    ]  # fmt: skip
    remote_logs("memory://bucket/logs/b.mcap")[0].fetch()
    assert not folder.exists()
    place = UrlFolder("memory://bucket/results")
    for content in ("one", "two"):
        (tmp_path / "metrics.json").write_text(content)
        (tmp_path / "sweep_key.json").write_text(content)
        place.replace(tmp_path, "sweep_key.json")
    assert (place / "metrics.json").read_text() == "two"
    assert [each.name for each in place.glob("*.json")] == ["metrics.json", "sweep_key.json"]


@pytest.fixture
def scheduler() -> Iterator[str]:
    """The address of a Dask scheduler with a worker, both in this process."""
    distributed = pytest.importorskip("distributed", reason="DASK IS NOT TESTED: pip install distributed")
    options = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "protocol": "tcp://"}
    with distributed.LocalCluster(host="127.0.0.1", dashboard_address=None, **options) as cluster:
        yield cluster.scheduler_address


@pytest.mark.usefixtures("in_threads")
@pytest.mark.filterwarnings("ignore")  # of Dask and tornado
def test_a_sweep_on_dask_is_that_on_one_machine(
    tmp_path: Path, scheduler: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    before = os.getcwd()
    words = [
        "sweep",
        str(OFFICE),
        str(tmp_path / "missing.mcap"),
        "--out",
        str(tmp_path),
        "--end",
        "1.5",
        "--json",
        "-q",
    ]
    assert main([*words, "--executor", scheduler.replace("tcp", "dask")]) == 1
    assert os.getcwd() == before
    table = json.loads(capsys.readouterr().out)
    assert [row["state"] for row in table] == [DONE, FAILED]
    assert main(words) == 1
    assert [row["state"] for row in json.loads(capsys.readouterr().out)] == [SKIPPED, FAILED]


def test_where_no_scheduler_answers_it_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "DASK_TIMEOUT_S", 0.5)
    pytest.importorskip("distributed", reason="DASK IS NOT TESTED: pip install distributed")
    with pytest.raises(HslocError, match=r"tcp://127.0.0.1:9: no Dask scheduler answers"):
        parallel.sweep_on_dask([], tmp_path, "tcp://127.0.0.1:9")
    with pytest.raises(SystemExit):
        main(["sweep", str(OFFICE), "--out", str(tmp_path), "--executor", "ray://x:1"])
    assert "'ray://x:1' is not dask://HOST:PORT" in capsys.readouterr().err


def fake_hsloc(folder: Path) -> str:
    """A PATH with a program hsloc that prints its arguments, one a line."""
    program = folder / "hsloc"
    program.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    program.chmod(0o755)
    return f"{folder}:{os.environ['PATH']}"


def test_the_kubernetes_example_is_an_indexed_job_that_our_parser_takes(tmp_path: Path) -> None:
    """The fields that the API server would refuse, or ignore, in another combination."""
    job = YAML(typ="safe").load((EXAMPLES / "sweep-kubernetes.yaml").read_text())
    spec, pod = job["spec"], job["spec"]["template"]["spec"]
    assert (job["apiVersion"], job["kind"], spec["completionMode"]) == ("batch/v1", "Job", "Indexed")
    assert pod["restartPolicy"] == "Never"  # podFailurePolicy requires it
    assert spec["backoffLimitPerIndex"] >= 1  # FailIndex and maxFailedIndexes require it
    (container,) = pod["containers"]
    codes: dict[int, str] = {}
    for rule in spec["podFailurePolicy"]["rules"]:
        if "onExitCodes" in rule:
            assert rule["onExitCodes"]["containerName"] == container["name"]
            codes |= dict.fromkeys(rule["onExitCodes"]["values"], rule["action"])
    assert codes == {1: "FailIndex", 2: "FailJob", 3: "FailIndex", 4: "FailIndex"}
    assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
    done = subprocess.run(
        container["command"], env={"PATH": fake_hsloc(tmp_path)}, capture_output=True, text=True, check=True
    )
    arguments = build_parser_of_words(done.stdout, {"JOB_COMPLETION_INDEX": "3"})
    assert arguments.shard == Shard(3, spec["completions"])


def test_the_slurm_example_is_an_array_that_our_parser_takes(tmp_path: Path) -> None:
    script = EXAMPLES / "sweep-slurm.sh"
    first, last = re.findall(r"^#SBATCH --array=(\d+)-(\d+)$", script.read_text(), re.MULTILINE)[0]
    done = subprocess.run(
        ["bash", str(script)], env={"PATH": fake_hsloc(tmp_path)}, capture_output=True, text=True, check=True
    )
    slurm = {"SLURM_ARRAY_TASK_ID": last, "SLURM_ARRAY_TASK_MIN": first, "SLURM_ARRAY_TASK_COUNT": str(int(last) + 1)}
    assert build_parser_of_words(done.stdout, slurm).shard == Shard(int(last), int(last) + 1)


def build_parser_of_words(lines: str, environment: dict[str, str]) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        return build_parser().parse(lines.splitlines())
