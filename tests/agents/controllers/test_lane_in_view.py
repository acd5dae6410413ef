"""A good controller keeps the lane in the camera's view where the road follows the nominal car."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sideslip
from sideslip.envs.record import PACKET
from sideslip.envs.scenarios.manoeuvres import scenario_from
from sideslip.estimators import vector

CARS = 16
VIEW = {"camera_heading": 0.35, "camera_offset": 3.0}
LEVEL: dict[str, Any] = {"bank": 0.0, "gyro_bias": 0.0, "accel_y_bias": 0.0, "gps_latency": 0.0}


def share_seen(name: str, road: str) -> float:
    """Of the camera's frames, under lqr on exact-kf, with tyres drawn from 0.6 to 1.4."""
    scenario = scenario_from(name).replace(road=road, **VIEW, **LEVEL)
    assert scenario.front_stiffness == (0.6, 1.4)
    env: Any = gym.make_vec("sideslip/AfsYawFusion-v0", CARS, scenario=scenario.to_dict())
    env = vector.EstimateObservation(env, "exact-kf", options={"slow": ["camera", "gps"]})
    lqr, base = sideslip.make_agent("lqr", env), env.unwrapped
    obs, _ = env.reset(seed=100)
    state, start, seen = None, np.ones(CARS, bool), []
    for _ in range(round(scenario.duration / 0.01) - 1):
        actions, state = lqr.predict(obs, state, start)
        obs, _, terminated, truncated, _ = env.step(actions)
        start = terminated | truncated
        for i in range(CARS):
            packets = base.packets[i, : base.delivered[i]]
            seen.append(packets[packets[:, PACKET.sensor] == 0, PACKET.quality])
    return float(np.concatenate(seen).mean())


@pytest.mark.parametrize("name", ["coms-slalom", "coms-random", "coms-brake-in-turn"])
def test_the_lane_is_seen_in_most_frames_and_on_a_straight_road_in_no_more(name: str) -> None:
    winding, straight = share_seen(name, "nominal-path"), share_seen(name, "straight")
    assert winding > 0.8
    assert straight <= (0.5 if name == "coms-brake-in-turn" else winding)
