"""Drives of known cars as logs, with sensors that err as they may."""

import dataclasses
import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

from sideslip.agents.rollout import rollout
from sideslip.envs.record import FAST, PACKET, Log
from sideslip.envs.vehicle.parameters import Vehicle

EVERY = 10  # ticks to a row
PLAIN = {"tyres": "linear", "roll": False, "lags": False}
TURNS = {
    "base": "random-steering", "duration": 40.0, "speed": (18.0, 22.0), "amplitude": (0.01, 0.02),
    "amplitude_2": (0.005, 0.01), "surge": 0.7, "surge_frequency": 0.05, "disturbance_force": 100.0,
    "disturbance_moment": 60.0, "front_stiffness": (0.7, 1.3), "rear_stiffness": (0.7, 1.3),
}  # fmt: skip


@functools.cache
def drive(
    seed: int,
    ratio: float = 1.0,
    offset: float = 0.0,
    late: float = 0.0,
    plain: bool = False,
    **changes: float,
) -> tuple[Log, Vehicle]:
    """(log, true car) of a passenger car at 100 Hz; ratio: with the sign, of the logged steering;
    offset: rad at the wheels; late: s, of the GPS, whose packets bear the time of their arrival."""
    scenario: dict[str, Any] = TURNS | (PLAIN if plain else {}) | {"gps_latency": late} | changes
    env: Any = gym.make("sideslip/YawFusion-v0", scenario=scenario, vehicle="passenger-car")
    log = decimated(rollout(env, seed=seed).log)
    log.record.fast[:, FAST.steer] = (log.record.fast[:, FAST.steer] - offset) * ratio
    log.record.packets[:, PACKET.captured] = log.record.packets[:, PACKET.arrived]
    return dataclasses.replace(log, truth={}), env.unwrapped.vehicle


def decimated(log: Log, every: int = EVERY) -> Log:
    """Every so many rows of a log, with its GPS alone; its steering is the mean of the rows."""
    whole = log.record.fast[1:]
    fast = whole[every - 1 :: every].copy()
    steer = whole[:, FAST.steer][: len(fast) * every].reshape(-1, every).mean(axis=1)
    fast[:, FAST.steer] = steer
    packets = log.record.select_packets("gps").copy()
    ticks = [PACKET.captured, PACKET.arrived]
    packets[:, ticks] = np.ceil(packets[:, ticks] / every)
    within = (packets[:, PACKET.captured] >= 1) & (packets[:, PACKET.arrived] <= len(fast))
    record = dataclasses.replace(
        log.record, fast=fast, packets=packets[within], first=1, dt=every * log.record.dt
    )
    truth = {name: values[1:][every - 1 :: every] for name, values in log.truth.items()}
    slow = {name: sensor for name, sensor in log.slow.items() if name == "gps"}
    return dataclasses.replace(log, record=record, slow=slow, truth=truth)


def as_table(log: Log) -> pd.DataFrame:
    fast = log.record.fast
    course = np.full(len(fast), np.nan)
    packets = log.record.packets
    course[(packets[:, PACKET.captured] - log.record.first).astype(int)] = packets[:, PACKET.value]
    return pd.DataFrame({
        "time_s": log.time, "speed_x_mps": fast[:, FAST.wheel_left],
        "yaw_rate_radps": fast[:, FAST.gyro], "accel_y_mps2": fast[:, FAST.accel_y],
        "steer_rad": np.append(fast[1:, FAST.steer], fast[-1, FAST.steer]), "course_rad": course,
    })  # fmt: skip
