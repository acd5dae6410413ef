"""Tables of drives of cars that were drawn in world v1, with one fault each, from seeds."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

import sideslip
from sideslip.benchmarks.harness.drives import draw_steering, record_drive
from sideslip.envs.record import FAST, PACKET, Array
from sideslip.envs.vehicle.parameters import PASSENGER_CAR, Vehicle

assert sideslip.__version__
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
