"""Numbers that no algorithm can work with are refused by name, before any of them is tried."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hsloc.config import Config, from_dict, to_dict
from hsloc.errors import ConfigError, MapError
from hsloc.matching.likelihood_field import LikelihoodField
from hsloc.model.occupancy_grid import OccupancyGrid


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (
            {"localiser": {"window_min": 1e-300}},
            "config.localiser.window_min is 1e-300; it must be from 1e-9 to 1e9",
        ),
        ({"localiser": {"window_sigmas": 1e300}}, "window_sigmas is 1e"),
        ({"likelihood_field": {"sigma": 1e-300}}, "sigma is 1e-300"),
        ({"likelihood_field": {"margin": 1e-300}}, "margin is 1e-300; it must be 0, or at least 1e-9 in size"),
        ({"hide": {"budget": 10**30}}, "budget is 1000000000000000000000000000000; it must be from 1 to 1e9"),
        (
            {"localiser": {"relocaliser": {"hypotheses": 0}}},
            "localiser.relocaliser.hypotheses is 0; it must be from 1 to",
        ),
        (
            {"localiser": {"relocaliser": {"renew_distance": -1.0}}},
            "renew_distance is -1.0; it must be from 1e-9",
        ),
        (
            {"localiser": {"max_consecutive_rejections": 0}},
            "localiser.max_consecutive_rejections is 0; it must be from 1 to",
        ),
        ({"localiser": {"min_fitness_ratio": -1}}, "min_fitness_ratio is -1"),
        ({"icp": {"tolerance": -1.0}}, "tolerance is -1.0"),
        ({"graph_mapper": {"passes": 0}}, "config.graph_mapper.passes is 0; it must be from 1 to 1e9"),
        ({"graph_mapper": {"loops": {"search_radius": -3.0}}}, "config.graph_mapper.loops.search_radius is -3.0"),
        ({"graph_mapper": {"loops": {"sigma": float("nan")}}}, "config.graph_mapper.loops.sigma is nan"),
        ({"graph_mapper": {"joint_registration": {"gates": [0.3, -0.1]}}}, "joint_registration.gates is -0.1"),
        ({"graph_mapper": {"joint_registration": {"gates": []}}}, "gates is empty"),
        ({"hide": {"restarts": 2.5}}, "config.hide.restarts is 2.5; it must be of type int"),
        ({"mapper": "hector"}, "config.mapper is 'hector'; it must be one of graph, point"),
    ],
)
def test_a_number_out_of_all_range_is_refused(values: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        from_dict(Config, values)
    assert expected in str(caught.value)


def test_the_defaults_are_within_the_ranges() -> None:
    assert from_dict(Config, to_dict(Config())) == Config()


def test_a_field_that_fits_no_memory_is_refused() -> None:
    grid = OccupancyGrid(np.full((3, 3), 100, dtype=np.int8), 0.05)
    with pytest.raises(MapError, match=r"choose a smaller likelihood_field\.margin or a coarser map"):
        LikelihoodField.from_grid(grid, margin=1e9)


def test_points_beyond_all_range_score_nothing() -> None:
    field = LikelihoodField.from_grid(OccupancyGrid(np.full((3, 3), 100, dtype=np.int8), 0.05))
    points = np.array(((1e38, 0.0), (3e38, 3e38)))
    from hsloc.model import Pose2

    assert field.fitness(points, Pose2(0.0, 0.0, 1.0)) == 0.0
