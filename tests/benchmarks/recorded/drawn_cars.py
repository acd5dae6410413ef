"""Cars that the stated one is not, each driven twice: for the identification and held out."""

import dataclasses
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from sideslip.agents.rollout import rollout
from sideslip.benchmarks.harness.drives import draw_steering
from sideslip.envs.record import FAST, PACKET, Log
from sideslip.envs.vehicle.parameters import LATERAL_FIELDS, PASSENGER_CAR, Vehicle, critical_speed

from .simulated import decimated

EVERY, STEP = 10, 0.01  # ticks to a row; s of a steering trace
NOISE = {"gyro": 0.005, "accel": 0.1, "wheel": 0.05, "course": 0.0407}


class DrawnCar(NamedTuple):
    """A car and its logs: one to identify from, one held out; late: s, of the GPS."""

    car: Vehicle
    log: Log
    held_out: Log
    late: float


def scenario_of(car: Vehicle) -> dict[str, Any]:
    """Disturbed drives of this car after a steering trace, which is to be added."""
    return {
        "base": "random-steering", "steering": "trace", "trace_step": STEP, "half_width": 1e4,
        "surge_frequency": 0.05, "disturbance_force": 150.0, "disturbance_moment": 150.0,
        "front_stiffness": 1.0, "rear_stiffness": 1.0,
        "vehicle": {name: getattr(car, name) for name in (*LATERAL_FIELDS, "sprung_mass")},
    }  # fmt: skip


def simulate(scenario: dict[str, Any], seed: int) -> Log:
    """A drive at 100 Hz whose GPS packets bear the time of their arrival."""
    env: Any = gym.make("sideslip/YawGps-v0", scenario=scenario, vehicle="passenger-car")
    log = decimated(rollout(env, seed=seed).log)
    log.record.packets[:, PACKET.captured] = log.record.packets[:, PACKET.arrived]
    return log


def without(log: Log, accel: bool, course: bool) -> Log:
    """The log without its lateral acceleration, without its GPS."""
    record = log.record
    if accel:
        fast = record.fast.copy()
        fast[:, FAST.accel_y] = 0.0
        present = tuple(name for name in record.present if name != "accel_y")
        record = dataclasses.replace(record, fast=fast, present=present)
    if course:
        record = dataclasses.replace(record, packets=record.packets[:0])
    return dataclasses.replace(log, record=record, slow={} if course else log.slow)


def drawn_car(seed: int, duration: float = 60.0, held_out: float = 30.0) -> DrawnCar:
    """A passenger car with other tyres, inertia and load, and its two drives; one that the steering
    loses is drawn again."""
    rng = np.random.default_rng((seed, 7))
    while True:
        drawn = _drawn(rng, seed, duration, held_out)
        if all(
            len(log.time) > 0.95 * each / (EVERY * 1e-3)
            for log, each in zip((drawn.log, drawn.held_out), (duration, held_out), strict=True)
        ):
            return drawn


def _drawn(rng: np.random.Generator, seed: int, duration: float, held_out: float) -> DrawnCar:
    stated = PASSENGER_CAR
    speed, surge = rng.uniform(14.0, 24.0), rng.choice([0.0, rng.uniform(0.2, 0.8)])
    while True:
        front, rear = rng.uniform(0.6, 1.4, 2)
        ratio, load = rng.uniform(0.7, 1.1), rng.uniform(0.0, 0.25)
        mass = stated.mass * (1.0 + load)
        car = stated.scale_stiffness(front, rear).replace(
            mass=mass,
            sprung_mass=stated.sprung_mass + load * stated.mass,
            yaw_inertia=ratio * mass * stated.front_arm * stated.rear_arm,
        )
        if critical_speed(car) > speed + 6.0:
            break
    noisy = np.exp(rng.uniform(np.log(0.5), np.log(4.0)))
    scenario = scenario_of(car) | {
        "speed": speed, "surge": surge, "friction": rng.uniform(0.8, 1.0),
        "gyro_bias": rng.uniform(-0.005, 0.005), "gps_latency": round(rng.uniform(0.1, 0.3), 2),
        "noise": {name: noisy * size for name, size in NOISE.items()},
    }  # fmt: skip
    logs = []
    for drive, lasts in enumerate((duration, held_out)):
        changes: dict[str, Any] = {"speed": speed * rng.uniform(0.85, 1.1)} if drive else {}
        size = rng.uniform(0.5, 1.2) * 0.05 * min(1.0, (16.0 / speed) ** 1.2)
        trace = draw_steering(rng, size, lasts)
        changes |= {"trace": tuple(trace), "duration": lasts}
        logs.append(simulate(scenario | changes, 2 * seed + drive))
    log = without(logs[0], accel=seed % 2 == 1, course=seed % 4 >= 2)
    return DrawnCar(car, log, logs[1], scenario["gps_latency"])
