"""Bicycle filters on a road that winds: the curvature at the car is an input, psi is the road's."""

import math
from typing import Any

import numpy as np
import pytest

from sideslip.envs import StabilityEnv
from sideslip.envs.engine.layout import Z
from sideslip.envs.record import FAST, Record
from sideslip.envs.scenarios.manoeuvres import make_scenario
from sideslip.estimators import Estimator, make_estimator
from tests.estimators.drives import record_episode

WINDING = make_scenario("tie-vision-fig7").replace(road="nominal-path", duration=4.0)
RUNS = 24
SETS = [("camera",), ("gps",), ("camera", "gps")]
LATE: dict[str, Any] = {"gps": {"delays": (0.25,)}}
RULES: list[Any] = ["clone", "buffer"]


def drives(**arguments: Any) -> list[Any]:
    """(record, psi - theta at its end, the env): linear cars on linear tyres."""
    found = []
    for seed in range(RUNS):
        env = StabilityEnv("fusion", WINDING, control_period=1000, **arguments)
        record = record_episode(env, seed)
        z = env.get_state()["state"]
        psi = float(z[Z.motion.psi] - z[Z.motion.theta])
        found.append((record, psi, env))
    return found


@pytest.fixture(scope="module")
def prompt() -> list[Any]:
    return drives()


def nees(found: list[Any], told: bool, sensors: tuple[str, ...], **options: Any) -> float:
    """Mean squared error of psi over its variance at the ends; told: of the road's curvature."""
    squares = []
    for record, psi, env in found:
        common = {"vehicle": env.vehicle, "sensors": env.slow_sensors, "speed": env.held_speed}
        filter_: Estimator = make_estimator("exact-kf", slow=list(sensors), **common, **options)
        fast = record.fast.copy()
        fast[:, FAST.curvature] *= told
        filter_.run(Record(fast, record.packets))
        i = filter_.names.index("psi")
        squares.append((filter_.x[i] - psi) ** 2 / filter_.P[i, i])
    return float(np.mean(squares))


@pytest.mark.parametrize("sensors", SETS, ids="-".join)
def test_psi_follows_the_road_within_its_deviation(prompt: list[Any], sensors: Any) -> None:
    """And does not where the input is missing; the course is one over the ground."""
    assert 0.4 < nees(prompt, True, sensors) < 2.1  # chi-square of 24, 99.9 %
    assert nees(prompt, False, sensors) > (3.0 if sensors == ("camera",) else 20.0)


@pytest.mark.parametrize("rule", RULES)
def test_so_it_does_with_a_late_course(rule: str) -> None:
    """Which is one over the road's direction when it was captured."""
    late = drives(**LATE)
    assert 0.4 < nees(late, True, ("gps",), delay=rule) < 2.1
    assert nees(late, True, ("gps",), delay="ignore") > 3.0


def test_a_record_without_the_column_has_a_straight_road(prompt: list[Any]) -> None:
    record, _, env = prompt[0]
    bare = Record(record.fast.copy(), record.packets, present=FAST._fields[:-1])
    bare.fast[:, FAST.curvature] = 0.0
    filter_ = make_estimator("exact-kf", sensors=env.slow_sensors, speed=env.held_speed)
    assert "curvature" not in filter_.needs
    assert math.isfinite(filter_.run(bare).x[-1, 2])
