"""Costs of a learned policy beside others' on the same seeds, and what policies are trained on.

Lessons of `sideslip distill` and starts of `sideslip train -i`: a class's tasks, some varied.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from ...agents.learned.policy import Card, JsonMap, Policy, is_policy, load_policy, save_policy
from ...agents.rollout import compute_cost_ratios
from ...envs.record import Array
from ...envs.scenarios.manoeuvres import make_scenario
from ...envs.task import OBSERVATION_OPTIONS
from ...envs.validation import check_choice
from ...estimators.vector.estimate import EstimateObservation
from ..control.entries import (
    ADAPTIVE,
    ORACLE_NAMES,
    REFERENCE_FILTER,
    ControlEntry,
    make_cars,
    make_estimate_options,
)
from ..control.run import Chunk, DriveResult, run_chunk
from ..control.score import compute_log_ratios, make_spec
from ..control.tasks import (
    NOMINAL,
    ORACLES,
    PARAMETERS,
    ControlTask,
    list_scored_tasks,
    make_salted_seeds,
    vary_scenario,
)
from ..harness.parallel import run_cases
from ..harness.results import ResultTable, Suite
from ..harness.stats import Estimate, compute_win_rate, geometric_mean, interval
from ..harness.verdict import format_percent, format_verdict
from ..report.study import add_rows

if TYPE_CHECKING:
    from ...agents.training.config import TrainingTask
    from ...agents.training.distill import DistillTask

_CLASSICAL, FILTER = "lqr", "exact-kf"


@dataclass
class PolicyEvaluation:
    """Episodes on the same seeds by entry, the policy's first."""

    policy: Policy  # the policy
    salt: str  # salt of the seeds, "" where the caller chose them
    seeds: list[int]  # seeds of the episodes
    reference: str  # reference of the env
    entries: dict[str, ControlEntry]  # entries by name
    drives: dict[str, DriveResult]  # episodes by name
    left_out: dict[str, str]  # why an entry is not among them, by name


def evaluate_policy(
    policy: str,
    episodes: int = 256,
    *,
    env_id: str | None = None,
    scenario: str | None = None,
    seed: int | None = None,
) -> PolicyEvaluation:
    """Drive a policy, the uncontrolled car, and the classical line.

    Args:
        policy: Shipped name or path.
        episodes: Episodes of each entry.
        env_id: Another env than the policy's own, with that id's options.
        scenario: Name instead of the env's own.
        seed: Seed of the first episode, the next ones count up; None: made from the weights.

    Returns:
        Episodes of all entries.

    Raises:
        ValueError: The policy cannot drive the env.
    """
    loaded = load_policy(policy)
    card, home = loaded.card, env_id or loaded.card.env_id
    options = dict(card.env_options) if env_id in (None, card.env_id) else {}
    options |= {} if scenario is None else {"scenario": scenario}
    base: Any = gym.make(home, **options).unwrapped
    salt = loaded.salt if seed is None else ""
    seeds = (
        make_salted_seeds(salt, episodes) if seed is None else list(range(seed, seed + episodes))
    )
    rivals = {f"{_CLASSICAL} on {FILTER}": (FILTER, _CLASSICAL), "none": ("", "none")}
    if loaded.name in rivals:
        raise ValueError(f"the policy's file is called {loaded.name!r}, as what it is held against")
    contestants = {loaded.name: (card.estimator, policy)} | rivals
    task = ControlTask(env_id=home, scenario=base.scenario.name)
    entries = {name: ControlEntry(task, *pair, options) for name, pair in contestants.items()}
    chunks = [Chunk(entry, tuple(seeds), keep=True) for entry in entries.values()]
    results = dict(zip(entries, run_cases(run_chunk, chunks, loaded.name, jobs=1), strict=True))
    errors = {name: outcome.error for name, outcome in results.items() if outcome.error}
    if failed := [name for name in (loaded.name, "none") if name in errors]:
        raise ValueError(f"{failed[0]} cannot drive {home}: {errors[failed[0]]}")
    drives = {name: outcome for name, outcome in results.items() if name not in errors}
    return PolicyEvaluation(loaded, salt, seeds, base.reference, entries, drives, errors)


