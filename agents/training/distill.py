"""Distillation: a policy with memory imitates a teacher with more information, by DAgger.

A teacher drives cars of its own, with any sensors, filter or truth, in lockstep with the
student's: equal seeds and actions give equal motion to the last bit. In the first round the
teacher acts, with coloured noise, in later ones the student; the teacher's action is always the
label (Ross et al., AISTATS 2011).
"""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..controllers.lqr import Lqr
from ..learned.policy import Card, Policy, PolicyController, save_policy
from ..rollout import COST_FLOOR
from .networks import compute_scale
from .student import (
    LAST_ROUND_FACTOR,
    Demonstrations,
    DistillConfig,
    Scaling,
    Student,
    compute_scaling,
    fit_model,
    normalise_inputs,
)

import torch  # isort: skip  # after ours, which say which extra is missing

DISTILL_SEEDS = 2**69  # no other seeds are as large: `callbacks`, `corrections`
SEEDS_PER_TRAINING = 2**40
_NOISE_DECAY = 0.95  # factor of the coloured noise in a step


class DistillTask(NamedTuple):
    """Cars that a student drives, the same cars as the teacher sees them, and the teacher."""

    cars: Any  # vector env of the student, which resets itself
    teachers: Any  # vector env of the teacher, of as many rows, which resets itself
    teacher: Any  # `Controller`


class RoundResult(NamedTuple):
    """The result of a round."""

    steps: int  # steps that taught, in all rounds so far
    cost: float  # mean cost of the round's episodes
    loss: float  # what `fit_model` returns


def collect_demonstrations(
    task: DistillTask, policy: Any, seeds: Sequence[int], noise: float, max_cost: float = np.inf
) -> Demonstrations:
    """Collect each seed's first episode, driven by a policy, or by the teacher with noise.

    Args:
        task: Cars and teacher.
        policy: `Policy`, object with stable-baselines3's `predict`, or None for the teacher.
        seeds: Seeds of the rows.
        noise: Largest standard deviation of the noise on the teacher's actions.
        max_cost: Cap on the cost that divides an episode's errors, so that failed episodes keep
            weight.

    Returns:
        Demonstrations with the teacher's actions, one row for each seed.

    Raises:
        ValueError: The teacher's cars differ from the student's.
    """
    cars, twins, teacher = task
    student = PolicyController(cars, policy) if isinstance(policy, Policy) else policy
    rng = np.random.default_rng(seeds[0])
    spread = noise * rng.random((len(seeds), 1))
    obs, _ = cars.reset(seed=list(seeds))
    teacher_obs, _ = twins.reset(seed=list(seeds))
    running = start = np.ones(len(seeds), np.bool_)
    coloured_noise, student_state, teacher_state = np.zeros((len(seeds), teacher.width)), None, None
    costs, steps = np.zeros(len(seeds)), []
    privileged_columns = _list_privileged_columns(task)
    while running.any():
        label, teacher_state = teacher.predict(teacher_obs, teacher_state, start)
        if student is None:
            white_noise = (1.0 - _NOISE_DECAY**2) ** 0.5 * rng.standard_normal(label.shape)
            coloured_noise = _NOISE_DECAY * coloured_noise + white_noise
            disturbed = np.nan_to_num(label) + spread * coloured_noise
            action = np.clip(disturbed, -1.0, 1.0).astype(np.float32)
        else:
            action, student_state = student.predict(obs, student_state, start)
        is_valid = running & np.isfinite(label).all(axis=1)
        steps.append((obs, np.nan_to_num(label), teacher_obs[:, privileged_columns], is_valid))
        teacher.record_action(teacher_state, action)
        obs, rewards, terminated, truncated, _ = cars.step(action)
        teacher_obs, teacher_rewards, *_ = twins.step(action)
        if not np.array_equal(rewards[running], teacher_rewards[running]):
            raise ValueError("the teacher's cars are others than the student's: rewards differ")
        costs -= np.where(running, rewards, 0.0)
        start = np.logical_or(terminated, truncated)
        running = running & ~start
    x, y, privileged, valid = (np.stack(columns, axis=1) for columns in zip(*steps, strict=True))
    curvature = np.eye(teacher.width, dtype=np.float32)
    if isinstance(teacher, Lqr):  # S of its design at the mean speed, `Lqr.curvature`
        names = [entry.name for entry in cars.layout]
        speed = float(x[..., names.index("wheel_left")].mean())
        curvature = teacher.curvature(speed).astype(np.float32)
    weights = (valid / (np.minimum(costs, max_cost)[:, None] + COST_FLOOR)).astype(np.float32)
    return Demonstrations(x, y, privileged, weights, curvature, costs)


