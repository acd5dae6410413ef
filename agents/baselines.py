"""Oracles, controllers that know more and more of the truth, and the tuned options of entries.

An entry is scored between `nominal`, a well-designed LQG that knows the nominal car alone, and the
better of the two that know state, disturbances and car. `sideslip tune controller` finds the
options of `tuned.toml` by class of tasks: car, disturbances and reference, as in "coms-model".
"""

import dataclasses
import math
from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium as gym

from ..envs.io import read_document
from ..envs.scenarios.manoeuvres import SCENARIOS
from ..envs.scenarios.scenario import Scenario
from ..envs.scenarios.world import IDEAL, WORLD_VERSION, World, get_range
from ..envs.sensors.inertial import Noise
from ..envs.sensors.slow import HDOP_LAWS
from ..envs.validation import check_choice
from ..envs.vehicle.parameters import GRAVITY
from ..estimators.vector import estimate as vector
from ..estimators.vector.estimate import TruthObservation as VectorTruthObservation
from ..estimators.wrappers.estimate import EstimateObservation
from ..estimators.wrappers.truth import STIFFNESSES, TRUTH, TruthObservation
from .controllers.base import FRICTION, Controller
from .controllers.lqr import TRUE_PARAMETERS, Lqr
from .controllers.mpc import Nmpc

NOMINAL = "nominal"
PARAMETER_ORACLES = ("oracle-parameters-lqr", "oracle-parameters-nmpc")
STATE_ORACLES = ("oracle-state-lqr", "oracle-state-nmpc")
ORACLES = (NOMINAL, *PARAMETER_ORACLES, *STATE_ORACLES)
"""Oracles by rising knowledge: `PARAMETER_ORACLES` know car, friction, noise and biases,
`STATE_ORACLES` also the state and the disturbances; neither controller is always the better one."""

FILTER = "exact-kf"
# Options of an oracle's filter for tyres with a limit: it knows them to a tenth, for its tyre law
# differs from the plant's. To a thousandth it is overconfident, and costs 1.1 to 4 times as much.
_TYRE_SDS = ("front_tyres_sd", "rear_tyres_sd", "inverse_friction_sd")
_TYRE_OPTIONS = {"wary": 10} | dict.fromkeys(_TYRE_SDS, 0.1)
OUTPUTS = ("beta", "gamma", "F_d", "N_d")
STATES = (*OUTPUTS, "phi", "phi_rate")
GRIP = 0.7  # fraction of the rear tyres' grip for the yaw moment; sqrt(1 - 0.7^2) is left laterally
STEER_WEIGHT = 100.0  # factor on the cost of added steering, whose rate limit `lqr` does not design
_NOISE = {"gyro": "gyro_noise", "accel": "accel_y_noise", "camera_psi": "psi_noise",
          "camera_y": "y_l_noise"}  # fmt: skip
CONSTANT_ERRORS = (
    *("camera_yaw", "camera_pitch", "camera_height", "gyro_scale", "gyro_drift", "accel_scale"),
    *("accel_roll", "accel_ahead", "gps_stamp", "map_lag"),
)  # constant errors of sensors from which no reference is made; who knows them subtracts them
_ACCELERATION = 2.0  # m/s2 to the side, of a manoeuvre
_BANK_TIME = 10.0  # s within which a wavy road forgets its bank
_WAVE = math.sqrt(0.5)  # root mean square of a wave, or of two axles' spreads, over its amplitude
FILE = Path(__file__).with_name("tuned.toml")
PARTS = ("filter", "controller")
Options = dict[str, dict[str, Any]]  # options of the filter and of the controller, by `PARTS`


