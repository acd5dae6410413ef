"""A case: a memory is trained and judged by the optimum; finished ones stay in a folder."""

import contextlib
import hashlib
import json
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from ...agents.optimum import Lqg, Optimum, wrap_optimal_estimate
from ...envs.backend.cache import hash_experiment
from ...envs.backend.files import atomic_file
from ...envs.record import Array
from ..harness.stats import Estimate, interval
from .cases import FILTER, ID, LQG_FACTOR, PPO, MemoryCase

FIRST_SEED = 2**30
NOISE = 0.3  # of what shakes the teacher in the first round
SOURCE_MODULES = ("measure", "cases")  # with the agents and the case all that its numbers depend on
_LETTERS = 24  # of a kept case's name


class MemoryResult(NamedTuple):
    """Of each episode what the actions' errors cost and what all cost (n,); the optimum;
    CPU-seconds and steps of the training."""

    excess: Array
    costs: Array
    best: Array
    seconds: Array
    steps: Array

    def gap(self) -> Estimate:
        """From the actions' errors."""
        return interval(self.excess / self.best)

    def compute_paired_gap(self, reference: "MemoryResult") -> Estimate:
        """From the costs, against the optimum's own policy on the same seeds."""
        return interval((self.costs - reference.costs[: len(self.costs)]) / self.best)


def evaluate_agent(
    cars: Any, twins: Any, agent: Any, best: Optimum, seed: int
) -> tuple[Array, Array]:
    """(excess, costs), (N,) each, of an agent's episodes; twins: the same cars,
    `wrap_optimal_estimate`."""
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


def run_case(case: MemoryCase) -> MemoryResult:
    """Train and judge."""
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
        from ...agents.training.memory.inputs import CompactObservation

        cars = CompactObservation(_make_cars(case, count))
    seconds = time.process_time() - start_time if steps else 0.0
    outcome = evaluate_agent(cars, twins, agent, best, FIRST_SEED)
    return MemoryResult(*outcome, *(np.array(value) for value in (best.cost, seconds, steps)))


def _make_cars(case: MemoryCase, count: int) -> Any:
    return gym.make_vec(ID, count, **case.options)


def _train_memory(case: MemoryCase) -> tuple[Any, int]:
    """(a memory that acts, steps that it saw)."""
    from ...agents.training.distill import DistillTask
    from ...agents.training.memory.imitation import train_memory
    from ...agents.training.memory.inputs import CompactObservation
    from ...agents.training.memory.networks import MEMORIES
    from ...agents.training.student import DistillConfig

    budget = case.budget
    twins = wrap_optimal_estimate(_make_cars(case, budget.cars))
    task = DistillTask(CompactObservation(_make_cars(case, budget.cars)), twins, Lqg(twins))
    config = DistillConfig(
        rounds=budget.rounds,
        epochs=budget.epochs,
        learning_rate=MEMORIES[case.learner].rate,
        noise=NOISE,
        seed=case.seed,
    )
    weight, steps = float(case.best.weights[0]), list[int]()
    agent = train_memory(
        case.learner,
        task,
        config,
        case.delay_steps,
        weight,
        lambda round_result: steps.append(round_result.steps),
    )
    return agent, steps[-1]


def _train_ppo(case: MemoryCase, cars: Any) -> Any:
    """PPO's policy, which sees the last observation alone, and the whole of it."""
    from ...agents.learned.files import load_policy
    from ...agents.learned.policy import PolicyController
    from ...agents.training.train import POLICY, TrainingTask, train

    task = TrainingTask(ID, env_options=case.options, seed=case.seed)
    with tempfile.TemporaryDirectory() as folder:
        train(task, case.budget.ppo, folder)
        return PolicyController(cars, load_policy(Path(folder) / POLICY))


@dataclass(frozen=True)
class CaseCache:
    """`measured` that looks in a folder first and leaves its result there; None keeps nothing."""

    folder: Path | None

    def __call__(self, case: MemoryCase) -> MemoryResult:
        """The case's result."""
        if self.folder is None:
            return run_case(case)
        sources = "".join(
            (Path(__file__).parent / f"{name}.py").read_text() for name in SOURCE_MODULES
        )
        text = hash_experiment() + sources + json.dumps(asdict(case) | case.options)
        path = self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:_LETTERS]}.npz"
        with contextlib.suppress(Exception), np.load(path, allow_pickle=False) as saved:
            return MemoryResult(
                *(saved[name] for name in MemoryResult._fields)
            )  # damaged: measured anew
        result = run_case(case)
        with contextlib.suppress(OSError):  # a full disk loses the file, not the run
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(path) as file:
                np.savez_compressed(file, **result._asdict())
        return result
