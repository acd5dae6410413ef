"""Scenarios: draws within their ranges, files, what is refused, and the tiers."""

import dataclasses
import json
import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from sideslip.envs import COMS, PASSENGER_CAR, SCENARIOS, Scenario, StabilityEnv, make_scenario
from sideslip.envs.engine.config import make_car
from sideslip.envs.engine.layout import Z
from sideslip.envs.scenarios.manoeuvres import TIERS
from sideslip.envs.scenarios.world import DRAWS_WIDTH, KMH, Draws, _is_stable, draw_stable

from ..helpers import play

pytestmark = pytest.mark.plain

CAR = make_car(COMS)
POSITIVE = (
    *("friction", "frequency", "frequency_3", "disturbance_time", "curve_ramp", "half_width"),
    *("hdop", "camera_heading", "surge_frequency", "driver_preview", "driver_rate", "front_change"),
)
ROAD: dict[str, Any] = {"road": "nominal-path"}
TRACK: dict[str, Any] = {"steering": "driver", "path": "iso-3888-2"}
DRAWN = [name for name, scenario in SCENARIOS.items() if scenario.mirror]


def draws(name: str, count: int, first: int = 0) -> tuple[list[Draws], list[int]]:
    """(drawn numbers, unstable attempts) of the keys first, first + 1, ..."""
    low, high = SCENARIOS[name].get_draw_ranges()
    fast = SCENARIOS[name].tier[:1] in ("2", "r", "l") or name == "wet-evasion"
    car = make_car(PASSENGER_CAR) if fast else CAR
    drawn, lost = [], []
    for key in range(first, first + count):
        each, attempts = draw_stable(low, high, key, 77, car, np.zeros(DRAWS_WIDTH))
        drawn.append(each)
        lost.append(attempts)
    return drawn, lost


@pytest.mark.parametrize("name", DRAWN)
def test_draws_lie_in_their_ranges_and_fill_them(name: str) -> None:
    # at 110 km/h many cars are near their critical speed and drawn anew
    values = np.array(draws(name, 1600 if name.startswith("limit") else 400)[0], np.float64)
    low, high = SCENARIOS[name].get_draw_ranges()
    assert np.all((low <= values) & (values <= high))
    fixed = low == high
    assert np.all(values[:, fixed] == low[fixed])  # bit for bit, without rounding
    width = (high - low)[~fixed]
    assert np.all(values[:, ~fixed].min(axis=0) < low[~fixed] + 0.05 * width)  # 0.95^400 = 1e-9
    assert np.all(values[:, ~fixed].max(axis=0) > high[~fixed] - 0.05 * width)


@pytest.mark.smoke
def test_the_same_key_draws_the_same_and_another_draws_anew() -> None:
    one, again, other = draws("sine", 5), draws("sine", 5), draws("sine", 5, first=5)
    assert one == again
    assert not {each.speed for each in one[0]} & {each.speed for each in other[0]}


def test_quantities_are_drawn_independently() -> None:
    """Of a slow car, which no pair of tyres makes unstable: nothing is drawn again."""
    low, high = SCENARIOS["random-steering"].replace(speed=1.0).get_draw_ranges()
    out = np.zeros(DRAWS_WIDTH)
    values = np.array([draw_stable(low, high, key, 77, CAR, out)[0] for key in range(3000)])
    free = np.flatnonzero(low < high)
    shares = ((values - low) / np.where(low < high, high - low, 1.0))[:, free]
    for column in shares.T:
        assert stats.kstest(column, "uniform").pvalue > 1e-3  # fixed keys: passed once and for all
    mixed = np.corrcoef(shares.T) - np.eye(len(free))
    assert np.abs(mixed).max() < 5.0 / np.sqrt(3000)  # five standard errors


def test_half_of_the_draws_are_mirrored() -> None:
    values = draws("gust", 1000)[0]
    for side in ("side", "wind_side"):
        left = sum(getattr(each, side) < 0.5 for each in values)
        assert abs(left - 500) < 4.0 * math.sqrt(250.0)  # four standard deviations
    assert all(each.side == each.wind_side == 1.0 for each in draws("tie-vision-fig7", 10)[0])


