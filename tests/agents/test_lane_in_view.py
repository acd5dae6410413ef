"""A good controller keeps the lane in the camera's view where the road follows the nominal car."""

from typing import Any

import numpy as np
import pytest

from sideslip.agents.baselines import make_oracle
from sideslip.envs import SCENARIOS
from sideslip.envs.record import PACKET
from sideslip.envs.scenarios.scenario import Scenario
from sideslip.envs.scenarios.tiers import TIERS

CARS = 16
OFTEN = ("coms-slalom", "coms-brake-in-turn", "car-step", "limit-sine-with-dwell")
SCORED = [
    each.name if each.name in OFTEN else pytest.param(each.name, marks=pytest.mark.long)
    for each in TIERS
    if each.tier
]


def share_seen(scenario: Scenario) -> float:
    """Of the camera's frames, under the rung that knows the nominal car."""
    car = "coms" if scenario.tier == "1" else "passenger-car"
    env: Any
    env, agent = make_oracle(
        "nominal",
        "sideslip/YawFusion-v0",
        CARS,
        scenario=scenario.to_dict(),
        vehicle=car,
        nominal=car,
        reference="limited",
    )
    base, state, start = env.unwrapped, None, np.ones(CARS, bool)
    obs, _ = env.reset(seed=100)
    seen = []
    for _ in range(round(scenario.duration / 0.01) - 1):
        actions, state = agent.predict(obs, state, start)
        obs, _, terminated, truncated, _ = env.step(actions)
        start = terminated | truncated
        for i in range(CARS):
            packets = base.packets[i, : base.delivered[i]]
            seen.append(packets[packets[:, PACKET.sensor] == 0, PACKET.quality])
    return float(np.concatenate(seen).mean())


@pytest.mark.parametrize("name", SCORED)
def test_the_lane_is_seen_in_four_of_five_frames(name: str) -> None:
    """With tyres from 0.6 to 1.4 of the nominal ones."""
    scenario = SCENARIOS[name]
    assert scenario.front_stiffness == (0.6, 1.4) and scenario.camera_heading < 0.4
    assert share_seen(scenario) > 0.8


@pytest.mark.parametrize("name", ["coms-brake-in-turn", "coms-step", "limit-step"])
def test_on_a_straight_road_it_would_not(name: str) -> None:
    scenario = SCENARIOS[name]
    assert share_seen(scenario.replace(road="straight")) < min(0.9, share_seen(scenario))
