"""References and their lag, the cost of a tick, the reward, and what a failure costs."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sideslip.envs import COMS, FAILURES, PASSENGER_CAR, StabilityEnv, Vehicle
from sideslip.envs.numerics.functions import TICK
from sideslip.envs.record import FAST
from sideslip.envs.task import (
    LAGGED,
    LIMITED,
    MODEL,
    REFERENCE_LAG,
    ZERO_SLIP,
    ReferenceParams,
    compute_cost_rate,
    compute_reference,
    filter_reference,
    make_reference_params,
)

from ..helpers import FULL, IDS, LINEAR, bits, fast_rows, play, unwrapped

pytestmark = pytest.mark.plain

errors = st.floats(-0.5, 0.5)
TURNING = {"steering": "sine", "amplitude": 0.1, "frequency": 0.5}


def dakf_23_24(nominal: Vehicle, v_x: float, delta_cmd: float) -> tuple[float, float]:
    """dakf-stability (23) and (24) as printed."""
    M, l_f, l_r = nominal.mass, nominal.front_arm, nominal.rear_arm
    C_fn, C_rn = nominal.front_stiffness, nominal.rear_stiffness
    G = M / (2 * (l_f + l_r) ** 2) * (C_rn * l_r - C_fn * l_f) / (C_fn * C_rn)
    top = 1 - M / (2 * (l_f + l_r)) * l_f / (C_rn * l_r) * v_x**2
    beta_d = top / (1 + G * v_x**2) * l_r / (l_f + l_r) * delta_cmd
    gamma_d = 1 / (1 + G * v_x**2) * v_x / (l_f + l_r) * delta_cmd
    return beta_d, gamma_d


@pytest.mark.smoke
@given(st.floats(0.0, 14.0), st.floats(-0.3, 0.3))
def test_model_is_dakf_23_and_24(v: float, steer: float) -> None:
    """Up to 14 m/s: above 15.7 m/s the COMS has 1 + G v^2 < 0.2, which is kept there."""
    got = compute_reference(steer, v, make_reference_params(COMS), MODEL)
    # roundings of numbers up to 1 rad and 10 rad/s
    assert got == pytest.approx(dakf_23_24(COMS, v, steer), abs=1e-14)


def test_near_the_critical_speed_the_gain_is_kept_finite() -> None:
    target = make_reference_params(COMS)
    for v in (16.0, 17.58, 30.0, 100.0):
        _, gamma = compute_reference(0.1, v, target, MODEL)
        assert gamma == pytest.approx(v / 1.4 * 0.1 / 0.2, rel=1e-14)  # roundings


@given(st.floats(-1.0, 60.0), st.floats(-1.0, 1.0), st.floats(0.01, 1.0))
def test_limited_is_the_model_within_what_friction_holds(v: float, steer: float, mu: float) -> None:
    target = make_reference_params(COMS.replace(friction=mu))
    beta, gamma = compute_reference(steer, v, target, LIMITED)
    free = compute_reference(steer, v, target, MODEL)
    most_beta, most_gamma = 0.02 * mu * 9.81, 0.85 * mu * 9.81 / max(v, 1.0)
    assert beta == pytest.approx(min(max(free[0], -most_beta), most_beta), abs=1e-15)
    assert gamma == pytest.approx(min(max(free[1], -most_gamma), most_gamma), rel=1e-14)


def test_zero_slip_asks_for_none() -> None:
    assert compute_reference(0.3, 20.0, make_reference_params(COMS), ZERO_SLIP) == (0.0, 0.0)


SWERVING: dict[str, Any] = {"steering": "sine", "amplitude": 0.3, "frequency": 0.7, "duration": 3.0}
TARGETS = {car.name: make_reference_params(car) for car in (COMS, PASSENGER_CAR)}


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
    env = StabilityEnv(scenario=FULL | SWERVING, reference="lagged", control_period=1)
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
        scenario = FULL | SWERVING | {"noise": {}}
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


@given(errors, errors, st.floats(-1.0, 1.0), st.floats(-0.1, 0.1))
def test_cost_is_designs_formula(e_beta: float, e_gamma: float, share: float, steer: float) -> None:
    rest = (e_beta / 0.02) ** 2 + 0.01 * share**2 + 0.01 * (steer / 0.05) ** 2
    whole = rest + (e_gamma / 0.1) ** 2
    # roundings of sums up to 700
    for kind, c in ((ZERO_SLIP, rest), (MODEL, whole), (LIMITED, whole)):
        capped = pytest.approx(min(c, 100.0), abs=1e-12)
        assert compute_cost_rate(e_beta, e_gamma, share, steer, kind) == capped


def test_cost_is_capped_whatever_comes() -> None:
    for worst in (1e200, -1e200, math.inf, math.nan):
        assert compute_cost_rate(worst, 0.0, 0.0, 0.0, MODEL) == 100.0
        assert compute_cost_rate(0.0, worst, 0.0, 0.0, MODEL) == 100.0


@pytest.mark.parametrize("kind", ["zero-slip", "model", "limited"])
def test_reward_is_minus_the_cost_written_out_from_the_record(kind: str) -> None:
    env = StabilityEnv(scenario=LINEAR | TURNING, reference=kind, control_period=1)
    env.reset(seed=0)
    code = {"zero-slip": ZERO_SLIP, "model": MODEL, "limited": LIMITED}[kind]
    for moment in play(env, np.linspace(-1.0, 1.0, 300)):
        row, info = moment.record.fast[0], moment.info
        v = 0.5 * (row[FAST.wheel_left] + row[FAST.wheel_right])  # noise-free here
        command = 0.1 * math.sin(2.0 * math.pi * 0.5 * info["t"])
        refs = compute_reference(command, v, make_reference_params(COMS), code)
        # the polynomial sine's stated error, on 0.1 rad, times the reference's gain
        assert (info["beta_ref"], info["gamma_ref"]) == pytest.approx(refs, abs=1e-14)
        N_z = 0.5 * COMS.rear_track / COMS.wheel_radius
        N_z = N_z * (row[FAST.torque_right] - row[FAST.torque_left])
        assert info["yaw_moment"] == pytest.approx(N_z, abs=1e-12)
        share = N_z / COMS.yaw_moment_limit
        e_beta, e_gamma = info["beta"] - info["beta_ref"], info["gamma"] - info["gamma_ref"]
        c = compute_cost_rate(e_beta, e_gamma, share, 0.0, code)
        assert info["cost"] == pytest.approx(c * TICK, rel=1e-12)
        assert moment.reward == -info["cost"]


@pytest.mark.compiled
@pytest.mark.parametrize("name", IDS)
def test_the_return_does_not_depend_on_the_control_period(name: str) -> None:
    returns = []
    for n in (1, 10, 33):
        env = unwrapped(name, control_period=n)
        env.reset(seed=4, options={"duration": 1.5})
        moments = play(env, [0.0] * 1500)
        assert moments[-1].truncated
        assert len(fast_rows(moments)) == 1500
        returns.append(sum(moment.reward for moment in moments))
    assert returns[0] < 0.0
    # the same 1500 numbers, added up in another grouping
    assert returns[1:] == pytest.approx(returns[:1] * 2, rel=1e-13)


FALLS: dict[str, dict[str, Any]] = {
    "off-road": {"y": 49.0, "psi": 0.3},
    "spin": {"gamma": -4.0, "v_y": 2.0},
}


@pytest.mark.smoke
@pytest.mark.parametrize("n", [1, 10, 33])
@pytest.mark.parametrize("name", FALLS)
def test_failure_charges_the_rest_at_100_a_second(name: str, n: int) -> None:
    env = StabilityEnv(scenario=FULL | {"duration": 6.0}, control_period=n)
    _, info = env.reset(seed=0, options={"state": FALLS[name]})
    assert info["failure"] == 0
    moments = play(env, [0.0] * 6000)
    last = moments[-1]
    assert last.terminated
    assert not last.truncated
    assert not last.info["is_success"]
    assert FAILURES[last.info["failure"]] == name
    ticks = round(last.info["t"] / TICK)
    assert ticks == len(fast_rows(moments)) < 6000
    driven = -sum(moment.reward for moment in moments) - 100.0 * (6000 - ticks) * TICK
    # what was driven costs at least nothing and at most the cap; roundings of 600
    assert -1e-10 < driven < 100.0 * ticks * TICK + 1e-10
    assert len(last.record.fast) == ticks - n * (len(moments) - 1)


@pytest.mark.parametrize("name", FALLS)
def test_failing_never_pays(name: str) -> None:
    """An episode that goes on costs at most the cap; every second that a failure cuts, the cap."""
    totals = []
    for duration in (10.0, 20.0):
        env = StabilityEnv(scenario=FULL | {"duration": duration})
        env.reset(seed=0, options={"state": FALLS[name]})
        totals.append(-sum(moment.reward for moment in play(env, [0.0] * 2000)))
    # roundings of 2000
    assert totals[0] <= 1000.0 + 1e-9
    assert totals[1] - totals[0] == pytest.approx(1000.0, abs=1e-9)
