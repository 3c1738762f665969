"""The real localiser behind the service: the same bytes as `hsloc replay`; hostile files fail with a reason."""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest
from live_service import upload, wait, without_command
from paths import RECORDINGS

from hsloc.errors import MapError
from hsloc.log import open_log
from hsloc.maps import read_metadata, save_map
from hsloc.model.pose2 import Pose2
from hsloc.report.view import MOST_POSES
from hsloc_service.execution.worker import linked_map
from hsloc_service.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from fastapi.testclient import TestClient

REAL = Settings().worker_command


@pytest.mark.unmeasured
@pytest.mark.parametrize(
    ("request_", "options"),
    [
        (
            {"seed": 11, "config": {"hide": {"budget": 250}}, "read": {"end_s": 8.0}},
            ["--seed", "11", "--config", "c.yaml", "--end", "8"],
        ),
        (
            {"align_to": {"yaml": "map.yaml", "image": "map.pgm"}, "read": {"end_s": 6.0}},
            ["--align-to", "map.yaml", "--end", "6"],
        ),
    ],
)
def test_the_result_is_that_of_hsloc_replay_byte_for_byte(
    make_client: Callable[..., TestClient], tmp_path: Path, request_: dict[str, Any], options: list[str]
) -> None:
    client = make_client(worker_command=REAL, sandbox="none", job_memory_bytes=4 << 30)
    file = upload(client, (RECORDINGS / "office.mcap").read_bytes(), "office.mcap")
    if parts := request_.get("align_to"):
        grid = open_log(RECORDINGS / "office.mcap").map()
        assert grid is not None
        save_map(replace(grid, origin=Pose2(20.0, -5.0, 0.0)), tmp_path)  # as a floor plan, in a frame of its own
        ids = {part: upload(client, (tmp_path / name).read_bytes(), name) for part, name in parts.items()}
        request_ = {**request_, "align_to": ids}
    (tmp_path / "c.yaml").write_text("hide: {budget: 250}\n")
    # A job has the name of its log alone; so has a command in the folder of the log.
    shutil.copy(RECORDINGS / "office.mcap", tmp_path)
    command = [sys.executable, "-m", "hsloc.cli.main", "replay", "office.mcap", "-q", *options]
    # It comes first: a job keeps nothing that it compiles.
    subprocess.run([*command, "--out", str(tmp_path / "out")], check=True, cwd=tmp_path)
    job = client.post("/v1/jobs", json={"log": file, **request_}).json()["id"]
    ended = wait(client, job)
    assert ended["state"] == "succeeded", ended
    names = {each["name"] for each in client.get(f"/v1/jobs/{job}/results").json()["assets"]}
    theirs = {path.name for path in (tmp_path / "out").iterdir()}
    assert names - theirs == {"viewer.json", "viewer-map.png"}
    assert theirs <= names
    for name in theirs - {"timings.json"}:  # wall times
        ours = client.get(f"/v1/jobs/{job}/results/{name}").content
        assert without_command(name, ours) == without_command(name, (tmp_path / "out" / name).read_bytes()), name
    if parts:
        plan = client.get(f"/v1/jobs/{job}/results/metrics.json").json()["map"]["plan"]
        assert (plan["name"], plan["certain"]) == ("map.yaml", True)
    viewer = client.get(f"/v1/jobs/{job}/results/viewer.json").json()
    assert len(viewer["trajectory"]["x"]) == len(viewer["trajectory"]["t"]) <= MOST_POSES + 1
    ape = ended["summary"]["metrics"]["ape"]["trans_part"]
    assert max(viewer["charts"][0]["v"]) == pytest.approx(100.0 * ape["max"], rel=1e-4)


def chunk(compression: bytes, claimed: int, data: bytes) -> bytes:
    """A chunk record of an MCAP, with whatever size it claims."""
    body = struct.pack("<QQQI", 0, 1, claimed, 0) + struct.pack("<I", len(compression)) + compression
    body += struct.pack("<Q", len(data)) + data
    return b"\x06" + struct.pack("<Q", len(body)) + body


MAGIC = b"\x89MCAP0\r\n"
HEADER = b"\x01" + struct.pack("<Q", 8) + struct.pack("<II", 0, 0)


