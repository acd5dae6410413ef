"""A car that nobody has measured: noise found while driving, outliers, tyres and logs that err."""

import dataclasses
import functools
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from scipy.signal import lfilter

import sideslip
from sideslip.agents.rollout import rollout
from sideslip.envs import Log
from sideslip.envs.record import FAST, PACKET
from sideslip.envs.vehicle.parameters import GRAVITY
from sideslip.estimators import Estimator, make_estimator
from sideslip.estimators.core.filter import NO_OUTPUTS, StepRecord
from sideslip.estimators.core.memory import N_INPUTS
from sideslip.estimators.core.model import build_model, linearise
from tests.estimators.dense import WITH_TYRES

assert sideslip.__version__


SURE = {"force_share": 1e-3, "model_error": 0.0, "robust": 0.0, "noise_time": 2.0}
SURE |= dict.fromkeys(("accel_bias_sd", "accel_scale_sd", "bias_sd", "bank_sd"), 0.0)
"""Options of a filter that does not doubt its forces: what it cannot predict is noise."""


@functools.cache
def drive(accel: float = 0.1, base: str = "random-steering") -> tuple[Any, Log]:
    """A drive of the COMS whose accelerometer has this noise in m/s2."""
    scenario: dict[str, Any] = {"base": base, "noise": {"accel": accel}, "duration": 6.0}
    if base == "straight":  # nothing errs but by its noise
        scenario |= dict.fromkeys(("disturbance_force", "disturbance_moment", "accel_y_bias"), 0.0)
    env: Any = gym.make("sideslip/YawFusion-v0", scenario=scenario)
    return env.unwrapped, rollout(env, seed=1).log


def built(name: str, log: Log, **options: Any) -> Estimator:
    slow = {"sensors": log.slow, "slow": list(log.slow)}
    return make_estimator(name, vehicle=drive()[0].nominal, **(slow | options))


def filter_with_tyres(log: Log, **options: Any) -> Estimator:
    """`exact-kf` with states for its tyres."""
    return built("exact-kf", log, **WITH_TYRES | options)


def test_without_options_it_uses_every_slow_sensor_that_is_there() -> None:
    log = drive()[1]
    for names in (("camera",), ("gps",), ("camera", "gps"), ()):
        sensors = {name: log.slow[name] for name in names}
        assert tuple(make_estimator("joint", sensors=sensors).config.sensors) == names
    assert tuple(make_estimator("exact-kf", sensors=log.slow).config.sensors) == ("camera",)


@pytest.mark.parametrize("noise", [0.03, 0.1, 0.8])
def test_the_accelerometers_noise_is_found_and_never_less_than_configured(noise: float) -> None:
    _, log = drive(noise, "straight")
    filter_ = built("joint", log, accel_y_noise=0.05, **SURE)
    filter_.run(log)
    f = filter_.filters[0]
    assert math.sqrt(f.r_fast[f.accel_row]) == pytest.approx(max(noise, 0.05), rel=0.4)
    filter_ = built("joint", log, accel_y_noise=0.1, noise_time=0.0)
    filter_.run(log)
    assert filter_.filters[0].r_fast[f.accel_row] == pytest.approx(0.1**2)


def test_noise_that_is_coloured_counts_for_what_its_mean_errs() -> None:
    """AR(1) of correlation time tau: a mean of many rows errs by 2 tau / dt times white noise's."""
    _, log = drive(0.02, "straight")
    sd, tau, rng = 0.5, 0.02, np.random.default_rng(0)
    keep = math.exp(-0.001 / tau)
    steps = rng.normal(0.0, sd * math.sqrt(1.0 - keep * keep), len(log.record.fast))
    fast = log.record.fast.copy()
    fast[:, FAST.accel_y] += lfilter([1.0], [1.0, -keep], steps)
    shaken = dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))
    filter_ = built("joint", log, accel_y_noise=0.02, **SURE)
    filter_.run(shaken)
    f = filter_.filters[0]
    wanted = sd * math.sqrt(2.0 * tau / 0.001)
    assert wanted / 2.0 < math.sqrt(f.r_fast[f.accel_row]) < 2.0 * wanted


def test_the_moment_forgets_in_a_time_of_its_own() -> None:
    _, log = drive()
    f = filter_with_tyres(log, disturbance_time=0.5, moment_time=0.1, moment_sd=20.0).filters[0]
    assert f.decay[f.dense] == pytest.approx(math.exp(-0.001 / 0.5))
    assert f.decay[f.dense + 1] == pytest.approx(math.exp(-0.001 / 0.1))
    assert f.q_nominal[1] == pytest.approx((1.0 - math.exp(-0.002 / 0.1)) * 20.0**2)


