"""A memory learns to imitate a teacher with a filter.

In a linear scenario an action costs S_j (u - u*)^2 more than the optimum, with u* the action of
the optimal filter's estimate. So imitation on the student's own drives minimises its cost, and the
student needs memory, not exploration.
"""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from ....envs.record import Array
from ..distill import (
    DISTILL_SEEDS,
    SEEDS_PER_TRAINING,
    DistillTask,
    RoundResult,
    collect_demonstrations,
)
from ..student import LAST_ROUND_FACTOR, DistillConfig, fit_model
from ..traces.drives import Demonstrations, Scaling, Single, compute_scaling, normalise_inputs
from .networks import MemoryNetwork, make_memory

import torch  # isort: skip  # after ours, which say which extra is missing


class MemoryAgent:
    """A memory as an agent: stable-baselines3's `predict` on plain observations.

    Args:
        model: Network with memory.
        mean: Means of the observation, shape (k,).
        scale: Factors of the observation, shape (k,).
    """

    def __init__(self, model: MemoryNetwork, mean: Array, scale: Array) -> None:
        self.model, self.mean, self.scale = model, mean, scale

    def predict(
        self,
        observation: Single,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Single, Any]:
        """Compute actions (N, 1) and the next state.

        Args:
            observation: Observations, shape (N, k).
            state: State from the last call; None at the start.
            episode_start: Rows whose state is cleared, shape (N,).
            deterministic: Without effect.

        Returns:
            Actions within [-1, 1], shape (N, 1), and the next state.
        """
        z = torch.from_numpy(normalise_inputs(observation, self.mean, self.scale))[:, None]
        if state is not None and episode_start is not None and np.any(episode_start):
            state = state.clone()
            state[torch.from_numpy(np.asarray(episode_start))] = 0.0
        with torch.no_grad():
            actions, state = self.model(z, state)
        return actions[:, 0].clamp(-1.0, 1.0).numpy(), state


def train_memory(
    name: str,
    task: DistillTask,
    config: DistillConfig,
    delay_steps: int,
    weight: float = 1.0,
    report: Callable[[RoundResult], None] = lambda _: None,
) -> MemoryAgent:
    """Train a memory to act as a task's teacher, by DAgger.

    Args:
        name: Key of `MEMORIES`.
        task: Cars and teacher.
        config: Configuration, of which `cells` and `hidden` have no effect.
        delay_steps: Control periods between a packet's capture and its arrival.
        weight: S, the cost of a squared error.
        report: Function that is called after each round.

    Returns:
        Agent of the last round.

    Raises:
        ValueError: The name is unknown, or the observation does not say whether a packet arrived.
        FloatingPointError: The training diverges; the message has the step.
    """
    cars = task.cars
    names = [entry.name for entry in cars.layout]
    fresh_columns = [i for i, label in enumerate(names) if label.endswith("_fresh")]
    if len(fresh_columns) != 1:
        raise ValueError(
            f"a memory knows one sensor with packets, got {len(fresh_columns)} in {names}"
        )
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    model = make_memory(name, len(names), fresh_columns[0], delay_steps)
    seeds = itertools.count(DISTILL_SEEDS + config.seed * SEEDS_PER_TRAINING, cars.num_envs)
    drives: list[Demonstrations] = []
    agent, steps = None, 0
    scaling: Scaling | None = None
    for i in range(config.rounds):
        first = next(seeds)
        demo = collect_demonstrations(
            task, agent, range(first, first + cars.num_envs), config.noise
        )
        drives.append(demo._replace(curvature=np.full((1, 1), weight, np.float32)))
        steps += int((demo.weights > 0.0).sum())
        if scaling is None:
            mean, scale, _ = compute_scaling(
                drives, cars.layout, task.teacher.needs, usual_ages=False
            )
            scaling = Scaling(mean, scale, np.eye(len(mean)))  # memories mix by themselves
            model.fit_whitening(drives, mean, scale)
        last = i == config.rounds - 1
        loss = fit_model(
            model, drives, scaling, config, config.epochs * (LAST_ROUND_FACTOR if last else 1)
        )
        agent = MemoryAgent(model, scaling.mean, scaling.scale)
        report(RoundResult(steps, float(demo.costs.mean()), loss))
    assert agent is not None
    return agent
