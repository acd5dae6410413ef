"""Costs of a learned policy beside others' on the same seeds, and what policies are trained on.

Lessons of `sideslip distill` and starts of `sideslip train -i`: a class's tasks, some varied.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from ...envs.vehicle.parameters import VEHICLES
from ...estimators.vector.estimate import EstimateObservation
from ..control.entries import ADAPTIVE, JOINT, REFERENCE_FILTER, ControlCase, Entry
from ..control.run import Chunk, DriveResult, run_chunk
from ..control.score import compute_log_ratios
from ..control.tasks import (
    NOMINAL,
    PARAMETERS,
    QUICK_LEAD_IN,
    ControlTask,
    list_scored_tasks,
    make_salted_seeds,
)
from ..harness.parallel import run_cases
from ..harness.results import Column, ResultTable, Suite
from ..harness.stats import Estimate, compute_win_rate, geometric_mean, interval
from ..report.study import format_percent, format_verdict

if TYPE_CHECKING:
    from ...agents.training.config import TrainingTask
    from ...agents.training.distill import DistillTask

_CLASSICAL, FILTER = "lqr", "exact-kf"
_METRICS = ("cost", "rms_slip", "peak_slip", "effort", "largest_step")
_COLUMNS = (
    Column("label", "controller"),
    "cost ratio",
    Column("better", "better / %", 100.0, ".0f"),
    Column("rms_slip", "RMS slip / mrad", 1e3, ".2f", interval=False),
    Column("largest_step", "step / (N m)", form=".0f", interval=False),
    Column("fails", "fails / %", 100.0, ".1f"),
)


@dataclass
class PolicyEvaluation:
    """Episodes on the same seeds by entry, the policy's first."""

    policy: Policy
    salt: str  # of the seeds, "" where the caller chose them
    seeds: list[int]
    reference: str  # of the env
    task: ControlTask  # that they drive
    entries: dict[str, Entry]
    drives: dict[str, DriveResult]
    left_out: dict[str, str]  # why an entry is not among them, by name

    def make_suite(self) -> Suite:
        """Make a suite of table and rows, and of the first episode over time and in motion."""
        from ..control.suite import make_time_explorer

        name, card, task = self.policy.name, self.policy.card, self.task
        text = (
            f"{len(self.seeds)} episodes of {task.scenario}, the same seeds for all. "
            f"{name} was trained by {card.algorithm or 'an unnamed algorithm'} on {card.steps} "
            f"steps of {card.world_id} (reference: {card.reference}) in {card.cpu_seconds:.0f} "
            "CPU-s."
        )
        if self.reference != card.reference:
            text += f" Here it is judged by another reference, {self.reference}: by another cost."
        suite, costs = Suite("enjoy", f"{name} on {task.env_id}", text), self.drives[name].costs
        lines, verdict = list[dict[str, Any]](), list[str]()
        for label, drive in self.drives.items():
            entry = self.entries[label]
            line: dict[str, Any] = {metric: interval(drive[metric]) for metric in _METRICS}
            line |= {"label": label, "fails": float(np.mean(drive["failure"] != 0.0))}
            line |= {"controller": name if label == name else entry.agent}
            line |= {"estimator": entry.estimator, "spec": ControlCase(task, entry).spec}
            if label != name:
                ratio = geometric_mean(np.log(compute_cost_ratios(costs, drive.costs)))
                line |= {"cost ratio": format_percent(ratio)}
                line |= {"better": compute_win_rate(costs, drive.costs).value}
                verdict.append(f"{name} costs {line['cost ratio']} of {label}, seed by seed.")
            lines.append(line)
        n = len(self.seeds)
        suite.add_rows(lines, task.env_id, n=n, scenario=task.scenario, salt=self.salt)
        note = (
            f"cost ratio: {name}'s over each other's, paired geometric means with 95 % intervals. "
            f"better: on how many of the seeds {name} costs less. step: the largest between two "
            "decisions."
        )
        note += "".join(f" {x} was not driven: {error}." for x, error in self.left_out.items())
        suite.tables.append(ResultTable("What it costs", _COLUMNS, lines, note))
        drives = self.drives.items()
        series: dict[tuple[str, ...], Array]
        series = {(label,): x.series for label, x in drives if x.series is not None}
        suite.explorers.append(make_time_explorer("The first seed, side by side", (), series, name))
        suite.verdict = format_verdict(
            *verdict,
            f"It fails in {100.0 * lines[0]['fails']:.0f} % of the episodes. Not said: other "
            f"cars, scenarios and seeds than these {len(self.seeds)}.",
        )
        return suite


