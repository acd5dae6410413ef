"""What entries are compared with: oracles that know more and more, and a linear scenario's optimum.

An entry is scored between `nominal`, a well-designed LQG that knows the nominal car alone, and the
better of the two that know state, disturbances and car. `sideslip tune controller` finds the
options of `tuned.toml` by class of tasks: car, disturbances and reference, as in "coms-model".
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ..envs.engine.config import EnvConfig
from ..envs.io import read_document
from ..envs.numerics.functions import TICK
from ..envs.numerics.jit import as_python
from ..envs.record import PACKET_WIDTH, Array
from ..envs.scenarios.driver import compute_wander_gains
from ..envs.scenarios.manoeuvres import SCENARIOS
from ..envs.scenarios.scenario import Scenario
from ..envs.scenarios.world import IDEAL, WORLD_VERSION, World, get_range
from ..envs.sensors.inertial import Noise
from ..envs.sensors.slow import HDOP_LAWS
from ..envs.task import REFERENCES
from ..envs.validation import check_choice
from ..envs.vehicle.parameters import GRAVITY
from ..estimators.design.options import select_states
from ..estimators.make import make_estimator
from ..estimators.vector import estimate as vector
from ..estimators.wrappers.estimate import EstimateObservation
from ..estimators.wrappers.truth import STIFFNESSES, TRUTH, TruthObservation
from .controllers.base import FRICTION, Controller
from .controllers.lqr import TRUE_PARAMETERS, Lqr
from .controllers.mpc import Nmpc
from .design.sampled_model import DesignModel, DesignSpec, make_design_model, make_tick_model
from .env_info import AnyEnv, CarEnv, list_configs

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
    options = {"force_sd": sd, "moment_sd": scenario.disturbance_moment, "hdop_table": table,
               "disturbance_time": scenario.disturbance_time}  # fmt: skip
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
    known = SCENARIOS.get(scenario.name, scenario)  # nobody is told of a change
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
        env = gym.make_vec(env_id, num_envs=num_envs, **env_kwargs)
    if name not in STATE_ORACLES:
        env = _add_filter(env, base, name in PARAMETER_ORACLES, chosen["filter"])
    settings: dict[str, Any] = {"disturbance_time": base.scenario.disturbance_time, "grip": GRIP}
    is_predictive = name in (PARAMETER_ORACLES[1], STATE_ORACLES[1])
    if not is_predictive:  # the prediction has the steering's rate limit
        settings["steer_weight"] = STEER_WEIGHT
    if name != NOMINAL:
        truth_wrapper = vector.TruthObservation if num_envs is not None else TruthObservation
        tyres = (*STIFFNESSES, FRICTION.removeprefix("true_"))
        parameters = tyres if world.is_ideal else TRUE_PARAMETERS
        env = truth_wrapper(env, parameters, () if name in PARAMETER_ORACLES else STATES)
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


# The optimum of a linear scenario: with Gaussian noise and a quadratic cost certainty equivalence
# holds (Joseph and Tou 1961). The cap of the cost and the motors' limit, which such scenarios make
# rare, are left out. The driver's angle, a Gauss-Markov process, decays by `LinearPlant.decay`.
_REQUIRED = {
    "steering": "wander", "small_angle": True, "tyres": "linear", "roll": False,
    "hdop_law": "constant", "hdop_spread": 0.0,
}  # fmt: skip
_ALLOWED = {
    "name", "duration", "amplitude", "frequency", "hold", "speed", "friction", "noise",
    "vehicle", "nominal", "disturbance_force", "disturbance_moment", "disturbance_time",
    "half_width", "camera_delays", "camera_jitter", "camera_loss", "camera_outage", "gps_period",
    "gps_delays", "gps_outage",
}  # fmt: skip
_ZERO = ("motor_lag", "steering_lag", "motor_power", "antenna_ahead", "antenna_left")
# Noise from which on a sensor that the filter does not read says nothing of the car.
_MIN_NOISE = {"accel": 1e4, "wheel": 100.0, "gps_speed": 100.0, "gps_position": 1e4}


@dataclass(frozen=True)
class LinearPlant:
    """A linear scenario at the decisions: x+ = G x + H u + w, with w of covariance W."""

    model: DesignModel  # with a driver's angle that decays
    W: Array  # (n, n)
    rest: float  # cost of the noise within a period, under every policy
    start: Array  # covariance of x at the start, (n, n)
    steps: int  # control periods of an episode

    @property
    def driver(self) -> int:
        """Index of the driver's angle in x."""
        return self.model.states.index("driver")

    @property
    def decay(self) -> float:
        """Factor by which the driver's angle decays in a period, on average."""
        return float(self.model.G[self.driver, self.driver])


