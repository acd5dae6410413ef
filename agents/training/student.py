"""The student of a distillation: demonstrations, scaled inputs, network, a round of learning.

The loss is what an action's error adds to the cost of the rest of the drive, by the Riccati
matrix of the teacher's design, over the cost of the episode: the score's logarithm, linearised.
"""

import itertools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.task import ObservationEntry
from ...estimators.learned.forward import MemoryLayer, RecurrentCell
from ...estimators.learned.network import Network
from .networks import TraceLayer, compute_scale, compute_whitening

with require_extra("train", "distillation needs torch"):
    import torch
    from torch import nn

Single = npt.NDArray[np.float32]

_CLIP = 8.0  # limit of a normalised input (standard deviations)
UNREAD = ("gps_X", "gps_Y", "gps_satellites")
"""Entries without information for control, as they only locate the car."""
_MIN_VARIANCE = 1e-3  # least variance of a mixture of normalised inputs, for `compute_whitening`
_EARLY, _MEDIAN = 16.0, 50.0  # percentiles of an age, one deviation apart where it is normal
_WINDOW = 50  # steps through which the gradient goes back in time
_SAMPLES = 512  # steps of a batch of a student without memory
LAST_ROUND_FACTOR = 3  # times as many epochs in the last round


class _Batch(NamedTuple):
    """B episodes, or a window of T steps of them, as tensors; fields as in `Demonstrations`."""

    inputs: Any  # (B, T, k), mixed by `Scaling`
    labels: Any  # (B, T, m)
    privileged: Any  # (B, T, q)
    weights: Any  # (B, T)
    curvatures: Any  # (B, m, m)
    begins: bool  # whether the episodes begin with it


class Demonstrations(NamedTuple):
    """Episodes of a task, oldest step first."""

    obs: Single  # observations, shape (N, T, k)
    labels: Single  # the teacher's actions, shape (N, T, m)
    privileged: Single  # the teacher's inputs that the observations lack, shape (N, T, q)
    weights: Single  # 1 / (min(J, max_cost) + COST_FLOOR), 0 after an episode's end, (N, T)
    curvature: Single  # S (m, m), of the cost-to-go: an action's error e adds e'S e
    costs: Array  # costs J, shape (N,)

    @property
    def zero_loss(self) -> float:
        """Loss of a student whose actions are zero, summed over episodes."""
        losses = np.einsum("nti,ij,ntj->nt", self.labels, self.curvature, self.labels)
        return float((losses * self.weights).sum())


class Scaling(NamedTuple):
    """The scaling of a student's inputs: clip((x - mean) scale) mixing.

    `normalise.Standardised` is that of reinforcement learning.
    """

    mean: Array  # shape (k,)
    scale: Array  # factors, shape (k,), zero for an entry that is not read
    mixing: Array  # symmetric whitening, shape (k, k): it scales up small differences

    def mix_inputs(self, obs: Single) -> Single:
        """Compute a `Student`'s inputs.

        Args:
            obs: Observations, shape (..., k).

        Returns:
            Inputs, shape (..., k).
        """
        mixing = self.mixing.astype(np.float32)
        return normalise_inputs(obs, self.mean, self.scale) @ mixing


def compute_scaling(
    drives: Sequence[Demonstrations],
    layout: Sequence[ObservationEntry],
    needs: Sequence[str],
    usual_ages: bool = True,
) -> Scaling:
    """Compute the scaling of a student's inputs from drives.

    A student that has all of `needs` reads nothing else, which would only be noise to it. One that
    has less reads all that varies, but for `UNREAD`.

    Args:
        drives: Demonstrations.
        layout: Entries of the observation.
        needs: Entries that the teacher reads.
        usual_ages: Whether an age is scaled by its variation while packets come, not by all of it.

    Returns:
        Mean and factor, shape (k,), and mixing, shape (k, k).
    """
    x = np.concatenate([demo.obs[demo.weights > 0.0] for demo in drives])
    names = [entry.name for entry in layout]
    is_read = np.isin(names, needs) if set(needs) <= set(names) else ~np.isin(names, UNREAD)
    mean, spread = x.mean(0, np.float64), x.std(0, dtype=np.float64)
    for i, name in enumerate(names):
        if usual_ages and name.endswith("_age"):
            early, median = np.percentile(x[:, i], (_EARLY, _MEDIAN))
            if median > early:
                mean[i], spread[i] = median, median - early
    scale = np.where(is_read, compute_scale(spread), 0.0)
    return Scaling(mean, scale, compute_whitening(normalise_inputs(x, mean, scale), _MIN_VARIANCE))


def normalise_inputs(obs: Single, mean: Array, scale: Array) -> Single:
    """Normalise observations: clip((x - mean) scale).

    Args:
        obs: Observations, shape (..., k).
        mean: Means, shape (k,).
        scale: Factors, shape (k,).

    Returns:
        Normalised observations, shape (..., k).
    """
    return np.clip((obs - mean.astype(np.float32)) * scale.astype(np.float32), -_CLIP, _CLIP)


