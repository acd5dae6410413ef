"""Distillation: a policy with memory imitates a teacher with more information, by DAgger.

A teacher drives cars of its own, with any sensors, filter or truth, in lockstep with the student's.
In the first round the teacher acts, with coloured noise, in later ones the student; the teacher's
action is always the label (Ross et al., AISTATS 2011). The loss is what an action's error adds to
the cost of the rest of the drive, by the Riccati matrix of the teacher's design, over the cost of
the episode: the score's logarithm, linearised.
"""

import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..controllers.lqr import Lqr
from ..learned.policy import Card, Policy, PolicyController, save_policy
from ..rollout import COST_FLOOR
from .student import Demonstrations, DistillConfig, Scaling, Student, compute_scale, compute_scaling

import torch  # isort: skip  # after ours, which say which extra is missing
from torch import nn  # isort: skip
from torch.nn.utils.rnn import pad_sequence  # isort: skip

_Drives = Sequence[Demonstrations]
_DISTILL_SEEDS = 2**69  # no other seeds are as large: `callbacks`
_SEEDS_PER_TRAINING = 2**40
_NOISE_DECAY = 0.95  # factor of the coloured noise in a step
_WINDOW = 50  # steps through which the gradient goes back in time, but for traces
_SAMPLES = 512  # steps of a batch of a student without memory
_LAST_ROUND_FACTOR = 3  # times as many epochs in the last round


class DistillTask(NamedTuple):
    """Cars that a student drives, the same cars as the teacher sees them, and the teacher."""

    cars: Any  # vector env of the student, which resets itself
    teachers: Any  # vector env of the teacher, of as many rows, which resets itself
    teacher: Any  # `Controller`


class RoundResult(NamedTuple):
    """The result of a round."""

    steps: int  # steps that taught, in all rounds so far
    cost: float  # mean cost of the round's episodes
    loss: float  # what `_fit_model` returns


class _Batch(NamedTuple):
    """B episodes, or a window of T steps of them, as tensors; fields as in `Demonstrations`."""

    inputs: torch.Tensor  # (B, T, k), mixed by `Scaling`
    labels: torch.Tensor  # (B, T, m)
    privileged: torch.Tensor  # (B, T, q)
    weights: torch.Tensor  # (B, T)
    curvatures: torch.Tensor  # (B, m, m)
    begins: bool  # whether the episodes begin with it


def _collect_demonstrations(
    task: DistillTask, policy: Policy | None, seeds: Sequence[int], noise: float,
    max_cost: float = np.inf,
) -> Demonstrations:  # fmt: skip
    """Collect each seed's first episode, driven by a policy, or by the teacher with noise."""
    # noise: largest standard deviation on the teacher's actions. Episodes that cost more than
    # `max_cost` are weighted as if they cost that: failed ones keep their weight.
    cars, twins, teacher = task
    student = None if policy is None else PolicyController(cars, policy)
    rng = np.random.default_rng(seeds[0])
    spread = noise * rng.random((len(seeds), 1))
    obs, _ = cars.reset(seed=list(seeds))
    teacher_obs, _ = twins.reset(seed=list(seeds))
    running = start = np.ones(len(seeds), np.bool_)
    coloured_noise, student_state, teacher_state = np.zeros((len(seeds), teacher.width)), None, None
    costs, steps, columns = np.zeros(len(seeds)), [], _list_privileged_columns(task)
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
        steps.append((obs, np.nan_to_num(label), teacher_obs[:, columns], is_valid))
        teacher.record_action(teacher_state, action)
        obs, rewards, terminated, truncated, _ = cars.step(action)
        teacher_obs, teacher_rewards, *_ = twins.step(action)
        if not np.array_equal(rewards[running], teacher_rewards[running]):
            raise ValueError("the teacher's cars are others than the student's: rewards differ")
        costs -= np.where(running, rewards, 0.0)
        start = np.logical_or(terminated, truncated)
        running = running & ~start
    x, y, privileged, valid = (np.stack(part, axis=1) for part in zip(*steps, strict=True))
    curvature = np.eye(teacher.width, dtype=np.float32)
    if isinstance(teacher, Lqr):  # S of its design at the mean speed, `Lqr.curvature`
        speed = float(x[..., [e.name for e in cars.layout].index("wheel_left")].mean())
        curvature = teacher.curvature(speed).astype(np.float32)
    weights = (valid / (np.minimum(costs, max_cost)[:, None] + COST_FLOOR)).astype(np.float32)
    return Demonstrations(x, y, privileged, weights, curvature, costs)


