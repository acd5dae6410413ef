"""A recorded steering trace is driven again, and a driver wanders, alone and in a batch."""

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv

from sideslip.agents.clairvoyant.forecast import make_forecast
from sideslip.envs import StabilityEnv, make_scenario
from sideslip.envs.device import make_device_env
from sideslip.envs.record import FAST

from .. import batches
from ..helpers import bits
from ..recordings.drives import drive, saved

VISION = "sideslip/YawVision-v0"
TRACE: dict[str, Any] = {"steering": "trace", "trace": [0.0, 0.03, -0.02, 0.01], "duration": 0.2}


def commands(env: StabilityEnv, seed: int = 0, **options: Any) -> Any:
    """The driver's steering command at the ticks of an episode but the last, (T,)."""
    env.reset(seed=seed, options=options)
    rows, over = [env.record.fast[:, FAST.steer_command]], False
    while not over:
        _, _, terminated, truncated, _ = env.step(np.zeros(1, np.float32))
        rows.append(env.record.fast[:, FAST.steer_command])
        over = terminated or truncated
    return np.concatenate(rows)[1:]  # a row has what acted before it


def test_a_log_is_driven_again(tmp_path: Path) -> None:
    """Its angles at its times, from its first row on, at its first speed."""
    table = drive(rows=41, dt=0.02)
    path = saved(table, tmp_path)
    scenario = make_scenario(str(path))
    assert scenario.duration == 0.8 and scenario.name == "drive"
    assert scenario.speed == pytest.approx(table["speed_x_mps"][0], rel=1e-12)
    driven = commands(StabilityEnv(scenario=str(path), vehicle="passenger-car"))
    times = table["time_s"] - table["time_s"][0]
    expected = np.interp(1e-3 * np.arange(800), times, table["steer_rad"])
    np.testing.assert_allclose(driven, expected, rtol=0.0, atol=1e-15)


def test_a_log_needs_time_and_steering_alone_and_a_mapping_changes_the_rest(tmp_path: Path) -> None:
    table = drive()[["time_s", "steer_rad"]]
    path = saved(table.rename(columns={"steer_rad": "delta"}), tmp_path)
    with pytest.raises(ValueError, match=r"drive\.csv: no column steer_rad"):
        make_scenario(path)
    made = make_scenario(saved(table, tmp_path))
    assert made.trace == tuple(table["steer_rad"])
    (tmp_path / "icy.toml").write_text('base = "drive.csv"\nfriction = 0.3\n')
    assert make_scenario(tmp_path / "icy.toml") == made.replace(name="icy", friction=0.3)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("steer_rad", np.nan, r"'steer_rad' has no value \(NaN\) in row 8"),
        ("time_s", 1.0, "time runs backward at row 8"),
        ("time_s", 3.06, "time stands still at row 8"),
    ],
)
def test_a_bad_log_is_refused(tmp_path: Path, column: str, value: float, message: str) -> None:
    table = drive()
    table.loc[7, column] = value
    with pytest.raises(ValueError, match=rf"drive\.csv: .*{message}"):
        make_scenario(saved(table, tmp_path))


def test_the_last_angle_stays_and_a_mirrored_trace_is_its_negative() -> None:
    env = StabilityEnv(scenario={**TRACE, "mirror": True})
    expected = np.interp(np.arange(200), 10 * np.arange(4), TRACE["trace"])
    signs = set()
    for seed in range(8):
        driven = commands(env, seed)
        sign = np.sign(driven[-1])
        np.testing.assert_allclose(driven, sign * expected, rtol=0.0, atol=1e-15)
        signs.add(sign)
    assert signs == {-1.0, 1.0}