@dataclass(frozen=True)
class DistillConfig:
    """The configuration of a student and its training.

    The auxiliary loss is that of the teacher's inputs that a student with memory does not see:
    squared errors in standard deviations, where the loss of zero actions counts 1.

    Raises:
        ValueError: A number is out of range, there are cells and traces, or `told` without memory.
    """

    rounds: int = 7  # of driving and learning; in the first one the teacher drives
    epochs: int = 12  # over all drives in a round; in the last one times `LAST_ROUND_FACTOR`
    cells: int = 0  # of a GRU, 0 for none
    hidden: tuple[int, ...] = (64, 64)  # sizes of the dense layers
    learning_rate: float = 3e-3  # of Adam, which falls to a fiftieth in each round
    noise: float = 0.02  # largest standard deviation of the noise on the teacher's actions
    seed: int = 0  # of weights and episodes
    batch: int = 16  # episodes of a batch, for a student with memory
    told: float = 0.0  # weight of the auxiliary loss: predict the teacher's inputs it cannot see
    traces: int = 0  # SiLU units in front of the moving averages; 0: no averages

    def __post_init__(self) -> None:
        sizes = self.rounds, self.epochs, self.batch, *self.hidden
        if min(sizes) < 1 or min(self.cells, self.traces, self.seed) < 0:
            rule = "rounds, epochs and sizes are 1 at least, cells, traces and seed 0"
            raise ValueError(f"{rule}: {self}")
        if not (self.learning_rate > 0.0 and self.noise >= 0.0 and self.told >= 0.0):
            raise ValueError(f"learning_rate is above zero, noise and told not below: {self}")
        if self.cells and self.traces:
            raise ValueError(f"a student has cells or traces, got {self.cells} and {self.traces}")
        if self.told and not (self.cells or self.traces):
            raise ValueError("a student without memory has nothing to say: told is for those with")

    def describe(self) -> dict[str, Any]:
        """Collect all numbers but the seed, in JSON types."""
        numbers = asdict(self) | {"hidden": list(self.hidden)}
        return {name: value for name, value in numbers.items() if name != "seed"}

    @property
    def window(self) -> int:
        """Steps of truncated back-propagation; with traces all of them."""
        return sys.maxsize if self.traces else _WINDOW


class Student(nn.Module):
    """A GRU or moving averages, if there are any, and dense layers, on whitened observations.

    Args:
        inputs: Number of inputs.
        width: Entries of an action.
        config: Configuration of the student.
        n_privileged: Outputs of the auxiliary head, which serve in training alone.
    """

    def __init__(
        self, inputs: int, width: int, config: DistillConfig, n_privileged: int = 0
    ) -> None:
        super().__init__()
        self.cell = nn.GRU(inputs, config.cells, batch_first=True) if config.cells else None
        self.traces = TraceLayer(inputs, config.traces) if config.traces else None
        memory_size = self.traces.size if self.traces else config.cells
        sizes = [memory_size or inputs, *config.hidden, width]
        self.dense = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        head_inputs = config.cells or sizes[-2]
        self.auxiliary_head = nn.Linear(head_inputs, n_privileged) if config.told else None
        self.recurrent = bool(memory_size)

    def forward(self, z: Any, state: Any = None) -> tuple[Any, Any]:
        """Compute actions and auxiliary outputs (B, T, m + q), and the next state.

        Args:
            z: Inputs, shape (B, T, k).
            state: State from the last call; None at the start.

        Returns:
            Outputs and next state.
        """
        memory = self.cell or self.traces
        if memory is not None:
            z, state = memory(z, state)
        memory_output = z
        for layer in self.dense[:-1]:
            z = nn.functional.silu(layer(z))
        auxiliary = []
        if self.auxiliary_head is not None:
            auxiliary.append(self.auxiliary_head(memory_output if self.cell else z))
        return torch.cat([self.dense[-1](z), *auxiliary], dim=-1), state

    def fit_whitening(self, drives: Sequence[Demonstrations], scaling: Scaling) -> None:
        """Fit the whitening of the moving averages' linear part on drives.

        Args:
            drives: Demonstrations.
            scaling: Scaling of the inputs.
        """
        if self.traces is not None:
            samples = [(scaling.mix_inputs(demo.obs), demo.weights > 0.0) for demo in drives]
            self.traces.fit_whitening(samples)

    def network(self, scaling: Scaling) -> Network:
        """Convert the student to a network of plain observations without auxiliary outputs.

        Args:
            scaling: Scaling of the inputs.

        Returns:
            Network of the actions, by NumPy.
        """
        numbers = {name: value.detach().numpy().copy() for name, value in self.named_parameters()}
        names = ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
        first = "cell.weight_ih_l0" if self.cell else "dense.0.weight"
        cells: list[MemoryLayer] = []
        if self.traces:
            cells.append(self.traces.cell(scaling.mixing))
            layer = [numbers[f"dense.0.{part}"] for part in ("weight", "bias")]
            numbers["dense.0.weight"], numbers["dense.0.bias"] = self.traces.convert_weights(*layer)
        else:
            numbers[first] = numbers[first] @ scaling.mixing
        if self.cell:
            cells.append(RecurrentCell("gru", *(numbers[f"cell.{name}"] for name in names)))
        weights = [numbers[f"dense.{i}.weight"] for i in range(len(self.dense))]
        biases = [numbers[f"dense.{i}.bias"] for i in range(len(self.dense))]
        mean, scale, _ = scaling
        return Network(mean, scale, weights, biases, "silu", clip=_CLIP, cells=cells)


