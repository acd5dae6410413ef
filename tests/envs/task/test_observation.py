"""The observation, written out again from the record; its layout and its documentation."""

import re
from typing import Any

import gymnasium
import numpy as np
import pytest

from sideslip.envs import Record, SlowSensor, StabilityEnv
from sideslip.envs.numerics.functions import TICK
from sideslip.envs.record import FAST, PACKET, Fast
from sideslip.envs.sensors.slow import SENSOR_SETS, SLOW, SLOW_NAMES
from sideslip.envs.task import AGE_CAP, N_SAMPLED

from ..helpers import FULL, IDS, LINEAR, play, unwrapped

pytestmark = pytest.mark.plain
COMPILED = pytest.mark.compiled
SUMMARISED = [name for name in IDS if "fast" not in gymnasium.spec(name).kwargs]
"""The ids whose fast sensors come as last values and means, unless they are asked otherwise."""


def expected(
    env: StabilityEnv, record: Record, seen: dict[str, tuple[float, Any]], info: dict[str, Any]
) -> dict[str, float]:
    """The observation by name. `seen`: each sensor's newest (captured tick, values), kept here."""
    values: dict[str, float] = {}
    for column in range(N_SAMPLED):
        name = Fast._fields[column]
        values[name] = record.fast[-1, column]
        values[f"{name}_mean"] = float(np.sum(record.fast[:, column]) / len(record.fast))
    for name in ("steer", "torque_left", "torque_right", "steer_command", "curvature"):
        values[name] = record.fast[-1, getattr(FAST, name)]
    for sensor in env.slow_sensors:
        fresh = 0.0
        for packet in record.packets[record.packets[:, PACKET.sensor] == SLOW_NAMES.index(sensor)]:
            if packet[PACKET.captured] > seen.get(sensor, (-1.0, None))[0]:
                seen[sensor] = packet[PACKET.captured], packet[PACKET.value :]
                fresh = 1.0
        captured, newest = seen.get(sensor, (-np.inf, np.zeros(4)))
        kind = SLOW[SLOW_NAMES.index(sensor)]
        values |= {f"{sensor}_{each.name}": newest[i] for i, each in enumerate(kind.values)}
        values[f"{sensor}_age"] = min((record.ticks[-1] - captured) * TICK, AGE_CAP)
        values[f"{sensor}_fresh"] = fresh
    values |= {name: info[name] for name in ("beta_ref", "gamma_ref")}
    return {entry.name: values[entry.name] for entry in env.layout}


def compare(env: StabilityEnv, obs: np.ndarray, by_name: dict[str, float]) -> None:
    assert obs.dtype == np.float32
    assert obs.shape == (len(env.layout),) == env.observation_space.shape
    for entry, value in zip(env.layout, obs, strict=True):
        clipped = min(max(by_name[entry.name], entry.low), entry.high)
        # one rounding to 32 bits; a mean may be summed in another order
        assert value == pytest.approx(clipped, rel=6e-8, abs=1e-12), entry.name


