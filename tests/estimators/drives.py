"""Drives of the environment with every state of the exact filter known at every tick.

Random numbers are pure functions of (key, tick, channel), so an env with perfect sensors at every
tick drives exactly as the one whose sensors are noisy, slow and late: its record is the truth.
"""

from typing import Any

import numpy as np

from sideslip.envs import Log, SlowSensor, StabilityEnv
from sideslip.envs.record import FAST, PACKET, Record, concatenate
from sideslip.envs.scenarios.scenario import Scenario
from sideslip.envs.sensors.inertial import Noise
from sideslip.envs.vehicle.linear import LinearModel, make_vision_model

STATES = ("beta", "gamma", "psi", "y_l", "F_d", "N_d")
_PERFECT: dict[str, Any] = {
    "camera": {"period": 0.001, "delays": (0.0,)},
    "gps": {"period": 0.001, "delays": (0.0,)},
}


class Drives:
    """A scenario of the small-angle plant on linear tyres, with camera and GPS.

    camera, gps: fields of `SlowSensor` that replace the id's.
    """

    def __init__(self, scenario: str | Scenario, camera: Any = None, gps: Any = None) -> None:
        self._env = StabilityEnv("fusion", scenario, control_period=1000, camera=camera, gps=gps)
        silent = self._env.scenario.replace(noise=dict.fromkeys(Noise._fields, 0.0))
        self._twin = StabilityEnv("fusion", silent, control_period=1000, **_PERFECT)
        self._env.reset(seed=0)
        self.vehicle, speed = self._env.vehicle, self._env.held_speed
        assert speed is not None
        self.speed: float = speed

    def run(self, seed: int) -> Log:
        """An episode less its last tick, whose force is not seen; its truth holds `STATES`."""
        record = record_episode(self._env, seed)
        truth = dict(zip(STATES, self._truth(record_episode(self._twin, seed)).T, strict=True))
        last = len(record.fast) - 1
        packets = record.packets[record.packets[:, PACKET.arrived] < last]
        return Log(Record(record.fast[:last], packets), self._env.slow_sensors, truth)

    def _truth(self, record: Record) -> np.ndarray:
        """`STATES` (K - 1, 6) of a record (K rows) of perfect sensors."""
        seen = [record.select_packets(sensor)[:, PACKET.value :] for sensor in ("camera", "gps")]
        psi, y_l = seen[0][:, 0], seen[0][:, 1]
        x = np.column_stack([seen[1][:, 0] - psi, record.fast[:, FAST.gyro], psi, y_l])
        car, model = self.vehicle, make_vision_model(self.vehicle, self.speed)
        push = np.zeros((4, 2))
        push[0, 0], push[1, 1] = 1.0 / (car.mass * self.speed), 1.0 / car.yaw_inertia
        G, H = model.discretise(record.dt)
        pushed = LinearModel(model.A, push, model.C, model.states, ("F", "N"), ())
        _, D = pushed.discretise(record.dt)
        rest = x[1:] - x[:-1] @ G.T - np.outer(record.fast[1:, FAST.steer], H[:, 0])
        force = rest @ np.linalg.pinv(D).T
        # the plant is that linear model, but for Kutta's error
        assert np.abs(rest - force @ D.T).max() < 1e-9
        return np.hstack([x[:-1], force])


def record_episode(env: StabilityEnv, seed: int) -> Record:
    """The whole record of an uncontrolled episode."""
    env.reset(seed=seed)
    records, over = [env.record], False
    while not over:
        _, _, terminated, over, _ = env.step(np.zeros(1, np.float32))
        assert not terminated
        records.append(env.record)
    return concatenate(records)


def told(log: Log, *names: str) -> dict[str, SlowSensor]:
    """Some of a log's slow sensors, as a filter is told them."""
    return {name: log.slow[name] for name in names}
