"""Question: what does a learned policy cost, against no control and the best classical line?

All drive the same seeds in the env that the policy was trained on, which are made from its weights:
nobody can have trained on them.

What `sideslip distill` learns from, the contests of a class with their teacher, what goes on
from it, and what came of it in each of them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from ... import __version__
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
from ..harness.results import ResultRow, ResultTable, Suite
from ..harness.stats import Estimate, compute_win_rate, geometric_mean, interval
from ..harness.study import format_percent, format_verdict

if TYPE_CHECKING:
    from ...agents.training.config import TrainingTask
    from ...agents.training.distill import DistillTask

CLASSICAL, FILTER = "lqr", "exact-kf"


@dataclass
class PolicyEvaluation:
    """The contestants' episodes on the same seeds: the policy's first.

    salt: of the seeds, "" where the caller chose them. reference: of the env. driven: by
    contestant. left_out: why a contestant is not among them.
    """

    policy: Policy
    salt: str
    seeds: list[int]
    reference: str
    entries: dict[str, ControlEntry]
    drives: dict[str, DriveResult]
    left_out: dict[str, str]

    def costs(self, name: str) -> Array:
        """(seeds,) of a contestant."""
        return self.drives[name].costs


def evaluate_policy(
    policy: str,
    episodes: int = 256,
    *,
    env_id: str | None = None,
    scenario: str | None = None,
    seed: int | None = None,
) -> PolicyEvaluation:
    """Drive a policy, the uncontrolled car, and the classical line.

    policy: a shipped name or a path. env_id: another env than the policy's own, with that id's
    options. scenario: a name, instead of the env's own. seed: of the first episode, the next ones
    count up; default: seeds made from the weights.

    Raises ValueError where the policy cannot drive the env, and what `load_policy` raises.
    """
    loaded = load_policy(policy)
    home, shown, reference, options = _describe_task(loaded, env_id, scenario)
    salt = loaded.salt if seed is None else ""
    seeds = (
        make_salted_seeds(salt, episodes) if seed is None else list(range(seed, seed + episodes))
    )
    rivals = {f"{CLASSICAL} on {FILTER}": (FILTER, CLASSICAL), "none": ("", "none")}
    if loaded.name in rivals:
        raise ValueError(f"the policy's file is called {loaded.name!r}, as what it is held against")
    contestants = {loaded.name: (loaded.card.estimator, policy)} | rivals
    entries = {
        name: ControlEntry(ControlTask(env_id=home, scenario=shown), estimator, controller, options)
        for name, (estimator, controller) in contestants.items()
    }
    chunks = [Chunk(entry, tuple(seeds), keep=True) for entry in entries.values()]
    results = dict(zip(entries, run_cases(run_chunk, chunks, loaded.name, jobs=1), strict=True))
    errors = {name: outcome.error for name, outcome in results.items() if outcome.error}
    for needed in (loaded.name, "none"):
        if needed in errors:
            raise ValueError(f"{needed} cannot drive {home}: {errors[needed]}")
    drives = {name: outcome for name, outcome in results.items() if name not in errors}
    return PolicyEvaluation(loaded, salt, seeds, reference, entries, drives, errors)


def _describe_task(
    policy: Policy, env_id: str | None, scenario: str | None
) -> tuple[str, str, str, JsonMap]:
    """(env's id, what its scenario is called, its reference, its options)."""
    card = policy.card
    options = dict(card.env_options) if env_id in (None, card.env_id) else {}
    if scenario is not None:
        options["scenario"] = scenario
    home = env_id or card.env_id
    base: Any = gym.make(home, **options).unwrapped
    return home, base.scenario.name, base.reference, options


def summarise_evaluation(result: PolicyEvaluation) -> dict[str, Any]:
    """For a card: the seeds' salt, and each contestant's mean cost with its 95 % interval."""
    costs = {}
    for name in result.drives:
        mean, low, high = (round(number, 6) for number in interval(result.costs(name)))
        costs[name] = {"mean": mean, "low": low, "high": high}
    return {"salt": result.salt, "episodes": len(result.seeds), "cost": costs}


def record_evaluation(path: str | Path, episodes: int = 256) -> PolicyEvaluation:
    """Drive a policy's test seeds in its own env and write what it costs into its card."""
    result = evaluate_policy(str(path), episodes)
    policy = result.policy
    save_policy(path, policy.network, replace(policy.card, evaluation=summarise_evaluation(result)))
    return result


def make_suite(result: PolicyEvaluation) -> Suite:
    """Table and rows; the first episode over time and in motion."""
    name, card = result.policy.name, result.policy.card
    entry = result.entries[name]
    text = (
        f"{len(result.seeds)} episodes of {entry.task.scenario}, the same seeds for all. "
        f"{name} was trained by {card.algorithm or 'an unnamed algorithm'} on {card.steps} "
        f"steps of {card.env_id} (reference: {card.reference}) in {card.cpu_seconds:.0f} CPU-s."
    )
    reference = result.reference
    if reference != card.reference:
        text += f" Here it is judged by another reference, {reference}: by another cost."
    suite = Suite(
        "enjoy", f"{name} on {entry.task.env_id}", text, _make_rows(result), [_make_table(result)]
    )
    from ..control.report import make_time_explorer

    series: dict[tuple[str, ...], Array] = {
        (label,): outcome.series
        for label, outcome in result.drives.items()
        if outcome.series is not None
    }
    suite.explorers.append(make_time_explorer("The first seed, side by side", (), series, name))
    suite.verdict = _compose_verdict(result)
    return suite


def _compose_verdict(result: PolicyEvaluation) -> str:
    """What the policy costs over each of the others, and how often it fails."""
    name, others = (
        result.policy.name,
        [label for label in result.drives if label != result.policy.name],
    )
    fails = 100.0 * np.mean(result.drives[name]["failure"] != 0.0)
    lines = []
    for other in others:
        logs = np.log(compute_cost_ratios(result.costs(name), result.costs(other)))
        lines.append(
            f"{name} costs {format_percent(geometric_mean(logs))} of {other}, seed by seed."
        )
    limits = f"Not said: other cars, scenarios and seeds than these {len(result.seeds)}."
    return format_verdict(*lines, f"It fails in {fails:.0f} % of the episodes. {limits}")


def _make_table(result: PolicyEvaluation) -> ResultTable:
    first = result.policy.name
    costs, cells = result.costs(first), []
    for name, outcome in result.drives.items():
        rival = name != first
        ratio = (
            format_percent(geometric_mean(np.log(compute_cost_ratios(costs, outcome.costs))))
            if rival
            else ""
        )
        cells.append(
            [
                name,
                ratio,
                f"{100.0 * compute_win_rate(costs, outcome.costs).value:.0f} %" if rival else "",
                f"{1e3 * outcome['rms_slip'].mean():.2f}",
                f"{outcome['largest_step'].mean():.0f}",
                f"{100.0 * np.mean(outcome['failure'] != 0.0):.1f} %",
            ]
        )
    header = (f"{first} costs, of it", "better", "RMS slip", "step", "fails")
    note = (
        f"{first}'s cost over each other's: paired geometric means with 95 % intervals. "
        f"better: share of the seeds on which {first} costs less. Slip in mrad. step: "
        "the largest between two decisions, in N m."
    )
    left_out = [f"{name} was not driven: {error}." for name, error in result.left_out.items()]
    return ResultTable("What it costs", ("controller", *header), cells, " ".join([note, *left_out]))


def _make_rows(result: PolicyEvaluation) -> list[ResultRow]:
    rows = []
    for name, outcome in result.drives.items():
        entry, is_policy = result.entries[name], name == result.policy.name
        labels = {
            "estimator": entry.estimator,
            "controller": name if is_policy else entry.controller,
        }
        seeds: dict[str, Any] = {
            "n": len(result.seeds),
            "salt": result.salt,
            "spec": make_spec(entry),
        }
        common = {"suite": "enjoy", "env_version": f"{entry.task.env_id} {__version__}"}
        for metric in ("cost", "rms_slip", "peak_slip", "effort", "largest_step"):
            columns = {"scenario": entry.task.scenario, **common, **labels, **seeds}
            rows.append(ResultRow.from_estimate(metric, interval(outcome[metric]), **columns))
    return rows


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
    from ...agents.training.distill import DistillTask

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
