"""A world's errors: each does what it is named after, and nothing else changes."""

import dataclasses
import importlib
import json
import math
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest

import sideslip
from sideslip.envs import StabilityEnv
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.scenarios.scenario import Scenario
from sideslip.envs.scenarios.world import GROUPS, IDEAL, WORLDS, Draws, World, make_world
from sideslip.envs.sensors.inertial import CAMERA_HEIGHT
from sideslip.envs.task import RATE_TICKS
from sideslip.envs.vehicle.parameters import GRAVITY, PASSENGER_CAR, critical_speed
from sideslip.estimators import EstimateObservation

from ..batches import drive, pair, same
from ..helpers import FULL, V1, Moment, fast_rows, packets, play

SWERVING: dict[str, Any] = {"steering": "sine", "amplitude": 0.03, "frequency": 0.4}
QUIET: dict[str, Any] = {"duration": 3.0, "speed": 15.0, "half_width": 1e3} | SWERVING
SCENARIO = FULL | QUIET | {"roll": True}
NAMES = [entry.name for entry in dataclasses.fields(World)]
ERRS = World(course_period=11.0)
"""An error of amplitude zero: the code of a world that is not ideal runs."""


def swerve(world: Any, steps: int = 300, action: float = 0.2, **changes: Any) -> list[Moment]:
    """Steps of a passenger car that swerves, without noise."""
    told = {"scenario": SCENARIO, "vehicle": "passenger-car", "world": world, "with_map": True}
    env = StabilityEnv("fusion", **(told | changes))
    env.reset(seed=4)
    return play(env, [action * (-1.0) ** (k // 7) for k in range(steps)])


CLEAN = swerve("ideal")
ROWS = fast_rows(CLEAN)


@pytest.mark.parametrize("scenario", [SCENARIO, "car-slalom", "coms-double-lane-change"])
def test_a_world_without_errors_is_the_ideal_one(scenario: Any) -> None:
    """To the last digit, though its code is another."""
    clean, errs = swerve("ideal", scenario=scenario), swerve(ERRS, scenario=scenario)
    for one, other in zip(clean, errs, strict=True):
        np.testing.assert_array_equal(one.obs, other.obs)
        assert one.reward == other.reward
        np.testing.assert_array_equal(one.record.fast, other.record.fast)
        np.testing.assert_array_equal(one.record.packets, other.record.packets)


def test_a_world_draws_what_draws_have() -> None:
    drawn = set(Draws._fields) - set(Scenario.__dataclass_fields__) - {"side", "wind_side", "phase"}
    assert set(NAMES) - {"tyres", "moment_rate"} == drawn


TIME = 1e-3 * np.arange(1, len(ROWS) + 1)
MEASURED: list[tuple[dict[str, float], int, Any]] = [
    ({"steer_offset": 0.002}, FAST.steer, ROWS[:, FAST.steer] + 0.002),
    ({"steer_offset": 0.002}, FAST.steer_command, ROWS[:, FAST.steer_command] + 0.002),
    ({"steer_scale": 1.03}, FAST.steer, 1.03 * ROWS[:, FAST.steer]),
    ({"wheel_scale": 1.01}, FAST.wheel_right, 1.01 * ROWS[:, FAST.wheel_right]),
    ({"wheel_scale": 1.01, "wheel_left": 0.99}, FAST.wheel_left,
     1.01 * 0.99 * ROWS[:, FAST.wheel_left]),
    ({"gyro_scale": 0.98}, FAST.gyro, 0.98 * ROWS[:, FAST.gyro]),
    ({"gyro_drift": 1e-3}, FAST.gyro, ROWS[:, FAST.gyro] + 1e-3 * TIME),
    ({"accel_scale": 1.02}, FAST.accel_y, 1.02 * ROWS[:, FAST.accel_y]),
    ({"accel_scale": 1.02}, FAST.accel_x, 1.02 * ROWS[:, FAST.accel_x]),
    ({"accel_roll": 0.02}, FAST.accel_y, ROWS[:, FAST.accel_y] + GRAVITY * math.sin(0.02)),
    ({"accel_ahead": 0.4}, FAST.accel_y,
     ROWS[:, FAST.accel_y] + 400.0 * np.diff(ROWS[:, FAST.gyro], prepend=0.0)),
    ({"accel_ahead": 0.4}, FAST.accel_x, ROWS[:, FAST.accel_x] - 0.4 * ROWS[:, FAST.gyro] ** 2),
]  # fmt: skip


_PAIRS = (
    (FAST.steer, FAST.steer_command), (FAST.accel_x, FAST.accel_y),
    (FAST.wheel_left, FAST.wheel_right),
)  # fmt: skip
_TOGETHER = {column: two for two in _PAIRS for column in two}


@pytest.mark.parametrize(("error", "column", "expected"), MEASURED)
def test_a_fast_sensor_errs_as_it_says(
    error: dict[str, float], column: int, expected: np.ndarray
) -> None:
    """The car is driven alike, and no sensor but this one errs."""
    rows = fast_rows(swerve(error))
    # a tick's mean of the yaw rate, not that at its end
    tolerance = 1e-3 if column == FAST.accel_x and "accel_ahead" in error else 1e-11
    np.testing.assert_allclose(rows[1:, column], expected[1:], rtol=0.0, atol=tolerance)
    others = [each for each in range(rows.shape[1]) if each not in _TOGETHER.get(column, (column,))]
    np.testing.assert_array_equal(rows[:, others], ROWS[:, others])


def test_a_camera_that_is_askew_sees_the_lane_as_geometry_says() -> None:
    """A plane through the lane's points, seen by a camera that is told it looks straight."""
    yaw, pitch, height, l_pre = 0.01, 0.005, 0.03, PASSENGER_CAR.preview
    clean = packets(CLEAN)
    seen = packets(swerve({"camera_yaw": yaw, "camera_pitch": pitch, "camera_height": height}))
    clean, seen = (each[each[:, PACKET.sensor] == 0.0, PACKET.value :] for each in (clean, seen))
    psi, y = clean[:, 0], clean[:, 1] - l_pre * clean[:, 0]  # the road is straight
    ahead = np.array([0.6, 1.0]) * l_pre  # told distances
    # where these points are in truth: the picture's rows fix h / X + pitch
    true = 1.0 / (1.0 / ahead + pitch / CAMERA_HEIGHT)
    lateral = (y[:, None] + psi[:, None] * true) * (ahead / true) + yaw * ahead
    slope = (lateral[:, 1] - lateral[:, 0]) / (ahead[1] - ahead[0])
    np.testing.assert_allclose(seen[:, 0], slope, atol=1e-12)
    np.testing.assert_allclose(seen[:, 1], lateral[:, 1] + height * y, atol=1e-12)


@pytest.mark.long
def test_pictures_are_askew_as_the_analytic_camera_is() -> None:
    """Yaw, by the lane finder and by the formula; the finder sees a pitch in the lane's width."""
    pytest.importorskip("cv2")
    straight = SCENARIO | {"amplitude": 0.0, "duration": 1.0, "roll": False}
    for error in ({"camera_yaw": 0.02}, {"camera_pitch": 0.01}):
        seen = []
        ways: tuple[dict[str, Any], ...] = ({}, {"vision": "image", "delay": "link"})
        for told in ways:
            env = StabilityEnv("vision", straight, "passenger-car", world=error, **told)
            env.reset(seed=0, options={"state": {"y": 0.8, "Y": 0.8}})
            rows = packets(play(env, [0.0] * 60))
            seen.append(rows[:, PACKET.value : PACKET.value + 2].mean(0))
        analytic, pictured = seen
        assert abs(analytic[0]) > 5e-3
        if "camera_yaw" in error:
            assert pictured[0] == pytest.approx(analytic[0], abs=2e-3)
            assert pictured[1] == pytest.approx(analytic[1], abs=0.05)
        else:
            assert pictured[0] == pytest.approx(0.0, abs=2e-3)


def test_gps_stamps_are_off_and_its_course_wanders() -> None:
    """The receiver's clock is its own; the course is the car's when it was captured."""
    long: dict[str, Any] = {"scenario": SCENARIO | {"duration": 30.0}, "control_period": 1}
    env = StabilityEnv("gps", vehicle="passenger-car", world={"gps_stamp": -0.03}, **long)
    env.reset(seed=2)
    moments = play(env, [0.0] * 8000)
    course = np.array([moment.info["psi"] + moment.info["beta"] for moment in moments])
    rows = packets(moments)
    stamps = rows[:, PACKET.captured].astype(int)
    np.testing.assert_allclose(rows[:, PACKET.value], course[stamps + 30 - 1], atol=1e-9)
    sensor = env.slow_sensors["gps"]
    assert sensor.phase is not None
    assert set(stamps % 200) == {round(1e3 * sensor.phase) % 200}
    world = {"course_error": 0.1, "course_period": 6.0}
    wandering = packets(swerve(world, 3000, 0.0, scenario=SCENARIO | {"duration": 30.0}))
    clean = packets(swerve("ideal", 3000, 0.0, scenario=SCENARIO | {"duration": 30.0}))
    gps = clean[:, PACKET.sensor] == 1.0
    error = (wandering - clean)[gps, PACKET.value] * clean[gps, PACKET.value + 1]
    phase = 2.0 * np.pi * clean[gps, PACKET.captured] * 1e-3 / 6.0
    basis = np.stack([np.sin(phase), np.cos(phase)], 1)
    amplitude, rest, *_ = np.linalg.lstsq(basis, error)
    assert math.hypot(*amplitude) == pytest.approx(0.1, rel=0.02)
    assert rest.sum() < 1e-3


@pytest.mark.parametrize("scenario", ["random-steering", "coms-slalom"])
def test_no_packet_is_later_than_the_sensors_say_and_no_filter_refuses_one(scenario: str) -> None:
    """Wrong stamps look like other delays: a filter that is told them has room for every packet."""
    env: Any = gymnasium.make("sideslip/YawFusion-v0", scenario=scenario, world="v1")
    env = EstimateObservation(env, "exact-kf", options={"slow": ("camera", "gps")})
    signs = set()
    for seed in range(8):
        env.reset(seed=seed)
        gps, rows = env.unwrapped.slow_sensors["gps"], []
        for _ in range(400):
            env.step(np.zeros(1, np.float32))
            rows.append(env.unwrapped.record.select_packets("gps"))
        seen = np.concatenate(rows)
        late = 1e-3 * (seen[:, PACKET.arrived] - seen[:, PACKET.captured])
        assert min(gps.delays) - 1e-9 <= late.min()
        assert late.max() <= gps.longest_delay + 1e-9
        counts = env.estimator.counts
        assert (counts["refused"], counts["unknown"], counts["future"]) == (0, 0, 0)
        signs.add(bool(seen[0, PACKET.captured] % 200))
    assert True in signs  # the receiver's clock is not the car's


def test_a_loaded_car_drives_as_one_that_was_built_so() -> None:
    """Load, inertia, centre of gravity and tyres are in `vehicle`, and the plant's are the same."""
    load, inertia, shift = 0.2, 1.1, 0.04
    car = PASSENGER_CAR
    world: dict[str, Any] = {"load": load, "inertia": inertia, "gravity_shift": shift}
    world |= {"relaxation": 0.5, "tyres": "magic-formula"}
    loaded = StabilityEnv("gps", SCENARIO, "passenger-car", world=world)
    loaded.reset(seed=1)
    back = shift * car.wheelbase
    heavy = car.replace(
        mass=1.2 * car.mass, yaw_inertia=1.2 * 1.1 * car.yaw_inertia,
        front_arm=car.front_arm + back, rear_arm=car.rear_arm - back,
        relaxation=0.5 * car.relaxation, sprung_mass=1.2 * car.sprung_mass,
        roll_inertia=1.2 * car.roll_inertia,
    )  # fmt: skip
    changed = {"mass", "yaw_inertia", "front_arm", "rear_arm", "relaxation"}
    for name in changed | {"sprung_mass", "roll_inertia"}:
        assert getattr(loaded.vehicle, name) == pytest.approx(getattr(heavy, name), rel=1e-14)
    tyred = FULL | QUIET | {"tyres": "magic-formula"}
    built = StabilityEnv("gps", tyred, heavy, car)
    unrolled = StabilityEnv("gps", FULL | QUIET, "passenger-car", world=world)
    for env in (built, unrolled):
        env.reset(seed=1)
    one, other = (np.array(play(env, [0.0] * 250) and env.motion) for env in (built, unrolled))
    np.testing.assert_allclose(one, other, rtol=1e-9)


def test_torque_is_scaled_and_its_rate_is_limited() -> None:
    """A record holds what is commanded; the moment delivered is that of the scaled torques."""
    scale, left, rate = 0.9, 0.97, 20.0
    no_lags: dict[str, Any] = {"vehicle": {"base": "passenger-car", "motor_lag": 0.0}}
    torque = {"torque_scale": scale, "torque_left": left, "torque_rate": rate}
    moments = swerve(torque, action=1.0, **no_lags)
    rows, car = fast_rows(moments), PASSENGER_CAR
    torques = rows[:, [FAST.torque_left, FAST.torque_right]] * scale * np.array([left, 1.0])
    N_z = 0.5 * car.rear_track / car.wheel_radius * (torques[:, 1] - torques[:, 0])
    told = np.array([moment.info["yaw_moment"] for moment in moments])
    np.testing.assert_allclose(told, N_z[9::10], rtol=1e-12)
    slope = np.abs(np.diff(rows[:, FAST.torque_right]))
    limit = rate * car.motor_torque * 1e-3
    assert slope.max() == pytest.approx(limit, rel=1e-9)
    assert np.isclose(slope, limit).sum() > 100


def _find_wave(rows: np.ndarray, values: np.ndarray, length: float) -> float:
    """The amplitude of a wave along the road, by least squares."""
    phase = 2.0 * np.pi * np.cumsum(rows[:, FAST.wheel_left]) * 1e-3 / length
    basis = np.stack([np.sin(phase), np.cos(phase), np.ones(len(phase))], 1)
    amplitude, *_ = np.linalg.lstsq(basis, values)
    return math.hypot(amplitude[0], amplitude[1])


def test_friction_and_bank_are_waves_along_the_road() -> None:
    """Seen where they act: the accelerometer of a car that goes straight, and the tyres' limit."""
    straight = SCENARIO | {"amplitude": 0.0, "duration": 10.0}
    world = {"bank_wave": 0.02, "bank_length": 40.0}
    rows = fast_rows(swerve(world, 1000, 0.0, scenario=straight))
    wave = _find_wave(rows, rows[:, FAST.accel_y], 40.0)
    assert wave == pytest.approx(GRAVITY * math.sin(0.02), rel=0.15)
    hard = SCENARIO | {"amplitude": 0.3, "frequency": 1e-3, "friction": 0.5}
    hard |= {"steering": "held-step", "lags": False}
    world = {"friction_wave": 0.3, "friction_length": 30.0}
    rows, clean = (fast_rows(swerve(each, 180, 0.0, scenario=hard)) for each in (world, "ideal"))
    ratio = rows[500:, FAST.accel_y] / clean[500:, FAST.accel_y]  # the tyres are at their limit
    assert _find_wave(rows[500:], ratio, 30.0) == pytest.approx(0.3, rel=0.3)


def test_vibration_and_the_map_are_coloured() -> None:
    """Vibration has its deviation and a correlation of 30 ms; the curvature lags and waves."""
    straight = SCENARIO | {"amplitude": 0.0, "duration": 60.0}
    rows = fast_rows(swerve({"vibration": 0.3}, 6000, 0.0, scenario=straight))
    noise = rows[:, FAST.accel_y]
    assert noise.std() == pytest.approx(0.3, rel=0.1)
    correlation = np.corrcoef(noise[:-30], noise[30:])[0, 1]
    assert correlation == pytest.approx(math.exp(-1.0), abs=0.08)
    bend = {"road": "straight", "curvature": 0.01, "curve_start": 5.0, "curve_ramp": 1e-3}
    ramp = fast_rows(swerve({"map_lag": 0.2}, 200, 0.0, scenario=straight | bend))
    clean = fast_rows(swerve("ideal", 200, 0.0, scenario=straight | bend))
    start = int(np.argmax(clean[:, FAST.curvature] > 0.0))
    assert ramp[start + 200, FAST.curvature] == pytest.approx(0.01 * (1 - math.exp(-1)), rel=0.01)
    wave = {"map_error": 0.001, "map_length": 50.0}
    error = fast_rows(swerve(wave, 1000, 0.0, scenario=straight))[:, FAST.curvature]
    assert (error.min(), error.max()) == pytest.approx((-0.001, 0.001), rel=1e-3)


def test_the_rate_of_the_moment_costs_what_its_formula_says() -> None:
    """0.00025 s2 ((N_z(t) - N_z(t - 10 ms)) / (10 ms N_max))^2, of the moment delivered."""
    weight, limit = 0.00025, PASSENGER_CAR.yaw_moment_limit
    for period in (10, 3, 25):
        told: dict[str, Any] = {"control_period": period}
        rated, free = swerve({"moment_rate": weight}, 100, **told), swerve(ERRS, 100, **told)
        rows, car = fast_rows(rated), PASSENGER_CAR
        torque = rows[:, FAST.torque_right] - rows[:, FAST.torque_left]
        share = 0.5 * car.rear_track / car.wheel_radius * torque / limit
        before = np.concatenate([np.zeros(RATE_TICKS), share[:-RATE_TICKS]])
        cost = weight * ((share - before) / (RATE_TICKS * 1e-3)) ** 2 * 1e-3
        costs = (np.array([moment.info["cost"] for moment in each]) for each in (rated, free))
        extra = np.subtract(*costs)
        np.testing.assert_allclose(extra, cost.reshape(-1, period).sum(1), atol=1e-12)
        assert max(extra) > 1e-4


@pytest.mark.parametrize("scenario", ["car-slalom", "car-iso-3888-1"])
def test_a_lead_in_is_gentle_unscored_and_shifts_all_else(scenario: str) -> None:
    """Actions do nothing in it, and the manoeuvre follows as it would have begun."""
    told: dict[str, Any] = {"scenario": scenario, "vehicle": "passenger-car", "lead_in": 8.0}
    wild, idle = (
        play(env, [action] * 800)
        for action in (0.1, 0.0)
        for env in [StabilityEnv("fusion", **told)]
        if env.reset(seed=3)
    )
    assert all(moment.reward == 0.0 for moment in wild)
    for one, other in zip(wild, idle, strict=True):
        np.testing.assert_array_equal(one.obs, other.obs)
    gentle = fast_rows(idle)
    assert 0.2 < np.abs(gentle[:, FAST.steer]).max() * 20.0**2 / 3.0 < 2.0  # m/s2, about
    env = StabilityEnv("fusion", **told)
    env.reset(seed=3)
    later = play(env, [0.0] * 800 + [0.1] * 2000)[800:]
    assert later[0].reward < 0.0
    first = StabilityEnv("fusion", **(told | {"lead_in": 0.0}))
    first.reset(seed=3)
    now = play(first, [0.1] * 2000)
    assert len(later) == len(now)
    if scenario == "car-slalom":  # the programme; a driver reacts to where the car is
        angle, first_angle = (fast_rows(moments)[:, FAST.steer_command] for moments in (later, now))
        np.testing.assert_allclose(angle, first_angle, atol=1e-12)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_rows_of_a_batch_have_a_single_cars_bits(mode: str) -> None:
    """In a world with every error, over ends and resets, with a lead-in and a step of 7 ticks."""
    for told in ({}, {"lead_in": 0.1, "control_period": 7}):
        alone, together = pair("sideslip/YawFusion-v0", 9, mode, world="v1", **told)
        same(alone.reset(seed=2), together.reset(seed=2))
        assert drive(alone, together, 60) > 5


def test_groups_are_scaled_about_the_ideal() -> None:
    world = WORLDS["v1"]
    names = "camera, steering, wheels and motors, inertial, GPS and map, load, road, tyres"
    assert ", ".join(GROUPS) == names
    doubled = world.scale("camera", 2.0)
    assert doubled.camera_yaw == pytest.approx(2.0 * np.array(world.camera_yaw))
    assert doubled.steer_scale == world.steer_scale
    assert world.scale("steering", 2.0).steer_scale == pytest.approx((0.94, 1.06))
    for group in GROUPS:
        world = world.scale(group, 0.0)
    assert dataclasses.replace(world, tyres="", moment_rate=0.0, critical_speed=1.05) == IDEAL


def test_a_world_goes_through_a_spec() -> None:
    """A mapping in JSON makes it again, and so does an env's spec."""
    world = WORLDS["v1"].scale("load", 0.5)
    assert make_world(json.loads(json.dumps(world.to_dict()))) == world
    env = gymnasium.make("sideslip/YawFusion-v0", world=world.to_dict(), lead_in=1.0)
    assert env.spec is not None
    again = gymnasium.make(type(env.spec).from_json(env.spec.to_json()))
    assert again.unwrapped.config.world == world  # type: ignore[attr-defined]


REFUSED: list[tuple[Any, type[Exception], str]] = [
    ("v2", ValueError, "unknown world 'v2'; known: ideal, v1"),
    (3, TypeError, "a world is a name or a mapping of ranges, got 3"),
    ({"camera_yow": 1.0}, TypeError, "range of a world 'camera_yow'; did you mean 'camera_yaw'"),
    ({"camera_yaw": math.nan}, ValueError, "camera_yaw is a number or .* in rad, got nan"),
    ({"camera_yaw": (0.1, -0.1)}, ValueError, "camera_yaw is a number or .low, high. in rad"),
    ({"camera_yaw": 0.3}, ValueError, "World.camera_yaw: 0.3 rad is outside .*strict=False"),
    ({"camera_yaw": 3.0}, ValueError, "World.camera_yaw: 3.0 rad .*is it in deg"),
    ({"steer_scale": 0.0}, ValueError, "steer_scale must be positive, got 0.0"),
    ({"map_length": -1.0}, ValueError, "map_length must be positive"),
    ({"tyres": "rubber"}, ValueError, "world: tyres 'rubber'; known: linear"),
    ({"moment_rate": math.inf}, ValueError, "moment_rate is a number"),
]


@pytest.mark.plain
@pytest.mark.parametrize(("world", "error", "message"), REFUSED)
def test_what_is_no_world_is_refused(world: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        StabilityEnv("fusion", world=world)


@pytest.mark.plain
@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"lead_in": -1.0}, "lead_in is 0 to 3600 s, got -1.0"),
        ({"lead_in": math.nan}, "lead_in nan is no finite number"),
        ({"lead_in": 1.0, "scenario": {"steering": "wander", "hold": 0.01}}, "steers by wander"),
        ({"lead_in": 1.0, "scenario": {"surge": 0.5}}, "surges from 0 s on"),
        ({"lead_in": 1.0, "scenario": {"acceleration": 0.5}}, "accelerates from 0 s on"),
        ({"lead_in": 1.0, "scenario": "recovery"}, "begins with a slip or a yaw rate"),
    ],
)
def test_what_is_no_lead_in_is_refused(told: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        StabilityEnv("fusion", **told)


@pytest.mark.parametrize("world", ["ideal", {"friction_wave": 0.1}])
def test_friction_that_changes_is_that_of_another_road_from_then_on(world: Any) -> None:
    """Nearly from the start it is another road's; before its time nothing has changed."""
    turn = {"base": "limit-slalom", "mirror": False, "friction": 0.8, "amplitude": 0.05}
    changes = turn | {"tyre_change_time": 0.001, "friction_change": 0.5}
    later = turn | {"tyre_change_time": 2.0, "friction_change": 0.5}
    ends = {}
    for name, scenario in (("dry", turn), ("wet", turn | {"friction": 0.4}), ("changes", changes),
                           ("later", later)):  # fmt: skip
        env: Any = StabilityEnv("fusion", scenario=scenario, vehicle="passenger-car", world=world)
        env.reset(seed=4)
        slips = [env.step(np.zeros(1, np.float32))[4]["beta"] for _ in range(250)]
        ends[name] = np.array(slips), env.vehicle.friction
    assert ends["changes"][0] == pytest.approx(ends["wet"][0], abs=2e-4)
    assert np.abs(ends["dry"][0] - ends["wet"][0]).max() > 0.02
    assert (ends["later"][0][:199] == ends["dry"][0][:199]).all()
    assert np.abs(ends["later"][0] - ends["dry"][0]).max() > 1e-3
    assert ends["changes"][1] == pytest.approx(0.4) == ends["later"][1]


def test_no_car_of_the_world_is_near_its_critical_speed() -> None:
    """Others are drawn anew: a driver would lose them on a straight road."""
    env = StabilityEnv("fusion", "any-friction-step", "passenger-car", world="v1")
    for seed in range(64):
        env.reset(seed=seed)
        assert critical_speed(env.vehicle) > 1.5 * env.motion.v_x


@pytest.mark.parametrize("name", V1)
def test_version_1_of_an_id_is_version_0_in_the_world_v1(name: str) -> None:
    """And version 0 is used without a word: it is the papers' world."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        importlib.reload(sideslip)  # its filter comes first again
        older = gymnasium.make(name.replace("-v1", "-v0"), world="v1")
    assert not [each for each in caught if "out of date" in str(each.message)]
    newer = gymnasium.make(name)
    for env in (older, newer):
        env.reset(seed=3)
    action = np.full(older.action_space.shape or (), 0.3, np.float32)
    for _ in range(40):
        one, other = older.step(action), newer.step(action)
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1] == other[1]