def evaluate_policy(
    policy: str, episodes: int = 256, *, env_id: str | None = None, scenario: str | None = None,
    seed: int | None = None,
) -> PolicyEvaluation:  # fmt: skip
    """Drive a policy, the uncontrolled car, and the classical line.

    Args:
        policy: Shipped name or path; ValueError where it cannot drive the env.
        episodes: Episodes of each entry.
        env_id: Another env than the policy's own, with that id's options.
        scenario: Name instead of the env's own.
        seed: Seed of the first episode, the next ones count up; None: made from the weights.
    """
    loaded = load_policy(policy)
    card, home = loaded.card, env_id or loaded.card.env_id
    options = dict(card.env_options) if home == card.env_id else {}
    options |= {} if scenario is None else {"scenario": scenario}
    base: Any = gym.make(home, **options).unwrapped
    salt, seeds = loaded.salt, make_salted_seeds(loaded.salt, episodes)
    if seed is not None:
        salt, seeds = "", list(range(seed, seed + episodes))
    rivals = {f"{_CLASSICAL} on {FILTER}": Entry(_CLASSICAL, FILTER), "none": Entry("none")}
    if loaded.name in rivals:
        raise ValueError(f"the policy's file is called {loaded.name!r}, as what it is held against")
    entries = {loaded.name: Entry(policy, card.estimator)} | rivals
    task = ControlTask(env_id=home, scenario=base.scenario.name, changes=options)
    chunks = [Chunk(task, entry, tuple(seeds), keep=True) for entry in entries.values()]
    results = dict(zip(entries, run_cases(run_chunk, chunks, loaded.name, jobs=1), strict=True))
    errors = {name: outcome.error for name, outcome in results.items() if outcome.error}
    if failed := [name for name in (loaded.name, "none") if name in errors]:
        raise ValueError(f"{failed[0]} cannot drive {home}: {errors[failed[0]]}")
    drives = {name: outcome for name, outcome in results.items() if name not in errors}
    return PolicyEvaluation(loaded, salt, seeds, base.reference, task, entries, drives, errors)


def record_evaluation(path: Path, episodes: int = 256, kind: str = "") -> JsonMap:
    """Drive a policy's test seeds and write what it costs into its card.

    Args:
        path: File of the policy.
        episodes: Episodes of each entry, in the policy's own env and in each task.
        kind: Class of tasks that it drives too, beside their baselines; "" for none.
    """
    evaluation, names = evaluate_policy(str(path), episodes), ("mean", "low", "high")
    policy, costs = evaluation.policy, dict[str, JsonMap]()
    for name, drive in evaluation.drives.items():
        costs[name] = dict(zip(names, _round_estimate(interval(drive.costs), 6), strict=True))
    record: JsonMap = {"salt": evaluation.salt, "episodes": len(evaluation.seeds), "cost": costs}
    if kind:
        tasks, evaluate = _list_tasks(kind), partial(_evaluate_task, path, episodes=episodes)
        of_nominal = run_cases(evaluate, tasks, "tasks", jobs=1)
        scenarios = (task.scenario for task in tasks)
        record["cost in % of nominal"] = dict(zip(scenarios, of_nominal, strict=True))
    save_policy(path, policy.network, replace(policy.card, evaluation=record))
    return record


