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
from ...agents.rollout import steps_of
from ...agents.rungs import CURVED, FILTER, GRIP, STEER_WEIGHT, levels_of, make_rung
from ...envs.arguments import brief
from ...envs.scenarios.manoeuvres import scenario_from
from ...envs.sensors.slow import SENSOR_SETS
from ...estimators.design.models import TYRES
from ...estimators.filters import FILTERS
from ...estimators.learned.files import load_correction
from ...estimators.vector.estimate import EstimateObservation
from ...estimators.vector.truth import TruthObservation
from ..harness.drives import quietly
from .cells import ADAPTIVE, REFERENCE_CONTROLLER, REFERENCE_FILTER, SETUPS, TRUTH, Cell
from .contests import STEERING

STEPS = 200  # of a decision's time

_PUSHES = ("force_sd", "moment_sd")
_DISTURBANCES = {"forces": ("F_d", "N_d"), "walk": ("d1", "d2"), "walk-all": ("d1", "d2")}


def outputs_for(estimator: str) -> tuple[str, ...]:
    """The estimates that controllers read: beta, gamma, and disturbances if there are any."""
    name = name_of(estimator)
    base = name.removeprefix("learned-")
    row = FILTERS.get(base)  # a user's own has none
    options = SETUPS.get(estimator, ("", {}))[1] | dict(row.options if row else ())
    if row and base != name:
        options |= load_correction(base).card.base_options
    tyres = tuple(name for name in TYRES if f"{name}_sd" in options)
    return ("beta", "gamma", *_DISTURBANCES.get(row.disturbances if row else "", ()), *tyres)


def name_of(estimator: str) -> str:
    """The name of `make_estimator` of a cell's estimator."""
    return SETUPS.get(estimator, (estimator, {}))[0]


def estimate_options(cell: Cell) -> dict[str, Any]:
    """Options of `EstimateObservation` for a cell; a policy gets the estimate it was trained on."""
    if is_policy(cell.controller):
        card = load_policy(cell.controller).card
        if card.estimator == cell.estimator:
            return card.estimator_options
    found: dict[str, Any] = {"outputs": outputs_for(cell.estimator), "std": False}
    if cell.estimator in SETUPS:
        name, options = SETUPS[cell.estimator]
        if cell.estimator == REFERENCE_FILTER:
            options = options | {"slow": slow_sensors(cell.contest.env_id)}
        if name in (FILTER, CURVED):
            levels = levels_of(scenario_from(cell.env_options["scenario"]))
            # where nothing pushes, the filter's own level
            levels = {key: x for key, x in levels.items() if key not in _PUSHES or x > 0.0}
            own = name == FILTER or cell.controller == ADAPTIVE.get(cell.estimator)
            options = levels | (cell.best["filter"] if own else {}) | options
            unused = set() if "gps" in options["slow"] else {"hdop_table"}
            if "accel_y" not in options.get("fast", ()):
                unused |= {"accel_y_noise", "accel_bias_sd"}
            options = {key: value for key, value in options.items() if key not in unused}
        found["options"] = options
    return found


def slow_sensors(env_id: str) -> list[str]:
    """The names of an id's slow sensors."""
    return list(SENSOR_SETS[gym.spec(env_id).kwargs["sensors"]])


class Checked:
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
        found = self.agent.predict(observation, state, episode_start, deterministic=deterministic)
        if not (isinstance(found, tuple) and len(found) == 2):
            raise TypeError(f"predict returns (action, state), got {brief(found)}")
        shape = np.shape(found[0])
        if shape != self.shape:
            raise ValueError(
                f"predict of observations {observation.shape} returns actions {self.shape}, a row "
                f"a car, got shape {shape}"
            )
        return found


def make_cars(cell: Cell, cars: int) -> tuple[VectorEnv[Any, Any, Any], Any]:
    """(vector env of `cars` rows with the cell's estimator, its agent), both as they are tuned."""
    contest, options = cell.contest, cell.env_options
    if cell.rung:
        return make_rung(cell.rung, contest.env_id, cars, options=cell.best, **options)
    env: Any = gym.make_vec(contest.env_id, num_envs=cars, **options)
    if cell.estimator == TRUTH:
        env = TruthObservation(env, (), ("beta", "gamma"))
    elif cell.estimator:
        source = cell.objects.get("estimator", name_of(cell.estimator))
        env = quietly(EstimateObservation, env, source, **estimate_options(cell))
    agent = make_agent(cell.objects.get("controller", cell.controller), env, **agent_options(cell))
    if cell.is_users:
        return env, Checked(agent, cars, env.single_action_space.shape[0])
    return env, agent


def agent_options(cell: Cell) -> dict[str, Any]:
    """Options of `make_agent` for a cell."""
    more: dict[str, Any] = {}
    if cell.controller == "model-following":
        more["rejection"] = cell.estimator == "dakf"
    if cell.controller == REFERENCE_CONTROLLER:  # nominal's own design
        more["grip"] = GRIP
        if cell.contest.env_id == STEERING:
            more["steer_weight"] = STEER_WEIGHT
    return more | cell.best["controller"]


class _Timed:
    """A function that notes how long each of its calls takes, in s of wall time."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.seconds = function, list[float]()

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        begun = time.perf_counter()
        result = self.function(*args, **kwargs)
        self.seconds.append(time.perf_counter() - begun)
        return result


def decision_time(cell: Cell) -> float:
    """us (wall) a decision of one car: predict, and what the estimator adds to an env-step.

    Medians over STEPS steps of an episode, the bare env stepped side by side.
    """
    cars: tuple[Any, Any] = make_cars(cell, 1)
    env, agent = cars
    bare: Any = gym.make_vec(cell.contest.env_id, num_envs=1, **cell.env_options)
    bare.reset(seed=0)
    agent.predict, env.step, without = _Timed(agent.predict), _Timed(env.step), _Timed(bare.step)
    for step in islice(steps_of(env, agent, 0), 1, STEPS + 1):
        without(np.zeros_like(step.action))
    predict, whole, plain = (np.median(f.seconds) for f in (agent.predict, env.step, without))
    return 1e6 * float(predict + max(whole - plain, 0.0))