def test_unstable_draws_are_drawn_again_and_counted() -> None:
    drawn, lost = draws("straight", 1000)
    assert all(_is_stable(each, CAR) for each in drawn)
    share = sum(lost) / (1000 + sum(lost))
    assert 0.0 < share < 0.15  # 15 % at 40 km/h, where these are fastest
    fast = make_scenario({"base": "straight", "speed": 40.0 / 3.6})
    low, high = fast.get_draw_ranges()
    lost = [draw_stable(low, high, key, 1, CAR, np.zeros(DRAWS_WIDTH))[1] for key in range(2000)]
    share = sum(lost) / (2000 + sum(lost))
    # independently: U(0.6, 1.4) twice and the critical speed, with 5 % of speed to spare
    rng = np.random.default_rng(0)
    f, r = rng.uniform(0.6, 1.4, (2, 100_000))
    excess = 6000.0 * (f * 0.8 - r * 0.6)
    limit = 2.0 * 6000.0**2 * f * r * 1.4**2 / (380.0 * np.maximum(excess, 1e-9))
    exact = np.mean((excess > 0.0) & (limit < (1.05 * 40.0 / 3.6) ** 2))
    # four standard errors of the share of some 2400 draws, and of the reference
    assert abs(share - exact) < 4.0 * math.sqrt(exact * (1.0 - exact) * (1 / 2400 + 1 / 1e5))


def test_the_env_tells_its_redraws_and_has_the_drawn_vehicle() -> None:
    env = StabilityEnv(scenario={"base": "straight", "speed": 40.0 / 3.6})
    seen = []
    for seed in range(60):
        env.reset(seed=seed)
        seen.append(env.packed_state[Z.clock.redraws])
        low, high = 0.6 * 6000.0, 1.4 * 6000.0
        assert low <= env.vehicle.front_stiffness <= high
        assert 0.7 <= env.vehicle.friction <= 1.0
        assert env.nominal == COMS
    assert max(seen) > 0
    assert min(seen) == 0


@pytest.mark.parametrize(("front", "rear"), [(0.8, 1.2), (1.3, 0.9)])
def test_each_axle_has_its_own_draw(front: float, rear: float) -> None:
    """The drawn car drives as one built with these tyres, of which nothing is drawn."""
    turning: dict[str, Any] = {"base": "sine", "speed": 7.0, "friction": 0.9, "onset": 0.0}
    stiffness = 6000.0 * front, 6000.0 * rear
    own = dict(zip(("front_stiffness_per_tyre", "rear_stiffness_per_tyre"), stiffness, strict=True))
    rows = []
    for (f, r), vehicle in (((front, rear), {}), ((1.0, 1.0), own)):
        drawn = turning | {"front_stiffness": f, "rear_stiffness": r}
        env = StabilityEnv(scenario=drawn, vehicle={"base": "coms"} | vehicle)
        env.reset(seed=2)
        rows.append([tuple(play(env, [0.2]) and env.motion) for _ in range(100)])
        assert (env.vehicle.front_stiffness, env.vehicle.rear_stiffness) == stiffness
    assert rows[0] == rows[1]


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_name_is_the_scenario_and_a_base(name: str) -> None:
    scenario = SCENARIOS[name]
    assert make_scenario(scenario) is make_scenario(name) is scenario
    assert make_scenario({"base": name, "duration": 3.0}) == scenario.replace(duration=3.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steering": "figure-of-eight"}, r"unknown steering 'figure-of-eight'; known: straight,"),
        ({"duration": 0.0}, "duration 0.0"),
        ({"speed": -1.0}, "speed must not be negative"),
        ({"speed": (9.0, 8.0)}, r"speed \(9.0, 8.0\)"),
        ({"front_stiffness": (-0.1, 1.0)}, "front_stiffness must be positive"),
        ({"noise": {"gyro": math.nan}}, "noise gyro nan is not finite"),
        ({"tyres": "magic"}, "unknown tyres 'magic'; known: linear, fiala, dugoff, magic-formula"),
        ({"tier": "3"}, "unknown tier '3'; known: , 1, 2a, 2b, 2c"),
        ({"hdop_law": "squared"}, "unknown hdop_law 'squared'; known: constant, half, table"),
        ({"hdop_spread": 2.0}, "hdop_spread is 0 to 1, got 2.0"),
        ({"hdop_time": -1.0}, "hdop_time must be positive"),
        ({"gps_period": 0.01}, "gps_period is 0.05 s or more, got 0.01"),
        ({"camera_jitter": 0.01}, "camera_jitter needs camera_delays"),
        ({"camera_loss": 1.0}, "camera_loss is a probability below 1, got 1.0"),
        ({"bank": 1.0}, "bank and grade are up to 0.5 rad, got 1.0, 0.0"),
        ({"bank": (-0.6, 0.1)}, r"bank and grade are up to 0.5 rad, got \(-0.6, 0.1\), 0.0"),
        ({"initial_beta": (0.0, 1.6)}, r"initial_beta is up to 1.5 rad, got \(0.0, 1.6\)"),
        ({"gyro_bias": (0.1, -0.1)}, r"gyro_bias \(0.1, -0.1\) is not finite, or its ends are"),
        ({"gps_latency": (-0.1, 0.1)}, r"gps_latency is zero or more, got \(-0.1, 0.1\)"),
        ({"speed": 5.0, "speed_change": -6.0}, "speed must not be negative"),
        ({"speed_change": 1.0, "acceleration": 0.0}, "need the held speed"),
        ({"surge": 1.0, "acceleration": 0.5}, "need the held speed"),
        ({"change_length": 0.0001}, "change_length is 0.001 s at least, got 0.0001"),
        ({"path": "iso-3888-3"}, "unknown path 'iso-3888-3'; did you mean 'iso-3888-"),
        ({"path": "iso-3888-1"}, "path 'iso-3888-1' needs the steering 'driver', got 'straight'"),
        ({"steering": "driver", "path_speed": 9.0}, "path_speed needs a track as path"),
        (TRACK | {"path_speed": (0.0, 9.0)}, r"path_speed must be positive or None, got \(0.0"),
        (TRACK | {"path_speed": 9.0, "speed": (0.0, 9.0)}, "path_speed needs a speed above zero"),
        ({"driver_lag": -0.1}, "driver_lag is zero or more, got -0.1"),
        ({"friction_right": 0.0}, "friction_right must be positive or None, got 0.0"),
        ({"tyre_change_time": -1.0}, "tyre_change_time must be positive or None, got -1.0"),
        ({"rear_change": (1.0, 0.5)}, r"rear_change \(1.0, 0.5\) is not finite, or its ends are"),
        ({"front_change": 0.7}, "front_change 0.7 needs a tyre_change_time, from which it acts"),
        ({"rear_change": (0.7, 1.0)}, r"rear_change \(0.7, 1.0\) needs a tyre_change_time"),
        ({"curvature": (0.1, math.nan)}, r"curvature \(0.1, nan\) is not finite"),
        ({"steering": "ramp", "hold": 0.0}, "hold of a ramp is 1 ms or more, got 0.0"),
        ({"steering": "sweep", "hold": 0.0}, "hold of a sweep is 1 ms or more, got 0.0"),
        ({"steering": "sine-with-dwell", "hold": -0.5}, "hold of a dwell is not negative"),
        ({"road": "winding"}, "unknown road 'winding'; known: straight, nominal-path"),
        (ROAD | {"steering": "driver"}, "follows a programme's steering"),
        (ROAD | {"curvature": 0.01}, "has no curvature, got 0.01"),
        ({"amplitude": math.nan}, "amplitude nan is not finite"),
        ({"duration": math.inf}, "duration inf is not finite"),
        *(({name: 0.0}, f"{name} must be positive, got 0.0") for name in POSITIVE),
    ],
)
def test_values_that_cannot_be_are_refused_by_name(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"scenario 'bad': .*{message}"):
        Scenario(name="bad", **changes)


