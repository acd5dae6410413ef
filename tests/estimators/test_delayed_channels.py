"""Fast channels that are late: by a known latency, exactly; by one that is found while driving."""

import dataclasses
import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.rollout import rollout
from sideslip.envs.record import FAST, PACKET, PACKET_WIDTH, Log, Record
from sideslip.envs.recordings.log_file import read_parts
from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import EstimateObservation, Estimator, make_estimator
from sideslip.estimators.analysis.limits import compute_error_bound
from sideslip.estimators.delayed_channels import _LatencySearch
from tests.estimators.core.test_conditioning import CASES, EXACT, differences
from tests.estimators.dense import WITH_TYRES
from tests.estimators.simulation import CAMERA, FIG7, simulate
from tests.estimators.test_joint import drive as drive_table
from tests.estimators.vector.fleets import make_batch, step

LATE = {"gyro": 0.06}


def later(log: Log, latency: dict[str, float]) -> Log:
    """The log with columns that stand too late, the first value until they come."""
    fast = log.record.fast.copy()
    for name, late in latency.items():
        column, rows = getattr(FAST, name), round(late / log.record.dt)
        fast[rows:, column], fast[:rows, column] = fast[:-rows, column], fast[0, column]
    return dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))


@pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")
@pytest.mark.parametrize("delay", ["clone", "buffer"])
@pytest.mark.parametrize("case", ["forces, camera and gps", "accelerometer, roll rate, bias"])
def test_it_equals_dense_conditioning_on_what_has_come(case: str, delay: str) -> None:
    """Of the last ticks the gyro is not there, accelerometers and packets are."""
    told = CASES[case]
    latency = {"gyro": 0.06} | ({"accel_y": 0.025} if "accel" in case else {})
    late = dataclasses.replace(told, options=told.options | {"latency": latency})
    filter_ = late.build(delay)
    for seed in range(6):
        log = told.schedule(seed)
        filter_.run(later(log, latency))
        fast = log.record.fast.copy()
        for name, seconds in latency.items():
            fast[len(fast) - round(seconds / told.dt) :, getattr(FAST, name)] = np.nan
        record = dataclasses.replace(log.record, fast=fast)
        dense = told.posterior(filter_.names, record).at(told.rows - 1)
        assert differences(filter_, *dense) < EXACT
        assert {name for name, count in filter_.counts.items() if count} <= {"duplicates"}


def drive() -> tuple[Log, dict[str, Any]]:
    """Two seconds with a camera that is late, some of whose frames are refused."""
    sensors = {"camera": SlowSensor(0.033, (0.04, 0.02))}
    log = simulate(FIG7, sensors, 3)
    packets = log.record.packets.copy()
    packets[5, PACKET.value], packets[9, PACKET.captured] = np.nan, 1e9
    record = Record(log.record.fast[:1990], packets[packets[:, PACKET.arrived] < 1990])
    facts = {"vehicle": FIG7.truth, "sensors": sensors, "speed": FIG7.speed} | WITH_TYRES
    return later(dataclasses.replace(log, record=record), LATE), facts


def stepped(filter_: Any, record: Record, width: int) -> None:
    """A run in steps of some ticks."""
    filter_.reset()
    for first in range(0, len(record.fast), width):
        arrived = record.packets[:, PACKET.arrived]
        new = (arrived >= first) & (arrived < first + width)
        filter_.step(record.fast[first : first + width], record.packets[new])


@pytest.mark.parametrize("latency", [LATE, {"gyro": "find"}])
def test_a_run_is_its_steps_whatever_their_length_and_so_is_a_batch(latency: Any) -> None:
    log, facts = drive()
    filter_: Any = make_estimator("exact-kf", **facts, latency=latency)
    end = filter_.run(log)
    assert filter_.latency["gyro"] == pytest.approx(0.06, abs=0.004)
    batch = make_batch("exact-kf", 2, **facts, latency=latency)
    for width in (10, 37, 1990):
        stepped(filter_, log.record, width)
        assert (filter_.x == end.x[-1]).all() and filter_.tick == 1989
        assert filter_.counts["invalid"] == filter_.counts["unknown"] == 1
    for first in range(0, 1990, 500):
        arrived = log.record.packets[:, PACKET.arrived]
        new = log.record.packets[(arrived >= first) & (arrived < first + 500)]
        fast = log.record.fast[first : first + 500]
        step(batch, np.stack([fast, fast]), np.stack([new, new]))
    for each in batch:
        assert (each.x == filter_.x).all() and (each.P == filter_.P).all()


