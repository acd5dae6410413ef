"""The informed controller: LQG of the true linear car with the same sensors, DESIGN section 4."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym

from ..envs.scenario import Scenario
from ..envs.sensors import HDOP_LAWS
from ..envs.vehicle import Vehicle
from ..estimators import EstimateObservation, vector
from ..estimators.truth import STIFFNESSES, TruthObservation
from ..estimators.truth_vector import TruthObservation as VectorTruthObservation
from ..estimators.wrappers import TRUTH
from .given import AnyEnv
from .lqr import Lqr

OUTPUTS = ["beta", "gamma", "F_d", "N_d"]


TYRES = 4.0
"""How much more than the scenario's disturbance an informed filter expects where tyres saturate.

What Fiala tyres lack against their own stiffness is a disturbance to a linear filter. Of 1, 2, 4
and 8, tried on random-steering of YawFusion and YawVision (seeds 1000 to 1029), 8 has the least
mean cost, but pays for it where tyres do not saturate (YawVision's median is 0.97, with 4 it is
0.68); 4 is the compromise. It serves a filter told the nominal car as well: where tyres saturate,
most of what this controller gains on `lqr` with the scenario's own levels comes from it, not from
knowing the stiffnesses. Compare at equal levels (`levels_of`).
"""


def levels_of(scenario: Scenario) -> dict[str, Any]:
    """Options of `exact-kf` that say the noise and the disturbances of a scenario.

    The course's noise follows the HDOP that comes with each packet, as far as the scenario's does.
    """
    noise = dict(scenario.noise)
    share = HDOP_LAWS[scenario.hdop_law]
    more = 1.0 if scenario.linear_tyres else TYRES
    told = {
        "force_sd": more * scenario.disturbance_force,
        "moment_sd": more * scenario.disturbance_moment,
        "disturbance_time": scenario.disturbance_time,
        "hdop_table": [(1.0, 1.0), (101.0, 1.0 + 100.0 * share)],
    }
    names = {"gyro": "gyro_noise", "camera_psi": "psi_noise", "camera_y": "y_l_noise"}
    return told | {option: noise[key] for key, option in names.items() if key in noise}


class Informed(Lqr):
    """`lqr` designed on the true car: its gains are scheduled on the true stiffnesses too.

    For an env whose observation has `true_front_stiffness` and `true_rear_stiffness` and the
    estimates of a filter that was told the truth: `make_informed` builds both.

    Arguments and errors are those of `lqr`.
    """

    def __init__(self, env: AnyEnv, **options: Any) -> None:
        super().__init__(env, stiffness=[f"true_{name}" for name in STIFFNESSES], **options)


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
        env = TruthObservation(EstimateObservation(alone, "exact-kf", **filtered))
    else:
        rows: Any = gym.make_vec(
            env_id, num_envs=num_envs, vector_kwargs=dict(vector_kwargs or {}), **kwargs
        )
        env = VectorTruthObservation(vector.EstimateObservation(rows, "exact-kf", **filtered))
    return env, Informed(env, disturbance_time=base.scenario.disturbance_time, vehicle=car)
