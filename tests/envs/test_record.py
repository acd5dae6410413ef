"""The record: which tick a row is of, which inputs it holds, and that it tells everything."""

from typing import Any

import numpy as np
import pytest

from sideslip.envs import COMS, Log, Record, StabilityEnv
from sideslip.envs import record as columns
from sideslip.envs.engine.config import make_car
from sideslip.envs.engine.layout import Z
from sideslip.envs.numerics.functions import TICK
from sideslip.envs.record import FAST, FAST_WIDTH, PACKET_WIDTH, Fast, concatenate
from sideslip.envs.sensors.slow import SLOW, VALUES
from sideslip.envs.vehicle.dynamics import DisturbanceForces, Motion, RoadParams, kutta3
from sideslip.envs.vehicle.tyres import LINEAR as LINEAR_TYRES
from sideslip.envs.vehicle.tyres import PlantVariant, TyreInputs, compute_tyre_load

from .helpers import IDS, LINEAR, bits, play, unwrapped

SWERVING: dict[str, Any] = {"steering": "sine", "amplitude": 0.05, "frequency": 0.5}
PERIODS = (1, 10, 33)


def records(env: StabilityEnv, actions: Any, seed: int = 0) -> list[Record]:
    env.reset(seed=seed)
    return [env.record, *[moment.record for moment in play(env, actions)]]


@pytest.mark.plain
@pytest.mark.smoke
@pytest.mark.parametrize("n", PERIODS)
def test_reset_returns_tick_0_alone_and_the_step_from_tick_k_the_ticks_to_k_plus_n(n: int) -> None:
    found = records(StabilityEnv(control_period=n), [0.0] * 5)
    assert found[0].ticks.tolist() == [0]
    for step, record in enumerate(found[1:]):
        assert record.ticks.tolist() == list(range(step * n + 1, (step + 1) * n + 1))
        assert record.fast.shape == (n, FAST_WIDTH)
        assert record.dt == 0.001
        assert record.packets.shape[1] == PACKET_WIDTH


@pytest.mark.plain
def test_a_last_step_that_time_cuts_short_has_fewer_rows() -> None:
    env = StabilityEnv(scenario=LINEAR | {"duration": 0.05}, control_period=33)
    found = records(env, [0.0] * 5)
    assert [len(record.fast) for record in found] == [1, 33, 17]
    assert found[-1].ticks[-1] == 50


@pytest.mark.plain
def test_row_k_holds_the_inputs_that_acted_from_k_minus_1_to_k() -> None:
    env = StabilityEnv(scenario=LINEAR | SWERVING, control_period=3)
    actions = [0.5, -0.25, 1.0]
    found = records(env, actions)
    first = found[0].fast[0]
    assert first[[FAST.torque_left, FAST.torque_right, FAST.accel_command]].tolist() == [0.0] * 3
    assert first[FAST.steer] == first[FAST.steer_command] == 0.0  # the sine at tick 0
    for step, action in enumerate(actions):
        for k, row in zip(found[step + 1].ticks, found[step + 1].fast, strict=True):
            # roundings of numbers up to 100
            assert row[FAST.torque_right] == pytest.approx(100.0 * action, abs=1e-13)
            assert row[FAST.torque_left] == -row[FAST.torque_right]
            command = 0.05 * np.sin(2.0 * np.pi * 0.5 * (k - 1) * TICK)
            assert row[FAST.steer_command] == pytest.approx(command, abs=1e-16)
            assert row[FAST.steer] == row[FAST.steer_command]


@pytest.mark.plain
def test_inputs_of_the_rows_and_the_wind_replay_the_drive_bit_for_bit() -> None:
    """Who has these and the model has the truth: no input is late, early or missing."""
    wind = {"wind_force": 200.0, "wind_arm": 0.2, "wind_start": 0.1, "wind_length": 0.15}
    env = StabilityEnv(scenario=LINEAR | SWERVING | wind, control_period=10)
    env.reset(seed=3)
    car, road = make_car(COMS), RoadParams(0.0, 20.0, 20.0)
    plant = PlantVariant(1, LINEAR_TYRES)
    state = Motion(25.0 / 3.6, *[0.0] * 8)
    for moment in play(env, np.random.default_rng(1).uniform(-1.0, 1.0, 30)):
        for tick, row in zip(moment.record.ticks, moment.record.fast.tolist(), strict=True):
            inputs = TyreInputs(row[FAST.steer], row[FAST.torque_left], row[FAST.torque_right])
            load = compute_tyre_load(inputs, car, PlantVariant(1, LINEAR_TYRES))
            blows = 100 < tick <= 250  # it acts from tick 100 to tick 250
            push = DisturbanceForces(200.0, 0.2 * 200.0) if blows else DisturbanceForces(0.0, 0.0)
            state = kutta3(state, (load, load, load), push, car, road, TICK, plant)
        assert (state.gamma, state.psi) == (moment.info["gamma"], moment.info["psi"])
    truth = env.get_state()["state"][[*Z.motion]]
    assert bits(np.array(state)) == bits(truth)
    assert abs(state.v_y) > 0.001


@pytest.mark.plain
@pytest.mark.smoke
@pytest.mark.parametrize("name", IDS)
def test_records_of_held_actions_are_the_same_bits_for_every_control_period(name: str) -> None:
    held, whole = np.array([0.0, 0.7, -0.4]), []  # for 0.33 s each, a multiple of all periods
    for n in PERIODS:
        env = unwrapped(name, control_period=n)
        whole.append(concatenate(records(env, np.repeat(held, 330 // n), seed=8)))
    assert len(whole[0].packets) > 0
    for other in whole[1:]:
        assert bits(other) == bits(whole[0])


def test_a_record_is_a_copy() -> None:
    env, untouched = StabilityEnv(), StabilityEnv()
    for each in (env, untouched):
        each.reset(seed=0)
        play(each, [0.3] * 7)
    env.record.fast[:] = np.nan
    env.record.packets[:] = np.nan
    assert bits(env.record) == bits(untouched.record)
    moments, others = play(env, [0.3] * 3), play(untouched, [0.3] * 3)
    before = bits(moments)
    play(env, [-0.3] * 20)  # which leaves earlier records alone
    assert bits(moments) == before == bits(others)


def test_concatenate_refuses_gaps_and_repetitions() -> None:
    found = records(StabilityEnv(), [0.0] * 4)
    assert len(concatenate(found).fast) == 41
    with pytest.raises(ValueError, match=r"ends at tick 10 is .* starts at tick 21"):
        concatenate([found[0], found[1], found[3]])
    with pytest.raises(ValueError, match=r"ends at tick 10 is .* starts at tick 1$"):
        concatenate([found[1], found[1]])


def test_packets_of_picks_one_sensor() -> None:
    record = concatenate(records(StabilityEnv(), [0.0] * 50))
    assert bits(record.select_packets("camera")) == bits(record.packets)
    assert record.select_packets("gps").shape == (0, PACKET_WIDTH)


def test_columns_have_units_and_fit() -> None:
    assert len(columns.FAST_UNITS) == FAST_WIDTH == len(Fast._fields)
    assert list(FAST) == list(range(FAST_WIDTH))
    assert max(len(kind.values) for kind in SLOW) == VALUES == PACKET_WIDTH - columns.PACKET.value
    env = StabilityEnv()
    env.reset(seed=0)
    assert env.record.present == Fast._fields


def test_time_of_a_log_is_that_of_its_rows() -> None:
    record = concatenate(records(StabilityEnv(), [0.0] * 3))
    log = Log(record, {})
    assert log.time.tolist() == [tick * TICK for tick in range(31)]
