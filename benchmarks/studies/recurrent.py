"""The suite `memory`: how much more each kind of recurrent network costs than the optimum.

`sideslip/LinearYawVision-v0` with a picture every 40 ms, late or lost. All learn from the optimal
filter's actions with as many steps; PPO learns from rewards. The gap is what a policy costs over
the optimum, less one, from its actions' errors (`Optimum.excess`), which scatters little.
"""

import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from ...agents.optimum import Lqg, Optimum, compute_optimum, wrap_optimal_estimate
from ...envs.numerics.kernel_cache import hash_experiment
from ...envs.record import Array
from ..harness.results import Column, Line, ResultTable, Suite
from ..harness.stats import Estimate, interval
from ..harness.verdict import format_percent, format_verdict
from ..report.study import CaseStorage, Request, Study

ID = "sideslip/LinearYawVision-v0"
PERIOD, _STEP = 0.04, 0.01  # s, of pictures and of control
CONDITIONS: Mapping[str, Mapping[str, Any]] = {
    "100 ms": {"delays": [0.1]},
    "300 ms": {"delays": [0.3]},
    "0 ms": {"delays": [0.0]},
    "100 ms, half lost": {"delays": [0.1], "loss": 0.5},
    "300 ms, half lost": {"delays": [0.3], "loss": 0.5},
}
"""How late pictures are, and which share never comes."""
REPEATED, SEEDS = "100 ms", 3
"""The condition in which everybody trains on so many seeds; elsewhere on one."""
_SCHEDULES = 8  # whose arrivals the optimum is averaged over, where pictures are lost
FILTER, PPO, LQG_FACTOR = "lqg", "ppo", 8
"""The optimum's own policy, as a check, on so many times the episodes; learning from rewards."""
_EPISODES = 64, 16  # of a usual and of a quick run


@dataclass(frozen=True)
class Budget:
    """The budget of a training."""

    cars: int = 64  # cars side by side
    rounds: int = 3  # rounds of driving and learning
    epochs: int = 1  # passes over all drives in a round
    ppo: int = 500_000  # steps of PPO, 0 for none
    duration: float = 10.0  # duration of an episode (s)


QUICK = Budget(cars=32, rounds=2, epochs=1, ppo=0, duration=3.0)


@dataclass(frozen=True)
class MemoryCase:
    """A learner in a condition, its training's seed and budget, and the episodes that judge it."""

    learner: str
    condition: str
    seed: int
    budget: Budget
    episodes: int

    @property
    def options(self) -> dict[str, Any]:
        """Options of the env."""
        spec = gym.spec(ID).kwargs
        camera = {"period": PERIOD} | dict(CONDITIONS[self.condition])
        return {"camera": camera, "scenario": spec["scenario"] | {"duration": self.budget.duration}}

    @property
    def delay_steps(self) -> int:
        """Age of a picture when it arrives (control steps)."""
        return round(float(CONDITIONS[self.condition]["delays"][0]) / _STEP)

    @property
    def best(self) -> Optimum:
        """The optimum."""
        return _compute_best(self.condition, self.budget)


@cache
def _compute_best(condition: str, budget: Budget) -> Optimum:
    options = MemoryCase("", condition, 0, budget, 1).options
    n = _SCHEDULES if "loss" in options["camera"] else 1
    return compute_optimum(gym.make(ID, **options), n)


def _make_cases(quick: bool, episodes: int = 1) -> list[MemoryCase]:
    """Make the cases of a run, the repeated seeds last."""
    from ...agents.training.recurrent import MEMORIES

    budget, conditions = (QUICK, (REPEATED,)) if quick else (Budget(), tuple(CONDITIONS))
    pairs = product(conditions, (FILTER, *MEMORIES))
    cases = [MemoryCase(name, condition, 0, budget, episodes) for condition, name in pairs]
    if not quick:
        cases.append(MemoryCase(PPO, REPEATED, 0, budget, episodes))
        memories = [case for case in cases if case.learner in MEMORIES]
        repeated = [case for case in memories if case.condition == REPEATED]
        cases += [replace(item, seed=seed) for seed in range(1, SEEDS) for item in repeated]
    return cases


_FIRST_SEED = 2**30
_NOISE = 0.3  # of what shakes the teacher in the first round


class MemoryResult(NamedTuple):
    """Costs by the actions' errors and in all, (n,); the optimum; the training's CPU-s, steps."""

    excess: Array
    costs: Array
    best: Array
    seconds: Array
    steps: Array

    def gap(self) -> Estimate:
        """Compute the gap from the actions' errors."""
        return interval(self.excess / self.best)


def _evaluate_agent(
    cars: Any, twins: Any, agent: Any, best: Optimum, seed: int
) -> tuple[Array, Array]:
    """Excess and costs of an agent's episodes, (N,) each; twins: the cars with the optimum."""
    seeds = range(seed, seed + twins.num_envs)
    names = [entry.name for entry in twins.layout]
    columns = [names.index(name) for name in Lqg.needs]
    obs, _ = cars.reset(seed=list(seeds))
    twin_obs, _ = twins.reset(seed=list(seeds))
    state, read, actions, costs = None, [], [], np.zeros(len(seeds))
    for _ in range(best.plant.steps):
        action, state = agent.predict(obs, state)
        read.append(twin_obs[:, columns].astype(np.float64))
        actions.append(action[:, 0].astype(np.float64))
        twin_obs, rewards, *_ = twins.step(action)
        obs = twin_obs if cars is twins else cars.step(action)[0]
        costs -= rewards
    return best.excess(np.stack(read, 1), np.stack(actions, 1)), costs


