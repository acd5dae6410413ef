"""Entries of the control benchmark: an agent, the estimator that it reads, and their options."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple, cast

import gymnasium as gym
import numpy as np

from ...agents import AGENTS, Agent, baselines, make_agent
from ...agents.learned.policy import is_policy, load_policy
from ...envs.record import Array
from ...envs.scenarios.manoeuvres import make_scenario
from ...envs.scenarios.world import make_world
from ...envs.sensors.slow import SENSOR_SETS
from ...envs.task import OBSERVATION_OPTIONS
from ...envs.validation import short_repr
from ...estimators import vector, wrappers
from ...estimators.design.options import TYRES
from ...estimators.filters import FILTERS
from ..harness.drives import call_quietly
from .tasks import NOMINAL, ORACLES, STEERING, TIERS, YAW, ControlTask, find_oracle

TRUTH, REFERENCE_CONTROLLER = "truth", "lqr"
REFERENCE_FILTER, JOINT = "exact-kf, all sensors", "joint"
_BOTH = {"slow": ["camera", "gps"]}
SETUPS: dict[str, tuple[str, dict[str, Any]]] = {
    REFERENCE_FILTER: ("exact-kf", _BOTH),
    "exact-kf, no bias states": ("exact-kf", _BOTH | {"bias_sd": 0.0, "accel_bias_sd": 0.0}),
    "exact-kf, no accelerometer": ("exact-kf", _BOTH | {"fast": ["gyro"]}),
    "exact-kf, camera": ("exact-kf", {"slow": ["camera"]}),
    "exact-kf, gps": ("exact-kf", {"slow": ["gps"]}),
    "multirate-kf, camera and gps": ("multirate-kf", _BOTH),
    JOINT: (JOINT, {}),
}  # filters by name in the tables: a name of `make_estimator`, and options over the tuned ones
ADAPTIVE = ("adaptive-lqr", "adaptive-nmpc")  # controllers that follow the tyres of `JOINT`
ESTIMATORS = (*SETUPS, "single-rate-kf", "uneven-delay-kf", "dakf", "bicycle-kf", TRUTH)
CONTROLLERS: dict[str, tuple[str, ...]] = {
    YAW: ("two-dof", "esc", "sliding-mode", "mpc", "nmpc"),
    STEERING: ("two-dof", "esc", "model-following", "nmpc"),
}  # besides the reference controller, on the reference filter
ORACLE_NAMES = (NOMINAL, *ORACLES)
_CANDIDATES = tuple(name for names in ORACLES.values() for name in names)
_SLOW_AGENTS = ("mpc", "nmpc", "adaptive-nmpc", *(names[1] for names in ORACLES.values()))

_PUSHES = ("force_sd", "moment_sd")
_DISTURBANCES = {"forces": ("F_d", "N_d"), "walk": ("d1", "d2"), "walk-all": ("d1", "d2")}


@dataclass(frozen=True)
class Entry:
    """An agent on an estimator, in any task; those that differ in options alone are equal."""

    agent: str  # name of `make_agent`, or a baseline
    estimator: str = ""  # name in `SETUPS` or of `make_estimator`, "truth"; "": none, or its own
    # options of filter and agent instead of the best known
    options: baselines.Options | None = field(default=None, compare=False)
    # a user's own instead of what the names mean: "agent" or its factory, "estimator" as a factory
    objects: Mapping[str, Any] = field(default_factory=dict, compare=False)
    trust: bool = field(default=False, compare=False)  # whether a zip may be read, which runs code

    @property
    def label(self) -> str:
        """Agent and estimator in words."""
        return f"{self.agent} on {self.estimator}" if self.estimator else self.agent

    @property
    def is_oracle(self) -> bool:
        """Whether a baseline drives."""
        return "agent" not in self.objects and self.agent in (*ORACLE_NAMES, *_CANDIDATES)

    @property
    def is_users(self) -> bool:
        """Whether its agent is a user's own."""
        is_known = self.is_oracle or self.agent in AGENTS or is_policy(self.agent)
        return "agent" in self.objects or not is_known

    @property
    def is_default(self) -> bool:
        """Whether agents are compared on its estimator: none, the reference or the agent's own."""
        follows = self.estimator == JOINT and self.agent in ADAPTIVE
        return self.estimator in ("", REFERENCE_FILTER) or follows or self in _POLICIES

    @property
    def filter_name(self) -> str:
        """Name of `make_estimator`."""
        return SETUPS.get(self.estimator, (self.estimator, {}))[0]

    @property
    def outputs(self) -> tuple[str, ...]:
        """Estimates that agents read: beta, gamma, and disturbances and tyres if there are any."""
        row = FILTERS.get(self.filter_name)  # a user's own has none
        options = dict(row.options if row else ())
        tyres = tuple(name for name in TYRES if f"{name}_sd" in options)
        return ("beta", "gamma", *_DISTURBANCES.get(row.disturbances if row else "", ()), *tyres)

    def make(self, task: ControlTask, n: int | None = None) -> tuple[Any, Any]:
        """Make the env with the entry's estimator, and the agent that drives it.

        Args:
            task: Task to drive.
            n: Rows of a vector env; None: a single env.
        """
        case, env_id = ControlCase(task, self), task.env_id
        if self.is_oracle:
            chosen = {"options": case.options, **case.env_options}
            return baselines.make_oracle(case.driver, env_id, n, **chosen)
        env: Any
        module: ModuleType = wrappers if n is None else vector
        if n is None:
            env = gym.make(env_id, **case.env_options)
        else:
            env = gym.make_vec(env_id, num_envs=n, **case.env_options)
        if self.estimator == TRUTH:
            env = module.TruthObservation(env, (), ("beta", "gamma"))
        elif self.estimator:
            source = self.objects.get("estimator", self.filter_name)
            env = call_quietly(module.EstimateObservation, env, source, **case.estimate_options)
        agent = make_agent(self.objects.get("agent", self.agent), env, **case.agent_options)
        if self.is_users and n is not None:
            agent = check_agent(agent, (n, env.single_action_space.shape[0]))
        return env, agent