def _list_privileged_columns(task: DistillTask) -> list[int]:
    """List the columns of the teacher's inputs that the student's observation lacks."""
    names, known = ([e.name for e in env.layout] for env in (task.teachers, task.cars))
    return [names.index(name) for name in task.teacher.needs if name not in known]


class _DistillResult(NamedTuple):
    """The policy, and the result of each round."""

    policy: Policy
    rounds: tuple[RoundResult, ...]


def distill(
    card: Card,
    tasks: Sequence[DistillTask],
    config: DistillConfig,
    path: str | Path,
    report: Callable[[RoundResult], None] = lambda _: None,
) -> _DistillResult:
    """Train a policy on all tasks and write it to a file after every round.

    Args:
        card: Card of the student's cars, to which the training's numbers are added.
        tasks: Cars and teachers.
        config: Configuration of the student and its training.
        path: Path that ends in `.safetensors`.
        report: Function that is called after each round.

    Returns:
        Policy of the last round, and all rounds' results: equal bits for equal arguments.

    Raises:
        ValueError: There is no task, or `config.told` where the student sees all that matters.
    """
    if not tasks:
        raise ValueError("no lessons: there is nothing to learn from")
    n_privileged = len(_list_privileged_columns(tasks[0]))
    if config.told and not n_privileged:
        raise ValueError("nothing is left to be told: the student sees all that its teacher reads")
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    start_time, target, steps = time.process_time(), Path(path), 0
    cars = tasks[0].cars
    seeds = itertools.count(DISTILL_SEEDS + config.seed * SEEDS_PER_TRAINING, cars.num_envs)
    width = cars.single_action_space.shape[0]
    model = Student(len(cars.layout), width, config, n_privileged)
    policy: Policy | None = None
    scaling: Scaling | None = None
    drives, rounds = list[Demonstrations](), list[RoundResult]()
    max_costs = [np.inf] * len(tasks)
    for i in range(config.rounds):
        new_drives = []
        for task, max_cost in zip(tasks, max_costs, strict=True):
            first = next(seeds)
            numbers = range(first, first + task.cars.num_envs)
            new_drives.append(collect_demonstrations(task, policy, numbers, config.noise, max_cost))
        steps += sum(int((demo.weights > 0.0).sum()) for demo in new_drives)
        if scaling is None:
            scaling = compute_scaling(new_drives, cars.layout, tasks[0].teacher.needs)
            model.fit_whitening(new_drives, scaling)
            max_costs = [float(np.median(demo.costs)) for demo in new_drives]
            valid_parts = [demo.privileged[demo.weights > 0.0] for demo in new_drives]
            privileged = np.concatenate(valid_parts)
            middle, scale = privileged.mean(0), compute_scale(privileged.std(0))
        for demo in new_drives:
            standard = normalise_inputs(demo.privileged, middle, scale)
            drives.append(demo._replace(privileged=standard))
        epochs = config.epochs * (LAST_ROUND_FACTOR if i == config.rounds - 1 else 1)
        loss = fit_model(model, drives, scaling, config, epochs)
        mean_cost = float(np.mean([demo.costs.mean() for demo in new_drives]))
        rounds.append(RoundResult(steps, mean_cost, loss))
        cpu_seconds = round(time.process_time() - start_time, 1)
        card = replace(card, steps=steps, cpu_seconds=cpu_seconds)
        policy = Policy(target.stem, model.network(scaling), card)
        save_policy(target, policy.network, card)
        report(rounds[-1])
    assert policy is not None
    return _DistillResult(policy, tuple(rounds))