@dataclass(frozen=True)
class Optimum:
    """The optimal policy, u = -K_j E[x_j | measurements], and its cost."""

    plant: LinearPlant  # of the scenario
    cost: float  # expected, of an episode
    gains: Array  # K_j, shape (steps, n)
    weights: Array  # S_j, shape (steps,): an input that differs by du costs S_j du^2 more
    errors: Array  # covariances of the optimal estimate's error, shape (schedules, steps, n, n)

    def compute_cost(self, gains: Array) -> float:
        """Compute the expected cost of u = -L_j E[x_j | measurements].

        Args:
            gains: L_j, shape (steps, n), or (n,) for all steps.
        """
        model, W = self.plant.model, self.plant.W
        L = np.broadcast_to(gains, self.gains.shape)
        total = 0.0
        for error_covariances in self.errors:
            X = self.plant.start
            for j, P in enumerate(error_covariances):
                # the estimate is orthogonal to its error: its covariance is the state's less P
                known, d = X - P, self.gains[j] - L[j]
                total += self.weights[j] * float(d @ known @ d)
                closed = model.G - model.H @ L[j : j + 1]
                X = closed @ known @ closed.T + model.G @ P @ model.G.T + W
        return self.cost + total / len(self.errors)


def _make_linear_plant(env: AnyEnv) -> LinearPlant:
    """Make the linear plant of an env; ValueError where its scenario is not linear."""
    config = list_configs(env)[0]
    scenario, n = config.scenario, int(config.control_period)
    _check_linear(config)
    car, speed = config.base.nominal, config.base.held_speed
    assert speed is not None
    kind, full = REFERENCES.index(config.reference), config.base.vehicle.yaw_moment_limit
    design_spec = DesignSpec(n, full, False, kind, "forces", scenario.disturbance_time)
    model = make_design_model(car, speed, design_spec)
    G1, _, C, _ = make_tick_model(car, speed, design_spec)
    names, weights = design_spec.states, TICK * np.diag(design_spec.cost_weights)
    sd = np.zeros(len(names))
    sd[names.index("F_d")] = scenario.disturbance_force
    sd[names.index("N_d")] = scenario.disturbance_moment
    process_noise = np.diag(sd**2 * (1.0 - np.diag(G1) ** 2))
    W, rest = np.zeros_like(G1), 0.0
    for _ in range(n):
        rest += float(np.trace(weights @ C @ W @ C.T))
        W = G1 @ W @ G1.T + process_noise
    driver = names.index("driver")
    wander = [scenario.range(name)[0] for name in ("amplitude", "frequency", "hold")]
    decay, angle_noise = as_python(compute_wander_gains)(*wander)
    model.G[driver, driver], W[driver, driver], sd[driver] = decay, angle_noise**2, wander[0]
    return LinearPlant(model, W, rest, np.diag(sd**2), round(scenario.duration / (n * TICK)))


def _check_linear(config: EnvConfig) -> None:
    """Raise ValueError, naming what, where no optimum is known."""
    scenario, base, period = config.scenario, config.base, int(config.control_period) * TICK
    values, noise = {key: getattr(scenario, key) for key in _REQUIRED}, scenario.noise
    wrong = [f"{key} {value!r}" for key, value in values.items() if value != _REQUIRED[key]]
    wrong += [key for key in scenario.to_dict() if key not in _ALLOWED | set(_REQUIRED)]
    too_small = [(name, sd) for name, sd in _MIN_NOISE.items() if noise.get(name, 0.0) < sd]
    wrong += [f"noise of {name} below {sd:g}" for name, sd in too_small]
    wrong += [f"noise of {name}" for name in noise if name.endswith("_bias")]
    car = base.vehicle
    if car != base.nominal or any(getattr(car, name) for name in _ZERO):
        wrong.append(f"a car of unknown parameters or with {', '.join(_ZERO)}")
    ranges = [scenario.range(name) for name in ("amplitude", "frequency", "hold")]
    if base.held_speed is None or any(low != high for low, high in ranges):
        wrong.append("quantities that are drawn")
    if abs(ranges[2][0] - period) > 1e-9:
        wrong.append(f"hold {ranges[2][0]:g} s at control periods of {period:g} s")
    if config.reference != "zero-slip" or config.steering or config.vision == "image":
        wrong.append("another task than zero slip by the yaw moment, or pictures")
    if wrong:
        raise ValueError(f"scenario {scenario.name!r} has no known optimum: {', '.join(wrong)}")


