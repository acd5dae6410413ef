"""The student of a distillation: demonstrations, scaled inputs, moving averages, the network.

`_TraceLayer` is the runtime's `MovingAverages` for training, by whole episodes.
"""

import functools
import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.task import ObservationEntry
from ..learned.network import MemoryLayer, MovingAverages, Network, RecurrentCell

with require_extra("train", "distillation needs torch"):
    import torch
    from torch import nn

Single = npt.NDArray[np.float32]

_CLIP = 8.0  # limit of a normalised input (standard deviations)
_UNREAD = ("gps_X", "gps_Y", "gps_satellites")  # without information for control
# Beginnings of entries that a filter has read: behind it they would only shake the action.
_FILTERED = ("gyro", "accel_", "roll_rate", "camera_", "gps_")
_MIN_SPREAD = 1e-9  # standard deviation below which an input counts as constant
_MIN_VARIANCE = 1e-3  # least variance of a mixture of normalised inputs
_MIN_TRACE_VARIANCE = 1e-4  # likewise, of a mixture of inputs and their averages
_EARLY, _MEDIAN = 16.0, 50.0  # percentiles of an age, one deviation apart where it is normal
_TIMES = (3, 10, 30, 100, 300)  # steps, of 10 ms each: from the motors' lag to half a drive
_SAMPLE_STRIDE = 7  # every so many steps one is a sample for a whitening
_BLOCK = 50  # steps whose means are one product of matrices
_MIN_SHARE = 1e-300  # of the earlier means, in place of 0 at the first step, for the logarithm


def compute_scale(spread: Array) -> Array:
    """Compute the inverse of each standard deviation, shape (k,), zero where nothing varies.

    Args:
        spread: Standard deviations, shape (k,).
    """
    return np.where(spread > _MIN_SPREAD, 1.0 / np.maximum(spread, _MIN_SPREAD), 0.0)


def compute_whitening(z: npt.NDArray[np.floating], minimum: float = _MIN_VARIANCE) -> Array:
    """Compute the symmetric whitening (k, k) of samples, ZCA (Bell and Sejnowski 1997).

    Args:
        z: Samples, shape (n, k).
        minimum: Value that the covariance's lower eigenvalues count as.
    """
    sizes, axes = np.linalg.eigh(np.cov(z, rowvar=False))
    return np.asarray(axes / np.sqrt(np.maximum(sizes, minimum)) @ axes.T)


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


class Scaling(NamedTuple):
    """The scaling of a student's inputs: clip((x - mean) scale) mixing."""

    mean: Array  # shape (k,)
    scale: Array  # factors, shape (k,), zero for an entry that is not read
    mixing: Array | None = None  # whitening, shape (k, k), which scales up small differences

    def mix_inputs(self, obs: Single) -> Single:
        """Compute the inputs of a network, shape (..., k).

        Args:
            obs: Observations, shape (..., k).
        """
        mean, scale = self.mean.astype(np.float32), self.scale.astype(np.float32)
        z: Single = np.clip((obs - mean) * scale, -_CLIP, _CLIP)
        return z if self.mixing is None else z @ self.mixing.astype(np.float32)


def compute_scaling(
    drives: Sequence[Demonstrations], layout: Sequence[ObservationEntry], needs: Sequence[str]
) -> Scaling:
    """Compute the scaling of a student's inputs from drives.

    Args:
        drives: Demonstrations.
        layout: Entries of the observation.
        needs: Entries that the teacher reads.
    """
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
    plain = Scaling(mean, np.where(is_read, compute_scale(spread), 0.0))
    return plain._replace(mixing=compute_whitening(plain.mix_inputs(x)))