_RIVAL = "adaptive-nmpc"
_OUTPUTS = ("beta", "gamma", "phi", "phi_rate", "F_d", "N_d", "bias", "front_tyres", "rear_tyres",
           "inverse_friction")  # fmt: skip
_ESTIMATE_OPTIONS: JsonMap = {"outputs": list(_OUTPUTS), "std": True}
"""States that a student on `joint` reads, with standard deviations."""
VARIED = {"tyres": (0.4, 2.0), "wind": (-500.0, 500.0), "mass": (0.8, 1.3)}
VARIED |= {"camera": (0.01, 0.12), "out": (2.0, 6.0)}
"""Drawn in each episode: factors on each axle's tyres, side wind (N); once a lesson: a factor on
the true car's mass, how late its camera is (s), how long its GPS or its camera is out (s)."""
FILTERS = ("", JOINT)


def _list_tasks(kind: str) -> list[ControlTask]:
    """List the scored tasks of a class; ValueError for an unknown one."""
    tasks = list_scored_tasks()
    check_choice("class of tasks", kind, list(dict.fromkeys(task.kind for task in tasks)))
    return [task for task in tasks if task.kind == kind]


def _draw_scenarios(
    task: ControlTask, varied: int, rng: np.random.Generator
) -> Iterator[str | JsonMap]:
    """Draw the scenarios of a task's lessons: its own, then so many changed by `VARIED`."""
    yield task.scenario
    vehicle, full_mass = make_scenario(task.scenario).vehicle, VEHICLES[task.vehicle].mass
    for _ in range(varied):
        start, length = rng.uniform(0.0, 4.0), rng.uniform(*VARIED["out"])
        yield {
            "base": task.scenario,
            "front_stiffness": VARIED["tyres"],
            "rear_stiffness": VARIED["tyres"],
            "camera_delays": [round(rng.uniform(*VARIED["camera"]), 3)],  # whole ticks
            f"{rng.choice(('gps', 'camera'))}_outage": (start, start + length),
            "wind_force": VARIED["wind"],
            "wind_start": (0.0, 4.0),
            "wind_length": (1.0, 4.0),
            "vehicle": {**vehicle, "mass": float(rng.uniform(*VARIED["mass"])) * full_mass},
        }