def summarise_evaluation(result: PolicyEvaluation) -> JsonMap:
    """Summarise an evaluation for a card.

    Args:
        result: Episodes of all entries.

    Returns:
        Salt, number of episodes, and each entry's mean cost with its 95 % interval.
    """
    costs = {}
    for name, drive in result.drives.items():
        mean, low, high = (round(number, 6) for number in interval(drive.costs))
        costs[name] = {"mean": mean, "low": low, "high": high}
    return {"salt": result.salt, "episodes": len(result.seeds), "cost": costs}


def record_evaluation(path: str | Path, episodes: int = 256) -> PolicyEvaluation:
    """Drive a policy's test seeds in its own env and write what it costs into its card.

    Args:
        path: File of the policy.
        episodes: Episodes of each entry.

    Returns:
        Episodes of all entries.
    """
    result = evaluate_policy(str(path), episodes)
    policy = result.policy
    save_policy(path, policy.network, replace(policy.card, evaluation=summarise_evaluation(result)))
    return result


def make_suite(result: PolicyEvaluation) -> Suite:
    """Make a suite of table and rows, and of the first episode over time and in motion.

    Args:
        result: Episodes of all entries.

    Returns:
        Suite.
    """
    name, card = result.policy.name, result.policy.card
    entry = result.entries[name]
    text = (
        f"{len(result.seeds)} episodes of {entry.task.scenario}, the same seeds for all. "
        f"{name} was trained by {card.algorithm or 'an unnamed algorithm'} on {card.steps} "
        f"steps of {card.env_id} (reference: {card.reference}) in {card.cpu_seconds:.0f} CPU-s."
    )
    if result.reference != card.reference:
        text += f" Here it is judged by another reference, {result.reference}: by another cost."
    suite = Suite("enjoy", f"{name} on {entry.task.env_id}", text, tables=[_make_table(result)])
    _add_rows(suite, result)
    from ..control.report import make_time_explorer

    driven = {(label,): drive.series for label, drive in result.drives.items()}
    series: dict[tuple[str, ...], Array] = {x: y for x, y in driven.items() if y is not None}
    suite.explorers.append(make_time_explorer("The first seed, side by side", (), series, name))
    suite.verdict = _compose_verdict(result)
    return suite


def _compose_verdict(result: PolicyEvaluation) -> str:
    """Costs of the policy over the others', and how often it fails."""
    name = result.policy.name
    fails = 100.0 * np.mean(result.drives[name]["failure"] != 0.0)
    lines = [
        f"{name} costs {_format_cost_ratio(result, other)} of {other}, seed by seed."
        for other in result.drives
        if other != name
    ]
    limits = f"Not said: other cars, scenarios and seeds than these {len(result.seeds)}."
    return format_verdict(*lines, f"It fails in {fails:.0f} % of the episodes. {limits}")


def _format_cost_ratio(result: PolicyEvaluation, other: str) -> str:
    costs, others = (result.drives[name].costs for name in (result.policy.name, other))
    return format_percent(geometric_mean(np.log(compute_cost_ratios(costs, others))))


def _make_table(result: PolicyEvaluation) -> ResultTable:
    """Table of what the policy costs over each other's, and of everybody's motion."""
    first = result.policy.name
    costs, cells = result.drives[first].costs, []
    for name, outcome in result.drives.items():
        ratio = _format_cost_ratio(result, name) if name != first else ""
        better = f"{100.0 * compute_win_rate(costs, outcome.costs).value:.0f} %" if ratio else ""
        slip, step = 1e3 * outcome["rms_slip"].mean(), outcome["largest_step"].mean()
        fails = 100.0 * np.mean(outcome["failure"] != 0.0)
        cells.append([name, ratio, better, f"{slip:.2f}", f"{step:.0f}", f"{fails:.1f} %"])
    header = (f"{first} costs, of it", "better", "RMS slip", "step", "fails")
    note = (
        f"{first}'s cost over each other's: paired geometric means with 95 % intervals. "
        f"better: share of the seeds on which {first} costs less. Slip in mrad. step: "
        "the largest between two decisions, in N m."
    )
    left_out = [f"{name} was not driven: {error}." for name, error in result.left_out.items()]
    return ResultTable("What it costs", ("controller", *header), cells, " ".join([note, *left_out]))


