"""Each motion model against many samples of the noise that its source describes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hsloc.errors import ConfigError
from hsloc.localisation.motion_models import AckermannNoise, OdometryNoise, OmnidirectionalNoise
from hsloc.localisation.parameters import LocaliserParameters
from hsloc.model import Pose2

if TYPE_CHECKING:
    from hsloc.localisation.motion_models import MotionModel
    from hsloc.parameters import Parameters

N = 200_000
MODELS = (OdometryNoise(), AckermannNoise(), OmnidirectionalNoise())
coordinates = st.floats(-2.0, 2.0)


def arc_end(arc: Any, turn: Any) -> tuple[Any, Any]:
    """Where an arc of a circle ends (Probabilistic Robotics, eq. 5.9, with v dt = arc and omega dt = turn)."""
    radius = arc / turn
    return radius * np.sin(turn), radius * (1.0 - np.cos(turn))


@pytest.mark.parametrize(("arc", "turn"), [(1.2, 0.5), (-0.8, 0.3), (0.7, -0.9), (1.0, 1e-9)])
def test_the_car_is_that_of_many_sampled_arcs(arc: float, turn: float) -> None:
    noise = AckermannNoise(alpha1=4e-3, alpha2=2e-3, alpha3=3e-3, alpha4=5e-3, alpha5=1e-3, alpha6=2e-3)
    x, y = arc_end(arc, turn)
    rng = np.random.default_rng(0)
    arcs = rng.normal(arc, np.sqrt(4e-3 * arc**2 + 2e-3 * turn**2), N)
    turns = rng.normal(turn, np.sqrt(3e-3 * arc**2 + 5e-3 * turn**2), N)
    final = rng.normal(0.0, np.sqrt(1e-3 * arc**2 + 2e-3 * turn**2), N)
    samples = np.stack((*arc_end(arcs, turns), turns + final))
    np.testing.assert_allclose(noise.covariance(Pose2(x, y, turn)), np.cov(samples), rtol=0.05, atol=1e-4)


@pytest.mark.parametrize("motion", [Pose2(0.6, 0.3, 0.4), Pose2(-0.5, 0.0, -0.2), Pose2(0.0, 0.9, 0.0)])
def test_the_holonomic_base_is_that_of_amcls_samples(motion: Pose2) -> None:
    noise = OmnidirectionalNoise(alpha1=4e-3, alpha2=2e-3, alpha3=5e-3, alpha4=1e-3, alpha5=9e-3)
    trans, bearing, rot = np.hypot(motion.x, motion.y), np.arctan2(motion.y, motion.x), motion.theta
    rng = np.random.default_rng(1)
    along = rng.normal(trans, np.sqrt(5e-3 * trans**2 + 1e-3 * rot**2), N)
    across = rng.normal(0.0, np.sqrt(9e-3 * trans**2 + 1e-3 * rot**2), N)
    turns = rng.normal(rot, np.sqrt(4e-3 * rot**2 + 2e-3 * trans**2), N)
    c, s = np.cos(bearing), np.sin(bearing)
    samples = np.stack((along * c + across * s, along * s - across * c, turns))
    np.testing.assert_allclose(noise.covariance(motion), np.cov(samples), rtol=0.02, atol=2e-5)


def test_only_the_holonomic_base_moves_sideways_while_it_drives_straight() -> None:
    ahead = Pose2(1.0, 0.0, 0.0)
    silent = dict.fromkeys(("alpha1", "alpha2", "alpha4"), 0.0)
    assert OdometryNoise(alpha3=0.01, **silent).covariance(ahead)[1, 1] == 0.0
    car = AckermannNoise(alpha1=0.01, alpha2=0.0, alpha3=0.0, alpha4=0.0, alpha5=0.0, alpha6=0.0)
    assert car.covariance(ahead)[1, 1] == 0.0
    assert OmnidirectionalNoise(alpha3=0.01, alpha5=0.04, **silent).covariance(ahead)[1, 1] == pytest.approx(0.04)


@given(coordinates, coordinates, st.floats(-3.1, 3.1))
def test_every_covariance_is_symmetric_and_positive_semidefinite(x: float, y: float, theta: float) -> None:
    for model in MODELS:
        covariance = model.covariance(Pose2(x, y, theta))
        np.testing.assert_array_equal(covariance.shape, (3, 3))
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)
        assert np.linalg.eigvalsh(0.5 * (covariance + covariance.T)).min() >= -1e-9 * max(np.trace(covariance), 1.0)


@pytest.mark.parametrize("model", MODELS)
def test_no_motion_has_no_noise(model: MotionModel) -> None:
    assert np.abs(model.covariance(Pose2())).max() == 0.0


@pytest.mark.parametrize(
    ("kind", "name"),
    [(OdometryNoise, "alpha4"), (AckermannNoise, "alpha6"), (OmnidirectionalNoise, "alpha5")],
)
def test_negative_noise_is_refused_by_name(kind: type[Parameters], name: str) -> None:
    with pytest.raises(ConfigError, match=f"{name} is -1"):
        kind(**{name: -1.0})


def test_the_configuration_chooses_the_model() -> None:
    for name, kind in (
        ("differential", OdometryNoise),
        ("ackermann", AckermannNoise),
        ("omnidirectional", OmnidirectionalNoise),
    ):
        assert isinstance(LocaliserParameters(motion_model=name).noise(), kind)
    with pytest.raises(ConfigError, match="motion_model is 'tracked'; it must be one of differential"):
        LocaliserParameters(motion_model="tracked")
