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

from ...agents.optimum import Lqg, Optimum, estimated
from ...envs.backend.cache import experiment_stamp
from ...envs.backend.files import whole
from ...envs.record import Array
from ..harness.stats import Estimate, interval
from .cases import ALONE, FILTER, ID, PPO, Case

FIRST_SEED = 2**30
NOISE = 0.3  # of what shakes the teacher in the first round
OURS = ("measure", "cases")  # with the agents and the case all that its numbers depend on
_LETTERS = 24  # of a kept case's name


class Found(NamedTuple):
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

    def plain(self, alone: "Found") -> Estimate:
        """From the costs, against the optimum's own policy on the same seeds."""
        return interval((self.costs - alone.costs[: len(self.costs)]) / self.best)


def judged(cars: Any, twins: Any, agent: Any, best: Optimum, seed: int) -> tuple[Array, Array]:
    """(excess, costs), (N,) each, of an agent's episodes; twins: the same cars, `estimated`."""
    seeds = range(seed, seed + twins.num_envs)
    names = [entry.name for entry in twins.layout]
    columns = [names.index(name) for name in Lqg.needs]
    obs, _ = cars.reset(seed=list(seeds))
    seen, _ = twins.reset(seed=list(seeds))
    state, read, actions, costs = None, [], [], np.zeros(len(seeds))
    for _ in range(best.plant.steps):
        action, state = agent.predict(obs, state)
        read.append(seen[:, columns].astype(np.float64))
        actions.append(action[:, 0].astype(np.float64))
        seen, rewards, *_ = twins.step(action)
        obs = seen if cars is twins else cars.step(action)[0]
        costs -= rewards
    return best.excess(np.stack(read, 1), np.stack(actions, 1)), costs


def measured(case: Case) -> Found:
    """Train and judge."""
    best, begun = case.best, time.process_time()
    count = case.episodes * (ALONE if case.who == FILTER else 1)
    twins = estimated(_cars(case, count))
    if case.who == FILTER:
        cars, agent, steps = twins, Lqg(twins), 0
    elif case.who == PPO:
        cars = _cars(case, count)
        agent, steps = _rewarded(case, cars), case.budget.ppo
    else:
        agent, steps = _imitated(case)
        from ...agents.training.memory.inputs import Prepared

        cars = Prepared(_cars(case, count))
    seconds = time.process_time() - begun if steps else 0.0
    found = judged(cars, twins, agent, best, FIRST_SEED)
    return Found(*found, *(np.array(each) for each in (best.cost, seconds, steps)))


def _cars(case: Case, count: int) -> Any:
    return gym.make_vec(ID, count, **case.options)


def _imitated(case: Case) -> tuple[Any, int]:
    """(a memory that acts, steps that it saw)."""
    from ...agents.training.distill import Lesson
    from ...agents.training.memory.imitation import imitated
    from ...agents.training.memory.inputs import Prepared
    from ...agents.training.memory.networks import MEMORIES
    from ...agents.training.student import Course

    budget = case.budget
    twins = estimated(_cars(case, budget.cars))
    lesson = Lesson(Prepared(_cars(case, budget.cars)), twins, Lqg(twins))
    course = Course(
        rounds=budget.rounds,
        epochs=budget.epochs,
        learning_rate=MEMORIES[case.who].rate,
        noise=NOISE,
        seed=case.seed,
    )
    weight, steps = float(case.best.weights[0]), list[int]()
    agent = imitated(
        case.who, lesson, course, case.late, weight, lambda each: steps.append(each.steps)
    )
    return agent, steps[-1]


def _rewarded(case: Case, cars: Any) -> Any:
    """PPO's policy, which sees the last observation alone, and the whole of it."""
    from ...agents.learned.files import load_policy
    from ...agents.learned.policy import Learned
    from ...agents.training.train import POLICY, Task, train

    task = Task(ID, env_options=case.options, seed=case.seed)
    with tempfile.TemporaryDirectory() as folder:
        train(task, case.budget.ppo, folder)
        return Learned(cars, load_policy(Path(folder) / POLICY))


@dataclass(frozen=True)
class Kept:
    """`measured` that looks in a folder first and leaves its result there; None keeps nothing."""

    folder: Path | None

    def __call__(self, case: Case) -> Found:
        """The case's result."""
        if self.folder is None:
            return measured(case)
        ours = "".join((Path(__file__).parent / f"{name}.py").read_text() for name in OURS)
        text = experiment_stamp() + ours + json.dumps(asdict(case) | case.options)
        path = self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:_LETTERS]}.npz"
        with contextlib.suppress(Exception), np.load(path, allow_pickle=False) as there:
            return Found(*(there[name] for name in Found._fields))  # damaged: measured anew
        found = measured(case)
        with contextlib.suppress(OSError):  # a full disk loses the file, not the run
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole(path) as file:
                np.savez_compressed(file, **found._asdict())
        return found
