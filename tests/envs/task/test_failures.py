"""What ends an episode: the limits of sideslip and road, at the tick at which they are passed."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs import FAILURES, StabilityEnv

from ..helpers import FULL, play

pytestmark = pytest.mark.plain

SPIN_LIMIT = 0.5  # rad of sideslip
ROAD = 1.5  # m to either side of the road's middle
TURNING: dict[str, Any] = {"v_x": 8.0, "v_y": -3.2, "gamma": 3.0}
LEAVING: dict[str, Any] = {"v_x": 8.0, "psi": 0.3}


def mirrored(state: dict[str, float]) -> dict[str, float]:
    """The same to the other side."""
    return {name: value if name == "v_x" else -value for name, value in state.items()}


@pytest.mark.parametrize("state", [TURNING, mirrored(TURNING)], ids=["left", "right"])
def test_more_than_half_a_radian_of_slip_is_a_spin(state: dict[str, float]) -> None:
    env = StabilityEnv(scenario=FULL, control_period=1)
    env.reset(seed=0, options={"state": state})
    moments = play(env, [0.0] * 1000)
    slips = np.abs([moment.info["beta"] for moment in moments])
    assert 0.35 < slips[0] < 0.45 and len(slips) > 10
    assert slips[:-1].max() <= SPIN_LIMIT < slips[-1] < SPIN_LIMIT + 0.02
    assert [FAILURES[moment.info["failure"]] for moment in moments[-2:]] == ["none", "spin"]
    assert moments[-1].terminated and not moments[-2].terminated


@pytest.mark.parametrize("state", [LEAVING, mirrored(LEAVING)], ids=["left", "right"])
def test_beyond_the_half_width_the_road_is_left(state: dict[str, float]) -> None:
    env = StabilityEnv(scenario=FULL | {"half_width": ROAD}, control_period=1)
    env.reset(seed=0, options={"state": state})
    aside = []
    for _ in range(5000):
        (moment,) = play(env, [0.0])
        aside.append(abs(env.motion.y))
        if moment.terminated:
            break
    assert FAILURES[moment.info["failure"]] == "off-road"
    assert len(aside) > 100 and max(aside[:-1]) <= ROAD < aside[-1] < ROAD + 0.01