def test_a_scenario_is_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        SCENARIOS["sine"].duration = 3.0  # type: ignore[misc]


ODD = Scenario(
    name='a "name" \\ with\tall\x7f \u00e9\U0001f600', steering="trace", speed=(5.0, 6.0),
    trace=(0.0, -1e-17, 0.1 + 0.2), camera_heading=0.5, mirror=True, noise={"gyro": 1e-300},
    vehicle={"mass": 400},
)  # fmt: skip


@pytest.mark.parametrize("ending", ["toml", "json"])
def test_what_is_written_is_read_back(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"it.{ending}"
    for scenario in (*SCENARIOS.values(), ODD):
        scenario.write(path)
        assert make_scenario(path) == make_scenario(str(path)) == scenario
        assert make_scenario(json.loads(json.dumps(scenario.to_dict()))) == scenario


def test_a_file_starts_from_a_name_or_a_file_beside_it(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text('base = "gust"\nspeed = [4.0, 5.0]\n')
    (tmp_path / "other.json").write_text('{"base": "mine.toml", "friction": 0.5, "name": "o"}')
    mine, other = (make_scenario(tmp_path / name) for name in ("mine.toml", "other.json"))
    assert mine == SCENARIOS["gust"].replace(name="mine", speed=(4.0, 5.0))
    assert other == mine.replace(name="o", friction=0.5)
    env = StabilityEnv(scenario=str(tmp_path / "mine.toml"))
    env.reset(seed=0, options={"scenario": tmp_path / "other.json"})
    assert env.scenario == other


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        ("speed = ", ValueError, "expected TOML, but"),
        ("speeed = 5.0", TypeError, "unknown scenario field 'speeed'; did you mean 'speed'"),
        ('base = "gusts"', ValueError, "unknown scenario 'gusts'; did you mean 'gust'"),
        ('steering = "driven"', ValueError, "unknown steering 'driven'; did you mean 'driver'"),
        ("speed = -1.0", ValueError, "speed must not be negative"),
        ('steering = "trace"', ValueError, "trace has 2 to 1000000 angles"),
        ("trace = [0.1, 0.2]", ValueError, "trace has 2 to 1000000 angles"),
        ('steering = "trace"\ntrace = [0.1, nan]', ValueError, "trace is angles in rad, finite"),
        ('steering = "trace"\ntrace = [0, 1]\ntrace_step = 0', ValueError, "trace_step is 0.001"),
        ('base = "bad.toml"', ValueError, "its base is the file itself"),
        ('base = "good.toml"', ValueError, "its base is the file itself, or leads back to it"),
        ("", ValueError, "holds nothing"),
    ],
)
def test_a_bad_file_is_refused(
    tmp_path: Path, content: str, error: type[Exception], message: str
) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(content)
    (tmp_path / "good.toml").write_text('base = "bad.toml"')
    with pytest.raises(error, match=message) as caught:
        make_scenario(path)
    assert str(path) in str(caught.value)


