"""The tiers: the seed decides all that matters, within the speeds and frictions of the tier."""

from collections import Counter

import numpy as np
import pytest

from sideslip.envs import SCENARIOS, StabilityEnv
from sideslip.envs.scenarios.draws import KMH, Draws
from sideslip.envs.scenarios.tiers import TIERS

from ..helpers import play

pytestmark = pytest.mark.plain

SPEEDS = {"1": (18.0, 28.0), "2a": (60.0, 80.0), "2b": (60.0, 80.0), "2c": (55.0, 85.0)}  # km/h
FRICTIONS = {"1": (0.7, 1.0), "2a": (0.9, 1.0), "2b": (0.3, 1.0), "2c": (0.6, 1.0)}
NAMES = [scenario.name for scenario in TIERS if scenario.tier]


def vehicle_of(name: str) -> str:
    """The preset that a tier's scenario is meant for."""
    return "coms" if SCENARIOS[name].tier == "1" else "passenger-car"


def test_every_tier_has_at_least_four_and_both_classes_five() -> None:
    count = Counter(SCENARIOS[name].tier for name in NAMES)
    assert min(count.values()) >= 4
    assert count["1"] >= 5
    assert count["2a"] == count["2b"] >= 5
    assert {name for name, each in SCENARIOS.items() if each.tier} == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_table_of_actions_would_need_every_draw(name: str) -> None:
    """Onset, side, speed, tyres and friction, and the manoeuvre's size and its pace."""
    scenario = SCENARIOS[name]
    low, high = scenario.get_draw_ranges()
    drawn = {Draws._fields[i] for i in np.flatnonzero(low < high)}
    assert {"gyro_bias", "accel_y_bias", "gps_latency", "bank"} <= drawn
    assert {"onset", "side", "speed", "friction", "front_stiffness", "rear_stiffness"} <= drawn
    size = {"path_speed"} if scenario.steering == "driver" else {"amplitude"}
    pace = {"step": {"hold"}, "held-step": set(), "driver": set()}
    assert size | pace.get(scenario.steering, {"frequency"}) <= drawn
    for field, unit, ranges in (("speed", KMH, SPEEDS), ("friction", 1.0, FRICTIONS)):
        least, most = scenario.range(field)
        assert least >= ranges[scenario.tier][0] * unit - 1e-9
        assert most <= ranges[scenario.tier][1] * unit + 1e-9


@pytest.mark.compiled
@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith("limit")])
def test_a_car_without_control_mostly_gets_through(name: str) -> None:
    """Otherwise survival alone would decide the score, not how well the car is kept."""
    env = StabilityEnv("fusion", scenario=name, vehicle=vehicle_of(name), control_period=100)
    ends = []
    for seed in range(8):
        env.reset(seed=seed)
        ends.append(play(env, [0.0] * 200)[-1].terminated)
    assert sum(ends) <= 2