def _concatenate(parts: Sequence[Single]) -> Any:
    return torch.from_numpy(np.concatenate(parts))


class _EpisodeBatches:
    """Batches of episodes, cut into windows through which the state is carried."""

    def __init__(
        self, drives: Sequence[Demonstrations], scaling: Scaling, config: DistillConfig
    ) -> None:
        self.drives, self.scaling = drives, scaling
        self.batch, self.window = config.batch, config.window
        self.episodes = [(i, j) for i, demo in enumerate(drives) for j in range(len(demo.costs))]
        longest = max(demo.weights.shape[1] for demo in drives)
        self.n_batches = -(-len(self.episodes) // self.batch) * -(-longest // self.window)

    def __iter__(self) -> Iterator[_Batch]:
        names = ("obs", "labels", "privileged", "weights")
        for chosen in torch.split(torch.randperm(len(self.episodes)), self.batch):
            rows = [self.episodes[int(i)] for i in chosen]
            longest = max(self.drives[i].weights.shape[1] for i, _ in rows)
            shapes = [getattr(self.drives[0], name).shape[2:] for name in names]
            arrays = [np.zeros((len(rows), longest, *shape), np.float32) for shape in shapes]
            for row, (i, j) in enumerate(rows):
                length = self.drives[i].weights.shape[1]
                for array, name in zip(arrays, names, strict=True):
                    array[row, :length] = getattr(self.drives[i], name)[j]
            S = torch.from_numpy(np.stack([self.drives[i].curvature for i, _ in rows]))
            arrays[0] = self.scaling.mix_inputs(arrays[0])
            for start in range(0, longest, self.window):
                z, y, q, w = (torch.from_numpy(a[:, start : start + self.window]) for a in arrays)
                yield _Batch(z, y, q, w, S, start == 0)


class _StepBatches:
    """Batches of `_SAMPLES` single steps of all drives, each like an episode."""

    def __init__(
        self, drives: Sequence[Demonstrations], scaling: Scaling, _: DistillConfig
    ) -> None:
        valid = [demo.weights > 0.0 for demo in drives]
        indices = [torch.full((int(mask.sum()),), i) for i, mask in enumerate(valid)]
        self.demo_index = torch.cat(indices)
        self.curvatures = torch.from_numpy(np.stack([demo.curvature for demo in drives]))
        pairs = list(zip(drives, valid, strict=True))
        self.x = _concatenate([scaling.mix_inputs(demo.obs[mask]) for demo, mask in pairs])
        self.y = _concatenate([demo.labels[mask] for demo, mask in pairs])
        self.q = _concatenate([demo.privileged[mask] for demo, mask in pairs])
        self.w = _concatenate([demo.weights[mask] for demo, mask in pairs])
        self.n_batches = -(-len(self.w) // _SAMPLES)

    def __iter__(self) -> Iterator[_Batch]:
        for i in torch.split(torch.randperm(len(self.w)), _SAMPLES):
            S = self.curvatures[self.demo_index[i]]
            z, y, q, w = (array[i, None] for array in (self.x, self.y, self.q, self.w))
            yield _Batch(z, y, q, w, S, True)


def fit_model(
    model: nn.Module,
    drives: Sequence[Demonstrations],
    scaling: Scaling,
    config: DistillConfig,
    epochs: int,
) -> float:
    """Fit a model to drives.

    Args:
        model: Network with the outputs of a `Student`; `recurrent` says whether it has memory.
        drives: Demonstrations.
        scaling: Scaling of the inputs.
        config: Configuration of the training.
        epochs: Passes over all drives.

    Returns:
        What errors of the actions add to an episode's cost, as a fraction of it: the mean over the
        episodes in the last epoch, without the auxiliary loss.

    Raises:
        FloatingPointError: The loss is not finite.
    """
    optimiser = torch.optim.Adam(model.parameters(), config.learning_rate)
    batches = (_EpisodeBatches if model.recurrent else _StepBatches)(drives, scaling, config)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.02, epochs * batches.n_batches)
    count = sum(len(demo.costs) for demo in drives)
    length = sum(int((demo.weights > 0.0).sum()) for demo in drives) / count  # steps, on average
    zero_loss = sum(demo.zero_loss for demo in drives) / count
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
            if config.told:
                auxiliary_error = (out[..., y.shape[-1] :] - q)[valid].square().mean(-1).sum()
                loss = loss / zero_loss + config.told * auxiliary_error / valid.sum().clamp(min=1)
            optimiser.zero_grad()
            loss.backward()
            norm = nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            if not torch.isfinite(loss + norm):
                raise FloatingPointError(f"the loss is {loss.item()} at step {step}")
            optimiser.step()
            schedule.step()
            step += 1
            total += float(added_cost.detach().sum())
    return total / count