def test_a_snapshot_goes_on() -> None:
    log, facts = drive()
    filter_ = make_estimator("exact-kf", **facts, latency={"gyro": "find"})
    split = log.record.packets[:, PACKET.arrived] < 700
    filter_.step(log.record.fast[:700], log.record.packets[split])
    snapshot = filter_.get_state()
    ends = []
    for _ in range(2):
        filter_.step(log.record.fast[700:], log.record.packets[~split])
        ends.append(filter_.x)
        filter_.set_state(snapshot)
    assert (ends[0] == ends[1]).all()


def test_a_single_packet_counts_at_once() -> None:
    log, facts = drive()
    filter_ = make_estimator("exact-kf", **facts, latency=LATE)
    came = log.record.packets[:, PACKET.arrived] < 700
    filter_.step(log.record.fast[:700], log.record.packets[came])
    before, packet = filter_.P, log.record.packets[~came][0]
    packet[PACKET.arrived] = 699.0
    filter_.update(packet)
    assert filter_.P[0, 0] < before[0, 0] and filter_.counts["future"] == 0


def test_without_a_latency_it_is_the_filter_that_it_was() -> None:
    log, facts = drive()
    for none in ({}, {"gyro": 0.0}):
        filter_ = make_estimator("exact-kf", **facts, latency=none)
        assert type(filter_) is Estimator
        assert (filter_.run(log).x == make_estimator("exact-kf", **facts).run(log).x).all()


def test_the_bound_that_knows_it_is_a_bound() -> None:
    """A late gyro costs, a punctual one that is slower costs no less; the filter reaches it."""
    log, facts = drive()
    told: Any = {"record": log.record, "sensors": facts["sensors"], "speed": FIG7.speed}
    best = [compute_error_bound(FIG7.truth, **told, latency=x) for x in ({}, LATE, {"gyro": 0.12})]
    assert (best[0][500:] < best[1][500:]).all() and (best[1][500:] < best[2][500:]).all()