def _add_rows(suite: Suite, result: PolicyEvaluation) -> None:
    """Add rows of every entry: cost, slip, effort and steps."""
    for name, outcome in result.drives.items():
        entry = result.entries[name]
        task, is_policy = entry.task, name == result.policy.name
        labels = {"estimator": entry.estimator, "scenario": task.scenario, "salt": result.salt}
        labels |= {"controller": name if is_policy else entry.controller, "spec": make_spec(entry)}
        metrics = ("cost", "rms_slip", "peak_slip", "effort", "largest_step")
        numbers = {metric: interval(outcome[metric]) for metric in metrics}
        add_rows(suite, numbers, task.env_id, n=len(result.seeds), **labels)


_JOINT, _RIVAL = "joint, friction", "adaptive-nmpc"
_OUTPUTS = ("beta", "gamma", "phi", "phi_rate", "F_d", "N_d", "bias", "front_tyres", "rear_tyres",
           "inverse_friction")  # fmt: skip
"""States that a student on `joint` reads, with standard deviations."""
VARIED = {"tyres": (0.4, 2.0), "wind": (-500.0, 500.0), "mass": (0.8, 1.3)}
VARIED |= {"camera": (0.01, 0.12), "out": (2.0, 6.0)}
"""Drawn in each episode: factors on each axle's tyres, side wind (N); once a lesson: a factor on
the true car's mass, how late its camera is (s), how long its GPS or its camera is out (s)."""
_WITHOUT_FILTER = (*ORACLE_NAMES, *(name for names in ORACLES.values() for name in names))
FILTERS = ("", "joint")


def list_tasks(kind: str) -> list[ControlTask]:
    """List the scored tasks of a class; ValueError for an unknown one.

    Args:
        kind: Class of tasks.

    Returns:
        Tasks.
    """
    tasks = list_scored_tasks()
    check_choice("class of contests", kind, list(dict.fromkeys(task.kind for task in tasks)))
    return [task for task in tasks if task.kind == kind]


def make_card(
    kind: str,
    estimator: str = "",
    teacher: str = _RIVAL,
    observation_options: Mapping[str, Any] | None = None,
    **rest: Any,
) -> Card:
    """Make the card of a policy for a class of tasks in the first one's env.

    Args:
        kind: Class of tasks.
        estimator: Estimator that the policy reads, one of `FILTERS`.
        teacher: Name of its teacher, whose filter it shares where that is `joint`.
        observation_options: Options of the observation.
        **rest: Other fields of the card.

    Returns:
        Card.
    """
    check_choice("estimator", estimator, FILTERS)
    for name in observation_options or {}:
        check_choice("option", name, OBSERVATION_OPTIONS)
    first = list_tasks(kind)[0]
    options = _make_estimate_options(first, teacher) if estimator else {}
    env_options = first.env_options | dict(observation_options or {})
    return Card.from_env_id(first.env_id, env_options, estimator, options, **rest)


def _make_estimate_options(task: ControlTask, teacher: str) -> JsonMap:
    """The filter of a teacher on `joint`, else of the rival's, with more of its states."""
    filters = {controller: name for name, controller in ADAPTIVE.items()}
    controller = teacher if teacher in filters else _RIVAL
    entry = ControlEntry(task, filters[controller], controller)
    options = make_estimate_options(entry)["options"]
    has_friction = "inverse_friction_sd" in options
    known = [name for name in _OUTPUTS if name != "inverse_friction" or has_friction]
    return {"outputs": known, "std": True, "options": options}