@pytest.mark.smoke
@pytest.mark.parametrize("name", SUMMARISED)
@pytest.mark.parametrize(
    "n", [pytest.param(1, marks=COMPILED), 10, pytest.param(33, marks=COMPILED)]
)
def test_summary_is_last_mean_newest_age_and_fresh(name: str, n: int) -> None:
    env = unwrapped(name, control_period=n, scenario="slalom", reference="limited")
    seen: dict[str, tuple[float, Any]] = {}
    obs, info = env.reset(seed=1)
    compare(env, obs, expected(env, env.record, seen, info))
    for moment in play(env, np.random.default_rng(0).uniform(-1.0, 1.0, 450 // n)):
        compare(env, moment.obs, expected(env, moment.record, seen, moment.info))
    assert seen


@pytest.mark.parametrize("fast", ["summary", "all"])
def test_with_a_map_a_bend_is_seen_where_the_car_is(fast: str) -> None:
    bend = LINEAR | {"speed": 15.0, "curvature": 1.0 / 60.0, "curve_start": 20.0, "duration": 3.0}
    env = StabilityEnv(scenario=bend, fast=fast, with_map=True)
    plain = StabilityEnv(scenario=bend, fast=fast)
    (obs, _), (without, _) = env.reset(seed=0), plain.reset(seed=0)
    names = [entry.name for entry in env.layout]
    at = names.index("curvature")
    assert names[at - 1] == "steer_command" and names[:at] + names[at + 1 :] == [
        entry.name for entry in plain.layout
    ]
    found = [obs[at]]
    for moment, other in zip(play(env, [0.3] * 250), play(plain, [0.3] * 250), strict=True):
        assert moment.obs[at] == np.float32(moment.record.fast[-1, FAST.curvature])
        np.testing.assert_array_equal(np.delete(moment.obs, at), other.obs)
        found.append(moment.obs[at])
    assert 1.2 < 0.01 * np.flatnonzero(found)[0] < 1.5  # 20 m at 15 m/s
    assert found[-1] == pytest.approx(1.0 / 60.0, rel=0.3)  # of the lane beside the centre's
    assert env.observation_space.contains(moment.obs)
    np.testing.assert_array_equal(np.delete(obs, at), without)


def test_late_and_doubled_packets_are_not_fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = SlowSensor(period=0.010, delays=(0.0,), jitter=0.019, duplicate=0.5, phase=0.004)
    monkeypatch.setitem(SENSOR_SETS, "both", {"camera": camera, "gps": SlowSensor(period=0.05)})
    for n in (1, 4):
        env = StabilityEnv("both", scenario=LINEAR, control_period=n)
        seen: dict[str, tuple[float, Any]] = {}
        obs, info = env.reset(seed=1)
        compare(env, obs, expected(env, env.record, seen, info))
        stale = 0
        for moment in play(env, [0.1] * 300):
            by_name = expected(env, moment.record, seen, moment.info)
            compare(env, moment.obs, by_name)
            arrived = len(moment.record.select_packets("camera"))
            stale += arrived > 0 and by_name["camera_fresh"] == 0.0
        assert stale > 10


def test_before_the_first_packet_the_age_is_at_its_cap() -> None:
    env = StabilityEnv(scenario=LINEAR | {"camera_outage": (0.0, 0.1), "duration": 60.0})
    obs, _ = env.reset(seed=0)
    at = {entry.name: i for i, entry in enumerate(env.layout)}
    for moment in [None, *play(env, [0.5] * 12)]:
        now = obs if moment is None else moment.obs
        assert now[at["camera_psi"]] == now[at["camera_y_l"]] == now[at["camera_fresh"]] == 0.0
        assert now[at["camera_age"]] == 10.0
    gone = LINEAR | {"camera_outage": (0.02, 60.0), "duration": 60.0}
    env = StabilityEnv(scenario=gone, control_period=1000)
    env.reset(seed=0)
    moments = play(env, [0.0] * 15)
    assert moments[4].obs[at["camera_age"]] == np.float32(5.0)  # captured at tick 0
    assert moments[-1].obs[at["camera_age"]] == 10.0


@pytest.mark.parametrize("name", SUMMARISED)
@pytest.mark.parametrize("n", [1, 10])
def test_fast_all_gives_every_sample_and_leaves_the_rest_alone(name: str, n: int) -> None:
    every, summary = (unwrapped(name, control_period=n, fast=fast) for fast in ("all", "summary"))
    (obs, _), _ = every.reset(seed=2), summary.reset(seed=2)
    start = every.record.fast[0, :N_SAMPLED]
    # tick 0 stands for a whole period
    np.testing.assert_array_equal(
        obs[: N_SAMPLED * n].reshape(N_SAMPLED, n), np.float32(np.tile(start, (n, 1)).T)
    )
    actions = [0.4] * 20
    for one, other in zip(play(every, actions), play(summary, actions), strict=True):
        samples = one.obs[: N_SAMPLED * n].reshape(N_SAMPLED, n)
        np.testing.assert_array_equal(samples, np.float32(one.record.fast[:, :N_SAMPLED].T))
        np.testing.assert_array_equal(one.obs[N_SAMPLED * n :], other.obs[N_SAMPLED * 2 :])
        assert one.info == other.info


def test_fast_all_repeats_the_last_sample_after_an_early_end() -> None:
    env = StabilityEnv(scenario=FULL | {"duration": 0.015}, fast="all")
    env.reset(seed=0)
    last = play(env, [0.5, 0.5])[-1]
    assert last.truncated
    samples = last.obs[: N_SAMPLED * 10].reshape(N_SAMPLED, 10)
    np.testing.assert_array_equal(samples[:, :5], np.float32(last.record.fast[:, :N_SAMPLED].T))
    for j in range(5, 10):
        np.testing.assert_array_equal(samples[:, j], samples[:, 4])


def test_entries_are_clipped_at_their_bounds_and_angles_wrapped() -> None:
    env = StabilityEnv("gps", scenario=FULL, gps={"period": 0.01})
    state = {"psi": 7.0, "X": 9e5, "Y": -9e5, "v_x": 1e3, "gamma": 0.0}
    obs, _ = env.reset(seed=0, options={"state": state})
    at = {entry.name: i for i, entry in enumerate(env.layout)}
    assert obs[at["gps_course"]] == np.float32(7.0 - 2.0 * np.pi)
    assert obs[at["gps_X"]] == -obs[at["gps_Y"]] == 1e5
    assert obs[at["gps_speed"]] == obs[at["wheel_left"]] == 100.0
    assert env.observation_space.contains(obs)


@pytest.mark.parametrize("name", SUMMARISED)
def test_layout_names_each_entry_once_with_unit_and_the_spaces_bounds(name: str) -> None:
    env = gymnasium.make(name)
    layout = env.get_wrapper_attr("layout")
    names = [entry.name for entry in layout]
    assert len(set(names)) == len(names)
    assert all(entry.unit for entry in layout)
    space = env.observation_space
    assert isinstance(space, gymnasium.spaces.Box)
    for i, entry in enumerate(layout):
        assert (space.low[i], space.high[i]) == (np.float32(entry.low), np.float32(entry.high))
        assert -np.inf < entry.low < entry.high < np.inf


@pytest.mark.parametrize("name", SUMMARISED)
def test_length_does_not_depend_on_the_control_period(name: str) -> None:
    layouts = {unwrapped(name, control_period=n).layout for n in (1, 10, 1000)}
    assert len(layouts) == 1


@pytest.mark.parametrize("name", SUMMARISED)
def test_class_docstring_mentions_every_entry(name: str) -> None:
    text = StabilityEnv.__doc__ or ""
    table = " ".join(line for line in text.splitlines() if line.strip().startswith("|"))
    words = set(re.findall(r"[A-Za-z_0-9]+", table))
    for entry in unwrapped(name).layout:
        stem, _, suffix = entry.name.rpartition("_")
        in_common = suffix in ("mean", "age", "fresh") and f"_{suffix}" in words
        assert entry.name in words or in_common, entry.name
        assert stem in words or entry.name in words or stem in SLOW_NAMES
