"""Periodic gains are the limit; what diverges is refused, what cannot be seen is named."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sideslip.benchmarks.papers.manoeuvres import PAPER_TUNINGS
from sideslip.envs.record import FAST, FAST_WIDTH, PACKET_WIDTH, Record
from sideslip.envs.sensors.link import SlowSensor
from sideslip.envs.vehicle.parameters import COMS
from sideslip.estimators import make_estimator
from sideslip.estimators.design.periodic import design_and_map, spectral_radius
from sideslip.estimators.estimator import CHECKED_SPEEDS
from tests.estimators.simulation import CAMERA, FIG6, FIG7, GPS, Drive, simulate

SETS = {
    "camera": {"camera": CAMERA},
    "uneven": {"camera": SlowSensor(0.033, (0.020, 0.015, 0.010, 0.025))},
    "gps": {"gps": GPS},
    "late-gps": {"gps": SlowSensor(0.1, (0.25,), phase=0.030)},
}
LONG = type(FIG7)(duration=80.0)


@pytest.mark.parametrize(
    ("name", "which"),
    [
        ("multirate-kf", "uneven"),
        ("multirate-kf", "late-gps"),
        ("single-rate-kf", "camera"),
        ("single-rate-kf", "gps"),
    ],
)
def test_periodic_gains_equal_the_covariance_filters_limit(name: Any, which: Any) -> None:
    log = simulate(LONG, SETS[which], 0)
    common: dict[str, Any] = {"sensors": log.slow, "speed": LONG.speed, "q_psi": 1e-5}
    if "camera" in log.slow:
        common["q_y_l"] = 1e-4
    periodic = make_estimator(name, gains="periodic", **common)
    covariance = make_estimator(name, gains="covariance", **common)
    a, b = periodic.run(log), covariance.run(log)
    late = log.time > 75.0
    assert np.abs((a.x - b.x)[late] / b.std[late]).max() < 1e-6
    np.testing.assert_allclose(a.std[late], b.std[late], rtol=1e-9)
    np.testing.assert_allclose(periodic.P, covariance.P, rtol=1e-7, atol=1e-18)


def test_gains_have_a_limit_where_the_covariance_has_none() -> None:
    with pytest.warns(UserWarning, match="cannot see"):
        filter_ = make_estimator("dakf", sensors={"gps": GPS}, speed=7.0, gains="periodic")
    filter_.P  # noqa: B018  designs the table
    assert np.isfinite(filter_.gains).all()
    assert filter_.spectral_radius == pytest.approx(1.0, abs=1e-9)


def test_gains_are_made_for_each_speed_when_it_is_reached() -> None:
    """A filter that measures its speed has, at a held one, the gains of the nearest table."""
    log = simulate(FIG7, {"camera": CAMERA}, 1)
    measured = make_estimator("multirate-kf", sensors=log.slow)
    told = make_estimator("multirate-kf", sensors=log.slow, speed=7.0)
    measured.run(log)
    told.run(log)
    cell = int(measured.filters[0].cell)
    assert 1.5 + 0.5 * cell == 7.0
    np.testing.assert_array_equal(measured.gains[cell], told.gains[0])
    assert measured.gains[cell - 1].max() == 0.0  # never asked for


def test_a_changing_speed_rebuilds_the_model_by_half_a_percent() -> None:
    rows = np.zeros((4000, FAST_WIDTH))
    rows[:, FAST.wheel_left] = rows[:, FAST.wheel_right] = np.linspace(3.0, 12.0, 4000)
    filter_ = make_estimator("multirate-kf", sensors={"camera": CAMERA})
    speeds = []
    for row in rows[::10]:
        filter_.step(np.repeat(row[None], 10, 0), np.zeros((0, PACKET_WIDTH)))
        speeds.append(float(filter_.filters[0].model_speed))
    lowpass = 3.0
    for k, row in enumerate(np.repeat(rows[::10, FAST.wheel_left], 10)):
        lowpass = row if k == 0 else lowpass + (1.0 - np.exp(-0.001 / 0.015)) * (row - lowpass)
    assert speeds[-1] == pytest.approx(lowpass, rel=0.0051)
    steps = np.diff([s for i, s in enumerate(speeds) if i == 0 or s != speeds[i - 1]])
    assert steps.min() > 0.005 * 3.0


def test_a_record_may_start_at_any_tick() -> None:
    sensors = {"camera": SlowSensor(0.033, (0.020, 0.010), phase=0.004)}
    log = simulate(type(FIG7)(duration=0.5), sensors, 5)
    later = log.record.packets.copy()
    later[:, 1:3] += 660.0
    for name in ("multirate-kf", "single-rate-kf", "exact-kf"):
        filter_ = make_estimator(name, sensors=sensors, speed=FIG7.speed)
        once = filter_.run(log.record)
        again = filter_.run(Record(log.record.fast, later, 660))
        np.testing.assert_array_equal(once.x, again.x)
        assert again.time[0] == pytest.approx(0.660)


def test_the_error_map_is_what_the_compiled_filter_does() -> None:
    """Column by column: a small error put in comes out as the map says, one cycle later."""
    sensors = {"camera": SlowSensor(0.033, (0.020, 0.010))}
    for name in ("multirate-kf", "multirate-residual-kf"):
        filter_ = make_estimator(name, vehicle=COMS, sensors=sensors, speed=7.0)
        filter_.P  # noqa: B018  designs the table
        f, schedule = filter_.filters[0], filter_._schedules[0]
        _, M = design_and_map(f, schedule, 7.0, filter_.config)
        N, n = int(f.total), int(f.n)
        cycle = schedule.cycle
        rows = np.zeros((5 * cycle, FAST_WIDTH))
        packets = np.zeros((10, PACKET_WIDTH))
        for i in range(10):
            packets[i, :5] = 0, 33 * i, 33 * i + (20, 10)[i % 2], 1, i
        due = packets[packets[:, 2] < 2 * cycle]
        for column in range(n):
            filter_.reset()
            filter_.step(rows[: 2 * cycle], due)
            state = filter_.get_state()
            state["x"][0, :N] = 0.0
            state["x"][0, column] = -1.0  # error = truth - estimate
            filter_.set_state(state)
            later = (packets[:, 2] >= 2 * cycle) & (packets[:, 2] < 3 * cycle)
            filter_.step(rows[2 * cycle : 3 * cycle], packets[later])
            np.testing.assert_allclose(-filter_.x, M[:n, column], atol=1e-12)


def test_a_filter_whose_error_grows_is_refused_with_the_number() -> None:
    options: dict[str, Any] = {"sensors": {"camera": CAMERA}, "speed": 40.0}
    with pytest.raises(ValueError, match=r"multirate-residual-kf.*factor of 1\.0\d+.*40 m/s"):
        make_estimator("multirate-residual-kf", **options)
    filter_ = make_estimator("multirate-residual-kf", allow_unstable=True, **options)
    assert filter_.spectral_radius > 1.0 + 1e-9


def test_one_that_starts_to_diverge_on_the_way_is_refused_there() -> None:
    filter_ = make_estimator("multirate-residual-kf", sensors={"camera": CAMERA})
    rows = np.zeros((10, FAST_WIDTH))
    rows[:, [FAST.wheel_left, FAST.wheel_right]] = 40.0
    with pytest.raises(ValueError, match="error grows"):
        filter_.step(rows, np.zeros((0, PACKET_WIDTH)))


@pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")
def test_a_gyro_bias_drives_dakf_off() -> None:
    """0.05 deg/s for 120 s at a standstill of everything else; the three-state filter stays."""
    still = Drive(amplitude=0.0, duration=120.0)
    bias = np.radians(0.05)
    log = simulate(still, {"gps": GPS}, 0, gyro_bias=bias, disturbed=False, quiet=True)
    common: dict[str, Any] = {"vehicle": FIG6.told, "sensors": log.slow, "speed": still.speed}
    tuned = {name: PAPER_TUNINGS[name] for name in ("dakf", "course-kf")}
    tuned["dakf"]["q_psi"] = 1e-8  # psi is gamma's integral
    dakf, three = (
        make_estimator(name, **common, **options).run(log)["beta"]
        for name, options in tuned.items()
    )
    assert dakf[-1] == pytest.approx(-120.0 * bias, rel=0.02)  # the whole integral of the bias
    assert abs(three[-1]) < 0.02
    assert abs(three[-1] - three[90_000]) < 1e-3 < abs(dakf[-1] - dakf[90_000])


def test_random_delay_is_judged_by_its_extremes() -> None:
    sensors = {"camera": SlowSensor(0.033, (0.010,), jitter=0.020)}
    filter_ = make_estimator("exact-kf", sensors=sensors, speed=7.0)
    ends = [
        make_estimator("exact-kf", sensors={"camera": SlowSensor(0.033, (d,))}, speed=7.0)
        for d in (0.010, 0.030)
    ]
    assert filter_.spectral_radius == pytest.approx(max(e.spectral_radius for e in ends), abs=1e-9)


def test_spectral_radius_of_a_rotation_is_its_growth() -> None:
    turn = 1.25 * np.array([[0.0, -1.0], [1.0, 0.0]])
    assert spectral_radius(turn) == pytest.approx(1.25)


def test_a_filter_with_two_slow_sensors_is_checked_with_the_first_alone() -> None:
    """Its states, so that the directions are those that a second sensor may see."""
    both = {"camera": CAMERA, "gps": SlowSensor(0.1, (0.25,))}
    fused = make_estimator("exact-kf", sensors=both, slow=["camera", "gps"], speed=7.0)
    alone = make_estimator("exact-kf", sensors=both, slow="camera", speed=7.0)
    assert fused.unobservable == alone.unobservable == ()
    assert fused.spectral_radius == alone.spectral_radius


def test_a_filter_is_checked_with_the_rows_of_the_speed() -> None:
    """An accelerometer's row depends on the speed: the map at 3 m/s is that of a filter of 3 m/s,
    whose settled gains let no error grow, whatever the car."""
    options: dict[str, Any] = {"fast": ["gyro", "accel_y"], "bank_sd": 0.01, "slow": "camera"}
    car = replace(COMS, rear_stiffness=1.4 * COMS.rear_stiffness)
    arguments = options | {"vehicle": car, "sensors": {"camera": CAMERA}}
    anywhere = make_estimator("exact-kf", **arguments)
    for speed in CHECKED_SPEEDS:
        alone = make_estimator("exact-kf", speed=speed, **arguments)
        maps = []
        for each in (anywhere, alone):
            schedule = each._schedules[0]
            maps.append(design_and_map(each.filters[0], schedule, speed, each.config)[1])
        np.testing.assert_allclose(maps[0], maps[1], rtol=1e-9, atol=1e-12)
        assert alone.spectral_radius < 1.0