def test_a_late_map_errs_by_the_turn_of_the_road_in_that_time() -> None:
    """The camera's heading has the error, y_l grows with it, and it is as large as the turn."""
    _, log = drive()
    options = {"map_heading_sd": 0.01, "map_heading_time": 2.0, "map_lag_sd": 0.2}
    filter_ = filter_with_tyres(log, **options)
    f, i = filter_.filters[0], filter_.names.index("map_heading")
    f.u[2], f.model_speed = 0.02, 7.0
    linearise(f, 0.0)
    build_model(f, 7.0, 0.0)
    share = 1.0 - math.exp(-2.0 * 0.001 / 2.0)
    assert f.Q[i, i] == pytest.approx(share * (0.01**2 + (0.2 * 7.0 * 0.02) ** 2))
    assert f.B[3, N_INPUTS + i - f.dense] == 7.0
    assert f.C[0, :2, i].tolist() == [1.0, f.preview] and not f.C[1, :, i].any()


def test_a_filter_says_when_it_is_lost() -> None:
    """Of a clean drive never, of one whose course turns by 20 degrees within 3 s."""
    _, log = drive()

    def list_health(packets: Any) -> list[bool]:
        filter_, record, told = built("joint", log, slow="gps"), log.record, []
        filter_.reset(log.slow, record.first)
        for start in range(0, 6000, 500):
            arrives = (packets[:, PACKET.arrived] >= start) & (
                packets[:, PACKET.arrived] < start + 500
            )
            chosen = np.ascontiguousarray(packets[arrives])
            rows = record.fast[start : start + 500].copy()
            filter_.take(StepRecord(rows, 500, chosen, len(chosen)))
            told.append(filter_.is_healthy)
        return told

    course = log.record.select_packets("gps")
    assert all(list_health(course))
    turned = course.copy()
    late = turned[:, PACKET.captured] > 2000
    turned[late, PACKET.value] += np.where(np.arange(late.sum()) % 2, 0.35, -0.35)
    health = list_health(turned)
    assert all(health[:4]) and not any(health[9:])


def test_a_steering_angle_that_jumps_behind_a_gap_waits_for_the_next_row() -> None:
    _, log = drive()
    filter_, rows = built("joint", log), log.record.fast[:6].copy()
    filter_.reset(log.slow, 0)
    used = []
    rows[:, FAST.steer] = (0.0, 0.0, np.nan, 0.9, 0.0, 0.001)
    for row in rows:
        filter_.take(StepRecord(row[None], 1, log.record.packets[:0], 0))
        used.append(float(filter_.filters[0].u[0]))
    assert used == [0.0, 0.0, 0.0, 0.0, 0.0, 0.001]


@pytest.mark.parametrize("fault", ["degrees", "backward"])
def test_a_steering_angle_in_degrees_and_a_car_that_reverses_are_said(fault: str) -> None:
    """Within a second, and where the steering is wrong the deviation grows."""
    _, log = drive()
    fast = log.record.fast.copy()
    if fault == "degrees":
        fast[:, FAST.steer] = np.degrees(fast[:, FAST.steer])
    else:
        fast[:, [FAST.wheel_left, FAST.wheel_right]] *= -1.0
    wrong = dataclasses.replace(log.record, fast=fast)
    until = next(
        i for i in range(500, 6000) if abs(fast[i, FAST.steer]) > 1.0 or fault != "degrees"
    )
    filter_, deviations = built("joint", log), []
    for record in (wrong, log.record):
        filter_.reset(log.slow, 0)
        rows = np.ascontiguousarray(record.fast[: until + 1000])
        X, S = np.empty((2, len(rows), len(filter_.names)))
        filter_.take(
            StepRecord(rows, len(rows), record.packets[:0], 0), NO_OUTPUTS._replace(X=X, S=S)
        )
        deviations.append(S[-1, 0])
        assert filter_.is_healthy == (record is log.record)
    assert fault != "degrees" or deviations[0] > 2.0 * deviations[1]


def test_what_is_far_beyond_its_noise_counts_less_and_the_rest_as_it_is() -> None:
    _, log = drive()
    plain, robust = (filter_with_tyres(log, robust=size).run(log) for size in (0.0, 6.0))
    assert np.array_equal(plain.x, robust.x)
    fast = log.record.fast.copy()
    fast[3000, FAST.gyro] += 3.0
    hit = dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))
    ours, theirs = (filter_with_tyres(log, robust=size).run(hit) for size in (6.0, 0.0))
    after = slice(3000, 3300)
    moved = [np.abs(run.x - plain.x)[after, :2].max(axis=0) for run in (ours, theirs)]
    assert (moved[0] < 0.1 * moved[1]).all()


