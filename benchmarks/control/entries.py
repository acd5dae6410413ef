"""Entries of the control benchmark: a task, an estimator and a controller with their options.

They make the vector env with its estimator, the agent that drives it, and time a decision.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import gymnasium as gym
import numpy as np

from ...agents import AGENTS, Agent, make_agent
from ...agents.baselines import (
    FILTER,
    GRIP,
    STEER_WEIGHT,
    TYRE_FILTER,
    Options,
    get_tuned_options,
    make_noise_options,
    make_oracle,
)
from ...agents.env_info import CarVectorEnv
from ...agents.learned.policy import is_policy, load_policy
from ...agents.rollout import iterate_steps
from ...envs.record import Array
from ...envs.scenarios.manoeuvres import make_scenario
from ...envs.sensors.slow import SENSOR_SETS
from ...envs.task import OBSERVATION_OPTIONS
from ...envs.validation import short_repr
from ...estimators.design.models import TYRES
from ...estimators.filters import FILTERS
from ...estimators.learned.correction_file import load_correction
from ...estimators.vector.estimate import EstimateObservation
from ...estimators.vector.truth import TruthObservation
from ..harness.drives import call_quietly
from .tasks import (
    NOMINAL,
    ORACLES,
    PARAMETERS,
    STATE,
    STEERING,
    TIERS,
    YAW,
    ControlTask,
    find_oracle,
)

TRUTH, REFERENCE_CONTROLLER = "truth", "lqr"
REFERENCE_FILTER = "exact-kf, all sensors"
_BOTH = {"slow": ["camera", "gps"]}
SETUPS: dict[str, tuple[str, dict[str, Any]]] = {
    REFERENCE_FILTER: ("exact-kf", _BOTH),
    "exact-kf, no bias states": ("exact-kf", _BOTH | {"bias_sd": 0.0, "accel_bias_sd": 0.0}),
    "exact-kf, no accelerometer": ("exact-kf", _BOTH | {"fast": ["gyro"]}),
    "exact-kf, camera": ("exact-kf", {"slow": ["camera"]}),
    "exact-kf, gps": ("exact-kf", {"slow": ["gps"]}),
    "multirate-kf, camera and gps": ("multirate-kf", _BOTH),
    "joint": ("joint", _BOTH),
    "joint, friction": ("joint", _BOTH | {"inverse_friction_sd": 0.3}),
    "learned-joint": ("learned-joint", _BOTH),
}
"""Filters by name in the tables: a name of `make_estimator`, and options over the tuned ones."""
ADAPTIVE = {"joint": "adaptive-lqr", "joint, friction": "adaptive-nmpc"}
"""Adaptive controllers by the filter whose tyres they follow."""
_CORRECTED = ("learned-joint", "adaptive-nmpc")  # on a filter with a network behind it
ESTIMATORS = (
    *(name for name in SETUPS if name != _CORRECTED[0]),
    *("single-rate-kf", "uneven-delay-kf", "dakf", "bicycle-kf", TRUTH),
)
CONTROLLERS: dict[str, tuple[str, ...]] = {
    YAW: ("two-dof", "esc", "sliding-mode", "mpc", "nmpc"),
    STEERING: ("two-dof", "esc", "model-following", "nmpc"),
}
"""Besides the reference controller, on the reference filter."""
ORACLE_NAMES = (NOMINAL, PARAMETERS, STATE)
_CANDIDATES = tuple(name for names in ORACLES.values() for name in names)
LEARNED: dict[str, tuple[tuple[str, str], ...]] = {
    "car-steering": (("joint", "distill-car-steering"), ("", "raw-car-steering")),
    "car-yaw": (("joint", "distill-car-yaw"), ("", "raw-car-yaw")),
    "coms-model": (
        ("joint", "ppo-coms-steering"),
        ("", "raw-coms-steering"),
        ("joint", "distill-coms-steering"),
    ),
    "coms-zero-slip": (
        ("joint", "ppo-coms-yaw"),
        ("joint", "distill-coms-yaw"),
        ("", "raw-coms-yaw"),
    ),
}
"""Pairs of estimator and policy by the class of its tasks; verdicts speak of the first."""
_SHARED = {
    ORACLES[PARAMETERS][0]: ("adaptive-lqr", {"grip", "steer_weight"}),
    ORACLES[PARAMETERS][1]: ("adaptive-nmpc", {"horizon", "grip", "steer_weight"}),
    ORACLES[STATE][1]: ("adaptive-nmpc", {"horizon", "steer_weight"}),
}
"""Untuned controllers: the one, closest in knowledge, from which they take which options; their
filters' levels are the scenario's."""
_SLOW_CONTROLLERS = ("mpc", "nmpc", "adaptive-nmpc", ORACLES[STATE][1], ORACLES[PARAMETERS][1])

EPISODES, QUICK_EPISODES, SLOW_EPISODES = 256, 8, 64
_QUICK_TASKS = 2  # of each tier, in a quick run


def select_quick_tasks(tasks: Sequence[ControlTask]) -> list[ControlTask]:
    """Select `_QUICK_TASKS` of each tier, from its first to its last.

    Args:
        tasks: Tasks of all tiers, a tier's together.

    Returns:
        Selected tasks.
    """
    selected = []
    for tier in dict.fromkeys(task.tier for task in tasks):
        tier_tasks = [task for task in tasks if task.tier == tier]
        step = max(len(tier_tasks) / _QUICK_TASKS, 1.0)
        selected += [tier_tasks[int(i * step)] for i in range(min(_QUICK_TASKS, len(tier_tasks)))]
    return selected


@dataclass(frozen=True)
class ControlEntry:
    """An estimator and a controller in a task. Entries are equal whatever the last three are.

    Attributes:
        task: Task to drive.
        estimator: Name in `SETUPS` or of `make_estimator`, "truth", or "" where the controller
            reads none or brings its own.
        controller: Name of `make_agent`, or a baseline.
        options: Options of the env beside the task's, with a scenario that has no name.
        tuned: Options of filter and controller instead of the best known.
        objects: A user's objects instead of what the names mean: an agent or its factory as
            "controller", a filter's factory as "estimator".
    """

    task: ControlTask
    estimator: str
    controller: str
    options: dict[str, Any] = field(default_factory=dict, compare=False)
    tuned: Options | None = field(default=None, compare=False)
    objects: dict[str, Any] = field(default_factory=dict, compare=False)

    @property
    def is_users(self) -> bool:
        """Whether its controller is a user's own."""
        name = self.controller
        known = name in AGENTS or name in (*ORACLE_NAMES, *_CANDIDATES) or is_policy(name)
        return "controller" in self.objects or not known

    @property
    def best(self) -> Options:
        """Options of filter and controller: `tuned`, or those of `agents.get_tuned_options`.

        The reference controller has nominal's, a user's own nominal's filter, and one that was not
        tuned what it shares with a baseline.
        """
        if self.tuned is not None:
            return self.tuned
        if self.is_users:
            return get_tuned_options(self.task.kind, NOMINAL) | {"controller": {}}
        kind, name = self.task.kind, self.oracle or self.controller
        if name in _SHARED and not any(get_tuned_options(kind, name).values()):
            source, numbers = _SHARED[name]
            best = get_tuned_options(kind, source)["controller"]
            return {"filter": {}, "controller": {key: best[key] for key in numbers & best.keys()}}
        return get_tuned_options(kind, NOMINAL if name == REFERENCE_CONTROLLER else name)

    @property
    def label(self) -> str:
        """Controller and estimator in words."""
        return f"{self.controller} on {self.estimator}" if self.estimator else self.controller

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of the env; bad actions end the episode, a policy sees what its training saw."""
        card = load_policy(self.controller).card.env_options if is_policy(self.controller) else {}
        observed = {name: card[name] for name in OBSERVATION_OPTIONS if name in card}
        return self.task.env_options | {"on_bad_action": "fail"} | observed | self.options

    @property
    def oracle(self) -> str:
        """The baseline that drives, "" where a contestant does."""
        if self.is_users:
            return ""
        if self.controller in ORACLES:
            return find_oracle(self.task, self.controller)
        return self.controller if self.controller in (NOMINAL, *_CANDIDATES) else ""

    @property
    def slow(self) -> bool:
        """Whether it takes so long to decide that it gets fewer episodes."""
        return (self.oracle or self.controller) in _SLOW_CONTROLLERS


def make_entries(tasks: Sequence[ControlTask], quick: bool = False) -> Iterator[ControlEntry]:
    """Make every entry, task by task.

    All estimators drive in the tasks with the first of their tier's ids.

    Args:
        tasks: Tasks that are driven.
        quick: Whether slow contestants are left out.

    Yields:
        Entries.
    """
    for task in tasks:
        entries = [ControlEntry(task, "", oracle) for oracle in (*ORACLE_NAMES, "none")]
        first = task.tier not in TIERS or task.env_id == TIERS[task.tier][0][0]
        filters = ESTIMATORS if first else (REFERENCE_FILTER, TRUTH)
        entries += [ControlEntry(task, name, REFERENCE_CONTROLLER) for name in filters]
        entries += [ControlEntry(task, REFERENCE_FILTER, name) for name in CONTROLLERS[task.env_id]]
        entries += [ControlEntry(task, *pair) for pair in (*ADAPTIVE.items(), _CORRECTED)]
        if task.tier:
            entries += [ControlEntry(task, *pair) for pair in LEARNED.get(task.kind, ())]
        yield from (entry for entry in entries if not (quick and entry.slow and not entry.oracle))


_STEPS = 200  # of a decision's time

_PUSHES = ("force_sd", "moment_sd")
_DISTURBANCES = {"forces": ("F_d", "N_d"), "walk": ("d1", "d2"), "walk-all": ("d1", "d2")}


def list_outputs(estimator: str) -> tuple[str, ...]:
    """List the estimates that controllers read: beta, gamma, and disturbances if there are any.

    Args:
        estimator: Name as in a `ControlEntry`.

    Returns:
        Names of the estimates.
    """
    name = get_filter_name(estimator)
    base = name.removeprefix("learned-")
    row = FILTERS.get(base)  # a user's own has none
    options = SETUPS.get(estimator, ("", {}))[1] | dict(row.options if row else ())
    if row and base != name:
        options |= load_correction(base).card.base_options
    tyres = tuple(name for name in TYRES if f"{name}_sd" in options)
    return ("beta", "gamma", *_DISTURBANCES.get(row.disturbances if row else "", ()), *tyres)


def get_filter_name(estimator: str) -> str:
    """Return the name of `make_estimator` of an entry's estimator.

    Args:
        estimator: Name as in a `ControlEntry`.

    Returns:
        Name.
    """
    return SETUPS.get(estimator, (estimator, {}))[0]


def make_estimate_options(entry: ControlEntry) -> dict[str, Any]:
    """Make options of `EstimateObservation`; a policy gets the estimate it was trained on.

    Args:
        entry: Task, estimator and controller.

    Returns:
        Options by name.
    """
    if is_policy(entry.controller):
        card = load_policy(entry.controller).card
        if card.estimator == entry.estimator:
            return card.estimator_options
    settings: dict[str, Any] = {"outputs": list_outputs(entry.estimator), "std": False}
    if entry.estimator in SETUPS:
        name, options = SETUPS[entry.estimator]
        if entry.estimator == REFERENCE_FILTER:
            sensors = gym.spec(entry.task.env_id).kwargs["sensors"]
            options = options | {"slow": list(SENSOR_SETS[sensors])}
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


class CheckedAgent:
    """A user's agent, whose `predict` is to return actions and a state; NaN is the env's to judge.

    Args:
        agent: Agent with `predict` as stable-baselines3 has it.
        rows: Number of cars.
        width: Length of an action.

    Raises:
        TypeError: `predict` returns no pair.
        ValueError: Its actions have another shape.
    """

    def __init__(self, agent: Agent, rows: int, width: int) -> None:
        self.agent, self.shape = agent, (rows, width)

    def predict(
        self, observation: Array, state: object = None, episode_start: Array | None = None,
        deterministic: bool = True,
    ) -> tuple[Any, object]:  # fmt: skip
        """Return what the agent does, checked.

        Args:
            observation: Observations, shape (rows, k).
            state: Memory from the last call.
            episode_start: Whether each row's episode has just begun, shape (rows,).
            deterministic: Whether to take the mean action.

        Returns:
            Actions, shape (rows, width), and the next state.
        """
        result: object = self.agent.predict(
            observation, state, episode_start, deterministic=deterministic
        )
        if not (isinstance(result, tuple) and len(result) == 2):
            raise TypeError(f"predict returns (action, state), got {short_repr(result)}")
        shape = np.shape(result[0])
        if shape != self.shape:
            raise ValueError(
                f"predict of observations {observation.shape} returns actions {self.shape}, a row "
                f"a car, got shape {shape}"
            )
        return result


def make_cars(entry: ControlEntry, cars: int) -> tuple[CarVectorEnv, Any]:
    """Make the vector env with the entry's estimator, and its agent, both tuned.

    Args:
        entry: Task, estimator and controller.
        cars: Number of rows.

    Returns:
        Env and agent.
    """
    task, options = entry.task, entry.env_options
    if entry.oracle:
        return make_oracle(entry.oracle, task.env_id, cars, options=entry.best, **options)
    env: Any = gym.make_vec(task.env_id, num_envs=cars, **options)
    if entry.estimator == TRUTH:
        env = TruthObservation(env, (), ("beta", "gamma"))
    elif entry.estimator:
        source = entry.objects.get("estimator", get_filter_name(entry.estimator))
        env = call_quietly(EstimateObservation, env, source, **make_estimate_options(entry))
    controller = entry.objects.get("controller", entry.controller)
    agent = make_agent(controller, env, **make_agent_options(entry))
    if entry.is_users:
        return env, CheckedAgent(agent, cars, env.single_action_space.shape[0])
    return env, agent


def make_agent_options(entry: ControlEntry) -> dict[str, Any]:
    """Make the options of `make_agent` for an entry.

    Args:
        entry: Task, estimator and controller.

    Returns:
        Options by name.
    """
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

    def __init__(self, function: Callable[..., object]) -> None:
        self.function, self.seconds = function, list[float]()

    def __call__(self, *args: object, **kwargs: object) -> object:
        start_time = time.perf_counter()
        result = self.function(*args, **kwargs)
        self.seconds.append(time.perf_counter() - start_time)
        return result


def measure_decision_time(entry: ControlEntry) -> float:
    """Measure the wall time of a decision of one car: predict, and the estimator's part.

    Medians over _STEPS steps of an episode, the bare env stepped side by side.

    Args:
        entry: Task, estimator and controller.

    Returns:
        Wall time (us).
    """
    cars: tuple[Any, Any] = make_cars(entry, 1)
    env, agent = cars
    bare: Any = gym.make_vec(entry.task.env_id, num_envs=1, **entry.env_options)
    bare.reset(seed=0)
    agent.predict, env.step = _TimedFunction(agent.predict), _TimedFunction(env.step)
    without = _TimedFunction(bare.step)
    for step in islice(iterate_steps(env, agent, 0), 1, _STEPS + 1):
        without(np.zeros_like(step.action))
    timers = (agent.predict, env.step, without)
    predict, with_estimator, without_estimator = (np.median(f.seconds) for f in timers)
    return 1e6 * float(predict + max(with_estimator - without_estimator, 0.0))
