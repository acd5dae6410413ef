"""The matrix: contests, estimators, controllers, and the cells they make."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from ...agents import AGENTS
from ...agents.learned.files import is_policy, load_policy
from ...agents.tuned import Options, get_tuned_options
from ...envs.task.observation import OBSERVATION_OPTIONS
from .contests import (
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
SETUPS: dict[str, tuple[str, dict[str, Any]]] = {
    REFERENCE_FILTER: ("exact-kf", {"slow": ["camera", "gps"]}),
    "exact-kf, no bias states": (
        "exact-kf",
        {"slow": ["camera", "gps"], "bias_sd": 0.0, "accel_bias_sd": 0.0},
    ),
    "exact-kf, no accelerometer": ("exact-kf", {"slow": ["camera", "gps"], "fast": ["gyro"]}),
    "exact-kf, camera": ("exact-kf", {"slow": ["camera"]}),
    "exact-kf, gps": ("exact-kf", {"slow": ["gps"]}),
    "multirate-kf, camera and gps": ("multirate-kf", {"slow": ["camera", "gps"]}),
    "joint": ("joint", {"slow": ["camera", "gps"]}),
    "joint, friction": ("joint", {"slow": ["camera", "gps"], "inverse_friction_sd": 0.3}),
    "learned-joint": ("learned-joint", {"slow": ["camera", "gps"]}),
}
"""Filters by what they are called in the tables: a name of `make_estimator` and its options, over
the contestant's tuned ones where the filter is `exact-kf`."""
ADAPTIVE = {"joint": "adaptive-lqr", "joint, friction": "adaptive-nmpc"}
"""By the filter whose tyres they follow."""
CORRECTED = ("learned-joint", "adaptive-nmpc")
"""The same controller on that filter with a network behind it."""
ESTIMATORS = (
    *(name for name in SETUPS if name != CORRECTED[0]),
    "single-rate-kf",
    "uneven-delay-kf",
    "dakf",
    "bicycle-kf",
    TRUTH,
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
"""(estimator, policy), first the one of which verdicts speak, by the class of contests that the
policy was trained on, by its shipped name or path."""
SHARED = {
    ORACLES[PARAMETERS][0]: ("adaptive-lqr", {"grip", "steer_weight"}),
    ORACLES[PARAMETERS][1]: ("adaptive-nmpc", {"horizon", "grip", "steer_weight"}),
    ORACLES[STATE][1]: ("adaptive-nmpc", {"horizon", "steer_weight"}),
}
"""By who is not tuned: from whom, closest in what it knows, it takes over what of the controller;
its filter's levels are the scenario's."""
SLOW_CONTROLLERS = ("mpc", "nmpc", "adaptive-nmpc", ORACLES[STATE][1], ORACLES[PARAMETERS][1])

EPISODES, QUICK_EPISODES, SLOW_EPISODES = 256, 8, 64
QUICK_CONTESTS = 2
"""Of each tier, in a quick run."""


def select_quick_tasks(tasks: Sequence[ControlTask]) -> list[ControlTask]:
    """`QUICK_CONTESTS` of each tier, from its first to its last."""
    selected = []
    for tier in dict.fromkeys(task.tier for task in tasks):
        tier_tasks = [task for task in tasks if task.tier == tier]
        step = max(len(tier_tasks) / QUICK_CONTESTS, 1.0)
        selected += [tier_tasks[int(i * step)] for i in range(min(QUICK_CONTESTS, len(tier_tasks)))]
    return selected


@dataclass(frozen=True)
class ControlEntry:
    """One square of the matrix.

    estimator: a name of `SETUPS` or of `make_estimator`, "truth", or "" where the controller reads
    none or brings its own. controller: a name of `make_agent`, or a rung. options: of the env
    beside the contest's, a scenario that has no name among them; tuned: options of filter and
    controller instead of the best known; objects: a user's own instead of what the names mean, an
    agent, or a factory of one, as "controller", a filter's factory as "estimator". Cells are equal
    whatever these three are.
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
        """The options of its filter and its controller: `get_tuned_options`, or those of
        `agents.get_tuned_options`, where the reference controller, `nominal`'s design on any
        filter, has the rung's, a user's own the rung's filter, and one that was not tuned what it
        shares with the rung."""
        if self.tuned is not None:
            return self.tuned
        if self.is_users:
            return get_tuned_options(self.task.kind, NOMINAL) | {"controller": {}}
        kind, name = self.task.kind, self.oracle or self.controller
        if name in SHARED and not any(get_tuned_options(kind, name).values()):
            source, numbers = SHARED[name]
            best = get_tuned_options(kind, source)["controller"]
            return {"filter": {}, "controller": {key: best[key] for key in numbers & best.keys()}}
        return get_tuned_options(kind, NOMINAL if name == REFERENCE_CONTROLLER else name)

    @property
    def label(self) -> str:
        """Controller and estimator in words."""
        return f"{self.controller} on {self.estimator}" if self.estimator else self.controller

    @property
    def env_options(self) -> dict[str, Any]:
        """Options of the env: an action that is none ends the episode, and a policy sees what its
        training saw."""
        card = load_policy(self.controller).card.env_options if is_policy(self.controller) else {}
        observed = {name: card[name] for name in OBSERVATION_OPTIONS if name in card}
        return self.task.env_options | {"on_bad_action": "fail"} | observed | self.options

    @property
    def oracle(self) -> str:
        """The rung of the ladder that drives, "" where a contestant does."""
        if self.is_users:
            return ""
        if self.controller in ORACLES:
            return find_oracle(self.task, self.controller)
        return self.controller if self.controller in (NOMINAL, *_CANDIDATES) else ""

    @property
    def slow(self) -> bool:
        """Whether it takes so long to decide that it gets fewer episodes."""
        return (self.oracle or self.controller) in SLOW_CONTROLLERS


def make_entries(tasks: Sequence[ControlTask], quick: bool = False) -> Iterator[ControlEntry]:
    """Every cell of the matrix, contest by contest; quick: without the slow contestants.

    All estimators in the contests with the first of their tier's ids.
    """
    for task in tasks:
        entries = [ControlEntry(task, "", oracle) for oracle in (*ORACLE_NAMES, "none")]
        first = task.tier not in TIERS or task.env_id == TIERS[task.tier][0][0]
        filters = ESTIMATORS if first else (REFERENCE_FILTER, TRUTH)
        entries += [ControlEntry(task, name, REFERENCE_CONTROLLER) for name in filters]
        entries += [
            ControlEntry(task, REFERENCE_FILTER, controller)
            for controller in CONTROLLERS[task.env_id]
        ]
        entries += [ControlEntry(task, *pair) for pair in (*ADAPTIVE.items(), CORRECTED)]
        if task.tier:
            entries += [ControlEntry(task, *pair) for pair in LEARNED.get(task.kind, ())]
        yield from (entry for entry in entries if not (quick and entry.slow and not entry.oracle))