def test_tyres_that_err_push_by_their_share_of_the_force() -> None:
    """Q of a step holds (share of |F_f| + |F_r|)^2, and the same at half the wheelbase."""
    base, log = drive()
    filter_ = filter_with_tyres(log, model_error=0.1, disturbance_time=0.2)
    filter_.run(log)
    f, car = filter_.filters[0], base.nominal
    V, (beta, gamma), delta = f.model_speed, f.x[:2], log.record.fast[-1, FAST.steer]
    alpha = delta - beta - car.front_arm * gamma / V, car.rear_arm * gamma / V - beta
    stiffness = 2.0 * car.front_stiffness, 2.0 * car.rear_stiffness
    push = sum(abs(C * a * s) for C, a, s in zip(stiffness, alpha, f.x[f.tyres :][:2], strict=True))
    share = 1.0 - math.exp(-2.0 * 0.001 / 0.2)
    arm = 0.5 * (car.front_arm + car.rear_arm)
    for i, (sd, size) in enumerate(((50.0, 1.0), (20.0, arm))):
        wanted = share * (sd**2 + (0.1 * size * push) ** 2)
        assert f.Q[f.dense + i, f.dense + i] == pytest.approx(wanted, rel=0.05)


def test_forces_come_in_shares_of_the_weight() -> None:
    base, log = drive()
    filter_ = filter_with_tyres(log, force_share=0.05, moment_share=0.01, force_sd=30.0)
    f, car = filter_.filters[0], base.nominal
    weight, arm = car.mass * GRAVITY, 0.5 * (car.front_arm + car.rear_arm)
    share = 1.0 - math.exp(-2.0 * 0.001 / 0.3)
    assert f.q_nominal[0] == pytest.approx(share * (30.0**2 + (0.05 * weight) ** 2))
    assert f.q_nominal[1] == pytest.approx(share * (20.0**2 + (0.01 * weight * arm) ** 2))


def test_a_bias_that_wanders_keeps_its_deviation() -> None:
    _, log = drive()
    options: dict[str, Any] = {"fast": ["gyro", "accel_y"], "accel_bias_sd": 0.3}
    filter_ = built("exact-kf", log, **options, accel_bias_time=5.0)
    f, i = filter_.filters[0], filter_.names.index("accel_bias")
    assert f.decay[i] == pytest.approx(math.exp(-0.001 / 5.0))
    assert f.decay[i] ** 2 * 0.3**2 + f.Q[i, i] == pytest.approx(0.3**2)
    assert built("exact-kf", log, **options).filters[0].decay[i] == 1.0


@pytest.mark.long
def test_on_a_strange_car_its_intervals_mean_something() -> None:
    """CommonRoad's multi-body BMW, told tyres that are 0.7 and 1.3 of its own."""
    noise = {"accel": 0.6, "gyro": 0.004, "gyro_bias": 0.003, "course": math.radians(0.5) * 25.0}
    scenario = {"base": "random-steering", "speed": 25.0, "amplitude": 0.005, "noise": noise}
    env: Any = gym.make("sideslip/Outside-v0", model="multi-body", sensors="gps", scenario=scenario)
    log = rollout(env, seed=2, options={"duration": 7.0}).log
    car, beta = env.unwrapped.nominal.scale_stiffness(0.7, 1.3), log.truth["beta"]
    nees = []
    for name, options in (("joint", {}), ("exact-kf", WITH_TYRES)):
        known = {"sensors": log.slow, "slow": ["gps"], "course_noise": math.radians(0.5)}
        run = make_estimator(name, vehicle=car, **known, **options).run(log)
        nees.append(np.mean(((run.x[:, 0] - beta) / run.std[:, 0])[2000:] ** 2))
    assert nees[0] < 3.0 and nees[1] > 10.0


