"""What `sideslip distill` learns from, the contests of a class with their teacher, what goes on
from it, and what came of it in each of them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from ..agents.learned.card import Card, JsonMap
from ..agents.learned.files import Policy, is_policy, load_policy, save_policy
from ..envs.arguments import check_choice
from ..envs.scenarios.manoeuvres import make_scenario
from ..envs.task.observation import OBSERVATION_OPTIONS
from ..estimators.vector.estimate import EstimateObservation
from .control.build import make_cars, make_estimate_options
from .control.cells import ADAPTIVE, ORACLE_NAMES, REFERENCE_FILTER, ControlEntry
from .control.contests import (
    NOMINAL,
    ORACLES,
    PARAMETERS,
    ControlTask,
    list_scored_tasks,
    vary_scenario,
)
from .control.episodes import Chunk, run_chunk
from .control.scores import compute_log_ratios
from .control.seeds import make_salted_seeds
from .harness.parallel import run_cases
from .harness.stats import Estimate, compute_win_rate, geometric_mean
from .policies import evaluate_policy, summarise_evaluation

if TYPE_CHECKING:
    from ..agents.training.distill import DistillTask
    from ..agents.training.task import TrainingTask

JOINT, RIVAL = "joint, friction", "adaptive-nmpc"
OUTPUTS = ("beta", "gamma", "phi", "phi_rate", "F_d", "N_d", "bias", "front_tyres", "rear_tyres",
           "inverse_friction")  # fmt: skip
"""What a student on `joint` reads of it, with standard deviations."""
VARIED = {
    "tyres": (0.4, 2.0),
    "wind": (-500.0, 500.0),
    "mass": (0.8, 1.3),
    "camera": (0.01, 0.12),
    "out": (2.0, 6.0),
}
"""Of lessons that are varied: factors on each axle's tyres and the wind's force from the side, in
N, in every episode, and, of a lesson, on the true car's mass; how late its camera is, and how long
its GPS or its camera is out, in s."""
_WITHOUT_FILTER = (*ORACLE_NAMES, *(name for names in ORACLES.values() for name in names))
FILTERS = ("", "joint")


def list_tasks(kind: str) -> list[ControlTask]:
    """The scored contests of a class; ValueError for an unknown one."""
    check_choice(
        "class of contests", kind, list(dict.fromkeys(task.kind for task in list_scored_tasks()))
    )
    return [task for task in list_scored_tasks() if task.kind == kind]


def make_card(
    kind: str,
    estimator: str = "",
    teacher: str = RIVAL,
    observation_options: Mapping[str, Any] | None = None,
    **rest: Any,
) -> Card:
    """The card of a policy for a class of contests, in the first one's env with options
    `observation_options` of what is observed; rest: other fields."""
    check_choice("estimator", estimator, FILTERS)
    for name in observation_options or {}:
        check_choice("option", name, OBSERVATION_OPTIONS)
    first = list_tasks(kind)[0]
    options = _make_estimate_options(first, teacher) if estimator else {}
    return Card.from_env_id(
        first.env_id,
        first.env_options | dict(observation_options or {}),
        estimator,
        options,
        **rest,
    )


def _make_estimate_options(task: ControlTask, teacher: str) -> JsonMap:
    """The filter of a teacher that reads `joint`, else of the rival, which is the same in all
    contests of a class, and more of its states."""
    filters = {controller: name for name, controller in ADAPTIVE.items()}
    controller = teacher if teacher in filters else RIVAL
    filter_options = make_estimate_options(ControlEntry(task, filters[controller], controller))[
        "options"
    ]
    known = [
        output
        for output in OUTPUTS
        if output != "inverse_friction" or f"{output}_sd" in filter_options
    ]
    return {"outputs": known, "std": True, "options": filter_options}


def _draw_changes(varied: int, rng: np.random.Generator) -> Iterator[JsonMap]:
    """What lessons change of their contest's scenario: nothing, then `VARIED` so many times."""
    yield {}
    for _ in range(varied):
        start, length = rng.uniform(0.0, 4.0), rng.uniform(*VARIED["out"])
        yield {
            "front_stiffness": VARIED["tyres"],
            "rear_stiffness": VARIED["tyres"],
            "camera_delays": [round(rng.uniform(*VARIED["camera"]), 3)],  # whole ticks
            f"{rng.choice(('gps', 'camera'))}_outage": (start, start + length),
            "wind_force": VARIED["wind"],
            "wind_start": (0.0, 4.0),
            "wind_length": (1.0, 4.0),
            "mass": float(rng.uniform(*VARIED["mass"])),
        }


