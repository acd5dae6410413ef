"""Distillation: a policy with memory imitates a teacher with more information, by DAgger.

A teacher drives cars of its own, with any sensors, filter or truth, in lockstep with the student's.
In the first round the teacher acts, with coloured noise, in later ones the student; the teacher's
action is always the label (Ross et al., AISTATS 2011). The loss is what an action's error adds to
the cost of the rest of the drive, by the Riccati matrix of the teacher's design, over the cost of
the episode: the score's logarithm, linearised.
"""

import functools
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.record import Array
from ...envs.task import ObservationEntry
from ..controllers.lqr import Lqr
from ..learned.layers import MovingAverages
from ..learned.network import Network
from ..learned.policy import Card, Policy, PolicyController, save_policy
from ..rollout import COST_FLOOR
from .config import DistillConfig
from .export import convert_cells, mix_inputs
from .normalise import Standardisation, compute_scale, compute_whitening

import torch  # isort: skip  # after ours, which say which extra is missing
from torch import Tensor, nn  # isort: skip
from torch.nn.utils.rnn import pad_sequence  # isort: skip

_DISTILL_SEEDS = 2**69  # no other seeds are as large: `callbacks`
_SEEDS_PER_TRAINING = 2**40
_NOISE_DECAY = 0.95  # factor of the coloured noise in a step
_WINDOW = 50  # steps through which the gradient goes back in time, but for traces
_SAMPLES = 512  # steps of a batch of a student without memory
_LAST_ROUND_FACTOR = 3  # times as many epochs in the last round
Single = npt.NDArray[np.float32]

_CLIP = 8.0  # limit of a normalised input (standard deviations)
_UNREAD = ("gps_X", "gps_Y", "gps_satellites")  # without information for control
# Beginnings of entries that a filter has read: behind it they would only shake the action.
_FILTERED = ("gyro", "accel_", "roll_rate", "camera_", "gps_")
_MIN_TRACE_VARIANCE = 1e-4  # least variance of a mixture of inputs and their averages
_EARLY, _MEDIAN = 16.0, 50.0  # percentiles of an age, one deviation apart where it is normal
_TIMES = (3, 10, 30, 100, 300)  # steps, of 10 ms each: from the motors' lag to half a drive
_SAMPLE_STRIDE = 7  # every so many steps one is a sample for a whitening
_BLOCK = 50  # steps whose means are one product of matrices
_MIN_SHARE = 1e-300  # of the earlier means, in place of 0 at the first step, for the logarithm


class Demonstrations(NamedTuple):
    """Episodes of a task, oldest step first."""

    obs: Single  # observations, shape (N, T, k)
    labels: Single  # the teacher's actions, shape (N, T, m)
    privileged: Single  # the teacher's inputs that the observations lack, shape (N, T, q)
    weights: Single  # 1 / (min(J, max_cost) + COST_FLOOR), 0 after an episode's end, (N, T)
    curvature: Single  # S (m, m), of the cost-to-go: an action's error e adds e'S e
    costs: Array  # costs J, shape (N,)

    @property
    def is_valid(self) -> npt.NDArray[np.bool_]:
        """Whether a step counts, shape (N, T)."""
        return self.weights > 0.0


_Drives = Sequence[Demonstrations]


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

    inputs: Tensor  # (B, T, k), mixed by a `Standardisation`
    labels: Tensor  # (B, T, m)
    privileged: Tensor  # (B, T, q)
    weights: Tensor  # (B, T)
    curvatures: Tensor  # (B, m, m)
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


def _compute_scaling(
    drives: _Drives, layout: Sequence[ObservationEntry], needs: Sequence[str]
) -> Standardisation:
    """Compute the scaling of a student's inputs from drives; needs: what the teacher reads."""
    # A student that has all of `needs` reads nothing else, which would only be noise to it. One
    # that has less reads all that varies, but for `_UNREAD` and, behind a filter, what that has
    # read. An age is scaled by its variation while packets come.
    x = np.concatenate([demo.obs[demo.is_valid] for demo in drives])
    names = [entry.name for entry in layout]
    is_read = np.isin(names, needs) if set(needs) <= set(names) else ~np.isin(names, _UNREAD)
    if "beta_hat" in names:
        is_read &= [not x.startswith(_FILTERED) or x.endswith(("_hat", "_std")) for x in names]
    mean, spread = x.mean(0, np.float64), x.std(0, dtype=np.float64)
    for i, name in enumerate(names):
        if name.endswith("_age"):
            early, median = np.percentile(x[:, i], (_EARLY, _MEDIAN))
            if median > early:
                mean[i], spread[i] = median, median - early
    plain = Standardisation(mean, np.where(is_read, compute_scale(spread), 0.0), _CLIP)
    return plain._replace(mixing=compute_whitening(plain.transform(x)))


