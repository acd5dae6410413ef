"""Tables of drives of cars that were drawn in world v1, with one fault each, from seeds."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

from sideslip.benchmarks.harness.drives import draw_steering, record_drive
from sideslip.envs.record import FAST, PACKET, Array
from sideslip.envs.vehicle.parameters import PASSENGER_CAR, Vehicle

DT, EVERY = 0.01, 10  # s of a row; ticks
REST = 300  # rows at a standstill before every second drive
_SIGNALS = {
    "speed_x_mps": FAST.wheel_left, "yaw_rate_radps": FAST.gyro, "accel_y_mps2": FAST.accel_y,
    "accel_x_mps2": FAST.accel_x, "steer_rad": FAST.steer,
}  # fmt: skip
_NOISE = {"speed_x_mps": 0.01, "yaw_rate_radps": 0.004, "accel_y_mps2": 0.05, "accel_x_mps2": 0.05}
Fault = Callable[[pd.DataFrame, np.random.Generator], Any]


@functools.cache
def drive(seed: int, duration: float = 40.0) -> tuple[pd.DataFrame, Vehicle]:
    """(table, the car that is assumed) of a drive in world v1, whose errors the seed draws: load,
    tyres, scales, offsets, biases, bank, gusts, vibration, stamps, and the manoeuvre."""
    rng = np.random.default_rng((seed, 45))
    while True:
        speed = rng.uniform(10.0, 28.0)
        kind = ("trace", "slalom", "sweep", "trace")[seed % 4]
        size = rng.uniform(0.5, 1.0) * 0.05 * min(1.0, (15.0 / speed) ** 1.5)
        scenario: dict[str, Any] = {
            "base": "random-steering", "steering": kind, "duration": duration, "speed": speed,
            "surge": rng.uniform(0.0, 0.7), "surge_frequency": rng.uniform(0.03, 0.1),
            "friction": rng.uniform(0.75, 1.0), "half_width": 1e5,
            "front_stiffness": rng.uniform(0.8, 1.2), "rear_stiffness": rng.uniform(0.85, 1.2),
            "gyro_bias": rng.uniform(-0.005, 0.005), "accel_y_bias": rng.uniform(-0.1, 0.1),
        }  # fmt: skip
        if kind == "trace":
            trace = draw_steering(rng, size, duration)
            scenario |= {"trace": tuple(trace), "trace_step": 0.01}
        else:
            ends = {"frequency": rng.uniform(0.1, 0.4), "frequency_2": rng.uniform(0.5, 1.0)}
            scenario |= ends | {"amplitude": 0.7 * size, "hold": duration}
        env: Any = gym.make("sideslip/YawFusion-v1", scenario=scenario, vehicle="passenger-car")
        log = record_drive(env, seed)
        if len(log.record.fast) > 0.98 * duration / DT * EVERY:
            break
    fast = log.record.fast[1:]
    n = len(fast) // EVERY
    rows = fast[: n * EVERY].reshape(n, EVERY, -1)
    table = {name: rows[:, -1, column] for name, column in _SIGNALS.items()}
    table["steer_rad"] = np.append(rows[1:, :, FAST.steer].mean(axis=1), rows[-1, -1, FAST.steer])
    fixes = log.record.select_packets("gps")
    places = np.rint(fixes[:, PACKET.captured] / EVERY).astype(int) - 1
    inside = (places >= 0) & (places < n) & (fixes[:, PACKET.quality] > 0.0)
    for name, column in (("course_rad", 0), ("gps_speed_mps", 1)):
        table[name] = np.full(n, np.nan)
        table[name][places[inside]] = fixes[inside, PACKET.value + column]
    frame = pd.DataFrame({"time_s": np.arange(n) * DT, **table})
    return (_add_rest(frame, scenario["gyro_bias"], rng) if seed % 2 else frame), PASSENGER_CAR


def _add_rest(frame: pd.DataFrame, bias: float, rng: np.random.Generator) -> pd.DataFrame:
    """The car stands and moves off straight ahead, up to the speed of the drive."""
    ends = frame["speed_x_mps"].iloc[0] / 3.0  # s, at 3 m/s2
    clock = np.arange(-REST, round(ends / DT)) * DT
    start = pd.DataFrame({name: np.zeros(len(clock)) for name in frame})
    start["speed_x_mps"] = 3.0 * np.maximum(clock, 0.0)
    start["accel_x_mps2"] = np.where(clock > 0.0, 3.0, 0.0)
    start["yaw_rate_radps"] += bias
    fresh = (np.arange(len(clock)) % 20 == 0) & (start["speed_x_mps"] > 1.0)
    course = frame["course_rad"].dropna().iloc[0]
    start["course_rad"] = np.where(fresh, course + rng.normal(0.0, 0.003, len(clock)), np.nan)
    start["gps_speed_mps"] = np.where(fresh, start["speed_x_mps"], np.nan)
    for name, size in _NOISE.items():
        start[name] += rng.normal(0.0, size, len(clock))
    start["time_s"] = clock
    later = frame.assign(time_s=frame["time_s"] + clock[-1] + DT)
    return pd.concat([start, later], ignore_index=True)


def _of(name: str, change: Callable[[Array, np.random.Generator], Array]) -> Fault:
    """A fault that changes the values of one column."""
    return lambda x, rng: x.assign(**{name: change(x[name].to_numpy(), rng)})


def _hold(x: Array, rng: np.random.Generator) -> Array:
    """Repeat every fifth to twentieth value."""
    rows = np.arange(len(x))
    return x[rows - rows % rng.integers(5, 21)]


def _interpolate(x: Array, rng: np.random.Generator) -> Array:
    """Draw lines between every tenth to fiftieth value, or between samples."""
    rows, known = np.arange(len(x)), np.flatnonzero(np.isfinite(x))
    known = known[:: int(rng.integers(10, 51))] if len(known) == len(rows) else known
    return np.interp(rows, known, np.unwrap(x[known]))


def _gap(x: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    start = int(rng.uniform(0.4, 0.7) * len(x))
    return x.drop(index=range(start, start + int(rng.uniform(40, 500))))


def _outage(x: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    start, x = int(rng.uniform(0.4, 0.6) * len(x)), x.copy()
    x.loc[start : start + int(rng.uniform(300, 1000)), ["course_rad", "gps_speed_mps"]] = np.nan
    return x


def shift_fixes(x: pd.DataFrame, late: Array) -> pd.DataFrame:
    """Fixes so many s later, each by its own time."""
    columns = ["course_rad", "gps_speed_mps"]
    rows = np.flatnonzero(np.isfinite(x["course_rad"]))
    to = rows + np.rint(late[rows] / DT).astype(int)
    inside = (to >= 0) & (to < len(x))
    values, x = x[columns].to_numpy()[rows[inside]], x.assign(**dict.fromkeys(columns, np.nan))
    x.loc[x.index[to[inside]], columns] = values
    return x


def _late(x: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    return shift_fixes(x, np.full(len(x), rng.uniform(0.25, 0.8)))


def _drift(x: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """A clock that is 1 to 2 % fast or slow."""
    rate = rng.uniform(0.01, 0.02) * rng.choice([-1, 1])
    return shift_fixes(x, rate * (np.arange(len(x)) - 0.5 * len(x)) * DT)


def _clip(x: Array, rng: np.random.Generator) -> Array:
    limit = rng.uniform(0.4, 0.7) * np.percentile(np.abs(x), 99)
    return np.clip(x, -limit, limit)


def _stop(x: Array, rng: np.random.Generator) -> Array:
    """Hold a value for the rest of the drive."""
    start = int(rng.uniform(0.3, 0.6) * len(x))
    return np.where(np.arange(len(x)) < start, x, x[start])


def _times(name: str, low: float, high: float) -> Fault:
    """A column times a factor."""
    return _of(name, lambda x, rng: x * rng.uniform(low, high))


def _scaled(name: str, low: float, high: float) -> Fault:
    """A column times 1 + so much, or divided by it."""
    return _of(name, lambda x, rng: x * (1.0 + rng.uniform(low, high)) ** rng.choice([-1, 1]))


def _added(name: str, low: float, high: float) -> Fault:
    return _of(name, lambda x, rng: x + rng.uniform(low, high) * rng.choice([-1, 1]))


def _rounded(name: str, low: float, high: float) -> Fault:
    def change(x: Array, rng: np.random.Generator) -> Array:
        step = rng.uniform(low, high)
        return np.asarray(step * np.rint(x / step))

    return _of(name, change)


def _swapped(one: str, other: str) -> Fault:
    return lambda x, rng: x.rename(columns={one: other, other: one})


def _still(x: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Hardly any turn: every lateral signal is small beside its noise, but for biases."""
    share, x = rng.uniform(0.0, 0.05), x.copy()
    for name in ("yaw_rate_radps", "accel_y_mps2", "steer_rad"):
        x[name] = share * x[name] + rng.normal(0.0, _NOISE.get(name, 0.0), len(x))
    fixes = x["course_rad"].dropna()
    x.loc[fixes.index, "course_rad"] = fixes.iloc[0] + share * (np.unwrap(fixes) - fixes.iloc[0])
    return x