def _run_case(case: MemoryCase) -> MemoryResult:
    """Train and judge a case."""
    best, start_time = case.best, time.process_time()
    count = case.episodes * (LQG_FACTOR if case.learner == FILTER else 1)
    twins = wrap_optimal_estimate(_make_cars(case, count))
    if case.learner == FILTER:
        cars, agent, steps = twins, Lqg(twins), 0
    elif case.learner == PPO:
        cars = _make_cars(case, count)
        agent, steps = _train_ppo(case, cars), case.budget.ppo
    else:
        agent, steps = _train_memory(case)
        from ...agents.training.recurrent import CompactObservation

        cars = CompactObservation(_make_cars(case, count))
    seconds = time.process_time() - start_time if steps else 0.0
    outcome = _evaluate_agent(cars, twins, agent, best, _FIRST_SEED)
    return MemoryResult(*outcome, *(np.array(value) for value in (best.cost, seconds, steps)))


def _make_cars(case: MemoryCase, count: int) -> Any:
    return gym.make_vec(ID, count, **case.options)


def _train_memory(case: MemoryCase) -> tuple[Any, int]:
    """A memory that acts, and the steps that it saw."""
    from ...agents.training.distill import DistillTask
    from ...agents.training.recurrent import MEMORIES, CompactObservation, train_memory
    from ...agents.training.student import DistillConfig

    budget = case.budget
    twins = wrap_optimal_estimate(_make_cars(case, budget.cars))
    task = DistillTask(CompactObservation(_make_cars(case, budget.cars)), twins, Lqg(twins))
    rate, rounds, epochs = MEMORIES[case.learner].rate, budget.rounds, budget.epochs
    config = DistillConfig(
        rounds=rounds, epochs=epochs, learning_rate=rate, noise=_NOISE, seed=case.seed
    )
    weight, steps = float(case.best.weights[0]), list[int]()
    arguments = (case.learner, task, config, case.delay_steps, weight)
    agent = train_memory(*arguments, lambda round_result: steps.append(round_result.steps))
    return agent, steps[-1]


def _train_ppo(case: MemoryCase, cars: Any) -> Any:
    """PPO's policy, which sees the last observation alone, and the whole of it."""
    from ...agents.learned.policy import PolicyController, load_policy
    from ...agents.training.callbacks import POLICY
    from ...agents.training.config import TrainingTask
    from ...agents.training.trainer import Trainer

    task = TrainingTask(ID, env_options=case.options, seed=case.seed)
    with tempfile.TemporaryDirectory() as folder:
        Trainer(task, case.budget.ppo, folder).train()
        return PolicyController(cars, load_policy(Path(folder) / POLICY))


def _describe_case(case: MemoryCase) -> str:
    sources = Path(__file__).read_text()  # beside agents and case, all that numbers depend on
    return hash_experiment() + sources + json.dumps(asdict(case) | case.options)


_STORAGE = CaseStorage[MemoryCase, MemoryResult](
    _describe_case, MemoryResult._asdict, lambda _, arrays: MemoryResult(**arrays)
)
Results = Mapping[str, Mapping[str, Sequence[MemoryResult]]]
"""Results of each training seed, by learner and condition."""


def _measure(request: Request) -> Results:
    """Train and judge all in every condition; quick: in one, little, and without PPO."""
    cases = _make_cases(request.quick, request.episodes or 1)
    outcomes = request.run_cases(_run_case, cases, "memory", _STORAGE)
    results: dict[str, dict[str, list[MemoryResult]]] = {}
    for case, outcome in zip(cases, outcomes, strict=True):
        results.setdefault(case.learner, {}).setdefault(case.condition, []).append(outcome)
    return results


def _average_seeds(runs: Sequence[MemoryResult]) -> MemoryResult:
    """The mean over training seeds, episode by episode."""
    return MemoryResult(*(np.mean(arrays, axis=0) for arrays in zip(*runs, strict=True)))


