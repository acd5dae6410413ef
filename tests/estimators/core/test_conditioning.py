"""The filter equals conditioning the joint Gaussian of all ticks on everything that arrived."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from sideslip.envs.record import PACKET, Log, Record
from sideslip.envs.sensors.link import SlowSensor
from sideslip.estimators import make_estimator
from tests.estimators.dense import Posterior, arrivals, inputs, speeds

pytestmark = pytest.mark.filterwarnings("ignore::sideslip.estimators.UnobservableWarning")

PRIOR = {"beta": 0.02, "gamma": 0.05, "psi": 0.05, "y_l": 0.3, "F_d": 50.0, "N_d": 20.0}
PRIOR |= {"d1": 0.1, "d2": 1.0, "phi": 0.02, "phi_rate": 0.05}
PRIOR |= {"bias": 0.01, "accel_bias": 0.2, "bank": 0.02, "camera_yaw": 0.005, "steer_offset": 0.002}
INERTIAL = ("gyro", "accel_y", "roll_rate")
HDOP = ((1.0, 1.0), (2.0, 1.5), (5.0, 4.0))
EXACT = 1e-10  # of the posterior's standard deviation
SCHEDULES = 8  # of each case

CAMERA = SlowSensor(0.035, (0.0, 0.050, 0.020), jitter=0.100)
GPS = SlowSensor(0.050, (0.030,), jitter=0.120)
FAST_GPS = SlowSensor(0.025, (0.0,), jitter=0.150)


@dataclass
class Case:
    """A filter, what it is told, and its ticks."""

    name: str
    sensors: Any
    speed: Any = None
    Q: tuple[float, ...] = ()
    options: Any = field(default_factory=dict)
    dt: float = 0.005
    rows: int = 80

    def build(self, delay: str) -> Any:
        told: Any = {"slow": list(self.sensors), "dt": self.dt, "gains": "covariance"}
        if self.Q:
            told["Q"] = self.Q
        told |= {"sensors": self.sensors, "speed": self.speed, "delay": delay}
        return make_estimator(self.name, **(told | self.options))

    def schedule(self, seed: int, clock: bool = True) -> Log:
        """A record and clocks of their own."""
        rng = np.random.default_rng(seed)
        slow = {}
        for name, sensor in self.sensors.items():
            ticks = int(rng.integers(0, round(sensor.period / self.dt)))
            slow[name] = dataclasses.replace(sensor, phase=ticks * self.dt)
        fast = inputs(rng, self.rows)
        return Log(Record(fast, arrivals(rng, slow, self.rows, self.dt, clock), dt=self.dt), slow)

    def posterior(self, names: Any, record: Record) -> Posterior:
        """Of the states at all ticks."""
        noise = np.array(self.Q) * self.dt if self.Q else np.zeros(len(names))
        if "F_d" in names:
            at = names.index("F_d")
            drawn = (1.0 - math.exp(-self.dt / 0.3) ** 2) * np.array([50.0, 20.0]) ** 2
            noise[at : at + 2] = drawn
        V = speeds(record.fast, record.dt)
        return Posterior(
            list(names),
            record,
            np.array([PRIOR[name] for name in names]) ** 2,
            noise,
            V if self.speed is None else np.full_like(V, self.speed),
            fast=self.options.get("fast", () if self.name == "vision-only-kf" else ("gyro",)),
            factor=lambda hdop: np.interp(hdop, *np.array(HDOP).T),
        )


BOTH = {"camera": CAMERA, "gps": GPS}
QUICK = {
    "camera": SlowSensor(0.007, (0.003,), 0.0, 0.015),
    "gps": SlowSensor(0.011, (0.0,), 0, 0.03),
}
ACCEL: dict[str, Any] = {"fast": INERTIAL[:2]}
MISALIGNED = {"camera_yaw_sd": 0.005, "steer_offset_sd": 0.002}
BIASES = {"bias_sd": 0.01, "accel_bias_sd": 0.2, "bank_sd": 0.02}
CASES = {
    "forces, camera and gps": Case("exact-kf", BOTH, 7.0),
    "forces, camera": Case("exact-kf", {"camera": CAMERA}, 3.0),
    "forces, gps": Case("exact-kf", {"gps": FAST_GPS}, 15.0),
    "forces, both, measured speed": Case("exact-kf", {"camera": CAMERA, "gps": FAST_GPS}),
    "forces at 1 ms": Case("exact-kf", QUICK, 7.0, dt=0.001, rows=100),
    "none, camera": Case("multirate-kf", {"camera": CAMERA}, 7.0, (3e-3, 2e-2, 1e-4, 1e-4)),
    "none, both": Case("multirate-kf", BOTH, 12.0, (3e-3, 2e-2, 0.0, 0.0)),
    "none, vision alone": Case("vision-only-kf", {"camera": CAMERA}, None, (3e-3, 2e-2, 0.0, 0.0)),
    "walk, gps": Case("dakf", {"gps": GPS}, 7.0, (4e-4, 4e-4, 1e-8, 3e-2, 0.2)),
    "accelerometer, roll rate, bias": Case(
        "exact-kf", BOTH, 7.0, options={"fast": INERTIAL} | BIASES
    ),
    "all that is misaligned": Case("exact-kf", BOTH, options=ACCEL | BIASES | MISALIGNED),
    "misaligned, roll rate": Case(
        "exact-kf", {"camera": CAMERA}, 7.0, options={"fast": INERTIAL} | MISALIGNED
    ),
    "accelerometer, measured speed": Case("exact-kf", {"camera": CAMERA}, options=dict(ACCEL)),
    "roll rate, gps": Case("exact-kf", {"gps": FAST_GPS}, 12.0, options={"fast": INERTIAL[::2]}),
    "no disturbance, accelerometer's bias": Case(
        "exact-kf",
        {"camera": CAMERA},
        options=ACCEL | {"accel_bias_sd": 0.2, "disturbances": "none"},
    ),
    "bias, gps": Case("exact-kf", {"gps": FAST_GPS}, options={"bias_sd": 0.01, "bank_sd": 0.02}),
    "walk, accelerometer, bias": Case(
        "dakf",
        {"gps": GPS},
        7.0,
        (4e-4, 4e-4, 1e-8, 0.0, 0.0, 3e-2, 0.2, 0.0),
        {"fast": INERTIAL, "bias_sd": 0.01},
    ),
    "walk, gps, measured speed": Case("dakf", {"gps": GPS}, None, (4e-4, 4e-4, 1e-8, 3e-2, 0.2)),
}
for _case in CASES.values():  # HDOP is told to all that hear a GPS
    if "gps" in _case.sensors:
        _case.options["hdop_table"] = HDOP


def differences(filter_: Any, mean: Any, cov: Any) -> float:
    """The largest in states, standard deviations and covariances, over the standard deviation."""
    sd = np.sqrt(np.diag(cov))
    return float(
        max(
            np.abs((filter_.x - mean) / sd).max(),
            np.abs(np.sqrt(np.diag(filter_.P)) / sd - 1.0).max(),
            np.abs((filter_.P - cov) / np.outer(sd, sd)).max(),
        )
    )


@pytest.mark.parametrize("case", CASES)
def test_clone_and_buffer_equal_dense_gaussian_conditioning(case: Any) -> None:
    """Of the whole problem, whatever is late, out of order, lost or here twice."""
    told = CASES[case]
    clone, buffer = told.build("clone"), told.build("buffer")
    twice = late = 0
    for seed in range(SCHEDULES):
        log = told.schedule(seed)
        mean, cov = told.posterior(clone.names, log.record).at(told.rows - 1)
        for filter_ in (clone, buffer):
            filter_.run(log)
            skipped = {name for name, count in filter_.counts.items() if count}
            assert skipped <= {"duplicates"}
            assert differences(filter_, mean, cov) < EXACT
        assert clone.counts == buffer.counts
        assert differences(clone, buffer.x, buffer.P) < EXACT
        twice += clone.counts["duplicates"]
        late += int((np.diff(log.record.packets[:, PACKET.captured]) < 0).sum())
    assert twice > SCHEDULES // 4 and late > SCHEDULES // 4  # that the schedules were hard


@pytest.mark.parametrize("delay", ["clone", pytest.param("buffer", marks=pytest.mark.plain)])
def test_so_they_do_at_every_tick_on_the_way(delay: Any) -> None:
    told = CASES["forces, camera and gps"]
    filter_ = told.build(delay)
    log = told.schedule(99)
    for rows in (1, 2, 17, 40, 63):
        here = log.record.packets[:, PACKET.arrived] < rows
        record = Record(log.record.fast[:rows], log.record.packets[here], dt=told.dt)
        filter_.run(Log(record, log.slow))
        mean, cov = told.posterior(filter_.names, record).at(rows - 1)
        assert differences(filter_, mean, cov) < EXACT


@pytest.mark.parametrize("case", ["forces, camera and gps", "walk, gps, measured speed"])
def test_the_buffer_needs_no_clock(case: Any) -> None:
    """Samples captured at any ticks; what a clone has no place for."""
    told = CASES[case]
    buffer, clone = told.build("buffer"), told.build("clone")
    for seed in range(SCHEDULES):
        log = told.schedule(seed, clock=False)
        buffer.run(log)
        mean, cov = told.posterior(buffer.names, log.record).at(told.rows - 1)
        assert buffer.counts["unknown"] == buffer.counts["refused"] == 0
        assert differences(buffer, mean, cov) < EXACT
    clone.run(log)
    assert clone.counts["unknown"] > 0
