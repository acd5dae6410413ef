"""Added steering within its limits, and the feedforward yaw moment that needs none."""

import itertools
import math
import re
from typing import Any

import gymnasium
import numpy as np
import pytest

from sideslip.envs import COMS, FAILURES, StabilityEnv, Vehicle
from sideslip.envs.engine.config import make_car
from sideslip.envs.numerics.functions import TICK
from sideslip.envs.record import FAST
from sideslip.envs.vehicle.dynamics import DisturbanceForces, Motion, RoadParams, derivative
from sideslip.envs.vehicle.linear import make_bicycle_model
from sideslip.envs.vehicle.tyres import LINEAR as LINEAR_TYRES
from sideslip.envs.vehicle.tyres import PlantVariant, TyreInputs, compute_tyre_load

from ..helpers import FULL, IDS, LINEAR, bits, fast_rows, play

pytestmark = pytest.mark.plain

SINE = {"steering": "sine", "amplitude": 0.05, "frequency": 0.5}
BY_WIRE = LINEAR | {"lags": True, "vehicle": {"motor_lag": 0.0}}
"""dakf-stability's plant: nothing lags but the steering, whose motor moves the wheels alone."""


def steered(scenario: Any, **changes: Any) -> StabilityEnv:
    """A started env of one-tick steps whose action steers."""
    env = StabilityEnv("fusion", scenario, steering=True, **{"control_period": 1} | changes)
    env.reset(seed=0)
    return env


@pytest.mark.smoke
def test_the_action_has_two_entries_on_one_id_only() -> None:
    steering = {name: gymnasium.make(name).action_space.shape for name in IDS}
    assert steering.pop("sideslip/AfsYawFusion-v0") == (2,)
    assert set(steering.values()) == {(1,)}


@pytest.mark.parametrize("scenario", ["slalom", FULL | SINE, BY_WIRE | SINE], ids=str)
def test_no_added_steering_is_the_car_without_it_bit_for_bit(scenario: Any) -> None:
    moments = np.random.default_rng(0).uniform(-1.0, 1.0, 100)
    with_it, without = (StabilityEnv(scenario=scenario, steering=x) for x in (True, False))
    assert bits(with_it.reset(seed=1)) == bits(without.reset(seed=1))
    pairs = [(moment, 0.0) for moment in moments]
    assert bits(play(with_it, pairs)) == bits(play(without, moments))


def test_it_goes_to_its_share_of_the_authority_at_its_rate() -> None:
    env = steered(LINEAR | SINE)
    shares = [1.0] * 200 + [-0.5] * 300
    rows = fast_rows(play(env, [(0.0, share) for share in shares]))
    added, expected = rows[:, FAST.steer] - rows[:, FAST.steer_command], []
    value = 0.0
    for share in shares:
        away = share * COMS.steering_authority - value
        value += math.copysign(min(abs(away), COMS.steering_rate * TICK), away)
        expected.append(value)
    assert added == pytest.approx(expected, abs=1e-15)
    assert (COMS.steering_authority, COMS.steering_rate) == (0.1, 0.8)
    assert np.max(added) == pytest.approx(0.1, rel=1e-14)


def test_the_front_wheels_follow_driver_and_added_angle_by_one_lag() -> None:
    rows = fast_rows(play(steered(BY_WIRE | SINE), [(0.3, 1.0)] * 300))
    tau, value = COMS.steering_lag, 0.0
    for k, row in enumerate(rows):
        command = row[FAST.steer_command] + min((k + 1) * COMS.steering_rate * TICK, 0.1)
        mean = command + (value - command) * tau / TICK * -math.expm1(-TICK / tau)
        # Simpson's error, (1 ms / 30 ms)^4 / 2880 of the deviation, and roundings
        assert abs(row[FAST.steer] - mean) < 4.3e-10 * abs(value - command) + 1e-15
        value = command + (value - command) * math.exp(-TICK / tau)
    assert np.ptp(rows[:, FAST.torque_right]) == 0.0  # the motors do not lag there


