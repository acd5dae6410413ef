"""Steering and yaw moment together: the loop's radius by K, lanes that are kept."""

import numpy as np
import pytest

from sideslip.benchmarks.studies.coordinated_control import (
    BANDWIDTHS,
    LANE_CONTROLLERS,
    _compute_loop_radius,
    _keep_lane,
    _track_reference,
)
from sideslip.envs import COMS
from sideslip.envs.vehicle.linear import make_bicycle_model


def test_a_slow_loop_has_the_poles_of_its_design() -> None:
    """With true tyres and no lag the poles are those of K and of the car, dakf-stability (31)."""
    scenario = {"base": "dakf-fig7", "lags": False, "vehicle": {}, "nominal": {}}
    slowest = np.linalg.eigvals(make_bicycle_model(COMS, 25 / 3.6).A).real.max()
    for K in (1.0, 5.0):
        pole = (
            np.log(_compute_loop_radius(scenario, K)) / 1e-3
        )  # 1/s; sampling moves it by a hundredth
        assert pole == pytest.approx(max(slowest, -K), rel=0.01)


def test_the_loop_is_stable_below_the_critical_speed_only() -> None:
    """63.3 km/h: what V.D overlooks, for the feedback cancels the car's own poles."""
    bare = {"base": "dakf-fig7", "vehicle": {}, "nominal": {}}
    for K in BANDWIDTHS:
        assert _compute_loop_radius("dakf-fig7", K) < 1.0
        assert _compute_loop_radius(bare | {"speed": 60 / 3.6}, K) < 1.0
        assert _compute_loop_radius(bare | {"speed": 67 / 3.6}, K) > 1.0


def test_an_episode_gives_its_numbers() -> None:
    none, ours = _track_reference((0.0, 1)), _track_reference((5.0, 1))
    assert np.isfinite(none).all() and np.isfinite(ours).all()
    assert ours[1] < 0.5 * none[1] and ours[3] == 0.0


def test_lanes_are_kept_and_nobody_keeps_them_without_control() -> None:
    numbers = {LANE_CONTROLLERS[k][:2]: _keep_lane(k, 8) for k in (0, 1, 2)}
    assert numbers["none", "uneven-delay-kf"][:, 2].all()
    for what in ("steering alone", "both"):
        kept = numbers[what, "uneven-delay-kf"]
        assert not kept[:, 2].any() and kept[:, 0].max() < 1.0
    alone, both = (numbers[what, "uneven-delay-kf"][:, 0] for what in ("steering alone", "both"))
    assert both.mean() < alone.mean()