def zeros(size: int) -> bytes:
    """A frame of zstd that holds so many zeros, a multiple of 128 KiB: of blocks that repeat one byte."""
    block = 1 << 17
    frame = struct.pack("<IBBQ", 0xFD2FB528, 0xC0, 7 << 3, size)  # a window of 128 KiB
    *blocks, last = [(block << 3 | repeats << 1).to_bytes(3, "little") + b"\0" for repeats in [1] * (size // block)]
    return frame + b"".join(blocks) + bytes([last[0] | 1]) + last[1:]


def schema(name: bytes, encoding: bytes, text: bytes) -> bytes:
    body = struct.pack("<H", 1) + b"".join(struct.pack("<I", len(each)) + each for each in (name, encoding, text))
    return b"\x03" + struct.pack("<Q", len(body)) + body


HOSTILE: dict[str, Callable[[], bytes]] = {
    "truncated": lambda: (RECORDINGS / "office.mcap").read_bytes()[:1000],
    "4 GiB of zeros": lambda: MAGIC + HEADER + chunk(b"zstd", 4 << 30, zeros(4 << 30)),  # twice the memory of the job
    "huge array": lambda: MAGIC + HEADER + schema(b"a/msg/B", b"ros2msg", b"string[3000000] x"),
    "nested constants": lambda: (
        MAGIC
        + HEADER
        + schema(
            b"a/msg/B", b"ros2idl", b"module a{module msg{const long X = " + b"(" * 18 + b"1" + b")" * 18 + b";};};"
        )
    ),
    "sqlite": lambda: b"SQLite format 3\x00" + os.urandom(5000),
}


@pytest.mark.unmeasured
def test_hostile_files_fail_with_a_reason_and_little_work(make_client: Callable[..., TestClient]) -> None:
    client = make_client(worker_command=REAL, sandbox="none", job_memory_bytes=2 << 30, slots=2, job_cpu_s=60.0)
    jobs = {}
    for name, content in HOSTILE.items():
        jobs[name] = client.post("/v1/jobs", json={"log": upload(client, content(), f"{name}.mcap")}).json()["id"]
    for name, job in jobs.items():
        ended = wait(client, job)
        assert (ended["state"], ended["reason"]) in (("failed", "invalid_input"), ("failed", "out_of_memory")), (
            name,
            ended,
        )
        assert ended["message"], name
        assert "/data/" not in ended["message"], ended["message"]  # the server's folders are its own business
    assert client.get("/healthz").status_code == 200


def map_yaml(folder: Path, image: object) -> None:
    (folder / "map").mkdir()
    (folder / "map" / "map.yaml").write_text(
        f"image: {json.dumps(image)}\nresolution: 0.05\norigin: [0, 0, 0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    )


@pytest.mark.parametrize("image", ["..", "a/..", "", 3, None])
def test_a_map_must_name_an_image(tmp_path: Path, image: object) -> None:
    map_yaml(tmp_path, image)
    with pytest.raises(MapError, match="must name a file"):
        linked_map(tmp_path / "map", "map.yaml", ".image")


@pytest.mark.parametrize("image", ["/etc/passwd", "../input/log.mcap", "a/b.pgm", "C:\\maps\\b.pgm", "b.pgm"])
def test_a_map_never_reads_a_file_that_was_not_uploaded(tmp_path: Path, image: str) -> None:
    """A path is of the user's machine: the uploaded image is meant, whatever this machine has there."""
    map_yaml(tmp_path, image)
    (tmp_path / "map" / ".image").write_bytes(b"uploaded")
    named = read_metadata(linked_map(tmp_path / "map", "map.yaml", ".image")).image
    assert named.parent == tmp_path / "map"
    assert named.read_bytes() == b"uploaded"


@pytest.mark.unmeasured
def test_a_map_of_two_uploads_and_a_warning_that_names_it_without_the_servers_folder(
    make_client: Callable[..., TestClient],
) -> None:
    client = make_client(worker_command=REAL, sandbox="none", job_memory_bytes=2 << 30)
    yaml = (
        b"image: my map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    # A room of 5 m x 4 m with a wall in it. Its cells are unknown to map_server, and free with this threshold.
    wall, row = b"\x00" * 100, b"\x00" + b"\xcd" * 98 + b"\x00"
    pixels = b"P5 100 80 255\n" + wall + row * 30 + b"\x00" * 40 + b"\xcd" * 59 + b"\x00" + row * 47 + wall
    chart = {"yaml": upload(client, yaml, "office.yaml"), "image": upload(client, pixels, "other.pgm")}
    log = upload(client, (RECORDINGS / "paper.mcap").read_bytes(), "paper.mcap")
    job = client.post("/v1/jobs", json={"log": log, "map": chart, "read": {"end_s": 1.0}}).json()["id"]
    ended = wait(client, job)
    assert ended["state"] == "succeeded", ended
    assert ended["summary"]["metrics"]["run"]["map"] == "office.yaml"
    viewer = client.get(f"/v1/jobs/{job}/results/viewer.json").json()
    assert (viewer["map"]["width"], viewer["map"]["height"]) == (100, 80)
    assert any(each["text"].startswith("office.yaml: free_thresh") for each in ended["summary"]["warnings"]), ended
    assert "/data/" not in client.get(f"/v1/jobs/{job}/results/metrics.json").text