def _list_privileged_columns(task: DistillTask) -> list[int]:
    """List the columns of the teacher's inputs that the student's observation lacks."""
    names, known = ([e.name for e in env.layout] for env in (task.teachers, task.cars))
    return [names.index(name) for name in task.teacher.needs if name not in known]


def distill(
    card: Card, tasks: Sequence[DistillTask], config: DistillConfig, path: str | Path,
    report: Callable[[RoundResult], None] = lambda _: None,
) -> Policy:  # fmt: skip
    """Train a policy on all tasks and write it to a file after every round.

    Args:
        card: Card of the student's cars, to which the training's numbers are added.
        tasks: Cars and teachers; ValueError without one.
        config: Configuration; ValueError for `auxiliary_weight` where the student sees everything.
        path: Path that ends in `.safetensors`.
        report: Function that is called after each round.
    """
    if not tasks:
        raise ValueError("no lessons: there is nothing to learn from")
    n_privileged = len(_list_privileged_columns(tasks[0]))
    if config.auxiliary_weight and not n_privileged:
        raise ValueError("nothing is left to be told: the student sees all that its teacher reads")
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    start_time, target, cars = time.process_time(), Path(path), tasks[0].cars
    model = Student(len(cars.layout), cars.single_action_space.shape[0], config, n_privileged)
    seeds = itertools.count(_DISTILL_SEEDS + config.seed * _SEEDS_PER_TRAINING, cars.num_envs)
    policy: Policy | None = None
    scaling: Scaling | None = None
    drives, max_costs, steps = list[Demonstrations](), [np.inf] * len(tasks), 0
    for i in range(config.rounds):
        new_drives = []
        for task, max_cost in zip(tasks, max_costs, strict=True):
            first = next(seeds)
            numbers, limits = range(first, first + task.cars.num_envs), (config.noise, max_cost)
            new_drives.append(_collect_demonstrations(task, policy, numbers, *limits))
        steps += sum(int(demo.is_valid.sum()) for demo in new_drives)
        if scaling is None:
            scaling = compute_scaling(new_drives, cars.layout, tasks[0].teacher.needs)
            if model.traces is not None:
                model.traces.fit_whitening(new_drives, scaling)
            max_costs = [float(np.median(demo.costs)) for demo in new_drives]
            privileged = np.concatenate([demo.privileged[demo.is_valid] for demo in new_drives])
            standard = Scaling(privileged.mean(0), compute_scale(privileged.std(0)))
        for demo in new_drives:
            drives.append(demo._replace(privileged=standard.mix_inputs(demo.privileged)))
        epochs = config.epochs * (_LAST_ROUND_FACTOR if i == config.rounds - 1 else 1)
        loss = _fit_model(model, drives, scaling, config, epochs)
        cpu_seconds = round(time.process_time() - start_time, 1)
        new_card = replace(card, steps=steps, cpu_seconds=cpu_seconds)
        policy = Policy(target.stem, model.network(scaling), new_card)
        save_policy(target, policy.network, policy.card)
        mean_cost = float(np.mean([demo.costs.mean() for demo in new_drives]))
        report(RoundResult(steps, mean_cost, loss))
    assert policy is not None  # there is a round at least
    return policy