@dataclass(frozen=True)
class Lessons:
    """Lessons of a class: a student's drives and inputs, its teacher; ValueError if unknown."""

    kind: str  # class of tasks
    estimator: str = ""  # that the student reads, one of `FILTERS`
    teacher: str = _RIVAL
    """Baseline, controller on the student's filter if it has one, or policy with its card's."""
    cars: int = 6  # of each task's lesson
    varied: int = 0
    """Further lessons of each task by `VARIED`, which share as many cars, rounded up; no filter and
    no teacher knows of the changes."""
    seed: int = 0  # of what is drawn for them
    observation_options: Mapping[str, Any] = field(default_factory=dict)  # what is observed

    def __post_init__(self) -> None:
        check_choice("estimator", self.estimator, FILTERS)
        for name in self.observation_options:
            check_choice("option", name, OBSERVATION_OPTIONS)

    def make_card(self, **rest: Any) -> Card:
        """Make the card of a policy for the class, in the first task's env.

        Args:
            **rest: Other fields of the card.
        """
        first = _list_tasks(self.kind)[0]
        options = _ESTIMATE_OPTIONS if self.estimator else {}
        env_options = first.env_options | dict(self.observation_options)
        return Card.from_env_id(first.env_id, env_options, self.estimator, options, **rest)

    def make_tasks(self) -> "list[DistillTask]":
        """Make a lesson for each task, and more of each in which the scenario varies."""
        from ...agents.training.distill import DistillTask

        rng, teacher, lessons = np.random.default_rng(self.seed), self.teacher, []
        entry = Entry(teacher, JOINT if teacher in ADAPTIVE else self.estimator or REFERENCE_FILTER)
        if is_policy(teacher):
            entry = Entry(teacher, load_policy(teacher).card.estimator)
        elif entry.is_oracle:
            entry = Entry(teacher)
        for task in _list_tasks(self.kind):
            for scenario in _draw_scenarios(task, self.varied, rng):
                count = self.cars if scenario == task.scenario else -(-self.cars // self.varied)
                changes: JsonMap = {"scenario": scenario, "lead_in": QUICK_LEAD_IN}
                twins, agent = entry.make(replace(task, changes=changes), count)
                options = task.env_options | changes | dict(self.observation_options)
                env: Any = gym.make_vec(task.env_id, num_envs=count, **options)
                if self.estimator:
                    env = EstimateObservation(env, self.estimator, **_ESTIMATE_OPTIONS)
                lessons.append(DistillTask(env, twins, agent))
        return lessons


def prepare_start(
    agent: Path | None, varied: int = 0
) -> "tuple[Path | Policy | None, Callable[..., TrainingTask]]":
    """Prepare the path or policy of `sideslip train -i`, and the maker of its `TrainingTask`.

    A zip's path stays what it is; a distilled policy goes on in all tasks of its class, but for
    those with a driver where cars are driven on tensors: rows are of one kind there.

    Args:
        agent: File of a policy or a zip, None for none.
        varied: How often tasks vary by `VARIED` and the training's seed; ValueError for no class.
    """
    from ...agents.training.config import TrainingTask, get_algorithm, make_finetune_task

    policy = load_policy(agent) if agent is not None and is_policy(str(agent)) else None
    kind = policy.card.algorithm_options.get("class") if policy else None
    if varied and kind is None:
        raise ValueError(f"--varied is for a policy of a class of tasks, got {agent}")
    if policy is None:
        return agent, TrainingTask

    def make_task(**fields: Any) -> TrainingTask:
        has_scenarios = "scenarios" in fields or "scenario" in fields.get("env_options", {})
        if has_scenarios and varied:
            raise ValueError("--varied is of a policy's own tasks: without other scenarios")
        if kind is not None and not has_scenarios:
            tasks, rng = _list_tasks(kind), np.random.default_rng([fields.get("seed", 0), 1])
            if get_algorithm(fields.get("algo", "ppo")).on_tensors:
                tasks = [c for c in tasks if make_scenario(c.scenario).steering != "driver"]
            fields["scenarios"] = [x for task in tasks for x in _draw_scenarios(task, varied, rng)]
        return make_finetune_task(policy, **fields)

    return policy, make_task


def _evaluate_task(path: Path, task: ControlTask, episodes: int) -> JsonMap:
    """Cost in % of nominal's and win rates, with intervals, and the fraction of failures."""
    policy = load_policy(path)
    seeds = tuple(make_salted_seeds(policy.salt, episodes, task.seed_text))
    entries = {"policy": Entry(str(path), policy.card.estimator), NOMINAL: Entry(NOMINAL)}
    entries |= {_RIVAL: Entry(_RIVAL, JOINT), PARAMETERS: Entry(PARAMETERS)}
    results = {name: run_chunk(Chunk(task, entry, seeds)) for name, entry in entries.items()}
    for name, result in results.items():
        if result.error:
            raise ValueError(f"{name} cannot drive {task.name}: {result.error}")
    nominal, policy_costs, shown = results[NOMINAL].costs, results["policy"].costs, JsonMap()
    for name in ("policy", _RIVAL, PARAMETERS):
        ratio = geometric_mean(-compute_log_ratios(nominal, results[name]))
        shown[name] = _round_estimate(ratio.rescale(100.0))
    for name in (NOMINAL, _RIVAL):
        rate = compute_win_rate(policy_costs, results[name].costs)
        shown[f"better than {name}"] = _round_estimate(rate)
    return shown | {"fails": float((results["policy"]["failure"] != 0.0).mean())}


def _round_estimate(numbers: Estimate, digits: int = 3) -> Sequence[float]:
    return [round(number, digits) for number in numbers]
