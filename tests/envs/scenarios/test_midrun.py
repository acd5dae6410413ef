"""Tyres that change in mid-run, a road that grips less on one side, and a drawn bend."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs import COMS, StabilityEnv, stability
from sideslip.envs.engine import reset as restart
from sideslip.envs.engine import step as kernel
from sideslip.envs.engine.config import make_car
from sideslip.envs.engine.layout import P
from sideslip.envs.numerics.jit import as_python
from sideslip.envs.ticks import FOREVER
from sideslip.envs.vehicle.tyres import TyreInputs, compute_tyre_load

from ..helpers import FULL, LINEAR, bits, play

pytestmark = pytest.mark.plain

TURN: dict[str, Any] = {"steering": "sine", "amplitude": 0.06, "frequency": 0.5}
CHANGE: dict[str, Any] = {"tyre_change_time": 0.503, "front_change": 0.7, "rear_change": 1.2}
BRAKING = {"speed": 8.0, "speed_change": -4.0, "change_length": 1.5, "duration": 1.5}


def states(env: StabilityEnv, steps: int) -> list[Any]:
    """The Motion's bits after each step."""
    seen = []
    for _ in range(steps):
        play(env, [0.3])
        seen.append(bits(tuple(env.motion)))
    return seen


@pytest.mark.parametrize(
    "scenario",
    [
        {"base": "double-lane-change", "onset": 0.05},
        {"base": "curved-road-driver", "curve_start": -5.0, "speed_change": -1.0},
        {"base": "stiffness-step", "tyre_change_time": (0.1, 0.3)},
        {"base": "split-friction", "change_start": 0.1},
        {"base": "sine-with-dwell", "onset": 0.0, "frequency": 4.0, "hold": 0.1},
        {"base": "sine", "steering": "sweep", "onset": 0.1, "hold": 0.2, "frequency_2": 3.0},
        {"base": "sine", "steering": "ramp", "onset": 0.1, "hold": 0.2},
    ],
    ids=lambda scenario: f"{scenario['base']} {scenario.get('steering', '')}",
)
def test_whole_steps_have_the_same_bits_without_the_compiler(
    scenario: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def episode() -> Any:
        env = StabilityEnv("fusion", scenario=scenario, reference="model", steering=True)
        start = env.reset(seed=5)
        moments = play(env, np.random.default_rng(3).uniform(-1.0, 1.0, (40, 2)))
        return bits((start, moments, env.get_state()["state"], env.get_state()["params"]))

    compiled = episode()
    monkeypatch.setattr(stability, "reset_vehicle", as_python(restart.reset_vehicle))
    step = as_python(kernel.step_workspace)
    monkeypatch.setattr(stability, "_compile_step", lambda: step)
    assert episode() == compiled


@pytest.mark.parametrize("lags", [False, True])
@pytest.mark.parametrize("plant", [LINEAR, FULL])
def test_the_plant_is_another_from_the_tick_of_the_change_on(
    plant: dict[str, Any], lags: bool
) -> None:
    scene = plant | TURN | {"lags": lags}
    same = StabilityEnv("fusion", scenario=scene, control_period=1)
    changing = StabilityEnv("fusion", scenario=scene | CHANGE, control_period=1)
    same.reset(seed=0)
    changing.reset(seed=0)
    assert states(same, 503) == states(changing, 503)
    # from here on it moves as a car that always had those tyres, in the same state
    snapshot = changing.get_state()
    snapshot["params"][P.car.C_f] *= 0.7
    snapshot["params"][P.car.C_r] *= 1.2
    snapshot["params"][P.tyre_change.tick] = FOREVER
    later = states(changing, 60)
    assert later[0] != states(same, 1)[0]
    changing.set_state(snapshot)
    assert states(changing, 60) == later


def test_the_change_does_not_depend_on_the_control_period() -> None:
    ends = set()
    for n in (1, 10, 40):
        env = StabilityEnv("fusion", scenario=FULL | TURN | CHANGE, control_period=n)
        env.reset(seed=0)
        ends.add(states(env, 800 // n)[-1])
    assert len(ends) == 1


def test_the_env_tells_its_tyres_now() -> None:
    env = StabilityEnv("fusion", scenario=FULL | CHANGE, control_period=1)
    env.reset(seed=0)
    play(env, [0.0] * 502)
    assert (env.vehicle.front_stiffness, env.vehicle.rear_stiffness) == (6000.0, 6000.0)
    play(env, [0.0])
    assert env.vehicle.front_stiffness == pytest.approx(4200.0)
    assert env.vehicle.rear_stiffness == pytest.approx(7200.0)
    env.reset(seed=1)
    assert env.vehicle.front_stiffness == 6000.0


def test_each_rear_tyre_has_its_sides_grip_and_the_front_ones_the_mean() -> None:
    car = make_car(COMS)._replace(mu=0.9, mu_r=0.3)
    load = compute_tyre_load(TyreInputs(0.0, -100.0, -100.0), car, 0)
    high = compute_tyre_load(TyreInputs(0.0, -100.0, -100.0), car._replace(mu_r=0.9), 0)
    low = compute_tyre_load(TyreInputs(0.0, -100.0, -100.0), car._replace(mu=0.3), 0)
    assert (load.rear_l, load.limit_l, load.slope_l) == (high.rear_l, high.limit_l, high.slope_l)
    assert (load.rear_r, load.limit_r, load.slope_r) == (low.rear_r, low.limit_r, low.slope_r)
    assert load.limit_f == pytest.approx(0.5 * (high.limit_f + low.limit_f), rel=1e-14)
    braked_l, braked_r = 100.0 / COMS.wheel_radius, 0.3 * 380.0 * 9.81 * 0.8 / 2.8
    assert load.F_x == pytest.approx(-braked_l - braked_r, rel=1e-12)
    assert load.N_z == pytest.approx(0.41 * (braked_l - braked_r), rel=1e-12)


@pytest.mark.parametrize("roll", [False, True])
def test_braking_on_split_friction_yaws_the_car_to_the_side_that_grips(roll: bool) -> None:
    yawed = []
    for split in ({}, {"friction_right": 0.2}, {"friction_right": 0.9, "friction": 0.2}):
        env = StabilityEnv("fusion", scenario=FULL | {"roll": roll} | BRAKING | split)
        env.reset(seed=0)
        play(env, [0.0] * 150)
        yawed.append(env.motion.psi)
        assert env.motion.v_x < 7.0
    assert abs(yawed[0]) < 1e-9
    assert yawed[1] > 0.01  # to the left, where the road grips
    assert yawed[2] == pytest.approx(-yawed[1], rel=1e-9)


def test_the_same_friction_on_both_sides_is_no_split() -> None:
    seen = []
    for split in ({}, {"friction_right": 0.9}):
        env = StabilityEnv("fusion", scenario=FULL | TURN | split)
        env.reset(seed=0)
        seen.append(states(env, 100))
        assert env.vehicle.friction == 0.9
    assert seen[0] == seen[1]


def test_the_seed_draws_the_side_that_slips_and_that_of_the_bend() -> None:
    scene = {"base": "curved-road", "friction_right": (0.2, 0.3)}
    env = StabilityEnv("fusion", scenario=scene)
    seen = []
    for seed in range(30):
        env.reset(seed=seed)
        params = env.get_state()["params"]
        left, right, curvature = params[P.car.mu], params[P.car.mu_r], params[P.road.curvature]
        assert 0.01 <= abs(curvature) <= 0.03
        low, high = sorted((left, right))
        assert 0.2 <= low <= 0.3
        assert 0.7 <= high <= 1.0
        assert (right == low) == (curvature > 0.0)  # one side for all
        assert env.vehicle.friction == 0.5 * (left + right)
        seen.append(curvature > 0.0)
    assert 5 < np.sum(seen) < 25