def _repeated(x: pd.DataFrame, rng: np.random.Generator) -> pd.DataFrame:
    """Rows that come twice, or with the stamps of rows before."""
    time, rows = x["time_s"].to_numpy().copy(), rng.choice(len(x) - 10, 20, replace=False) + 5
    time[rows] -= DT * rng.integers(1, 4)
    return x.assign(time_s=time)


def _without(name: str) -> Fault:
    return lambda x, rng: x.drop(columns=[name, *["gps_speed_mps"] * name.startswith("course")])


DEG = 180.0 / np.pi
FAULTS: dict[str, tuple[Fault, str, str]] = {  # the fault, the check that finds it, its channel
    "yaw rate in degrees": (_times("yaw_rate_radps", DEG, DEG), "unit", "yaw_rate"),
    "steering in degrees": (_times("steer_rad", DEG, DEG), "ratio", "steer"),
    "course in degrees": (_times("course_rad", DEG, DEG), "unit unrelated", "course"),
    "speed in km/h": (_times("speed_x_mps", 3.6, 3.6), "unit", "speed_x"),
    "acceleration in g": (_times("accel_y_mps2", 1 / 9.81, 1 / 9.81), "unit", "accel_y"),
    "yaw rate turned": (_times("yaw_rate_radps", -1, -1), "sign", "yaw_rate"),
    "steering turned": (_times("steer_rad", -1, -1), "sign", "steer"),
    "course of a compass": (
        lambda x, rng: x.assign(course_rad=np.pi / 2 - x["course_rad"]), "sign", "course"),
    "acceleration turned": (_times("accel_y_mps2", -1, -1), "sign", "accel_y"),
    "steering wheel": (_times("steer_rad", 2.5, 20.0), "ratio", "steer"),
    "scale of yaw rate": (_scaled("yaw_rate_radps", 0.15, 0.5), "scale unit", "yaw_rate"),
    "scale of acceleration": (_scaled("accel_y_mps2", 0.3, 0.6), "scale unit", "accel_y"),
    "scale of speed": (_scaled("speed_x_mps", 0.08, 0.4), "scale unit", "speed_x"),
    "held steering": (_of("steer_rad", _hold), "held", "steer"),
    "held yaw rate": (_of("yaw_rate_radps", _hold), "held", "yaw_rate"),
    "held course": (lambda x, rng: x.ffill().bfill(), "held", "course"),
    "interpolated speed": (_of("speed_x_mps", _interpolate), "interpolated", "speed_x"),
    "interpolated course": (_of("course_rad", _interpolate), "interpolated", "course"),
    "gap": (_gap, "gaps", "time"),
    "outage": (_outage, "gaps", "course"),
    "clock drift": (_drift, "drift", "course"),
    "course late": (_late, "late", "course"),
    "bias of yaw rate": (_added("yaw_rate_radps", 0.8 / DEG, 3.0 / DEG), "bias", "yaw_rate"),
    "bias of acceleration": (_added("accel_y_mps2", 1.4, 4.0), "bias", "accel_y"),
    "offset of steering": (_added("steer_rad", 1.1 / DEG, 3.0 / DEG), "bias", "steer"),
    "saturated yaw rate": (_of("yaw_rate_radps", _clip), "saturation", "yaw_rate"),
    "saturated acceleration": (_of("accel_y_mps2", _clip), "saturation", "accel_y"),
    "coarse yaw rate": (_rounded("yaw_rate_radps", 0.5 / DEG, 2.0 / DEG), "resolution", "yaw_rate"),
    "coarse steering": (_rounded("steer_rad", 0.45 / DEG, 0.8 / DEG), "resolution", "steer"),
    "stuck yaw rate": (_of("yaw_rate_radps", _stop), "stuck", "yaw_rate"),
    "stuck steering": (_of("steer_rad", _stop), "stuck", "steer"),
    "stuck acceleration": (_of("accel_y_mps2", _stop), "stuck", "accel_y"),
    "constant course": (_times("course_rad", 0.0, 0.0), "stuck unrelated held", "course"),
    "steering and yaw rate": (_swapped("steer_rad", "yaw_rate_radps"), "swapped", "steer"),
    "accelerations": (_swapped("accel_x_mps2", "accel_y_mps2"), "swapped", "accel_x"),
    "no turn": (_still, "excitation", "yaw_rate"),
    "stamps": (_repeated, "stamps", "time"),
    "no yaw rate": (_without("yaw_rate_radps"), "missing", "yaw_rate"),
    "no acceleration": (_without("accel_y_mps2"), "missing", "accel_y"),
    "no course": (_without("course_rad"), "missing", "course"),
}  # fmt: skip


def spoil(number: int, first: int) -> tuple[str, pd.DataFrame]:
    """(name of a fault, a table with it); the number chooses the fault and seeds its size."""
    name = list(FAULTS)[number % len(FAULTS)]
    table, _ = drive(first + number)
    return name, FAULTS[name][0](table, np.random.default_rng((number, first)))
