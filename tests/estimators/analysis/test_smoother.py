"""The smoother equals conditioning on what is captured up to its horizon."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.rollout import rollout
from sideslip.envs.record import PACKET, Log, Record
from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import make_estimator, smooth
from tests.estimators.core.test_conditioning import CASES
from tests.estimators.simulation import CAMERA, FIG7, GPS, Drive, simulate

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")

SHORT = Drive(duration=0.5)


@pytest.mark.parametrize(
    "case",
    [
        "forces, camera and gps",
        "forces, both, measured speed",
        "none, vision alone",
        "walk, gps, measured speed",
    ],
)
@pytest.mark.parametrize("lag", [math.inf, 0.1])
def test_every_tick_equals_dense_gaussian_conditioning(case: Any, lag: float) -> None:
    told = CASES[case]
    for seed in range(3):
        log = told.schedule(seed)
        found = smooth(told.build("clone"), log, lag)
        block = told.rows if math.isinf(lag) else round(lag / told.dt)
        for start in range(0, told.rows, block):
            end = min(start + 2 * block, told.rows)  # what the block knows
            packets = log.record.packets[log.record.packets[:, PACKET.captured] < end]
            dense = told.posterior(found.names, Record(log.record.fast[:end], packets, dt=told.dt))
            for k in range(start, min(start + block, told.rows)):
                mean, cov = dense.at(k)
                sd = np.sqrt(np.diag(cov))
                assert np.abs((found.x[k] - mean) / sd).max() < 1e-8
                assert np.abs(found.std[k] / sd - 1.0).max() < 1e-8


def test_more_future_never_knows_less() -> None:
    log = simulate(SHORT, {"camera": CAMERA, "gps": GPS}, 0)
    options: Any = {"slow": ["camera", "gps"], "speed": FIG7.speed}
    filtered = make_estimator("exact-kf", sensors=log.slow, **options).run(log)
    before = filtered.std
    for lag in (0.02, 0.1, math.inf):
        found = smooth("exact-kf", log, lag, **options)
        assert (found.std <= before * (1.0 + 1e-9)).all()
        before = found.std if lag == 0.1 else filtered.std
    assert found.names == filtered.names and len(found.time) == len(filtered.time)
    np.testing.assert_allclose(found.std[-1], smooth("exact-kf", log, 0.1, **options).std[-1])


def test_the_truth_lies_nearer_and_as_near_as_it_says() -> None:
    drive = Drive(duration=4.0, real=6000.0)
    facts: Any = {"vehicle": drive.truth, "speed": drive.speed}
    filter_ = make_estimator("exact-kf", sensors={"camera": CAMERA}, **facts)
    errors, nees = np.zeros(2), []
    for seed in range(4):
        log = simulate(drive, {"camera": CAMERA}, seed)
        late = log.time > 1.0
        error = (smooth(filter_, log, 0.5)["gamma"] - log.truth["gamma"])[late]
        errors[0] += np.mean((filter_.run(log)["gamma"] - log.truth["gamma"])[late] ** 2)
        errors[1] += np.mean(error**2)
        nees.append(np.mean((error / smooth(filter_, log, 0.5).std[late, 1]) ** 2))
    assert errors[1] < 0.5 * errors[0]
    assert 0.8 < np.mean(nees) < 1.25


def test_an_estimator_of_any_rule_is_smoothed_alike_and_left_alone() -> None:
    log = simulate(SHORT, {"camera": CAMERA}, 2)
    built = {
        rule: make_estimator("exact-kf", sensors=log.slow, speed=7.0, delay=rule)
        for rule in ("clone", "buffer", "larsen", "stored", "ignore")
    }
    built["clone"].run(log)
    before = built["clone"].x
    found = {rule: smooth(filter_, log, 0.1) for rule, filter_ in built.items()}
    for estimates in found.values():
        np.testing.assert_array_equal(estimates.x, found["clone"].x)
        np.testing.assert_array_equal(estimates.nis, found["clone"].nis)
    np.testing.assert_array_equal(built["clone"].x, before)
    used = log.record.packets[:, PACKET.arrived] < len(log.record.fast)
    assert np.isfinite(found["clone"].nis[used]).all()


def test_a_filter_whose_noise_changes_as_it_drives_is_smoothed_with_that_noise() -> None:
    """`joint` rewrites its process noise every few rows; what comes later makes it surer."""
    env: Any = gym.make("sideslip/YawFusion-v0", scenario="coms-slalom")
    log, car = rollout(env, seed=1).log, env.unwrapped.vehicle
    runs = [make_estimator("joint", vehicle=car, sensors=log.slow).run(log)]
    runs += [smooth("joint", log, lag, vehicle=car) for lag in (0.2, 1.0, math.inf)]
    rows, beta = log.time > 2.0, runs[0].names.index("beta")
    errors = [np.sqrt(np.mean((run["beta"] - log.truth["beta"])[rows] ** 2)) for run in runs]
    deviations = [run.std[rows, beta].mean() for run in runs]
    assert max(errors[1:]) < 0.9 * errors[0]
    assert deviations == sorted(deviations, reverse=True)


def test_a_state_that_is_known_exactly_stays_known() -> None:
    log = simulate(SHORT, {"camera": CAMERA}, 3)
    prior = dict.fromkeys(("beta", "gamma", "psi", "y_l"), 0.0)
    found = smooth("exact-kf", log, 0.2, speed=7.0, prior=prior)
    assert np.isfinite(found.x).all() and np.isfinite(found.std).all()
    np.testing.assert_array_equal(found.x[0, :4], 0.0)
    np.testing.assert_array_equal(found.std[0, :4], 0.0)


@pytest.mark.parametrize(
    ("name", "options", "lag", "error", "message"),
    [
        ("multirate-residual-kf", {}, 1.0, ValueError, "one constant gain"),
        ("double-layer", {}, 1.0, ValueError, "double-layer: a smoother needs one layer"),
        ("single-rate-kf", {}, 1.0, ValueError, "samples used when they come"),
        ("multirate-kf", {"delay": "lag"}, 1.0, ValueError, "no states that lag"),
        ("lob", {}, 1.0, TypeError, "unknown option 'gains'"),
        ("exact-kf", {}, 0.0, ValueError, "lag is in s and positive, got 0.0"),
        ("exact-kf", {}, float("nan"), ValueError, "lag is in s and positive, got nan"),
        ("exact-kf", {}, 0.0105, ValueError, "the lag of 0.0105 s is no whole number of ticks"),
    ],
)
def test_what_is_not_smoothed(name: Any, options: Any, lag: Any, error: Any, message: Any) -> None:
    log = simulate(SHORT, {"camera": CAMERA, "gps": GPS}, 0)
    with pytest.raises(error, match=message):
        smooth(name, log, lag, speed=7.0, **options)


def test_options_are_for_a_name_and_a_log_for_its_filter() -> None:
    log = simulate(SHORT, {"camera": CAMERA}, 0)
    filter_ = make_estimator("exact-kf", sensors=log.slow, speed=7.0)
    with pytest.raises(TypeError, match="exact-kf is built, got gate"):
        smooth(filter_, log, gate=0.9)
    with pytest.raises(ValueError, match="built for the camera"):
        smooth(filter_, Log(log.record, {"camera": SlowSensor(0.05)}))
    periodic = make_estimator("multirate-kf", sensors=log.slow, speed=7.0)
    with pytest.raises(ValueError, match=r"multirate-kf: a smoother needs .*gains='covariance'"):
        smooth(periodic, log)