def make_noise_options(
    scenario: Scenario, world: World = IDEAL, has_tyres: bool = False
) -> dict[str, Any]:
    """Make options of `exact-kf` from the noise and the disturbances of a scenario.

    The accelerometer is read where the body rolls, as the filter then assumes. In a world that is
    not ideal, what can be seen of its errors has states, and the rest counts as noise: what is
    unknown of the tyres as forces, a late map as noise of the heading, a late GPS of the course.

    Args:
        scenario: Scenario whose noise the filter knows.
        world: Errors of car and sensors, of which it knows the ranges.
        has_tyres: Whether the filter knows the tyres or has states for them.
    """
    noise, share = scenario.noise, HDOP_LAWS[scenario.hdop_law]
    sd, table = scenario.disturbance_force, [(1.0, 1.0), (101.0, 1.0 + 100.0 * share)]
    options = {"force_sd": sd, "moment_sd": scenario.disturbance_moment, "hdop_table": table}
    options["disturbance_time"] = scenario.disturbance_time
    ranges = {"bias_sd": "gyro_bias", "bank_sd": "bank"}
    if scenario.roll:
        options["fast"], ranges["accel_bias_sd"] = ["gyro", "accel_y"], "accel_y_bias"
    options |= {key: compute_range_rms(scenario, name) for key, name in ranges.items()}
    options |= {option: noise[key] for key, option in _NOISE.items() if key in noise}
    if "course" in noise:
        options["course_noise"] = noise["course"] / (0.5 * sum(scenario.range("speed")))
    if world.is_ideal:
        return options
    errors = _make_error_options(scenario, world)
    unused = set() if scenario.roll else {"accel_y_noise"}
    unused |= {"force_share", "moment_share"} if has_tyres else set()
    return options | {key: value for key, value in errors.items() if key not in unused}


def _make_error_options(scenario: Scenario, world: World) -> dict[str, float]:
    """Make the options of `exact-kf` that a world adds or changes."""
    get_rms = partial(compute_range_rms, world)
    plain, speed = Noise()._asdict() | dict(scenario.noise), 0.5 * sum(scenario.range("speed"))
    turning = _ACCELERATION / speed  # rad/s, of a manoeuvre
    lag = get_rms("map_lag") * turning  # rad, error of the road's direction
    course = plain["course"], _WAVE * get_rms("course_error"), get_rms("gps_stamp") * _ACCELERATION
    known = SCENARIOS.get(scenario.name, scenario)  # of a variant too: nobody is told of it
    spreads = [compute_range_rms(known, name, 1.0) for name in STIFFNESSES]
    force_share = math.hypot(*spreads) * _WAVE * _ACCELERATION / GRAVITY
    options = {f"{name}_sd": get_rms(name) for name in ("camera_yaw", "steer_offset")} | {
        "psi_noise": math.hypot(plain["camera_psi"], lag), "q_psi": lag * turning,
        "course_noise": math.hypot(*course) / speed,
        "accel_y_noise": math.hypot(plain["accel"], get_rms("vibration")),
        "force_share": force_share, "moment_share": 0.5 * force_share,
    }  # fmt: skip
    if wave := get_rms("bank_wave"):
        options["bank_sd"] = math.hypot(compute_range_rms(scenario, "bank"), wave)
        options["bank_time"] = _BANK_TIME
    return options


def compute_range_rms(source: Scenario | World, name: str, ideal: float = 0.0) -> float:
    """Compute the root mean square, in its unit, of a quantity that is uniform over its range.

    Args:
        source: Scenario or world that holds the range.
        name: Name of the quantity, whose unit the result has.
        ideal: Value from which it counts.
    """
    low, high = (end - ideal for end in get_range(getattr(source, name)))
    return math.sqrt((low * low + low * high + high * high) / 3.0)