class ControlCase(NamedTuple):
    """A task and who drives it."""

    task: ControlTask
    entry: Entry

    @property
    def driver(self) -> str:
        """Name of the agent: of an oracle's candidates the task's better one."""
        agent, is_oracle = self.entry.agent, self.entry.is_oracle
        return find_oracle(self.task, agent) if is_oracle and agent in ORACLES else agent

    @property
    def is_slow(self) -> bool:
        """Whether it takes so long to decide that it gets fewer episodes."""
        return self.driver in _SLOW_AGENTS

    @property
    def options(self) -> baselines.Options:
        """Options of filter and agent: its own, or tuned; of oracles and a user's own none."""
        if self.entry.options is not None:
            return self.entry.options
        if self.entry.trust or self.entry.is_users:
            return {"filter": {}, "controller": {"trust": True} if self.entry.trust else {}}
        return baselines.get_tuned_options(self.task.kind, self.driver)

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of the env; bad actions end the episode, a policy sees what it trained on."""
        agent = self.entry.agent
        card = load_policy(agent).card.env_options if is_policy(agent) else {}
        observed = {name: card[name] for name in OBSERVATION_OPTIONS if name in card}
        changes = observed | dict(self.task.changes)
        return self.task.env_options | {"on_bad_action": "fail"} | changes

    @property
    def spec(self) -> str:
        """JSON of the env from which `gym.make` builds it again."""
        env = gym.make(gym.spec(self.task.env_id), **self.env_options)
        return env.spec.to_json() if env.spec is not None else ""

    @property
    def estimate_options(self) -> dict[str, Any]:
        """Options of `EstimateObservation`; a policy gets the estimate it was trained on."""
        agent, estimator = self.entry.agent, self.entry.estimator
        if is_policy(agent):
            card = load_policy(agent).card
            if card.estimator == estimator:
                return card.estimator_options
        settings: dict[str, Any] = {"outputs": self.entry.outputs, "std": False}
        if estimator in SETUPS:
            name, options = SETUPS[estimator]
            if estimator == REFERENCE_FILTER:
                sensors = gym.spec(self.task.env_id).kwargs["sensors"]
                options = options | {"slow": list(SENSOR_SETS[sensors])}
            if name == baselines.FILTER:
                world = make_world(self.env_options.get("world", "ideal"))
                scenario = make_scenario(self.env_options["scenario"])
                levels = baselines.make_noise_options(scenario, world)
                # where nothing pushes, the filter's own level
                levels = {key: x for key, x in levels.items() if key not in _PUSHES or x > 0.0}
                options = levels | self.options["filter"] | options
                unused = set() if "gps" in options["slow"] else {"hdop_table"}
                unused |= set() if "camera" in options["slow"] else {"camera_yaw_sd"}
                if "accel_y" not in options.get("fast", ()):
                    unused |= {"accel_y_noise", "accel_bias_sd"}
                options = {key: value for key, value in options.items() if key not in unused}
            settings["options"] = options
        return settings

    @property
    def agent_options(self) -> dict[str, Any]:
        """Options of `make_agent`."""
        options: dict[str, Any] = {}
        if self.entry.agent == "model-following":
            options["rejection"] = self.entry.estimator == "dakf"
        if self.entry.agent == REFERENCE_CONTROLLER:  # nominal's own design
            options["grip"] = baselines.GRIP
            if self.task.env_id == STEERING:
                options["steer_weight"] = baselines.STEER_WEIGHT
        return options | self.options["controller"]


def check_agent(agent: Agent, shape: tuple[int, int]) -> Agent:
    """Wrap a user's agent, whose `predict` is to return actions and a state.

    It raises TypeError or ValueError for anything else; NaN is the env's to see.

    Args:
        agent: Agent with `predict` as stable-baselines3 has it.
        shape: Number of cars, and length of an action.
    """

    def predict(
        observation: Array, state: object = None, start: Array | None = None,
        deterministic: bool = True,
    ) -> object:  # fmt: skip
        result: object = agent.predict(observation, state, start, deterministic=deterministic)
        if not (isinstance(result, tuple) and len(result) == 2):
            raise TypeError(f"predict returns (action, state), got {short_repr(result)}")
        if np.shape(result[0]) != shape:
            raise ValueError(
                f"predict of observations {observation.shape} returns actions {shape}, a row a "
                f"car, got shape {np.shape(result[0])}"
            )
        return result

    return cast(Agent, SimpleNamespace(predict=predict))


LEARNED: dict[str, tuple[Entry, ...]] = {
    "car-steering": (Entry("distill-car-steering", JOINT), Entry("raw-car-steering", "")),
    "car-yaw": (Entry("distill-car-yaw", JOINT),),
    "coms-model": (Entry("distill-coms-steering", JOINT), Entry("raw-coms-steering", "")),
    "coms-zero-slip": (Entry("distill-coms-yaw", JOINT),),
}  # policies by the class of their tasks; verdicts speak of the first
_POLICIES = {entry for entries in LEARNED.values() for entry in entries}

EPISODES, QUICK_EPISODES, SLOW_EPISODES = 256, 8, 64


def select_quick_tasks(tasks: Sequence[ControlTask], count: int = 2) -> list[ControlTask]:
    """Select some tasks of each tier, from its first to its last."""
    selected = []
    for tier in dict.fromkeys(task.tier for task in tasks):
        tier_tasks = [task for task in tasks if task.tier == tier]
        step = max(len(tier_tasks) / count, 1.0)
        selected += [tier_tasks[int(i * step)] for i in range(min(count, len(tier_tasks)))]
    return selected


def make_cases(tasks: Sequence[ControlTask], quick: bool = False) -> Iterator[ControlCase]:
    """Make the matrix, task by task; in a tier's first id all estimators drive.

    Args:
        tasks: Tasks that are driven.
        quick: Whether slow entries are left out.

    Yields:
        Cases.
    """
    for task in tasks:
        entries = [Entry(oracle) for oracle in (*ORACLE_NAMES, "none")]
        first = task.tier not in TIERS or task.env_id == TIERS[task.tier][0][0]
        filters = ESTIMATORS if first else (REFERENCE_FILTER, TRUTH)
        entries += [Entry(REFERENCE_CONTROLLER, name) for name in filters]
        entries += [Entry(name, REFERENCE_FILTER) for name in CONTROLLERS[task.env_id]]
        entries += [Entry(name, JOINT) for name in ADAPTIVE]
        entries += LEARNED.get(task.kind, ()) if task.tier else ()
        for case in (ControlCase(task, entry) for entry in entries):
            if not (quick and case.is_slow and not case.entry.is_oracle):
                yield case
