"""The lagged reference: limited, understeering, and later than the command by a first-order lag."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, PASSENGER_CAR, StabilityEnv
from sideslip.envs.record import FAST
from sideslip.envs.task import (
    LAGGED,
    LIMITED,
    MODEL,
    REFERENCE_LAG,
    ReferenceParams,
    compute_reference,
    filter_reference,
    make_reference_params,
)
from sideslip.envs.ticks import TICK

from ..helpers import FULL, bits, fast_rows, play

pytestmark = pytest.mark.plain

TURNING: dict[str, Any] = {"steering": "sine", "amplitude": 0.3, "frequency": 0.7, "duration": 3.0}
TARGETS = {
    "coms": make_reference_params(COMS),
    "passenger-car": make_reference_params(PASSENGER_CAR),
}


@pytest.mark.parametrize("name", TARGETS)
def test_a_step_is_answered_by_one_minus_exp(name: str) -> None:
    """Of a command so large that friction limits what is asked for, too."""
    target = TARGETS[name]
    for steer in (0.01, 0.4):
        steady = compute_reference(steer, 20.0, target, LAGGED)
        refs = (0.0, 0.0)
        for tick in range(1, 400):
            refs = filter_reference(refs, steady, target, LAGGED)
            share = 1.0 - math.exp(-tick * TICK / REFERENCE_LAG)
            # roundings of 400 multiplications
            assert refs == pytest.approx([share * each for each in steady], rel=1e-12)
    assert filter_reference((5.0, 5.0), (0.1, 0.2), target, LIMITED) == (0.1, 0.2)


@given(st.sampled_from(list(TARGETS.values())), st.floats(0.0, 60.0), st.floats(-1.0, 1.0))
def test_friction_limits_it(target: ReferenceParams, v: float, steer: float) -> None:
    beta, gamma = compute_reference(steer, v, target, LAGGED)
    assert abs(beta) <= 0.02 * target.mu_g
    assert abs(gamma) <= 0.85 * target.mu_g / max(v, 1.0)


@pytest.mark.parametrize("name", TARGETS)
def test_its_car_turns_most_at_the_characteristic_speed(name: str) -> None:
    """There an understeering car turns half as much as a neutral one; above it, less again."""
    target, gains = TARGETS[name], []
    for v in (34.0, 35.0, 36.0):
        gains.append(compute_reference(1e-6, v, target, LAGGED)[1] / 1e-6)
    assert gains[1] == max(gains)
    assert gains[1] == pytest.approx(0.5 * 35.0 * target.per_l, rel=1e-12)
    # understeering, but slightly: the passenger car itself turns 2 % more at 80 km/h
    v = 80.0 / 3.6
    ratio = compute_reference(0.01, v, TARGETS["passenger-car"], MODEL)[1]
    ratio /= compute_reference(0.01, v, TARGETS["passenger-car"], LAGGED)[1]
    assert 1.0 < ratio < 1.03


def test_in_the_env_it_follows_the_record_tick_by_tick() -> None:
    env = StabilityEnv(scenario=FULL | TURNING, reference="lagged", control_period=1)
    _, info = env.reset(seed=0)
    refs = np.array([info["beta_ref"], info["gamma_ref"]])
    assert refs.tolist() == [0.0, 0.0]
    rest, largest = math.exp(-TICK / REFERENCE_LAG), 0.0
    for moment in play(env, [0.1] * 3000):
        row, info = moment.record.fast[0], moment.info
        v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])  # noise-free here
        command = 0.3 * math.sin(2.0 * math.pi * 0.7 * info["t"])
        steady = np.array(compute_reference(command, v, make_reference_params(COMS), LAGGED))
        refs = steady + (refs - steady) * rest
        assert (info["beta_ref"], info["gamma_ref"]) == pytest.approx(refs.tolist(), abs=1e-12)
        assert moment.obs[-2:].tolist() == np.float32(refs).tolist()
        largest = max(largest, float(np.abs(refs - steady).max()))
    assert largest > 0.1  # the lag matters


@pytest.mark.parametrize("n", [1, 10, 33])
def test_a_snapshot_carries_it_on_and_the_period_does_not_matter(n: int) -> None:
    def made(period: int, seed: int) -> StabilityEnv:
        scenario = FULL | TURNING | {"noise": {}}
        env = StabilityEnv("fusion", scenario, reference="lagged", control_period=period)
        env.reset(seed=seed)
        return env

    env, twin, every = made(n, 3), made(n, 9), made(1, 3)
    last = play(env, [0.2] * (330 // n))[-1].info
    twin.set_state(env.get_state())
    assert bits(play(env, [0.1] * 20)) == bits(play(twin, [0.1] * 20))
    ticks = play(every, [0.2] * (330 // n * n))
    assert len(fast_rows(ticks)) == 330 // n * n
    for name in ("beta_ref", "gamma_ref"):
        assert ticks[-1].info[name] == last[name]