def test_what_is_no_scenario(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.toml: there is no such scenario file"):
        make_scenario("nowhere.toml")
    with pytest.raises(FileNotFoundError, match=r"nowhere\.csv"):
        make_scenario("nowhere.csv")
    with pytest.raises(ValueError, match=r"ends in \.toml or \.json"):
        make_scenario(tmp_path / "drive.txt")
    with pytest.raises(ValueError, match=r"ends in \.toml or \.json"):
        ODD.write(tmp_path / "it.yaml")
    with pytest.raises(TypeError, match="a scenario is a name, the path of"):
        make_scenario(5)  # type: ignore[arg-type]


SPEEDS = {"1": (18.0, 28.0), "2a": (60.0, 80.0), "2b": (60.0, 80.0), "2c": (55.0, 85.0)}  # km/h
SPEEDS |= {"small car": (18.0, 28.0), "road": (60.0, 90.0), "limit": (70.0, 110.0)}
FRICTIONS = {"1": (0.7, 1.0), "2a": (0.9, 1.0), "2b": (0.3, 1.0), "2c": (0.6, 1.0)}
FRICTIONS |= {"small car": (0.7, 1.0), "road": (0.4, 1.0), "limit": (0.3, 1.0)}
NAMES = [scenario.name for scenario in TIERS if scenario.tier]


def vehicle_of(name: str) -> str:
    """The preset that a tier's scenario is meant for."""
    return "coms" if SCENARIOS[name].tier in ("1", "small car") else "passenger-car"


def test_every_tier_has_at_least_three_and_both_classes_of_version_0_five() -> None:
    count = Counter(SCENARIOS[name].tier for name in NAMES)
    assert min(count.values()) >= 3
    assert count["1"] >= 5
    assert count["2a"] == count["2b"] >= 5
    assert {name for name, each in SCENARIOS.items() if each.tier} == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_table_of_actions_would_need_every_draw(name: str) -> None:
    """Onset, side, speed, tyres and friction, and the manoeuvre's size and its pace."""
    scenario = SCENARIOS[name]
    low, high = scenario.get_draw_ranges()
    drawn = {Draws._fields[i] for i in np.flatnonzero(low < high)}
    assert {"gyro_bias", "accel_y_bias", "gps_latency", "bank"} <= drawn
    assert {"side", "speed", "friction", "front_stiffness", "rear_stiffness"} <= drawn
    sizes = {"path_speed", "friction_right", "wind_force"}
    assert {"onset", "friction_right", "wind_start"} & drawn
    size = sizes & drawn if scenario.steering == "driver" else {"amplitude"}
    pace = {"step": {"hold"}, "held-step": set(), "driver": set()}
    assert size and size | pace.get(scenario.steering, {"frequency"}) <= drawn
    for field, unit, ranges in (("speed", KMH, SPEEDS), ("friction", 1.0, FRICTIONS)):
        least, most = scenario.range(field)
        assert least >= ranges[scenario.tier][0] * unit - 1e-9
        assert most <= ranges[scenario.tier][1] * unit + 1e-9


@pytest.mark.compiled
@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith(("limit", "road"))])
def test_a_car_without_control_mostly_gets_through(name: str) -> None:
    """Otherwise survival alone would decide the score, not how well the car is kept."""
    env = StabilityEnv("fusion", scenario=name, vehicle=vehicle_of(name), control_period=100)
    ends = []
    for seed in range(8):
        env.reset(seed=seed)
        ends.append(play(env, [0.0] * 200)[-1].terminated)
    assert sum(ends) <= 2


def test_numbers_of_a_base_that_are_not_named_stay() -> None:
    base = make_scenario("coms-slalom")
    changed = make_scenario({"base": "coms-slalom", "vehicle": {"roll_damping": 1200.0}})
    assert base.vehicle and changed.vehicle == {**base.vehicle, "roll_damping": 1200.0}
    assert changed.nominal == base.nominal