class _TraceLayer(nn.Module):
    """The inputs and SiLU units, with the moving averages of all over some times (steps).

    The inputs and their averages are whitened, by `mean` and `mixing`: small differences of two of
    them say how a sensor changes.
    """

    mean: Tensor
    mixing: Tensor

    def __init__(self, inputs: int, n_silu: int, times: Sequence[float] = _TIMES) -> None:
        super().__init__()
        self.inputs, self.times = inputs, tuple(times)
        self.unit = nn.Linear(inputs, n_silu)
        n_linear = inputs * (1 + len(self.times))
        self.register_buffer("mean", torch.zeros(n_linear))
        self.register_buffer("mixing", torch.eye(n_linear))

    @property
    def size(self) -> int:
        """Size of the output: inputs and their averages, then SiLU units and theirs."""
        return (self.inputs + self.unit.out_features) * (1 + len(self.times))

    def forward(self, z: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Compute units and averages (B, T, size) of inputs (B, T, k); episodes begin together."""
        # the state, which follows, has averages and the steps so far, (B, times, units + 1)
        u = torch.cat([z, nn.functional.silu(self.unit(z))], -1)
        if state is None:
            state = u.new_zeros(len(u), len(self.times), u.shape[-1] + 1)
        first, means, blocks = int(state[0, 0, -1]), state[..., :-1], []
        for part in torch.split(u, _BLOCK, 1):
            new, old = _compute_weights(self.times, first, part.shape[1])
            values = torch.einsum("nts,bsk->bntk", new, part) + old[..., None] * means[:, :, None]
            blocks.append(values)
            first, means = first + part.shape[1], values[:, :, -1]
        all_values = torch.cat([u[:, None], torch.cat(blocks, 2)], 1).transpose(1, 2)
        linear, silu = (values.flatten(2) for values in all_values.tensor_split([self.inputs], -1))
        age = means.new_full((*means.shape[:-1], 1), float(first))
        mixed = (linear - self.mean) @ self.mixing
        return torch.cat([mixed, silu], -1), torch.cat([means, age], -1)

    def fit_whitening(self, drives: _Drives, scaling: Standardisation) -> None:
        """Fit the whitening of inputs and their averages on drives."""
        outputs, size = [], len(self.mean)
        with torch.no_grad():
            for demo in drives:
                linear_part = self(torch.from_numpy(scaling.transform(demo.obs)))[0][..., :size]
                outputs.append(linear_part[torch.from_numpy(demo.is_valid)][::_SAMPLE_STRIDE])
        linear = torch.cat(outputs).numpy()
        self.mean.copy_(torch.from_numpy(linear.mean(0)))
        self.mixing.copy_(torch.from_numpy(compute_whitening(linear, _MIN_TRACE_VARIANCE)))

    def cell(self, mixing: Array) -> MovingAverages:
        """Make the runtime's layer for inputs that a mixing (k, k) mixes first."""
        silu_weights = self.unit.weight.detach().numpy() @ mixing
        bias = np.concatenate([np.zeros(self.inputs), self.unit.bias.detach().numpy()])
        weights = np.concatenate([mixing, silu_weights])
        return MovingAverages(weights, bias, self.unit.out_features, self.times)

    def convert_weights(self, weight: Array, bias: Array) -> tuple[Array, Array]:
        """Convert the next layer's weights (m, size) and biases (m,) for the output of `cell`."""
        # that output is in the order of times, inputs before SiLU units, without whitening
        size, times = len(self.mean), 1 + len(self.times)
        linear = weight[:, :size] @ self.mixing.numpy().astype(np.float64).T
        bias = bias - linear @ self.mean.numpy()
        parts = [block.reshape(len(bias), times, -1) for block in (linear, weight[:, size:])]
        return np.concatenate(parts, -1).reshape(len(bias), -1), bias


@functools.cache
def _compute_weights(times: tuple[float, ...], first: int, steps: int) -> tuple[Tensor, Tensor]:
    """Compute the weights of a block's steps (times, T, T) and of earlier averages (times, T)."""
    # They solve m_t = m_(t-1) + a_t (u_t - m_(t-1)) of `MovingAverages`, with the share a_t =
    # max(1 / steps so far, 1 - exp(-1 / time)): u_s has a_s prod (1 - a_r), r = s + 1, ..., t.
    ages = first + 1.0 + np.arange(steps)
    shares = np.maximum(1.0 / ages, -np.expm1(-1.0 / np.array(times))[:, None])
    left = np.log(np.maximum(1.0 - shares, _MIN_SHARE)).cumsum(-1)
    since = left[:, :, None] - left[:, None, :]  # `left`: log of what is left of earlier averages
    new = np.tril(np.exp(np.minimum(since, 0.0))) * shares[:, None, :]
    new, old = new.astype(np.float32), np.exp(left).astype(np.float32)
    return torch.from_numpy(new), torch.from_numpy(old)


class _Student(nn.Module):
    """A GRU or moving averages, if there are any, and dense layers, on whitened observations.

    The outputs of its auxiliary head serve in training alone.
    """

    def __init__(self, inputs: int, width: int, config: DistillConfig, n_auxiliary: int) -> None:
        super().__init__()
        self.cell = nn.GRU(inputs, config.cells, batch_first=True) if config.cells else None
        self.traces = _TraceLayer(inputs, config.traces) if config.traces else None
        memory_size = self.traces.size if self.traces else config.cells
        sizes = [memory_size or inputs, *config.hidden, width]
        self.dense = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        head_inputs = config.cells or sizes[-2] if config.auxiliary_weight else 0
        self.auxiliary_head = nn.Linear(head_inputs, n_auxiliary) if head_inputs else None
        self.recurrent = bool(memory_size)

    def forward(self, z: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Compute actions and auxiliary outputs (B, T, m + q) of inputs (B, T, k); next state."""
        memory = self.cell or self.traces
        if memory is not None:
            z, state = memory(z, state)
        memory_output = z
        for layer in self.dense[:-1]:
            z = nn.functional.silu(layer(z))
        outputs = [self.dense[-1](z)]
        if self.auxiliary_head is not None:
            outputs.append(self.auxiliary_head(memory_output if self.cell else z))
        return torch.cat(outputs, dim=-1), state

    def network(self, scaling: Standardisation) -> Network:
        """Convert the student to a network of plain observations without auxiliary outputs."""
        mean, scale = np.array(scaling.mean), np.array(scaling.scale)
        mixing = np.eye(len(mean)) if scaling.mixing is None else np.array(scaling.mixing)
        numbers = [parameter.detach().numpy() for parameter in self.dense.parameters()]
        weights, biases, cells = numbers[::2], numbers[1::2], convert_cells(self.cell)
        if self.traces:
            cells = [self.traces.cell(mixing)]
            weights[0], biases[0] = self.traces.convert_weights(weights[0], biases[0])
        else:
            mix_inputs(cells, weights, mixing)
        return Network(mean, scale, weights, biases, "silu", clip=scaling.clip, cells=cells)


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
    model = _Student(len(cars.layout), cars.single_action_space.shape[0], config, n_privileged)
    seeds = itertools.count(_DISTILL_SEEDS + config.seed * _SEEDS_PER_TRAINING, cars.num_envs)
    policy: Policy | None = None
    scaling: Standardisation | None = None
    drives, max_costs, steps = list[Demonstrations](), [np.inf] * len(tasks), 0
    for i in range(config.rounds):
        new_drives = []
        for task, max_cost in zip(tasks, max_costs, strict=True):
            first = next(seeds)
            numbers, limits = range(first, first + task.cars.num_envs), (config.noise, max_cost)
            new_drives.append(_collect_demonstrations(task, policy, numbers, *limits))
        steps += sum(int(demo.is_valid.sum()) for demo in new_drives)
        if scaling is None:
            scaling = _compute_scaling(new_drives, cars.layout, tasks[0].teacher.needs)
            if model.traces is not None:
                model.traces.fit_whitening(new_drives, scaling)
            max_costs = [float(np.median(demo.costs)) for demo in new_drives]
            privileged = np.concatenate([demo.privileged[demo.is_valid] for demo in new_drives])
            scale = compute_scale(privileged.std(0))
            standard = Standardisation(privileged.mean(0), scale, _CLIP)
        for demo in new_drives:
            drives.append(demo._replace(privileged=standard.transform(demo.privileged)))
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

    def __init__(self, drives: _Drives, scaling: Standardisation, config: DistillConfig) -> None:
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
            parts[0] = torch.from_numpy(self.scaling.transform(parts[0].numpy()))
            for start in range(0, parts[0].shape[1], self.window):
                z, y, q, w = (part[:, start : start + self.window] for part in parts)
                yield _Batch(z, y, q, w, S, start == 0)


class _StepBatches:
    """Batches of `_SAMPLES` single steps of all drives, each like an episode."""

    def __init__(self, drives: _Drives, scaling: Standardisation, _: DistillConfig) -> None:
        parts = []
        for demo in drives:
            valid = demo.is_valid
            inputs = scaling.transform(demo.obs[valid])
            arrays = [x[valid] for x in (demo.labels, demo.privileged, demo.weights)]
            parts.append((inputs, *arrays, np.repeat(demo.curvature[None], len(inputs), axis=0)))
        columns = zip(*parts, strict=True)
        self.arrays = [torch.from_numpy(np.concatenate(column)) for column in columns]
        self.n_batches = -(-len(self.arrays[0]) // _SAMPLES)

    def __iter__(self) -> Iterator[_Batch]:
        for i in torch.split(torch.randperm(len(self.arrays[0])), _SAMPLES):
            z, y, q, w, S = (array[i] for array in self.arrays)
            yield _Batch(z[:, None], y[:, None], q[:, None], w[:, None], S, True)


def _fit_model(
    model: Any, drives: _Drives, scaling: Standardisation, config: DistillConfig, epochs: int
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