def make_lessons(
    kind: str,
    teacher: str,
    estimator: str,
    cars: int,
    varied: int = 0,
    seed: int = 0,
    observation_options: Mapping[str, Any] | None = None,
) -> "list[DistillTask]":
    """A lesson for each contest of a class, and more of each where what the contest keeps varies.

    teacher: a rung, a controller of the matrix, which reads its filter there, or a policy, which
    reads the one of its card. cars: of each contest's lesson. varied: so many more, as `VARIED`
    says, share as many cars, rounded up; no filter and no teacher learns of it. seed: of what is
    drawn for them. seen: options of what the student observes. Raises ValueError for another name,
    or where that observation lacks what the teacher needs.
    """
    from ..agents.training.distill import DistillTask

    rng = np.random.default_rng(seed)
    reads = {controller: name for name, controller in ADAPTIVE.items()} | dict.fromkeys(
        _WITHOUT_FILTER, ""
    )
    if is_policy(teacher):
        reads[teacher] = load_policy(teacher).card.estimator
    lessons = []
    for task in list_tasks(kind):
        for change in _draw_changes(varied, rng):
            scenario_options = {"scenario": vary_scenario(task, change)} if change else {}
            entry = ControlEntry(
                task, reads.get(teacher, REFERENCE_FILTER), teacher, scenario_options
            )
            count = -(-cars // varied) if change else cars
            twins, agent = make_cars(entry, count)
            options = task.env_options | scenario_options | dict(observation_options or {})
            env: Any = gym.make_vec(task.env_id, num_envs=count, **options)
            if estimator:
                env = EstimateObservation(env, estimator, **_make_estimate_options(task, teacher))
            lessons.append(DistillTask(env, twins, agent))
    return lessons


def prepare_start(
    agent: Path | None, varied: int = 0
) -> "tuple[Path | Policy | None, Callable[..., TrainingTask]]":
    """What `sideslip train -i` begins with, and what makes its task of the fields that were said.

    agent: a zip's path stays what it is; a distilled policy goes on in all contests of its class,
    but for those with a driver where cars are driven on tensors: rows are of one kind there.
    varied: so many times in each of them as `VARIED` says, too, drawn by the training's seed and
    not as `make_lessons` draws. Raises ValueError for them without contests of a class.
    """
    from ..agents.training.algorithms import get_algorithm
    from ..agents.training.starts import make_finetune_task
    from ..agents.training.task import TrainingTask

    policy = load_policy(agent) if agent is not None and is_policy(str(agent)) else None
    kind = policy.card.algorithm_options.get("class") if policy else None
    if varied and kind is None:
        raise ValueError(f"--varied is for a policy of a class of contests, got {agent}")
    if policy is None:
        return agent, TrainingTask

    def make_task(**fields: Any) -> TrainingTask:
        has_scenarios = "scenarios" in fields or "scenario" in fields.get("env_options", {})
        if has_scenarios and varied:
            raise ValueError("--varied is of a policy's own contests: without other scenarios")
        if kind is not None and not has_scenarios:
            tasks, rng = list_tasks(kind), np.random.default_rng([fields.get("seed", 0), 1])
            if get_algorithm(fields.get("algo", "ppo")).on_tensors:
                tasks = [c for c in tasks if make_scenario(c.scenario).steering != "driver"]
            fields["scenarios"] = [
                vary_scenario(task, change) if change else task.scenario
                for task in tasks
                for change in _draw_changes(varied, rng)
            ]
        return make_finetune_task(policy, **fields)

    return policy, make_task


def evaluate_card(path: Path, kind: str, episodes: int) -> JsonMap:
    """Drive a policy, `nominal`, the rival and oracle-parameters on seeds made from its weights,
    and write into its card what it costs; what is written."""
    policy, policy_evaluation = load_policy(path), evaluate_policy(str(path), episodes)
    tasks = list_tasks(kind)
    task_costs = run_cases(
        partial(_evaluate_task, path, episodes=episodes), tasks, "contests", jobs=1
    )
    costs = dict(zip((task.scenario for task in tasks), task_costs, strict=True))
    record = summarise_evaluation(policy_evaluation) | {"cost in % of nominal": costs}
    save_policy(path, policy.network, replace(policy.card, evaluation=record))
    return record


def _evaluate_task(path: Path, task: ControlTask, episodes: int) -> JsonMap:
    policy = load_policy(path)
    seeds = tuple(make_salted_seeds(policy.salt, episodes, task.seed_text))
    entries = {
        "policy": ControlEntry(task, policy.card.estimator, str(path)),
        NOMINAL: ControlEntry(task, "", NOMINAL),
        RIVAL: ControlEntry(task, JOINT, RIVAL),
        PARAMETERS: ControlEntry(task, "", PARAMETERS),
    }
    results = {name: run_chunk(Chunk(entry, seeds)) for name, entry in entries.items()}
    for name, result in results.items():
        if result.error:
            raise ValueError(f"{name} cannot drive {task.name}: {result.error}")
    costs = results[NOMINAL].costs
    shown: JsonMap = {
        name: _list_rounded(geometric_mean(-compute_log_ratios(costs, result)), 100.0)
        for name, result in results.items()
        if name != NOMINAL
    }
    beaten = {
        name: compute_win_rate(results["policy"].costs, results[name].costs)
        for name in (NOMINAL, RIVAL)
    }
    fails = float((results["policy"]["failure"] != 0.0).mean())
    better = {f"better than {name}": _list_rounded(result, 1.0) for name, result in beaten.items()}
    return shown | better | {"fails": fails}


def _list_rounded(numbers: Estimate, unit: float) -> Sequence[float]:
    return [round(unit * number, 3) for number in numbers]
