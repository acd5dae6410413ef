"""The informed controller: LQG of the true linear car with the same sensors."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from ...envs.scenarios.scenario import Scenario
from ...envs.sensors.gps import HDOP_LAWS
from ...envs.vehicle.tyres import SLOW
from ...envs.vehicle.vehicle import GRAVITY, Vehicle
from ...estimators.vector import estimate as vector
from ...estimators.vector.truth import TruthObservation as VectorTruthObservation
from ...estimators.wrappers.estimate import EstimateObservation
from ...estimators.wrappers.truth import STIFFNESSES, TRUTH, TruthObservation
from ..env_facts import AnyEnv
from .base import Array
from .lqr import IN, Lqr

OUTPUTS = ["beta", "gamma", "F_d", "N_d"]
PARAMETERS = (*STIFFNESSES, "friction")
FRICTION = "true_friction"
GRIP = 0.7
"""Share of the rear tyres' grip that the motors may take; 0.71 of it is left across. Of 0.4, 0.7,
0.9 and no limit it costs least on low-friction (without one 8 % of the cars spin there).
"""
STEER_WEIGHT = 100.0
"""The design's weight of added steering over the cost's. A compromise between 1, where the steering
chatters at its rate limit, and 2500: on random-steering and sine-with-dwell it has the least median
cost, on gust 25, on brake-in-turn 2500.
"""


TYRES = 4.0
"""The disturbance that an informed filter expects where tyres saturate, over the scenario's.

What Fiala tyres lack against their own stiffness is a disturbance to a linear filter. Of 1, 2, 4
and 8, tried on random-steering of YawFusion and YawVision (seeds 1000 to 1029), 8 has the least
mean cost, but pays for it where tyres do not saturate (YawVision's median is 0.97, with 4 it is
0.68); 4 is the compromise. It serves a filter of the nominal car as well: where tyres saturate,
most of what this controller gains on `lqr` with the scenario's own levels comes from it, not from
knowing the stiffnesses. Compare at equal levels (`levels_of`).
"""


def levels_of(scenario: Scenario) -> dict[str, Any]:
    """Options of `exact-kf`: the noise and the disturbances of a scenario.

    The course's noise follows the HDOP that comes with each packet, as far as the scenario's does.
    """
    noise = dict(scenario.noise)
    share = HDOP_LAWS[scenario.hdop_law]
    more = 1.0 if scenario.tyres == "linear" else TYRES
    options = {
        "force_sd": more * scenario.disturbance_force,
        "moment_sd": more * scenario.disturbance_moment,
        "disturbance_time": scenario.disturbance_time,
        "hdop_table": [(1.0, 1.0), (101.0, 1.0 + 100.0 * share)],
    }
    names = {"gyro": "gyro_noise", "camera_psi": "psi_noise", "camera_y": "y_l_noise"}
    return options | {option: noise[key] for key, option in names.items() if key in noise}


class Informed(Lqr):
    """`lqr` designed on the true car: its gains are scheduled on the true stiffnesses too.

    It stays within what the true friction lets the tyres give: of the rear ones it takes `GRIP`
    for the yaw moment, and it adds no steering that only slides the front ones.

    For an env whose observation has `true_front_stiffness`, `true_rear_stiffness` and
    `true_friction` and the estimates of a filter of the true car: `make_informed` builds both.
    Arguments and errors are those of `lqr`.
    """

    more = (FRICTION,)

    def __init__(self, env: AnyEnv, **options: Any) -> None:
        true = [f"true_{name}" for name in STIFFNESSES]
        super().__init__(env, stiffness=true, **{"steer_weight": STEER_WEIGHT, **options})
        car = self.vehicle
        per_tyre = car.mass * GRAVITY / (2.0 * car.wheelbase)
        self._moment = GRIP * car.rear_track * per_tyre * car.front_arm / self.full_scale
        self._front_load = per_tyre * car.rear_arm

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        super()._law(inputs, state, action)
        friction = inputs[:, -1]
        most = self._moment * friction
        action[:, 0] = np.clip(action[:, 0], -most, most)
        if self.width == 2:
            wheels, driver = inputs[:, : IN.torque_left], inputs[:, IN.steer_command]
            front = inputs[:, IN.front_stiffness]
            beta, gamma = inputs[:, IN.beta_hat], inputs[:, IN.gamma_hat]
            v = np.maximum(wheels.mean(axis=1), SLOW)
            slides = 3.0 * friction * self._front_load / np.maximum(front, 1.0)  # rad, Fiala's
            straight = beta + self.vehicle.front_arm * gamma / v - driver
            low = np.minimum(straight - slides, 0.0) / self.authority
            high = np.maximum(straight + slides, 0.0) / self.authority
            action[:, 1] = np.clip(action[:, 1], low, high)
            state[:, 0] = action[:, 1] * self.authority  # what its rate is counted from


def make_informed(
    env_id: str,
    num_envs: int | None = None,
    vector_kwargs: Mapping[str, Any] | None = None,
    **kwargs: Any,
) -> tuple[Any, Informed]:
    """(env, agent): the informed controller and the env whose observation it needs.

    kwargs: of the env (scenario, vehicle, ...). num_envs: a vector env of so many rows, whose own
    arguments are vector_kwargs; None: a single one. The filter is `exact-kf` with all of the id's
    slow sensors, the true car of each episode and the scenario's levels of noise and disturbance.
    Of the car, stiffness and friction may differ between episodes; the rest is the env's.

    Raises what `gym.make` and `lqr` raise.
    """
    alone: Any = gym.make(env_id, **kwargs)
    base: Any = alone.unwrapped
    car: Vehicle = base.vehicle
    options = levels_of(base.scenario) | {"slow": list(base.slow_sensors)}
    if "gps" not in base.slow_sensors:
        del options["hdop_table"]
    filtered: dict[str, Any] = {
        "outputs": OUTPUTS,
        "std": False,
        "vehicle": TRUTH,
        "options": options,
    }
    env: Any
    if num_envs is None:
        env = TruthObservation(EstimateObservation(alone, "exact-kf", **filtered), PARAMETERS)
    else:
        rows: Any = gym.make_vec(
            env_id, num_envs=num_envs, vector_kwargs=dict(vector_kwargs or {}), **kwargs
        )
        env = VectorTruthObservation(
            vector.EstimateObservation(rows, "exact-kf", **filtered), PARAMETERS
        )
    return env, Informed(env, disturbance_time=base.scenario.disturbance_time, vehicle=car)
