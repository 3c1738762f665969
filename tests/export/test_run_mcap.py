"""run.mcap and report.html of a run, as others read them: the mcap library, rosbags, evo, and a reader of the page."""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from paths import RECORDINGS
from rosbags.highlevel import AnyReader

from hsloc.cli.main import main
from hsloc.log import open_log
from hsloc.maps import save_map
from hsloc.trajectory_io.reader import read_tum

HALL = RECORDINGS / "hall.mcap"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "out"
    assert main(["replay", str(HALL), "--end", "8", "--out", str(folder), "--quiet"]) == 0
    return folder


def test_the_mcap_library_finds_index_checksums_attachment_and_metadata(results: Path) -> None:
    with (results / "run.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary.chunk_indexes
        count = sum(1 for _ in reader.iter_messages())
        assert count == summary.statistics.message_count > 0
        (attachment,) = reader.iter_attachments()
        (metadata,) = reader.iter_metadata()
    assert (attachment.name, attachment.data) == ("config.yaml", (results / "config.yaml").read_bytes())
    assert metadata.metadata["seed"] == "0"


def test_rosbags_decodes_every_message(results: Path) -> None:
    trajectory = read_tum(results / "trajectory.tum")
    found = Counter()  # type: ignore[var-annotated]
    poses = []
    logged: list[str] = []
    states: list[str] = []
    errors: list[float] = []
    with AnyReader([results / "run.mcap"]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found[connection.topic] += 1
            if connection.topic == "/pose":
                poses.append((message.pose.position.x, message.pose.position.y))  # type: ignore[attr-defined]
            if connection.topic == "/rosout":
                assert (message.level, message.name, message.line) == (20, "hsloc", 0)  # type: ignore[attr-defined]
                logged.append(message.msg)  # type: ignore[attr-defined]
            if connection.topic == "/state":
                states.append(message.data)  # type: ignore[attr-defined]
            if connection.topic == "/error":
                errors.append(message.data)  # type: ignore[attr-defined]
            if connection.topic == "/map":
                cells = np.asarray(message.data).reshape(message.info.height, message.info.width)  # type: ignore[attr-defined]
                np.testing.assert_array_equal(cells, open_log(HALL).map().cells)
    scans = json.loads((results / "metrics.json").read_text())["scans"]["total"]
    of_each = {"/scan": scans, "/pose": len(trajectory), "/tf": len(trajectory)}
    layout = json.loads((results / "lichtblick.json").read_text())
    of_maps = {"/loops", "/places_to_check", "/map_changes"}
    assert set(layout["configById"]["3D!map"]["topics"]) - of_maps <= set(found)
    plotted = {
        line["value"].split(".")[0]
        for name in ("quality", "variance")
        for line in layout["configById"][f"Plot!{name}"]["paths"]
    }
    assert plotted <= set(found)
    metrics = json.loads((results / "metrics.json").read_text())
    assert 0 < found.pop("/fitness") <= scans
    assert found.pop("/error") == found.pop("/error_deg") == metrics["matched"]
    assert found.pop("/state") == len(states) == 1
    known = found.pop("/pose_with_covariance")
    assert 0 < known <= scans
    paths = {"/path": 1, "/reference_path": 1, "/odometry_path": 1}
    assert found == {"/map": 1, "/tf_static": 1, "/rosout": 1, **paths, **of_each}
    assert logged == ["verdict: good"]
    assert states == ["localised"]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(metrics["ape"]["trans_part"]["rmse"])
    np.testing.assert_allclose(poses, trajectory.poses[:, :2], atol=1e-9)


def test_evo_reads_the_poses(results: Path, tmp_path: Path) -> None:
    command = [
        str(Path(sys.executable).with_name("evo_traj")),
        "bag2",
        str(results / "run.mcap"),
        "/pose",
        "--save_as_tum",
    ]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, env={**os.environ, "HOME": str(tmp_path)}
    )
    assert done.returncode == 0, done.stderr
    (saved,) = tmp_path.glob("*.tum")
    ours, theirs = read_tum(results / "trajectory.tum"), read_tum(saved)
    assert len(ours) == len(theirs)
    np.testing.assert_allclose(theirs.poses, ours.poses, atol=1e-6)


def test_the_page_has_what_was_read_the_convergence_and_the_origin(results: Path) -> None:
    page = (results / "report.html").read_text()
    assert "localised on the map of the log" in page
    assert "2023-11-14 22:13:20 UTC" in page
    assert "/scan, laser at x -0.047 m, y 0.000 m, yaw 90.0° (from /tf_static)" in page
    (name,) = re.findall(r"Convergence: (.*?)\"", page)
    assert name.encode().decode("unicode_escape") == "HIDE, 25 scans, ±0.5 m, ±20°"
    assert "<h2>Warnings" not in page


def test_the_page_has_warnings_and_the_checksums_of_a_map_that_was_given(results: Path, tmp_path: Path) -> None:
    save_map(open_log(HALL).map(), tmp_path)  # type: ignore[arg-type]
    text = (tmp_path / "map.yaml").read_text().replace("free_thresh: 0.196", "free_thresh: 0.25")
    (tmp_path / "map.yaml").write_text(text)
    out = tmp_path / "out"
    command = ["replay", str(HALL), "--map", str(tmp_path / "map.yaml"), "--end", "4", "--out", str(out), "--quiet"]
    assert main([*command, "--matcher", "icp"]) == 0
    page = (out / "report.html").read_text()
    assert "localised on map.yaml" in page
    for name in ("map.yaml", "map.pgm"):
        assert f"{name}</th>" in page
        assert hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() in page
    (warning,) = json.loads((out / "metrics.json").read_text())["warnings"]
    assert warning["code"] == "map_unknown_read_as_free"
    assert "free_thresh 0.25" in warning["text"]
    assert re.search(r"<h2>Warnings <small[^>]*>[^<]*</small></h2><ul[^>]*><li>[^<]*free_thresh 0\.25", page)
    assert "Convergence: " not in page  # ICP does not search
