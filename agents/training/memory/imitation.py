"""A memory learns from a teacher that filters, and acts.

In a linear scenario what an action costs more than the best one is S_j (u - u*)^2, u* the action
of the optimal filter's estimate: who imitates it where he himself drives minimises his cost, and
what he lacks is memory, not exploration.
"""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from ..distill import DISTILLING, SEEDS, Lesson, Round, drive
from ..student import LONGER, Course, fitted
from ..traces.drives import Array, Drives, Scaling, Single, normalised, scaling_of
from .networks import Memory, make_memory

import torch  # isort: skip  # after ours, which say which extra is missing


class Remembering:
    """A memory that acts: stable-baselines3's `predict` on plain observations (N, k).

    mean, scale: (k,) of the observations.
    """

    def __init__(self, model: Memory, mean: Array, scale: Array) -> None:
        self.model, self.mean, self.scale = model, mean, scale

    def predict(
        self,
        observation: Single,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Single, Any]:
        """The actions (N, 1) and the next state; where an episode starts the state is zero."""
        z = torch.from_numpy(normalised(observation, self.mean, self.scale))[:, None]
        if state is not None and episode_start is not None and np.any(episode_start):
            state = state.clone()
            state[torch.from_numpy(np.asarray(episode_start))] = 0.0
        with torch.no_grad():
            actions, state = self.model(z, state)
        return actions[:, 0].clamp(-1.0, 1.0).numpy(), state


def imitated(
    name: str,
    lesson: Lesson,
    course: Course,
    late: int,
    weight: float = 1.0,
    report: Callable[[Round], None] = lambda _: None,
) -> Remembering:
    """A memory of `MEMORIES` that learned to act as a lesson's teacher, by DAgger.

    course: all but `cells` and `hidden`. late: steps that a packet is old when it arrives. weight:
    S, what the square of an error costs. report: called after each round.

    Raises ValueError for an unknown name, or a lesson whose observation does not say whether a
    packet arrived; FloatingPointError, with the step, where the training diverges.
    """
    cars = lesson.cars
    names = [entry.name for entry in cars.layout]
    fresh = [i for i, each in enumerate(names) if each.endswith("_fresh")]
    if len(fresh) != 1:
        raise ValueError(f"a memory knows one sensor with packets, got {len(fresh)} in {names}")
    torch.set_num_threads(1)
    torch.manual_seed(course.seed)
    model = make_memory(name, len(names), fresh[0], late)
    seeds = itertools.count(DISTILLING + course.seed * SEEDS, cars.num_envs)
    drives: list[Drives] = []
    agent, steps = None, 0
    scaling: Scaling | None = None
    for i in range(course.rounds):
        first = next(seeds)
        seen = drive(lesson, agent, range(first, first + cars.num_envs), course.noise)
        drives.append(seen._replace(curvature=np.full((1, 1), weight, np.float32)))
        steps += int((seen.weights > 0.0).sum())
        if scaling is None:
            mean, scale, _ = scaling_of(drives, cars.layout, lesson.teacher.needs, usual_ages=False)
            scaling = Scaling(mean, scale, np.eye(len(mean)))  # memories mix by themselves
            model.whiten(drives, mean, scale)
        last = i == course.rounds - 1
        loss = fitted(model, drives, scaling, course, course.epochs * (LONGER if last else 1))
        agent = Remembering(model, scaling.mean, scaling.scale)
        report(Round(steps, float(seen.costs.mean()), loss))
    assert agent is not None
    return agent