def _make_true_options(env: AnyEnv) -> dict[str, Any]:
    """Make options of `exact-kf` with the true noise, disturbances and start of an episode."""
    config = list_configs(env)[0]
    start = dict.fromkeys(select_states(tuple(config.slow)), 0.0)
    return make_noise_options(config.scenario) | {"slow": list(config.slow), "prior": start}


def compute_optimum(env: CarEnv, schedules: int = 1) -> Optimum:
    """Compute the optimum of a linear scenario; the env runs to show what arrives when.

    Args:
        env: Single env.
        schedules: Number of seeds from 0 whose arrivals are averaged; 1 where none are random.
    """
    plant = _make_linear_plant(env)
    gains, weights, cost = _solve_regulator(plant)
    errors = np.array([_compute_error_covariances(env, plant, seed) for seed in range(schedules)])
    # what the errors of the estimate add: the sum of S_j K_j P_j K_j'
    blind = np.einsum("j,ji,kjil,jl->", weights, gains, errors, gains) / schedules
    return Optimum(plant, cost + float(blind), gains, weights, errors)


def _solve_regulator(plant: LinearPlant) -> tuple[Array, Array, float]:
    """Compute K_j (steps, n), S_j (steps,) and the cost of an episode whose state is known."""
    model, n = plant.model, len(plant.model.G)
    G, H, V = model.G, model.H, np.zeros((n, n))
    gains, weights, cost = np.empty((plant.steps, n)), np.empty(plant.steps), 0.0
    for j in range(plant.steps - 1, -1, -1):
        cost += plant.rest + float(np.trace(V @ plant.W))
        S = model.R + H.T @ V @ H
        K = np.linalg.solve(S, H.T @ V @ G + model.N.T)
        V = model.Q + G.T @ V @ G - K.T @ S @ K
        V = 0.5 * (V + V.T)
        gains[j], weights[j] = K[0], S[0, 0]
    return gains, weights, cost + float(np.trace(V @ plant.start))


def _compute_error_covariances(env: CarEnv, plant: LinearPlant, seed: int) -> Array:
    """Compute the best estimate's error covariance at the decisions of a seed, (steps, n, n)."""
    env.reset(seed=seed)
    base: Any = env.unwrapped
    facts = {"vehicle": base.nominal, "sensors": base.slow_sensors, "speed": base.held_speed}
    filter_ = make_estimator(FILTER, **facts, **_make_true_options(env))
    names, n = plant.model.states, len(plant.model.states)
    in_state, in_filter = ([x.index(name) for name in OUTPUTS] for x in (names, filter_.names))
    covariances, idle = np.zeros((plant.steps, n, n)), np.zeros(env.action_space.shape or (), "f4")
    for j in range(plant.steps):
        filter_.step(base.record.fast, base.record.packets.reshape(-1, PACKET_WIDTH))
        covariances[j][np.ix_(in_state, in_state)] = filter_.P[np.ix_(in_filter, in_filter)]
        if j > 0:  # the angle from now on is not seen yet: its guess is off by the noise of W
            covariances[j, plant.driver, plant.driver] = plant.W[plant.driver, plant.driver]
        env.step(idle)
    return covariances


class Lqg(Controller):
    """The optimal policy of a linear scenario without end, for the env of `wrap_optimal_estimate`.

    It differs from `Optimum` in the last steps, and takes the first angle for a later one. But for
    that, `Optimum.compute_cost` of `gains` is its cost.

    Args:
        env: Env, single or vector, with the optimal estimate in its observation.
        gains: Gains of all steps, shape (n,); None: the optimal ones.
    """

    needs = (*(f"{name}_hat" for name in OUTPUTS), "steer_command")

    def __init__(self, env: AnyEnv, gains: Array | None = None) -> None:
        super().__init__(env)
        plant = _make_linear_plant(env)
        self.gains = _solve_regulator(plant)[0][0] if gains is None else gains
        self._answer = self.gains[[plant.model.states.index(x) for x in (*OUTPUTS, "driver")]]
        self._answer[-1] *= plant.decay  # the next angle's best guess

    def _law(self, inputs: Array, state: Array, action: Array) -> None:
        action[:, 0] = -inputs @ self._answer


def wrap_optimal_estimate(env: Any) -> Any:
    """Wrap an env, single or vector, so that its observation has the optimal estimate.

    Args:
        env: Env of a linear scenario.
    """
    wrapper: Any = EstimateObservation if isinstance(env, gym.Env) else vector.EstimateObservation
    return wrapper(env, FILTER, outputs=OUTPUTS, std=False, options=_make_true_options(env))