class _EpisodeBatches:
    """Batches of episodes, cut into windows through which the state is carried."""

    def __init__(self, drives: _Drives, scaling: Scaling, config: DistillConfig) -> None:
        self.drives, self.scaling = drives, scaling
        self.batch, self.window = config.batch, sys.maxsize if config.traces else _WINDOW
        self.episodes = [(i, j) for i, demo in enumerate(drives) for j in range(len(demo.costs))]
        longest = max(demo.weights.shape[1] for demo in drives)
        self.n_batches = -(-len(self.episodes) // self.batch) * -(-longest // self.window)

    def __iter__(self) -> Iterator[_Batch]:
        for chosen in torch.split(torch.randperm(len(self.episodes)), self.batch):
            rows = [self.episodes[int(i)] for i in chosen]
            S = torch.from_numpy(np.stack([self.drives[i].curvature for i, _ in rows]))
            columns = [
                [torch.from_numpy(getattr(self.drives[i], name)[j]) for i, j in rows]
                for name in ("obs", "labels", "privileged", "weights")
            ]
            parts = [pad_sequence(column, batch_first=True) for column in columns]
            parts[0] = torch.from_numpy(self.scaling.mix_inputs(parts[0].numpy()))
            for start in range(0, parts[0].shape[1], self.window):
                z, y, q, w = (part[:, start : start + self.window] for part in parts)
                yield _Batch(z, y, q, w, S, start == 0)


class _StepBatches:
    """Batches of `_SAMPLES` single steps of all drives, each like an episode."""

    def __init__(self, drives: _Drives, scaling: Scaling, _: DistillConfig) -> None:
        parts = []
        for demo in drives:
            inputs, count = scaling.mix_inputs(demo.obs[demo.is_valid]), int(demo.is_valid.sum())
            arrays = [x[demo.is_valid] for x in (demo.labels, demo.privileged, demo.weights)]
            parts.append((inputs, *arrays, np.repeat(demo.curvature[None], count, axis=0)))
        columns = zip(*parts, strict=True)
        self.arrays = [torch.from_numpy(np.concatenate(column)) for column in columns]
        self.n_batches = -(-len(self.arrays[0]) // _SAMPLES)

    def __iter__(self) -> Iterator[_Batch]:
        for i in torch.split(torch.randperm(len(self.arrays[0])), _SAMPLES):
            z, y, q, w, S = (array[i] for array in self.arrays)
            yield _Batch(z[:, None], y[:, None], q[:, None], w[:, None], S, True)


def _fit_model(
    model: Any, drives: _Drives, scaling: Scaling, config: DistillConfig, epochs: int
) -> float:
    """Fit a model to drives; return what its errors add to an episode, as a share of its cost."""
    # the mean over the episodes in the last epoch, without the auxiliary loss
    optimiser = torch.optim.Adam(model.parameters(), config.learning_rate)
    batches = (_EpisodeBatches if model.recurrent else _StepBatches)(drives, scaling, config)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.02, epochs * batches.n_batches)
    count = sum(len(demo.costs) for demo in drives)
    length = sum(int(demo.is_valid.sum()) for demo in drives) / count  # steps, on average
    zero_loss = 0.0  # of actions that are zero
    for demo in drives:
        losses = np.einsum("nti,ij,ntj->nt", demo.labels, demo.curvature, demo.labels)
        zero_loss += float((losses * demo.weights).sum())
    zero_loss /= count
    step, total, state = 0, 0.0, None
    for _ in range(epochs):
        total = 0.0
        for z, y, q, w, S, begins in batches:
            out, state = model(z, None if begins else state)
            state = None if state is None else state.detach()
            valid = w > 0.0
            error = out[..., : y.shape[-1]] - y
            added_cost = torch.einsum("bti,bij,btj->bt", error, S, error) * w
            loss = length * added_cost.sum() / valid.sum().clamp(min=1)  # by episode
            if config.auxiliary_weight:
                auxiliary_error = (out[..., y.shape[-1] :] - q)[valid].square().mean(-1).sum()
                auxiliary = config.auxiliary_weight * auxiliary_error / valid.sum().clamp(min=1)
                loss = loss / zero_loss + auxiliary
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            norm = nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            if not torch.isfinite(loss + norm):
                raise FloatingPointError(f"the loss is {loss.item()} at step {step}")
            optimiser.step()
            schedule.step()
            step += 1
            total += float(added_cost.detach().sum())
    return total / count
