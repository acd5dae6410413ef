"""The least expected cost of a linear scenario, by Riccati's equations: what no policy can beat.

With Gaussian noise and a quadratic cost, certainty equivalence holds (Joseph and Tou 1961). The cap
of the cost and the motors' limit, which such scenarios make rare, are left out. The best guess of
the driver's next angle is `LinearPlant.decay` times the last one (a Gauss-Markov process).
"""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from ..envs.engine.config import EnvConfig
from ..envs.numerics.functions import TICK
from ..envs.numerics.jit import as_python
from ..envs.record import PACKET_WIDTH, Array
from ..envs.scenarios.driver import compute_wander_gains
from ..envs.task import REFERENCES
from ..estimators.design.models import select_states
from ..estimators.make import make_estimator
from ..estimators.vector import estimate as vector
from ..estimators.wrappers.estimate import EstimateObservation
from .baselines import FILTER, OUTPUTS, make_noise_options
from .controllers.base import Controller
from .design.sampled_model import DesignModel, DesignSpec, make_design_model, make_tick_model
from .env_info import AnyEnv, CarEnv, list_configs

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
    _check(config)
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


def _check(config: EnvConfig) -> None:
    """Raise ValueError, naming what, where no optimum is known."""
    scenario, base, period = config.scenario, config.base, int(config.control_period) * TICK
    values = {key: getattr(scenario, key) for key in _REQUIRED}
    wrong = [f"{key} {value!r}" for key, value in values.items() if value != _REQUIRED[key]]
    wrong += [key for key in scenario.to_dict() if key not in _ALLOWED | set(_REQUIRED)]
    noisy = [name for name, sd in _MIN_NOISE.items() if scenario.noise.get(name, 0.0) >= sd]
    wrong += [f"noise of {k} below {sd:g}" for k, sd in _MIN_NOISE.items() if k not in noisy]
    wrong += [f"noise of {name}" for name in scenario.noise if name.endswith("_bias")]
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
    options = make_noise_options(config.scenario) | {"slow": list(config.slow), "prior": start}
    speed, noise = config.base.held_speed, config.scenario.noise
    if speed is not None and "course" in noise:
        options["course_noise"] = noise["course"] / speed
    return options


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
