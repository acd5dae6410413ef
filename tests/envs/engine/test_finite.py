"""Whatever happens, observations, infos, records and rewards are finite numbers."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sideslip.envs import FAILURES, SCENARIOS, StabilityEnv, make_vehicle
from sideslip.envs.engine.layout import P
from sideslip.envs.vehicle.tyres import TYRE_LAWS

from ..helpers import FULL, Moment, fast_rows, play


def assert_finite(env: StabilityEnv, start: Any, moments: list[Moment]) -> None:
    for obs, info in [start, *[(moment.obs, moment.info) for moment in moments]]:
        assert env.observation_space.contains(obs)
        assert all(math.isfinite(value) for value in info.values())
    assert all(-math.inf < moment.reward <= 0.0 for moment in moments)


def without_limits(env: StabilityEnv) -> dict[str, Any]:
    """The env's snapshot with a car that may spin and go where it likes."""
    snapshot = env.get_state()
    snapshot["params"][P.task.spin] = math.inf
    snapshot["params"][P.task.half_width] = math.inf
    return snapshot


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize("sensors", ["vision", "fusion"])
def test_every_scenario_under_hard_switching(name: str, sensors: str) -> None:
    env = StabilityEnv(sensors, scenario=name, control_period=100, reference="limited")
    for seed in range(2):
        start = env.reset(seed=seed)
        moments = play(env, np.random.default_rng(seed).choice([-1.0, 1.0], 300))
        assert_finite(env, start, moments)
        assert np.all(np.isfinite(fast_rows(moments)))
        assert moments[-1].terminated or moments[-1].truncated


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_from_standstill_on_ice(name: str) -> None:
    env = StabilityEnv("gps", scenario=name, control_period=100, reference="model", strict=False)
    start = env.reset(seed=0, options={"state": {"v_x": 0.0}, "friction": 1e-9})
    moments = play(env, [1.0] * 300)
    assert_finite(env, start, moments)
    assert np.all(np.isfinite(fast_rows(moments)))


def around(typical: float) -> st.SearchStrategy[float]:
    """From a thousandth to a thousand times a typical value."""
    return st.floats(-3.0, 3.0).map(lambda power: float(typical * 10.0**power))


TYPICAL = {
    "mass": 500.0, "yaw_inertia": 200.0, "front_arm": 1.0, "rear_arm": 1.0,
    "front_stiffness_per_tyre": 6000.0, "rear_stiffness_per_tyre": 6000.0, "wheel_radius": 0.3,
    "rear_track": 1.0, "motor_torque": 100.0, "sprung_mass": 300.0, "roll_arm": 0.3,
    "roll_inertia": 100.0, "roll_stiffness": 10000.0, "roll_damping": 300.0,
}  # fmt: skip


@settings(max_examples=75)
@given(
    vehicle=st.fixed_dictionaries({name: around(value) for name, value in TYPICAL.items()}),
    state=st.fixed_dictionaries(
        {name: st.floats(-50.0, 50.0) for name in ("v_x", "v_y", "gamma", "psi", "theta", "s")}
    ),
    plant=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    tyres=st.sampled_from(TYRE_LAWS),
    slope=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    kappa=st.floats(-1.0, 1.0),
)
def test_vehicles_that_nobody_builds(
    vehicle: dict[str, float], state: dict[str, float], plant: tuple[bool, ...], tyres: str,
    slope: tuple[float, float], kappa: float,
) -> None:  # fmt: skip
    """Also where 1 ms is far too long a step for the integrator."""
    small_angle, lags, roll = plant
    try:
        make_vehicle({"base": "coms", **vehicle}, strict=False).check_roll()
    except ValueError:
        roll = False
    scenario = FULL | {
        "steering": "sine", "amplitude": 1.0, "curvature": kappa, "curve_start": 0.0,
        "small_angle": small_angle, "tyres": tyres, "lags": lags, "roll": roll, "bank": slope[0],
        "grade": slope[1], "disturbance_force": 50.0,
    }  # fmt: skip
    arguments: dict[str, Any] = {"reference": "model", "gps": {"period": 0.01}, "strict": False}
    env = StabilityEnv("gps", scenario=scenario, **arguments)
    options = {"vehicle": {"base": "coms", **vehicle}, "state": state, "duration": 0.3}
    start = env.reset(seed=0, options=options)
    moments = play(env, [1.0, -1.0] * 15)
    assert_finite(env, start, moments)
    assert moments[-1].terminated or moments[-1].truncated


def test_a_state_that_overflows_ends_the_episode() -> None:
    """A car of a gram on linear tyres: the integrator makes it a thousand times faster a tick."""
    light = {"base": "coms", "mass": 1e-3, "yaw_inertia": 1e-3}
    scenario = FULL | {"tyres": "linear", "small_angle": True}
    env = StabilityEnv(vehicle=light, scenario=scenario, reference="model", strict=False)
    start = env.reset(seed=0, options={"state": {"gamma": 0.1}})
    env.set_state(without_limits(env))
    moments = play(env, [0.0] * 100)
    assert_finite(env, start, moments)
    assert FAILURES[moments[-1].info["failure"]] == "not-finite"
