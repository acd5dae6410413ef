"""A cell's cars: the vector env with its estimator, and the controller that drives them all."""

import time
from collections.abc import Callable
from itertools import islice
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from ...agents import make_agent
from ...agents.learned.files import is_policy, load_policy
from ...agents.rollout import iterate_steps
from ...agents.rungs import FILTER, GRIP, STEER_WEIGHT, TYRE_FILTER, make_noise_options, make_oracle
from ...envs.arguments import short_repr
from ...envs.scenarios.manoeuvres import make_scenario
from ...envs.sensors.slow import SENSOR_SETS
from ...estimators.design.models import TYRES
from ...estimators.filters import FILTERS
from ...estimators.learned.files import load_correction
from ...estimators.vector.estimate import EstimateObservation
from ...estimators.vector.truth import TruthObservation
from ..harness.drives import call_quietly
from .cells import ADAPTIVE, REFERENCE_CONTROLLER, REFERENCE_FILTER, SETUPS, TRUTH, ControlEntry
from .contests import STEERING

STEPS = 200  # of a decision's time

_PUSHES = ("force_sd", "moment_sd")
_DISTURBANCES = {"forces": ("F_d", "N_d"), "walk": ("d1", "d2"), "walk-all": ("d1", "d2")}


def list_outputs(estimator: str) -> tuple[str, ...]:
    """The estimates that controllers read: beta, gamma, and disturbances if there are any."""
    name = get_filter_name(estimator)
    base = name.removeprefix("learned-")
    row = FILTERS.get(base)  # a user's own has none
    options = SETUPS.get(estimator, ("", {}))[1] | dict(row.options if row else ())
    if row and base != name:
        options |= load_correction(base).card.base_options
    tyres = tuple(name for name in TYRES if f"{name}_sd" in options)
    return ("beta", "gamma", *_DISTURBANCES.get(row.disturbances if row else "", ()), *tyres)


def get_filter_name(estimator: str) -> str:
    """The name of `make_estimator` of a cell's estimator."""
    return SETUPS.get(estimator, (estimator, {}))[0]


def make_estimate_options(entry: ControlEntry) -> dict[str, Any]:
    """Options of `EstimateObservation` for a cell; a policy gets the estimate it was trained on."""
    if is_policy(entry.controller):
        card = load_policy(entry.controller).card
        if card.estimator == entry.estimator:
            return card.estimator_options
    settings: dict[str, Any] = {"outputs": list_outputs(entry.estimator), "std": False}
    if entry.estimator in SETUPS:
        name, options = SETUPS[entry.estimator]
        if entry.estimator == REFERENCE_FILTER:
            options = options | {"slow": list_slow_sensors(entry.task.env_id)}
        if name in (FILTER, TYRE_FILTER):
            levels = make_noise_options(make_scenario(entry.env_options["scenario"]))
            # where nothing pushes, the filter's own level
            levels = {key: x for key, x in levels.items() if key not in _PUSHES or x > 0.0}
            is_tuned = name == FILTER or entry.controller == ADAPTIVE.get(entry.estimator)
            options = levels | (entry.best["filter"] if is_tuned else {}) | options
            unused = set() if "gps" in options["slow"] else {"hdop_table"}
            if "accel_y" not in options.get("fast", ()):
                unused |= {"accel_y_noise", "accel_bias_sd"}
            options = {key: value for key, value in options.items() if key not in unused}
        settings["options"] = options
    return settings


def list_slow_sensors(env_id: str) -> list[str]:
    """The names of an id's slow sensors."""
    return list(SENSOR_SETS[gym.spec(env_id).kwargs["sensors"]])


class CheckedAgent:
    """A user's agent, whose `predict` is to return actions (rows, width) and a state.

    Raises TypeError or ValueError with what came instead; NaN is the env's to judge.
    """

    def __init__(self, agent: Any, rows: int, width: int) -> None:
        self.agent, self.shape = agent, (rows, width)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """What the agent's returns."""
        result = self.agent.predict(observation, state, episode_start, deterministic=deterministic)
        if not (isinstance(result, tuple) and len(result) == 2):
            raise TypeError(f"predict returns (action, state), got {short_repr(result)}")
        shape = np.shape(result[0])
        if shape != self.shape:
            raise ValueError(
                f"predict of observations {observation.shape} returns actions {self.shape}, a row "
                f"a car, got shape {shape}"
            )
        return result


def make_cars(entry: ControlEntry, cars: int) -> tuple[VectorEnv[Any, Any, Any], Any]:
    """(vector env of `cars` rows with the cell's estimator, its agent), both as they are tuned."""
    task, options = entry.task, entry.env_options
    if entry.oracle:
        return make_oracle(entry.oracle, task.env_id, cars, options=entry.best, **options)
    env: Any = gym.make_vec(task.env_id, num_envs=cars, **options)
    if entry.estimator == TRUTH:
        env = TruthObservation(env, (), ("beta", "gamma"))
    elif entry.estimator:
        source = entry.objects.get("estimator", get_filter_name(entry.estimator))
        env = call_quietly(EstimateObservation, env, source, **make_estimate_options(entry))
    agent = make_agent(
        entry.objects.get("controller", entry.controller), env, **make_agent_options(entry)
    )
    if entry.is_users:
        return env, CheckedAgent(agent, cars, env.single_action_space.shape[0])
    return env, agent


def make_agent_options(entry: ControlEntry) -> dict[str, Any]:
    """Options of `make_agent` for a cell."""
    options: dict[str, Any] = {}
    if entry.controller == "model-following":
        options["rejection"] = entry.estimator == "dakf"
    if entry.controller == REFERENCE_CONTROLLER:  # nominal's own design
        options["grip"] = GRIP
        if entry.task.env_id == STEERING:
            options["steer_weight"] = STEER_WEIGHT
    return options | entry.best["controller"]


class _TimedFunction:
    """A function that notes how long each of its calls takes, in s of wall time."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.seconds = function, list[float]()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        start_time = time.perf_counter()
        result = self.function(*args, **kwargs)
        self.seconds.append(time.perf_counter() - start_time)
        return result


def measure_decision_time(entry: ControlEntry) -> float:
    """us (wall) a decision of one car: predict, and what the estimator adds to an env-step.

    Medians over STEPS steps of an episode, the bare env stepped side by side.
    """
    cars: tuple[Any, Any] = make_cars(entry, 1)
    env, agent = cars
    bare: Any = gym.make_vec(entry.task.env_id, num_envs=1, **entry.env_options)
    bare.reset(seed=0)
    agent.predict, env.step, without = (
        _TimedFunction(agent.predict),
        _TimedFunction(env.step),
        _TimedFunction(bare.step),
    )
    for step in islice(iterate_steps(env, agent, 0), 1, STEPS + 1):
        without(np.zeros_like(step.action))
    predict, with_estimator, without_estimator = (
        np.median(f.seconds) for f in (agent.predict, env.step, without)
    )
    return 1e6 * float(predict + max(with_estimator - without_estimator, 0.0))
