"""The filter that knows the truth says how wrong it is: NEES, NIS and Riccati on the env's drives.

A statistic of one instant of each run is used where its distribution needs independent numbers:
errors within a run are correlated, runs are not. Innovations of an optimal filter are white, so
every packet counts.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from sideslip.envs import Log
from sideslip.envs.record import PACKET
from sideslip.envs.scenarios.manoeuvres import make_scenario
from sideslip.estimators import Estimator, make_estimator
from sideslip.estimators.design.options import MEASUREMENTS, NOISE, FilterOptions, select_states
from tests.estimators.drives import Drives, told
from tests.estimators.riccati import riccati

RUNS = 128
SURE = 0.999
SETS = [("camera",), ("gps",), ("camera", "gps")]
FIG7 = make_scenario("tie-vision-fig7")
LATE = {  # out of order, and three fixes under way at once
    "camera": {"delays": (0.010,), "jitter": 0.040},
    "gps": {"period": 0.1, "delays": (0.25,)},
}


def exact(drives: Drives, log: Log, sensors: tuple[str, ...], **options: Any) -> Estimator:
    """exact-kf told the truth, which starts from the known start as the bound does."""
    options.setdefault("prior", dict.fromkeys(select_states(sensors), 0.0))
    return make_estimator(
        "exact-kf",
        vehicle=drives.vehicle,
        sensors=told(log, *sensors),
        slow=list(sensors),
        speed=drives.speed,
        **options,
    )


def variances(vehicle: Any, **options: Any) -> dict[str, np.ndarray]:
    """By state, (ticks,) each, of the optimal estimates."""
    P, names = riccati(vehicle, **options)
    return {name: P[:, i, i] for i, name in enumerate(names)}


def errors(filter_: Estimator, x: np.ndarray, log: Log) -> np.ndarray:
    """Estimate minus truth, (K, n)."""
    return x - np.column_stack([log.truth[state] for state in filter_.names])


class Verdict(NamedTuple):
    """NEES over its mean with the interval it must lie in, the same of NIS, KS of NIS."""

    nees: float
    nees_within: tuple[float, float]
    nis: float
    nis_within: tuple[float, float]
    p: float

    @property
    def consistent(self) -> bool:
        """Whether all three tests are passed."""
        (a, b), (c, d) = self.nees_within, self.nis_within
        return a < self.nees < b and c < self.nis < d and self.p > 1.0 - SURE


def judge(filter_: Estimator, logs: list[Log]) -> Verdict:
    """NEES of all states at the last tick of every run; NIS of every packet used."""
    rows = np.array([len(MEASUREMENTS[sensor].rows) for sensor in ("camera", "gps")])
    nees, nis, dof = 0.0, [], []
    for log in logs:
        estimates = filter_.run(log)
        last = errors(filter_, estimates.x, log)[-1]
        nees += last @ np.linalg.solve(filter_.P, last)
        used = np.isfinite(estimates.nis)
        nis.append(estimates.nis[used])
        dof.append(rows[log.record.packets[used, PACKET.sensor].astype(int)])
    n, m = len(logs) * len(filter_.names), int(np.concatenate(dof).sum())
    seen = np.concatenate(nis)
    p = kstest(chi2.cdf(seen, np.concatenate(dof)), "uniform").pvalue
    return Verdict(nees / n, within(n), float(seen.sum()) / m, within(m), float(p))


def within(dof: int) -> tuple[float, float]:
    """Where chi-square over its mean lies with the probability `SURE`."""
    low, high = chi2.ppf([(1.0 - SURE) / 2.0, (1.0 + SURE) / 2.0], dof) / dof
    return float(low), float(high)


class Runs(NamedTuple):
    drives: Drives
    logs: list[Log]


def short_runs(**sensors: Any) -> Runs:
    """3 s each: the covariance has settled after 2 s."""
    drives = Drives(FIG7.replace(duration=3.0), **sensors)
    return Runs(drives, [drives.run(seed) for seed in range(RUNS)])


@pytest.fixture(scope="module")
def prompt() -> Runs:
    return short_runs()


@pytest.mark.parametrize("sensors", SETS, ids="-".join)
def test_told_the_truth_it_is_consistent(prompt: Runs, sensors: Any) -> None:
    verdict = judge(exact(prompt.drives, prompt.logs[0], sensors), prompt.logs)
    assert verdict.consistent, verdict


COURSE = math.radians(0.14) * 60.0 / 25.0  # rad, at 25 km/h
LIES: list[tuple[str, dict[str, Any]]] = [
    *(("camera", {key: NOISE[key] / 1.5}) for key in ("gyro_noise", "psi_noise", "y_l_noise")),
    ("gps", {"course_noise": COURSE / 1.5}),
    *(("camera", {key: getattr(FilterOptions, key) / 1.5}) for key in ("force_sd", "moment_sd")),
    ("gps", {"force_sd": FilterOptions.force_sd / 1.5}),
    ("camera", {"delay": "ignore"}),
]


@pytest.mark.parametrize(("sensor", "lie"), LIES, ids=str)
def test_told_a_noise_that_is_1_5_times_too_small_or_no_delay_it_is_not(
    prompt: Runs, sensor: Any, lie: Any
) -> None:
    verdict = judge(exact(prompt.drives, prompt.logs[0], (sensor,), **lie), prompt.logs)
    assert not verdict.consistent, verdict


@pytest.mark.parametrize("sensors", SETS, ids="-".join)
def test_what_it_says_of_every_state_is_the_recursion_in_textbook_letters(
    prompt: Runs, sensors: Any
) -> None:
    drives, log = prompt.drives, prompt.logs[0]
    filter_ = exact(drives, log, sensors)
    best = variances(drives.vehicle, sensors=told(log, *sensors), speed=drives.speed, seconds=1.0)
    std = filter_.run(log).std[: len(best["beta"])]
    for state, found in zip(filter_.names, std.T, strict=True):
        np.testing.assert_allclose(found**2, best[state], rtol=1e-8, atol=1e-18, err_msg=state)


@pytest.mark.long
@pytest.mark.parametrize("rule", ["clone", "buffer"])
def test_late_and_permuted_samples_leave_it_consistent(rule: Any) -> None:
    runs = short_runs(**LATE)
    filter_ = exact(runs.drives, runs.logs[0], ("camera", "gps"), delay=rule)
    verdict = judge(filter_, runs.logs)
    assert verdict.consistent, verdict


@pytest.mark.long
def test_monte_carlo_variances_are_riccatis() -> None:
    """900 runs of 10 s, averaged over time from 2 s on: beta within 3 %, every other state within
    four standard errors, which the spread over the runs tells (within a run errors are
    correlated)."""
    drives, runs, start = Drives("tie-vision-fig7"), 900, 2000
    log = drives.run(0)
    filters = {sensors: exact(drives, log, sensors) for sensors in SETS}
    squares: dict[Any, list[np.ndarray]] = {sensors: [] for sensors in SETS}
    for seed in range(runs):
        log = drives.run(seed)
        for sensors, filter_ in filters.items():
            late = errors(filter_, filter_.run(log).x, log)[start:]
            squares[sensors].append(np.mean(late**2, 0))
    for sensors, filter_ in filters.items():
        common: Any = {"sensors": told(log, *sensors), "speed": drives.speed}
        seconds = len(log.record.fast) * log.record.dt
        best = variances(drives.vehicle, seconds=seconds, **common)
        for i, state in enumerate(filter_.names):
            each = np.array(squares[sensors])[:, i]
            mean, wanted = each.mean(), best[state][start:].mean()
            error = each.std(ddof=1) / np.sqrt(runs)
            assert abs(mean - wanted) < 4.0 * error, (sensors, state, mean / wanted)
            assert state != "beta" or abs(mean / wanted - 1.0) < 0.03, (sensors, mean / wanted)
        louder = variances(drives.vehicle, seconds=seconds, force_sd=52.0, **common)
        assert louder["beta"][start:].mean() > 1.06 * best["beta"][start:].mean()  # it would show