def test_a_reset_option_may_bring_a_trace_and_take_it_away() -> None:
    env = StabilityEnv(scenario={"base": "slalom", "duration": 0.3})
    before = commands(env)
    snapshot = env.get_state()
    assert commands(env, scenario=TRACE)[10] == pytest.approx(0.03, abs=1e-15)
    assert bits(commands(env)) == bits(before)
    env.reset(options={"scenario": TRACE})
    env.set_state(snapshot)
    assert bits(env.get_state()["params"]) == bits(snapshot["params"])
    cars: Any = gym.make_vec(VISION, 2)
    cars.reset(seed=0)
    snapshot = cars.get_state()
    cars.reset(seed=0, options={"scenario": [None, TRACE]})
    cars.set_state(snapshot)
    assert bits(cars.get_state()["params"]) == bits(snapshot["params"])


WANDER: dict[str, Any] = {"steering": "wander", "amplitude": 0.01, "frequency": 2.0}
WANDER |= {"hold": 0.02, "duration": 0.5}


def wander(n: int = 10, seed: int = 0, **changes: Any) -> Any:
    return commands(StabilityEnv(scenario=WANDER | changes, control_period=n), seed)


def test_the_angle_is_of_the_seed_alone_and_is_held() -> None:
    angles = wander()
    assert bits(wander(7)) == bits(angles)
    assert bits(wander(1, vehicle={"mass": 500.0})) == bits(angles)
    assert bits(wander(seed=1)) != bits(angles)
    moved = 1 + np.flatnonzero(np.diff(angles))
    np.testing.assert_array_equal(moved, np.arange(20, 500, 20))


def test_it_is_stationary_and_forgets_at_its_rate() -> None:
    """From the reset on: standard deviation, correlation of neighbours, white innovations."""
    angles = np.array([wander(100, seed, duration=4.0)[::20] for seed in range(24)])
    keep = np.exp(-2.0 * np.pi * 2.0 * 0.02)
    fresh = (angles[:, 1:] - keep * angles[:, :-1]) / (0.01 * np.sqrt(1.0 - keep**2))
    count = fresh.size
    for numbers in (fresh, angles[:, ::20] / 0.01, angles[:, 0] / 0.01):
        assert abs(np.mean(numbers)) < 3.0 / np.sqrt(numbers.size)
        assert abs(np.mean(numbers**2) - 1.0) < 3.0 * np.sqrt(2.0 / numbers.size)
    for lag in (1, 2, 5):  # white, across env-steps too
        assert abs(np.mean(fresh[:, lag:] * fresh[:, :-lag])) < 3.0 / np.sqrt(count - 24 * lag)


def test_rows_of_a_batch_are_the_environment_alone() -> None:
    """Traces of several lengths and wanderers beside a programme and a driver, in lanes, too."""
    longer = {**TRACE, "trace": [0.05 * np.sin(k) for k in range(30)], "mirror": True}
    slalom = {"base": "slalom", "duration": 0.3}
    rows: list[Any] = [TRACE, slalom, longer, "car-iso-3888-1", WANDER, WANDER | {"hold": 0.05}] * 4
    told: dict[str, Any] = {"control_period": 7, "on_bad_action": "fail"}
    alone = SyncVectorEnv([partial(gym.make, VISION, scenario=each, **told) for each in rows])
    together = batches.batch(VISION, len(rows), scenario=rows, **told)
    batches.same(alone.reset(seed=5), together.reset(seed=5))
    batches.drive(alone, together, 100)


@pytest.mark.parametrize("scenario", [TRACE, WANDER], ids=["trace", "wander"])
def test_a_forecast_knows_the_angles_and_a_device_refuses_them(scenario: dict[str, Any]) -> None:
    env = StabilityEnv(scenario=scenario)
    env.reset(seed=0)
    expected = np.interp(np.arange(200), 10 * np.arange(4), TRACE["trace"])
    expected = wander() if scenario is WANDER else expected
    np.testing.assert_allclose(make_forecast(env).driver.ravel(), expected, rtol=0.0, atol=1e-15)
    pytest.importorskip("torch")
    with pytest.raises(ValueError, match=f"'custom': no {scenario['steering']} is driven on a dev"):
        make_device_env(VISION, scenario=scenario)