def _draw_changes(varied: int, rng: np.random.Generator) -> Iterator[JsonMap]:
    """Draw what lessons change of their task's scenario: nothing, then `VARIED` so many times."""
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
    """Make a lesson for each task of a class, and more of each in which the scenario varies.

    Args:
        kind: Class of tasks.
        teacher: Baseline, controller with its filter of the benchmark, or policy with its card's.
        estimator: Estimator of the student.
        cars: Cars of each task's lesson.
        varied: Further lessons by `VARIED`, which share as many cars, rounded up; no filter and no
            teacher knows of the changes.
        seed: Seed of what is drawn for them.
        observation_options: Options of what the student observes.

    Returns:
        Lessons of all tasks.

    Raises:
        ValueError: An unknown name, or an observation that lacks what the teacher needs.
    """
    from ...agents.training.distill import DistillTask

    rng = np.random.default_rng(seed)
    reads = {controller: name for name, controller in ADAPTIVE.items()}
    reads |= dict.fromkeys(_WITHOUT_FILTER, "")
    if is_policy(teacher):
        reads[teacher] = load_policy(teacher).card.estimator
    lessons = []
    for task in list_tasks(kind):
        for change in _draw_changes(varied, rng):
            scenario_options = {"scenario": vary_scenario(task, change)} if change else {}
            name = reads.get(teacher, REFERENCE_FILTER)
            entry = ControlEntry(task, name, teacher, scenario_options)
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
    """Prepare what `sideslip train -i` begins with, and the function that makes its task.

    A zip's path stays what it is; a distilled policy goes on in all tasks of its class, but for
    those with a driver where cars are driven on tensors: rows are of one kind there.

    Args:
        agent: File of a policy or a zip, None for none.
        varied: How often each task varies by `VARIED`, drawn by the training's seed.

    Returns:
        Path or policy, and the function of the fields of `TrainingTask`.

    Raises:
        ValueError: Tasks vary, but the policy is of no class.
    """
    from ...agents.training.config import TrainingTask, get_algorithm
    from ...agents.training.warm_start import make_finetune_task

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
    """Drive a policy and its class's baselines, and write what it costs into its card.

    Args:
        path: File of the policy.
        kind: Class of tasks.
        episodes: Episodes of each task.

    Returns:
        The card's evaluation.
    """
    policy, policy_evaluation = load_policy(path), evaluate_policy(str(path), episodes)
    tasks, evaluate = list_tasks(kind), partial(_evaluate_task, path, episodes=episodes)
    task_costs = run_cases(evaluate, tasks, "contests", jobs=1)
    costs = dict(zip((task.scenario for task in tasks), task_costs, strict=True))
    record = summarise_evaluation(policy_evaluation) | {"cost in % of nominal": costs}
    save_policy(path, policy.network, replace(policy.card, evaluation=record))
    return record


def _evaluate_task(path: Path, task: ControlTask, episodes: int) -> JsonMap:
    """Cost in % of nominal's and win rates, with intervals, and the fraction of failures."""
    policy = load_policy(path)
    seeds = tuple(make_salted_seeds(policy.salt, episodes, task.seed_text))
    entries = {
        "policy": ControlEntry(task, policy.card.estimator, str(path)),
        NOMINAL: ControlEntry(task, "", NOMINAL),
        _RIVAL: ControlEntry(task, _JOINT, _RIVAL),
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
    policy_costs, rivals = results["policy"].costs, (NOMINAL, _RIVAL)
    beaten = {name: compute_win_rate(policy_costs, results[name].costs) for name in rivals}
    better = {f"better than {name}": _list_rounded(result, 1.0) for name, result in beaten.items()}
    return shown | better | {"fails": float((results["policy"]["failure"] != 0.0).mean())}


def _list_rounded(numbers: Estimate, unit: float) -> Sequence[float]:
    return [round(unit * number, 3) for number in numbers]