def test_it_moves_the_car_as_the_linear_model_says() -> None:
    rows = play(steered(LINEAR), [(0.2, -1.0)] * 500)
    G, H = make_bicycle_model(COMS, 25.0 / 3.6).discretise(TICK)
    x = np.zeros(2)
    for moment in rows:
        x = G @ x + H @ [moment.record.fast[0, FAST.steer], moment.info["yaw_moment"]]
        # Kutta's error: (14 / s x 1 ms)^3 / 24 = 1.14e-7 of what changes, half a rad/s
        assert moment.info["beta"] == pytest.approx(x[0], abs=6e-8)
        assert moment.info["gamma"] == pytest.approx(x[1], abs=6e-8)
    assert x[1] < -0.5


@pytest.mark.parametrize(("driver", "most"), [(0.55, 0.6), (0.7, 0.7), (0.2, 0.3), (-0.55, -0.45)])
def test_together_they_stay_within_the_stop(driver: float, most: float) -> None:
    """The driver alone may be beyond it: then nothing is added."""
    step = {"steering": "step", "amplitude": driver, "onset": -1.0, "hold": 100.0}
    env = steered(LINEAR | step, vehicle={"base": "coms", "steering_stop": 0.6})
    # far too sharp a turn for the plant, so it starts slowly and is looked at before it spins
    env.reset(seed=0, options={"state": {"v_x": 0.6}})
    rows = fast_rows(play(env, [(0.0, 1.0)] * 150))
    assert rows[-1, FAST.steer] == pytest.approx(most, abs=1e-15)


def test_its_cost_is_that_of_what_was_delivered() -> None:
    env = steered(BY_WIRE | SINE, reference="model")
    moments = play(env, [(0.5, share) for share in np.linspace(-1.0, 1.0, 400)])
    tau, added = COMS.steering_lag, 0.0
    wanted = 0.0
    for share, moment in zip(np.linspace(-1.0, 1.0, 400), moments, strict=True):
        away = float(np.float32(share)) * COMS.steering_authority - wanted
        wanted += math.copysign(min(abs(away), COMS.steering_rate * TICK), away)
        mean = wanted + (added - wanted) * tau / TICK * -math.expm1(-TICK / tau)
        added = wanted + (added - wanted) * math.exp(-TICK / tau)
        info = moment.info
        c = ((info["beta"] - info["beta_ref"]) / 0.02) ** 2
        c += ((info["gamma"] - info["gamma_ref"]) / 0.1) ** 2
        c += 0.01 * (info["yaw_moment"] / COMS.yaw_moment_limit) ** 2 + 0.01 * (mean / 0.05) ** 2
        # Simpson's error in the mean, as above
        assert info["cost"] == pytest.approx(c * TICK, rel=1e-8, abs=1e-15)


def test_its_shape_is_refused_by_name_and_strides_do_not_matter() -> None:
    env = steered(LINEAR)
    for wrong in (np.zeros(1), np.zeros((1, 2)), np.zeros(3), 0.5):
        shape = re.escape(str(np.shape(wrong)))
        with pytest.raises(ValueError, match=rf"shape \(2,\), got shape {shape}"):
            env.step(wrong)
    table = np.zeros((2, 7), np.float32)
    table[:, 3] = 0.25, -0.5
    twin = steered(LINEAR)
    assert bits(env.step(table[:, 3])) == bits(twin.step(np.array([0.25, -0.5])))


BAD = [math.nan, math.inf, -math.inf]


@pytest.mark.parametrize(
    "action",
    [*itertools.product([0.0], BAD), *itertools.product(BAD, [0.0]), (math.inf, -math.inf)],
)
def test_one_bad_entry_is_enough(action: tuple[float, float]) -> None:
    env, untouched = steered(LINEAR), steered(LINEAR)
    with pytest.raises(ValueError, match="is not finite; nothing was stepped"):
        env.step(np.array(action, np.float32))
    assert bits(play(env, [0.2] * 5)) == bits(play(untouched, [0.2] * 5))
    failing = steered(LINEAR, on_bad_action="fail")
    _, _, terminated, _, info = failing.step(np.array(action, np.float32))
    assert terminated
    assert FAILURES[info["failure"]] == "bad-action"