@pytest.mark.parametrize(
    ("name", "options", "error", "message"),
    [
        ("exact-kf", {"gyro": -0.01}, ValueError, "latency of gyro is 0 to 0.5 s"),
        ("exact-kf", {"gyro": np.nan}, ValueError, "latency of gyro is 0 to 0.5 s"),
        ("exact-kf", {"gyro": 0.6}, ValueError, "latency of gyro is 0 to 0.5 s"),
        ("exact-kf", {"gyro": 0.0605}, ValueError, "gyro of 0.0605 s is no whole number of ticks"),
        ("exact-kf", {"sonar": 0.1}, ValueError, "latency is of steer, gyro"),
        ("joint", {"gyro": "find", "steer": "find"}, ValueError, "is 'find' for one channel"),
        ("exact-kf", {"gyro": "find"}, ValueError, "for one channel of a filter with tyres as sta"),
        ("multirate-residual-kf", LATE, ValueError, "latency, delay='larsen' and delay='buffer' n"),
        ("exact-kf", 0.06, TypeError, "latency is seconds by channel"),
    ],
)
def test_what_a_latency_cannot_be(name: str, options: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        make_estimator(name, sensors={"camera": CAMERA}, speed=7.0, latency=options)


def test_a_lost_filter_says_so_with_a_latency_too() -> None:
    """Beside one without: the same health and, where it is lost, a deviation as wide."""
    scenario = {"base": "coms-slalom", "gyro_bias": 0.4}
    found = []
    for latency in ({}, {"gyro": 0.001}):
        env: Any = gym.make("sideslip/YawFusion-v1", scenario=scenario)
        env = EstimateObservation(env, "joint", options={"latency": latency})
        env.reset(seed=0)
        infos = [env.step(np.zeros(1))[4] for _ in range(300)]
        healthy = np.mean([info["healthy"] for info in infos])
        found.append((healthy, np.mean([info["beta_std"] for info in infos[100:]])))
    (healthy, deviation), (late_healthy, late_deviation) = found
    assert healthy < 0.5 and late_healthy == pytest.approx(healthy, abs=0.05)
    assert late_deviation == pytest.approx(deviation, rel=0.2)


@pytest.fixture(scope="module")
def log() -> Log:
    """0.5 s of a drive with both slow sensors."""
    return rollout(gym.make("sideslip/YawFusion-v0"), seed=3, options={"duration": 0.5}).log


@pytest.mark.parametrize(
    ("name", "options", "layers"),
    [
        ("exact-kf", {}, [0]),
        pytest.param(  # side by side, uncorrelated
            "double-layer",
            {},
            [0, 1],
            marks=pytest.mark.filterwarnings("ignore:double-layer cannot see"),
        ),
        ("joint", {}, [0]),
    ],
)
def test_it_is_its_records(log: Log, name: str, options: dict[str, Any], layers: list[int]) -> None:
    estimator = make_estimator(name, sensors=log.slow, **options)
    estimator.run(log)
    x, P = np.zeros(0), np.zeros((len(estimator.names),) * 2)
    for f in estimator.filters[layers]:
        rows = slice(len(x), len(x) + int(f.n))
        x, P[rows, rows] = np.append(x, f.x[: f.n]), f.P[: f.n, : f.n]
    assert np.array_equal(estimator.x, x)
    assert np.array_equal(estimator.P, P)


@pytest.mark.parametrize("name", ["multirate-kf", "multirate-residual-kf", "lob-2"])
def test_with_periodic_gains_it_is_a_triangle_of_the_table(log: Log, name: str) -> None:
    estimator = make_estimator(name, sensors=log.slow)
    estimator.run(log)
    f, n = estimator.filters[0], len(estimator.names)
    row = estimator.gains[f.cell, 1 + f.at * max(int(f.fasts), 1)]
    upper = np.zeros((n, n))
    upper[np.triu_indices(n)] = row[int(f.total) : int(f.total) + n * (n + 1) // 2]
    assert np.array_equal(estimator.P, upper + np.triu(upper, 1).T)
    assert np.array_equal(estimator.x, f.x[:n])


def test_a_table_that_is_missing_is_made_for_the_covariance_alone(log: Log) -> None:
    estimator = make_estimator("multirate-kf", sensors=log.slow)
    assert not estimator.x.any()
    assert not estimator.gains.any()
    settled = estimator.P
    assert estimator.gains[0].any() and np.linalg.eigvalsh(settled).min() > 0.0


FIND = {"gyro": "find"}
FACTS: dict[str, Any] = {"sensors": {"camera": CAMERA}, "speed": FIG7.speed}


def joint(front: float, rear: float, **options: Any) -> Any:
    """Its nominal car has other tyres than the true one by these factors."""
    car = FIG7.truth.scale_stiffness(front, rear)
    return make_estimator("exact-kf", vehicle=car, **WITH_TYRES, **FACTS, **options)


TYRES, LATENCIES = ((1.0, 1.0), (0.7, 1.3), (1.4, 0.7)), (0.0, 0.013, 0.06, 0.1)
QUICK = {(TYRES[0], 0.0), (TYRES[2], 0.06)}
SLOW = [pair for pair in itertools.product(TYRES, LATENCIES) if pair not in QUICK]


@pytest.mark.parametrize(
    ("tyres", "late"),
    [*sorted(QUICK), *(pytest.param(*pair, marks=pytest.mark.long) for pair in SLOW)],
)
def test_it_finds_the_latency_whatever_the_tyres(tyres: tuple[float, float], late: float) -> None:
    filter_ = joint(*tyres, latency=FIND)
    log = later(simulate(FIG7, FACTS["sensors"], 0), {"gyro": late} if late else {})
    estimates = filter_.run(log)
    off = filter_.latency["gyro"] - late
    assert filter_.latency_sd < 0.003 and abs(off) <= max(4.0 * filter_.latency_sd, 0.001)
    plain = joint(*tyres)
    punctual = plain.run(simulate(FIG7, FACTS["sensors"], 0))
    if late == 0.0:
        assert (estimates.x == punctual.x).all()
    squares = [np.mean((x["beta"] - log.truth["beta"])[2000:] ** 2) for x in (estimates, punctual)]
    assert squares[0] < 1.2 * squares[1]


@pytest.mark.parametrize("dt", [0.1, 0.25])
def test_rows_too_far_apart_are_refused(dt: float) -> None:
    with pytest.raises(ValueError, match=f"rows every {dt:g} s tell nothing: say the latency"):
        _LatencySearch((FAST.gyro,), dt)


@pytest.mark.parametrize("least", [0.0, 3.2, 37.3, 62.6, 118.4, 120.0])
def test_between_the_lags_that_are_tried_a_parabola_has_the_least(least: float) -> None:
    search = _LatencySearch((FAST.gyro,), 0.001)
    lag, bend, _ = search._minimise_nis(lambda lag: 7.0 + 0.25 * (lag - least) ** 2)
    assert lag == round(least) and bend == pytest.approx(0.5)


def straight(rows: int) -> Log:
    """A car on a straight road: gyro and camera have noise, nothing turns."""
    rng = np.random.default_rng(0)
    fast = np.zeros((rows, len(FAST)))
    fast[:, FAST.wheel_left] = fast[:, FAST.wheel_right] = FIG7.speed
    fast[:, FAST.gyro] = 0.005 * rng.standard_normal(rows)
    packets = np.zeros((rows // 33, PACKET_WIDTH))
    packets[:, PACKET.captured] = packets[:, PACKET.arrived] = 33.0 * np.arange(len(packets))
    packets[:, PACKET.quality] = 1.0
    packets[:, PACKET.value] = 3.5e-3 * rng.standard_normal(len(packets))
    packets[:, PACKET.value + 1] = 0.02 * rng.standard_normal(len(packets))
    return Log(Record(fast, packets), FACTS["sensors"])


def test_it_leaves_alone_what_a_log_cannot_tell_and_goes_on_looking() -> None:
    """A straight road has no latency; where the car turns at last it is found."""
    filter_, still = joint(1.0, 1.0, latency=FIND), straight(9900)
    filter_.run(still)
    assert filter_.latency == {"gyro": 0.0} and filter_.latency_sd == np.inf
    turn = simulate(FIG7, FACTS["sensors"], 0).record
    packets = turn.packets.copy()
    packets[:, [PACKET.captured, PACKET.arrived]] += 9900.0
    both = Record(
        np.concatenate([still.record.fast, turn.fast]),
        np.concatenate([still.record.packets, packets]),
    )
    filter_.run(later(Log(both, still.slow), {"gyro": 0.06}))
    assert filter_.latency["gyro"] == pytest.approx(0.06, abs=0.003)


@pytest.mark.parametrize("late", [0.0, 0.1])
def test_a_gps_alone_finds_a_gyro_that_is_far_too_late(late: float) -> None:
    """Its optimum is flat, but no latency is surely worse."""
    table, truth, car = drive_table()
    gyro = table.yaw_rate_radps.shift(round(late / 0.01)).bfill()
    log = read_parts(table.assign(yaw_rate_radps=gyro))[0][0]
    errors = []
    for latency in (FIND, {"gyro": late}):
        facts: Any = {"vehicle": car, "sensors": log.slow, "dt": log.record.dt}
        filter_ = make_estimator("joint", latency=latency, **facts)
        error = (filter_.run(log)["beta"] - truth)[1000:]
        errors.append(np.sqrt(np.mean(error**2)))
    assert errors[0] < 1.2 * errors[1]
