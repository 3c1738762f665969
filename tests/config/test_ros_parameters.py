"""A ROS 2 parameter file as --config: what means the same is taken, the rest is named."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from hsloc.cli.main import main
from hsloc.config import Config, load
from hsloc.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

AMCL = """
amcl:
  ros__parameters:
    use_sim_time: true
    alpha1: 0.3
    alpha4: 1
    update_min_d: 0.5
    update_min_a: 0.1
    sigma_hit: 0.2
    scan_topic: front
    initial_pose: {x: 1.0, y: 2.0, yaw: 0.0}
map_server:
  ros__parameters:
    yaml_filename: office.yaml
"""


def test_what_means_the_same_is_taken_and_the_rest_is_named(tmp_path: Path) -> None:
    (tmp_path / "nav2.yaml").write_text(AMCL)
    warnings: list[str] = []
    config = load(tmp_path / "nav2.yaml", warnings=warnings)
    noise = config.localiser.odometry_noise
    assert (noise.alpha1, noise.alpha2, noise.alpha4) == (0.3, Config().localiser.odometry_noise.alpha2, 1.0)
    assert (config.localiser.update_min_d, config.localiser.update_min_a) == (0.5, 0.1)
    first, second = (line.partition(": ")[2] for line in warnings)
    assert first == (
        "parameters of amcl that are ignored: use_sim_time, sigma_hit, scan_topic (give --scan-topic), "
        "initial_pose (give --initial-pose)"
    )
    assert second == "parameters of map_server that are ignored: yaml_filename (give --map)"


def test_nodes_in_namespaces_and_wildcards(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text(
        "robot1:\n  amcl:\n    ros__parameters: {update_min_d: 0.7}\n/**:\n  ros__parameters: {alpha3: 0.5}\n"
    )
    warnings: list[str] = []
    config = load(tmp_path / "p.yaml", warnings=warnings)
    assert config.localiser.update_min_d == 0.7
    assert config.localiser.odometry_noise.alpha3 == 0.5
    assert warnings == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("amcl: {ros__parameters: {update_min_d: far}}", "config.localiser.update_min_d is 'far'"),
        ("amcl: {ros__parameters: {alpha1: -1}}", "alpha1 is -1"),
        ("amcl: {ros__parameter: {alpha1: 1}}", "unknown key 'amcl'"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "p.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"p\.yaml") as caught:
        load(tmp_path / "p.yaml")
    assert expected in str(caught.value)


def test_the_command_warns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "nav2.yaml").write_text(AMCL)
    assert main(["config", "--config", str(tmp_path / "nav2.yaml")]) == 0
    printed = capsys.readouterr()
    assert "update_min_d: 0.5" in printed.out
    assert "hsloc: warning:" in printed.err
    assert "yaml_filename (give --map)" in printed.err