@dataclass(frozen=True)
class DistillConfig:
    """The configuration of a student and its training.

    The auxiliary loss is that of the teacher's inputs that a student with memory does not see:
    squared errors in standard deviations, where the loss of zero actions counts 1.
    Raises ValueError for a number out of range, cells beside traces, or `told` without memory.
    """

    rounds: int = 7  # of driving and learning; in the first one the teacher drives
    epochs: int = 12  # over all drives in a round; in the last one three times as many
    cells: int = 0  # of a GRU, 0 for none
    hidden: tuple[int, ...] = (64, 64)  # sizes of the dense layers
    learning_rate: float = 3e-3  # of Adam, which falls to a fiftieth in each round
    noise: float = 0.02  # largest standard deviation of the noise on the teacher's actions
    seed: int = 0  # of weights and episodes
    batch: int = 16  # episodes of a batch, for a student with memory
    auxiliary_weight: float = 0.0  # weight of predicting the teacher's inputs it cannot see
    traces: int = 0  # SiLU units in front of the moving averages; 0: no averages

    def __post_init__(self) -> None:
        sizes = self.rounds, self.epochs, self.batch, *self.hidden
        if min(sizes) < 1 or min(self.cells, self.traces, self.seed) < 0:
            rule = "rounds, epochs and sizes are 1 at least, cells, traces and seed 0"
            raise ValueError(f"{rule}: {self}")
        if not (self.learning_rate > 0.0 and self.noise >= 0.0 and self.auxiliary_weight >= 0.0):
            raise ValueError(f"learning_rate is above zero, noise and told not below: {self}")
        if self.cells and self.traces:
            raise ValueError(f"a student has cells or traces, got {self.cells} and {self.traces}")
        if self.auxiliary_weight and not (self.cells or self.traces):
            raise ValueError("a student without memory has nothing to say: told is for those with")

    def describe(self) -> dict[str, object]:
        """Collect all numbers but the seed, in JSON types; cards call `auxiliary_weight` told."""
        numbers = asdict(self) | {"hidden": list(self.hidden)}
        numbers["told"] = numbers.pop("auxiliary_weight")
        return {name: value for name, value in numbers.items() if name != "seed"}


class _TraceLayer(nn.Module):
    """The inputs and SiLU units, with the moving averages of all over some times (steps).

    The inputs and their averages are whitened, by `mean` and `mixing`: small differences of two of
    them say how a sensor changes.
    """

    mean: torch.Tensor
    mixing: torch.Tensor

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

    def forward(
        self, z: torch.Tensor, state: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
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

    def fit_whitening(self, drives: Sequence[Demonstrations], scaling: Scaling) -> None:
        """Fit the whitening of inputs and their averages on drives."""
        outputs, size = [], len(self.mean)
        with torch.no_grad():
            for demo in drives:
                linear_part = self(torch.from_numpy(scaling.mix_inputs(demo.obs)))[0][..., :size]
                outputs.append(linear_part[torch.from_numpy(demo.is_valid)][::_SAMPLE_STRIDE])
        linear = torch.cat(outputs).numpy()
        self.mean.copy_(torch.from_numpy(linear.mean(0)))
        self.mixing.copy_(torch.from_numpy(compute_whitening(linear, _MIN_TRACE_VARIANCE)))

    def cell(self, mixing: Array) -> MovingAverages:
        """Make the runtime's layer for inputs that `Scaling.mixing` mixes first, shape (k, k)."""
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
def _compute_weights(
    times: tuple[float, ...], first: int, steps: int
) -> tuple[torch.Tensor, torch.Tensor]:
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
        self.traces = _TraceLayer(inputs, config.traces) if config.traces else None
        memory_size = self.traces.size if self.traces else config.cells
        sizes = [memory_size or inputs, *config.hidden, width]
        self.dense = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        head_inputs = config.cells or sizes[-2] if config.auxiliary_weight else 0
        self.auxiliary_head = nn.Linear(head_inputs, n_privileged) if head_inputs else None
        self.recurrent = bool(memory_size)

    def forward(
        self, z: torch.Tensor, state: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Compute actions and auxiliary outputs (B, T, m + q), and the next state.

        Args:
            z: Inputs, shape (B, T, k).
            state: State from the last call; None at the start.
        """
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

    def network(self, scaling: Scaling) -> Network:
        """Convert the student to a network of plain observations without auxiliary outputs.

        Args:
            scaling: Scaling of the inputs.
        """
        mean, scale, mixing = scaling
        mixing = np.eye(len(mean)) if mixing is None else mixing
        numbers = [parameter.detach().numpy() for parameter in self.dense.parameters()]
        weights, biases, cells = numbers[::2], numbers[1::2], list[MemoryLayer]()
        if self.traces:
            cells.append(self.traces.cell(mixing))
            weights[0], biases[0] = self.traces.convert_weights(weights[0], biases[0])
        elif self.cell:  # weights of the inputs and of the state, then both biases
            weight_in, *rest = (x.detach().numpy() for x in self.cell.parameters())
            cells.append(RecurrentCell("gru", weight_in @ mixing, *rest))
        else:
            weights[0] = weights[0] @ mixing
        return Network(mean, scale, weights, biases, "silu", clip=_CLIP, cells=cells)
