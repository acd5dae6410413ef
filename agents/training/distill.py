"""Distillation: a policy with memory learns to act as a teacher that sees more, by DAgger.

A teacher drives cars of its own, with whatever sensors, filter or truth it needs, in lockstep with
the student's: the same seeds and the same actions, hence the same motion to the last bit. In the
first round the teacher acts, shaken by coloured noise, in later ones the student; the teacher's
action is the label everywhere (Ross et al., AISTATS 2011).
"""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..controllers.lqr import Lqr
from ..learned.card import Card
from ..learned.files import Policy, save_policy
from ..learned.policy import Learned
from ..rollout import FLOOR
from .student import LONGER, Course, Student, fitted
from .traces.drives import Drives, Scaling, Single, normalised, scaling_of
from .traces.mixing import scale_of

import torch  # isort: skip  # after ours, which say which extra is missing

DISTILLING = 2**69  # no other seeds are as large: `keeper`, `corrections`
SEEDS = 2**40  # of a training
_MEMORY = 0.95  # share of the noise left after a step


class Lesson(NamedTuple):
    """Cars that a student drives, the same cars as the teacher sees them, and the teacher.

    Vector envs of as many rows that reset themselves; a `Controller`.
    """

    cars: Any
    teachers: Any
    teacher: Any


class Round(NamedTuple):
    """What a round came to: steps of the student's envs so far, mean cost of its episodes, and the
    loss, relative to their cost, of the last epoch."""

    steps: int
    cost: float
    loss: float


def drive(
    lesson: Lesson,
    policy: Any,
    seeds: Sequence[int],
    noise: float,
    usual: float = np.inf,
) -> Drives:
    """Each seed's first episode, driven by a policy, or by the teacher, shaken, without one.

    policy: a `Policy`, anything with stable-baselines3's `predict`, or None. usual: the cost by
    which errors are judged where an episode costs more: one that fails, or is lost, is what there
    is most to learn from.

    Raises ValueError where the teacher's cars are not those of the student.
    """
    cars, twins, teacher = lesson
    student = Learned(cars, policy) if isinstance(policy, Policy) else policy
    rng = np.random.default_rng(seeds[0])
    spread = noise * rng.random((len(seeds), 1))
    obs, _ = cars.reset(seed=list(seeds))
    seen, _ = twins.reset(seed=list(seeds))
    running = start = np.ones(len(seeds), np.bool_)
    shaken, own, memory = np.zeros((len(seeds), teacher.width)), None, None
    costs, steps = np.zeros(len(seeds)), []
    unseen = _unseen(lesson)
    while running.any():
        label, memory = teacher.predict(seen, memory, start)
        if student is None:
            shaken = _MEMORY * shaken + (1.0 - _MEMORY**2) ** 0.5 * rng.standard_normal(label.shape)
            action = np.clip(np.nan_to_num(label) + spread * shaken, -1.0, 1.0).astype(np.float32)
        else:
            action, own = student.predict(obs, own, start)
        taught = running & np.isfinite(label).all(axis=1)
        steps.append((obs, np.nan_to_num(label), seen[:, unseen], taught))
        teacher.acted(memory, action)
        obs, rewards, terminated, truncated, _ = cars.step(action)
        seen, theirs, *_ = twins.step(action)
        if not np.array_equal(rewards[running], theirs[running]):
            raise ValueError("the teacher's cars are others than the student's: rewards differ")
        costs -= np.where(running, rewards, 0.0)
        start = np.logical_or(terminated, truncated)
        running = running & ~start
    x, y, told, w = (np.stack(each, axis=1) for each in zip(*steps, strict=True))
    weights = w / (np.minimum(costs, usual)[:, None] + FLOOR)
    return Drives(x, y, told, weights.astype(np.float32), _curvature(cars, teacher, x), costs)


def _unseen(lesson: Lesson) -> list[int]:
    """Columns of what the teacher reads that is not in the student's observation."""
    names, known = ([e.name for e in env.layout] for env in (lesson.teachers, lesson.cars))
    return [names.index(name) for name in lesson.teacher.needs if name not in known]


def _curvature(cars: Any, teacher: Any, obs: Single) -> Single:
    """The Riccati matrix of the teacher's design at the drives' mean speed; without one, unity."""
    if not isinstance(teacher, Lqr):
        return np.eye(teacher.width, dtype=np.float32)
    names = [entry.name for entry in cars.layout]
    speed = float(obs[..., names.index("wheel_left")].mean())
    return teacher.curvature(speed).astype(np.float32)


class Distilled(NamedTuple):
    """The policy, and what each round came to."""

    policy: Policy
    rounds: tuple[Round, ...]


def distill(
    card: Card,
    lessons: Sequence[Lesson],
    course: Course,
    path: str | Path,
    report: Callable[[Round], None] = lambda _: None,
) -> Distilled:
    """Train a policy on all lessons and write it to a file after every round.

    card: of what the lessons' cars are; the training's numbers are filled in. path: ends in
    `.safetensors`. report: called after each round. The same numbers give the same bits.

    Raises ValueError for no lesson, for a course that tells where the student sees all that the
    teacher reads, for a teacher whose cars are others than the student's, and
    FloatingPointError, with the step, where the loss or the weights are not finite: the file then
    holds the round before.
    """
    if not lessons:
        raise ValueError("no lessons: there is nothing to learn from")
    unseen = len(_unseen(lessons[0]))
    if course.told and not unseen:
        raise ValueError("nothing is left to be told: the student sees all that its teacher reads")
    torch.set_num_threads(1)
    torch.manual_seed(course.seed)
    begun, target, steps = time.process_time(), Path(path), 0
    cars = lessons[0].cars
    seeds = itertools.count(DISTILLING + course.seed * SEEDS, cars.num_envs)
    width = cars.single_action_space.shape[0]
    model = Student(len(cars.layout), width, course, unseen)
    policy: Policy | None = None
    scaling: Scaling | None = None
    drives: list[Drives] = []
    rounds: list[Round] = []
    usual = [np.inf] * len(lessons)
    for i in range(course.rounds):
        fresh = []
        for lesson, most in zip(lessons, usual, strict=True):
            first = next(seeds)
            numbers = range(first, first + lesson.cars.num_envs)
            fresh.append(drive(lesson, policy, numbers, course.noise, most))
        steps += sum(int((each.weights > 0.0).sum()) for each in fresh)
        if scaling is None:
            scaling = scaling_of(fresh, cars.layout, lessons[0].teacher.needs)
            model.whiten(fresh, scaling)
            usual = [float(np.median(each.costs)) for each in fresh]
            told = np.concatenate([each.told[each.weights > 0.0] for each in fresh])
            middle, scale = told.mean(0), scale_of(told.std(0))
        drives += [each._replace(told=normalised(each.told, middle, scale)) for each in fresh]
        epochs = course.epochs * (LONGER if i == course.rounds - 1 else 1)
        loss = fitted(model, drives, scaling, course, epochs)
        rounds.append(Round(steps, float(np.mean([each.costs.mean() for each in fresh])), loss))
        spent = round(time.process_time() - begun, 1)
        card = replace(card, steps=steps, cpu_seconds=spent)
        policy = Policy(target.stem, model.network(scaling), card)
        save_policy(target, policy.network, card)
        report(rounds[-1])
    assert policy is not None
    return Distilled(policy, tuple(rounds))