def make_oracle(
    name: str, env_id: str, num_envs: int | None = None,
    vector_kwargs: Mapping[str, Any] | None = None,
    options: Mapping[str, Mapping[str, Any]] | None = None, **env_kwargs: Any,
) -> tuple[Any, Controller]:  # fmt: skip
    """Make an oracle and the env whose observation it needs; ValueError for an unknown name.

    In a world, those that know more than nominal get the drawn car, with gains of its own, and
    calibrated readings of steering, wheels and motors. References are made from the env's readings,
    as for everybody, so these err in its env too. Constant errors of which no reference is made are
    absent from the env of an oracle of parameters, as biases are.

    Args:
        name: Name in `ORACLES`.
        env_id: Id of the env.
        num_envs: Rows of a vector env; None: a single env.
        vector_kwargs: Arguments of the vector env.
        options: {"filter": of `exact-kf`, "controller": of the agent}, else TypeError, over the
            defaults: slow sensors of the id, the scenario's `make_noise_options`, a grip limit.
        env_kwargs: Arguments of the env (scenario, vehicle, ...).
    """
    check_choice("oracle", name, ORACLES)
    chosen: dict[str, Mapping[str, Any]] = {"filter": {}, "controller": {}} | dict(options or {})
    if len(chosen) != 2:
        raise TypeError(f"options of an oracle are 'filter' and 'controller', got {sorted(chosen)}")
    single_env: Any = gym.make(env_id, **env_kwargs)
    world: World = single_env.unwrapped.config.world
    if name in PARAMETER_ORACLES:
        # no biases: a filter that knows them would subtract them
        scenario: Scenario = single_env.unwrapped.scenario
        world = dataclasses.replace(world, **{key: getattr(IDEAL, key) for key in CONSTANT_ERRORS})
        noise = {key: sd for key, sd in scenario.noise.items() if not key.endswith("_bias")}
        unbiased = scenario.replace(noise=noise, gyro_bias=0.0, accel_y_bias=0.0)
        env_kwargs |= {"scenario": unbiased.to_dict(), "world": world.to_dict()}
        single_env = gym.make(env_id, **env_kwargs)
    base, env = single_env.unwrapped, single_env
    if num_envs is not None:
        env = gym.make_vec(env_id, num_envs=num_envs, **dict(vector_kwargs or {}), **env_kwargs)
    if name not in STATE_ORACLES:
        env = _add_filter(env, base, name in PARAMETER_ORACLES, chosen["filter"])
    if name != NOMINAL:
        truth_wrapper = VectorTruthObservation if num_envs is not None else TruthObservation
        tyres = (*STIFFNESSES, FRICTION.removeprefix("true_"))
        parameters = tyres if world.is_ideal else TRUE_PARAMETERS
        env = truth_wrapper(env, parameters, () if name in PARAMETER_ORACLES else STATES)
    settings: dict[str, Any] = {"disturbance_time": base.scenario.disturbance_time, "grip": GRIP}
    is_predictive = name in (PARAMETER_ORACLES[1], STATE_ORACLES[1])
    if not is_predictive:  # the prediction has the steering's rate limit
        settings["steer_weight"] = STEER_WEIGHT
    if name != NOMINAL:
        settings["vehicle"] = base.vehicle
        known = {"stiffness": [f"true_{x}" for x in STIFFNESSES]}
        settings |= known if world.is_ideal else {"knows_car": True}
    settings |= dict(chosen["controller"])
    return env, Nmpc(env, **settings) if is_predictive else Lqr(env, **settings)


def _add_filter(env: Any, base: Any, knows_tyres: bool, options: Mapping[str, Any]) -> Any:
    """Add a filter on all slow sensors, with the true tyres where it knows them."""
    world: World = base.config.world
    if knows_tyres:  # and how the steering sensor errs
        world = dataclasses.replace(world, steer_offset=IDEAL.steer_offset)
    levels = make_noise_options(base.scenario, world, knows_tyres)
    levels["slow"] = list(base.slow_sensors)
    for sensor, option in (("gps", "hdop_table"), ("camera", "camera_yaw_sd")):
        if sensor not in base.slow_sensors:
            levels.pop(option, None)
    if knows_tyres and (world.tyres or base.scenario.tyres) in ("fiala", "magic-formula"):
        levels |= _TYRE_OPTIONS
    wrapper = EstimateObservation if isinstance(env, gym.Env) else vector.EstimateObservation
    car, levels = TRUTH if knows_tyres else None, levels | dict(options)
    return wrapper(env, FILTER, outputs=OUTPUTS, std=False, vehicle=car, options=levels)


@cache
def read_tuned(path: Path = FILE) -> dict[str, dict[str, Options]]:
    """Read the options of a file, by class, entry and part; ValueError for another file or world.

    Args:
        path: TOML file; FileNotFoundError without one.
    """
    classes = read_document(path, "tuning")
    if (version := classes.pop("world_version", 0)) != WORLD_VERSION:
        text = f"{path} was tuned in world {version}, this is {WORLD_VERSION}: tune anew"
        raise ValueError(f"{text}, sideslip tune controller NAME --write")
    for kind, names in classes.items():
        for name, parts in names.items() if isinstance(names, dict) else [("", names)]:
            is_valid = isinstance(parts, dict) and parts.keys() <= set(PARTS)
            if not (is_valid and all(isinstance(options, dict) for options in parts.values())):
                raise ValueError(f"{path}: {kind}.{name} is no table of {' and '.join(PARTS)}")
    return classes


def get_tuned_options(task_class: str, name: str) -> Options:
    """Get the tuned options of an entry by part, empty where none was tuned.

    Args:
        task_class: Class of tasks.
        name: Name of the entry.
    """
    options = read_tuned().get(task_class, {}).get(name, {})
    return {part: dict(options.get(part, {})) for part in PARTS}