KMH = 1.0 / 3.6
SPEEDS = [v * KMH for v in (10.0, 15.0, 20.0, 20.73, 25.0, 30.0, 35.0, 40.0, 45.0)]
DELTA = 0.001
ROAD, CALM = RoadParams(0.0, 0.0, 1.0), DisturbanceForces(0.0, 0.0)
PAPER = PlantVariant(1, LINEAR_TYRES)


def gain(vehicle: Vehicle, V_x: float) -> float:
    """The right-hand side of tie-vision (24) as printed, in N m/rad."""
    m, l_f, l_r = vehicle.mass, vehicle.front_arm, vehicle.rear_arm
    C_f, C_r, l = vehicle.front_stiffness, vehicle.rear_stiffness, l_f + l_r  # noqa: E741
    above = 4.0 * l_r * l * C_f * C_r - 2.0 * l_f * C_f * m * V_x**2
    return above / (m * V_x**2 + 2.0 * (l_f * C_f - l_r * C_r))


@pytest.mark.parametrize("V_x", SPEEDS)
def test_it_is_minus_the_ratio_of_the_static_gains(V_x: float) -> None:
    """The middle of (24) lacks this minus: docs/reference/papers.md."""
    model = make_bicycle_model(COMS, V_x)
    (from_delta, from_moment), _ = np.linalg.solve(model.A, -model.B)
    scale = max(abs(gain(COMS, V_x)), 1e3)  # near 20.73 km/h the numerator is a difference
    assert -from_delta / from_moment == pytest.approx(gain(COMS, V_x), abs=1e-12 * scale)


def test_numbers_of_the_paper_car() -> None:
    assert round(gain(COMS, 25.0 * KMH)) == -2652
    assert gain(COMS, 20.72 * KMH) > 0.0 > gain(COMS, 20.74 * KMH)


@pytest.mark.smoke
@pytest.mark.parametrize("V_x", SPEEDS)
def test_the_plant_rests_at_zero_slip(V_x: float) -> None:
    model, N_z = make_bicycle_model(COMS, V_x), gain(COMS, V_x) * DELTA
    gamma = -(model.B[1] @ [DELTA, N_z]) / model.A[1, 1]
    T = 0.5 * N_z * COMS.wheel_radius / (0.5 * COMS.rear_track)
    load = compute_tyre_load(TyreInputs(DELTA, -T, T), make_car(COMS), PAPER)
    state = Motion(V_x, 0.0, gamma, *[0.0] * 6)
    rate = derivative(state, load, CALM, make_car(COMS), ROAD, PAPER)
    # sums of forces of some 10 N and moments of some 10 N m that cancel, over m and I
    assert abs(rate.v_y) < 1e-15
    assert abs(rate.gamma) < 1e-15


@pytest.mark.compiled
@pytest.mark.parametrize("V_x", SPEEDS)
def test_and_goes_there_from_straight_driving(V_x: float) -> None:
    held: dict[str, Any] = {"speed": V_x, "steering": "step", "amplitude": DELTA, "hold": 100.0}
    env = StabilityEnv(scenario=LINEAR | held)
    env.reset(seed=0)
    action = gain(COMS, V_x) * DELTA / COMS.yaw_moment_limit
    moments = play(env, [action] * 1000)
    assert moments[-1].truncated
    assert moments[-1].info["steer"] == DELTA
    assert max(abs(moment.info["beta"]) for moment in moments) > 1e-6
    # an action of 32 bits is 6e-8 off, of a moment that alone would turn the slip by some 1e-4
    assert abs(moments[-1].info["beta"]) < 1e-9
