"""Noise and latency from a log without truth: found, judged on the other half, or refused."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest

from sideslip.benchmarks.tuning.likelihood import LogTuning, cut_half, tune
from sideslip.envs.record import FAST, Array, Log
from sideslip.envs.recordings.log_file import read_parts
from sideslip.envs.vehicle.parameters import PASSENGER_CAR, Vehicle
from sideslip.estimators import make_estimator
from sideslip.estimators.analysis.innovations import compute_log_densities
from sideslip.estimators.wires import SignalCalibration
from tests.benchmarks.recorded.drawn_cars import drawn_car
from tests.benchmarks.recorded.simulated import as_table


@cache
def drive(seed: int) -> tuple[Log, Vehicle, float]:
    """A log as a user has it, with the truth that only the judge reads; its car, its latency."""
    drawn = drawn_car(seed, 80.0, 5.0)
    table = as_table(drawn.log).assign(sideslip_rad=drawn.log.truth["beta"])
    return read_parts(table)[0][0], drawn.car, drawn.late


def compute_rms(tuning: LogTuning, log: Log, x: Array) -> float:
    delayed = tuning.delay(log, x)
    error = tuning.make_filter(delayed, x).run(delayed)["beta"] - log.truth["beta"]
    return float(np.sqrt(np.mean(error[200:] ** 2)))


def test_on_a_late_gps_the_other_half_errs_little_more_than_with_truth() -> None:
    """One drive; docs/identify.md has others, on which it errs more."""
    log, car, late = drive(4)
    blind = dataclasses.replace(log, truth={})
    suite, wires, found = tune("joint", blind, car)
    assert abs(wires.latency["gps"] - late) < 0.05
    assert "Too poor" not in suite.verdict
    first, second = cut_half(log, False), cut_half(log, True)
    tuning = LogTuning("joint", first, car, {}, SignalCalibration())
    with_truth = tuning.search(lambda x: compute_rms(tuning, first, x))
    without = np.array([
        (math.log(found[p.name]) if p.is_noise else found[p.name]) if p.name in found else p.start
        for p in tuning.parameters
    ])  # fmt: skip
    error = compute_rms(tuning, second, without)
    assert error < 1.1 * compute_rms(tuning, second, with_truth)
    start = np.array([p.start for p in tuning.parameters])
    assert error < compute_rms(tuning, second, start)


def test_a_straight_calm_drive_is_too_poor() -> None:
    log, car, _ = drive(4)
    fast = log.record.fast.copy()
    rng = np.random.default_rng(0)
    fast[:, FAST.steer] = 0.0
    fast[:, FAST.gyro] = 0.003 * rng.standard_normal(len(fast))
    fast[:, FAST.accel_y] = 0.1 * rng.standard_normal(len(fast))
    calm = dataclasses.replace(log, record=dataclasses.replace(log.record, fast=fast))
    suite, wires, found = tune("joint", calm, car)
    assert suite.verdict.startswith("Too poor a log: no excitation")
    assert not found and wires == SignalCalibration()


def test_density_is_that_of_the_filter_itself() -> None:
    """The filter goes through the same states, and a packet's density has its own NIS."""
    log, car, _ = drive(4)
    filter_ = make_estimator("joint", vehicle=car, sensors=log.slow, dt=log.record.dt)
    expected = filter_.run(log)
    fast, packets, residuals = compute_log_densities(filter_, log)
    np.testing.assert_allclose(filter_.x, expected.x[-1], atol=1e-12)
    assert np.isfinite(fast).all() and residuals.shape == (len(fast), 2)
    used = np.isfinite(expected.nis)
    spread = packets[used] + 0.5 * np.minimum(expected.nis[used], 50.0)  # -ln(sd sqrt(2 pi))
    sd = np.exp(-spread) / math.sqrt(2.0 * math.pi)
    assert used.sum() > 100 and (sd > 1e-3).all() and (sd < 1.0).all()


def test_a_filter_without_a_covariance_is_refused() -> None:
    log, _, _ = drive(4)
    filter_ = make_estimator(
        "multirate-kf", vehicle=PASSENGER_CAR, sensors=log.slow, dt=log.record.dt
    )
    with pytest.raises(ValueError, match="multirate-kf: a likelihood needs"):
        compute_log_densities(filter_, log)