@pytest.mark.parametrize(("name", "options"), [("joint", {}), ("exact-kf", WITH_TYRES)])
def test_ten_minutes_at_a_standstill_change_nothing_that_is_not_seen(
    name: str, options: dict[str, Any]
) -> None:
    """Gyro and accelerometer are off, the wheels' noise is all that moves; then it drives again."""
    scenario = {
        "base": "random-steering",
        "duration": 12.0,
        "noise": {"gyro_bias": 0.0087, "accel_y_bias": 0.1},
    }
    env: Any = gym.make("sideslip/YawFusion-v0", scenario=scenario)
    log = rollout(env, seed=0).log
    first, packets, rng = log.record.fast, log.record.packets, np.random.default_rng(0)
    rows = 90 * 6600 - len(first)  # whole periods of both slow sensors
    still = np.zeros((rows, first.shape[1]))
    still[:, FAST.gyro] = 0.0087 + 0.005 * rng.standard_normal(rows)
    still[:, FAST.accel_y] = 0.1 + 0.1 * rng.standard_normal(rows)
    still[:, FAST.wheel_left] = still[:, FAST.wheel_right] = 0.02 * np.abs(rng.normal(size=rows))
    still[:1000] += np.linspace(1.0, 0.0, 1000)[:, None] * first[-1]
    later = packets.copy()
    later[:, [PACKET.captured, PACKET.arrived]] += 90 * 6600
    record = dataclasses.replace(
        log.record, fast=np.vstack([first, still, first]), packets=np.vstack([packets, later])
    )
    filter_ = built(name, log, bias_sd=0.01, **options)
    run = filter_.run(dataclasses.replace(log, record=record, truth={}))
    tyres = [filter_.names.index(f"{axle}_tyres") for axle in ("front", "rear")]
    stop, go = len(first) + 1200, len(first) + rows - 1
    assert (np.abs(run.x[go] - run.x[stop])[tyres] < 2.0 * run.std[stop, tyres]).all()
    assert (run.std[go, tyres] < 0.25).all() and np.isfinite(run.x).all()
    assert np.abs(run["beta"][stop : go + 1]).max() < 0.05
    truth = log.truth["beta"][2000:]
    errors = [run["beta"][start + 2000 :][: len(truth)] - truth for start in (0, go + 1)]
    assert np.std(errors[1]) < 1.3 * np.std(errors[0])


LINEAR: dict[str, Any] = {"base": "random-steering", "small_angle": True, "tyres": "linear"}
LINEAR |= {"amplitude": 0.05, "amplitude_2": 0.04, "roll": True, "duration": 8.0}


@functools.cache
def drive_linear() -> Log:
    """A drive of the small-angle car with a body that rolls."""
    return rollout(gym.make("sideslip/YawVision-v0", scenario=LINEAR), seed=3).log


def with_steer(log: Log, rows: Any, angle: float) -> Log:
    fast = log.record.fast.copy()
    fast[rows, FAST.steer] = angle
    return dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))


def test_a_steering_angle_that_the_next_row_does_not_confirm_is_skipped() -> None:
    """As if the last good angle had lasted until the second row after it, and counted."""
    log = drive_linear()
    before = log.record.fast[2999, FAST.steer]
    hit, lasted = with_steer(log, 3000, 0.3), with_steer(log, [3000, 3001], before)
    filters = [built("joint", log) for _ in range(2)]
    ours, wanted = (filter_.run(each) for filter_, each in zip(filters, (hit, lasted), strict=True))
    assert np.array_equal(ours.x, wanted.x)
    assert [filter_.counts["invalid"] for filter_ in filters] == [2, 0]
    believed = built("joint", log, steer_rate=0.0).run(hit)
    assert np.abs(believed.x - wanted.x)[3000:3010, :2].max() > 1e-4


def test_a_step_of_the_steering_comes_a_row_late() -> None:
    log = drive_linear()
    before = log.record.fast[2999, FAST.steer]
    step, later = with_steer(log, slice(3000, None), 0.1), with_steer(log, slice(3001, None), 0.1)
    later = with_steer(later, 3000, before)
    ours = built("joint", log).run(step)
    wanted = built("joint", log, steer_rate=0.0).run(later)
    assert np.array_equal(ours.x, wanted.x)


@pytest.mark.parametrize("wrong", [-0.06, 0.08])
def test_the_scale_of_the_accelerometer_is_found(wrong: float) -> None:
    log = drive_linear()
    fast = log.record.fast.copy()
    fast[:, FAST.accel_y] *= 1.0 + wrong
    log = dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))
    known = {"fast": ["gyro", "accel_y"], "accel_bias_sd": 0.05}
    run = built("exact-kf", log, **WITH_TYRES, accel_scale_sd=0.1, **known).run(log)
    found, sd = (each[-1, run.names.index("accel_scale")] for each in (run.x, run.std))
    assert abs(found - wrong) < 3.0 * sd and sd < 0.02
    plain = built("exact-kf", log, **WITH_TYRES, **known).run(log)
    errors = [np.std((each["beta"] - log.truth["beta"])[2000:]) for each in (run, plain)]
    assert errors[0] < 0.9 * errors[1]


def test_tyres_are_expanded_every_row_of_a_slow_log() -> None:
    """Every 4 ms, or every row where rows are further apart."""
    log = drive_linear()
    assert built("exact-kf", log, **WITH_TYRES).filters[0].linearise_every == 4
    facts: dict[str, Any] = {"sensors": {}, "slow": []}
    assert make_estimator("joint", dt=0.01, **facts).filters[0].linearise_every == 1