def _make_verdict(results: Results) -> str:
    """Compose the verdict."""
    gaps, mean = dict[str, dict[str, Estimate]](), dict[str, float]()
    for learner in (name for name in results if name not in (FILTER, PPO)):
        runs = results[learner].items()
        gaps[learner] = {condition: _average_seeds(item).gap() for condition, item in runs}
        mean[learner] = float(np.mean([item.value for item in gaps[learner].values()]))
    first, *others = sorted(mean, key=lambda learner: mean[learner])
    rest = ", ".join(f"{learner} {100.0 * mean[learner]:.0f} %" for learner in others)
    hardest = max(gaps[first], key=lambda condition: gaps[first][condition].value)
    optima = list(results[FILTER].items())[:2]
    checks = [f"{name} {format_percent(_compute_lqg_gap(item[0]))}" for name, item in optima]
    rewards = ""
    if PPO in results:
        gap = format_percent(_average_seeds(results[PPO][REPEATED]).gap())
        rewards = f"By rewards alone ppo, without memory: {gap} at {REPEATED}."
    return format_verdict(
        f"Over the optimum: {first} {100.0 * mean[first]:.0f} %, {rest}.",
        f"Means of {len(gaps[first])} conditions; {first} is furthest from it at {hardest}: "
        f"{format_percent(gaps[first][hardest])}.",
        rewards,
        f"Check, the optimal policy's own costs over it: {'; '.join(checks)}.",
        "Not covered: longer training, larger networks, other sensors and cars.",
    )


def _compute_lqg_gap(result: MemoryResult) -> Estimate:
    """Costs of the optimum's own policy over the computed optimum, less one."""
    return interval(result.costs / result.best - 1.0)


def _compute_paired_gap(result: MemoryResult, reference: MemoryResult) -> Estimate:
    """Compute the gap from the costs, beside the optimum's own policy's on the same seeds."""
    return interval((result.costs - reference.costs[: len(result.costs)]) / result.best)


def _add_tables(suite: Suite, results: Results) -> None:
    """Add rows and the tables of gaps and of trainings."""
    reference = {condition: runs[0] for condition, runs in results[FILTER].items()}
    gaps, trainings = list[Line](), list[list[object]]()
    for learner, learner_runs in results.items():
        numbers = {
            name: _compute_lqg_gap(runs[0]) if learner == FILTER else _average_seeds(runs).gap()
            for name, runs in learner_runs.items()
        }
        gaps.append({"memory": learner} | numbers)
        for condition, number in numbers.items():
            n = len(learner_runs[condition][0].costs)
            suite.add_rows([{"gap": number}], ID, scenario=condition, controller=learner, n=n)
        if learner != FILTER:
            runs = learner_runs[REPEATED]
            plain = _compute_paired_gap(_average_seeds(runs), reference[REPEATED])
            spent = np.mean([run.seconds for item in learner_runs.values() for run in item])
            seeds, steps = tuple(result.gap().value for result in runs), float(runs[0].steps)
            trainings.append([learner, seeds, plain, steps, float(spent)])
    n = len(reference[REPEATED].costs) // LQG_FACTOR
    optima = ", ".join(f"{name} {1e3 * run.best:.1f}" for name, run in reference.items())
    note = (
        f"Percent over the optimum, with 95 % intervals over {n} episodes, the same for all; "
        f"{FILTER}: the optimal policy's plain costs on {n * LQG_FACTOR}. "
        f"The optimum in 10^-3: {optima}."
    )
    columns = ("memory", *(Column(name, scale=100.0, form=".1f") for name in reference))
    suite.tables.append(ResultTable("Cost over the optimum", columns, gaps, note))
    percents = (
        Column(f"{x} / %", scale=100.0, form=".1f") for x in ("gaps of seeds", "plain costs")
    )
    title, text = f"Trainings, at {REPEATED}", "CPU-s: mean of all conditions. "
    text += "plain costs: over lqg's."
    columns = ("memory", *percents, Column("steps", form=".0f"), Column("CPU-s", form=".0f"))
    suite.tables.append(ResultTable(title, columns, trainings, text))


def _add_figures(suite: Suite, results: Results, draw: ModuleType) -> None:
    """Add the gap over the delay; nothing where there is one delay only."""
    late = {name: camera for name, camera in CONDITIONS.items() if "loss" not in camera}
    measured = [(1e3 * late[name]["delays"][0], name) for name in late if name in results[FILTER]]
    delays = dict(sorted(measured))
    if len(delays) < 2:
        return
    series = {}
    for learner in results:
        if set(delays.values()) <= set(results[learner]) and learner != FILTER:
            gaps = [_average_seeds(results[learner][name]).gap() for name in delays.values()]
            series[learner] = tuple(100.0 * np.array(gaps).T)
    labels = ("delay of the pictures / ms", "cost over the optimum / %")
    figure = draw.draw_curves(np.array(list(delays)), series, *labels, log="y")
    question = "How much of the optimum does each memory find?"
    suite.answers.append((question, figure, suite.verdict.splitlines()[0]))


STUDY = Study(
    "memory",
    "Memory where the optimum is known",
    "A linear car of known tyres whose sideslip angle a yaw moment keeps small, pictures every "
    "40 ms: the best policy and its cost are computed. Each kind of memory imitates the optimal "
    "filter's actions where it drives itself (DAgger), all with the same drives and passes; what "
    "is left is the price of what it does not remember, or has not learned. Gap: cost over the "
    "optimum, less one. An error of an action costs S (u - u*)^2, so the gap is their sum; beside "
    "it stands the plain difference of the costs to the optimal policy on the same seeds.",
    _EPISODES,
    _measure,
    _add_tables,
    _make_verdict,
    _add_figures,
    ("torch", 'Not trained: it needs torch, pip install "sideslip[train]".'),
)
