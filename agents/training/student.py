"""The student of a distillation: its network, and one round of learning.

The loss is what the error of an action adds to the cost of the rest of the drive, by the Riccati
matrix of the teacher's design, over the cost of the episode: the score's logarithm, linearised.
"""

import itertools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ...envs.backend.extras import extra
from ...estimators.learned.memory import Cell, Memory
from ...estimators.learned.network import Network
from .traces.drives import CLIP, Drives, Scaling, Single
from .traces.layer import TraceLayer

with extra("train", "distillation needs torch"):
    import torch
    from torch import nn

WINDOW = 50  # steps through which the gradient goes back in time
SAMPLES = 512  # steps of a batch without memory
LONGER = 3  # times as many epochs in the last round
Batch = tuple[Any, Any, Any, Any, Any, bool]
"""Mixed observations (B, T, k), labels (B, T, m), what is told (B, T, q), weights (B, T),
curvatures (B, m, m), and whether it begins the episodes."""


@dataclass(frozen=True)
class Course:
    """How a student learns.

    rounds: of driving and learning, the first one with the teacher at the wheel. epochs: passes
    over all drives in a round, `LONGER` times as many in the last one. cells: of a GRU; traces:
    bent units of `Traces`; neither for a student without memory. hidden: sizes of the dense layers.
    learning_rate: of Adam, falling to a fiftieth in each round. noise: largest standard deviation
    of what shakes the teacher's actions. seed: of weights and episodes. batch: episodes, for a
    student with memory. told: how much the squared errors count of what a student with memory has
    to say, all that the teacher reads and it does not see, in standard deviations, where the errors
    of doing nothing count 1.

    Raises ValueError for a number out of range, cells and traces, or something to tell without.
    """

    rounds: int = 7
    epochs: int = 12
    cells: int = 0
    hidden: tuple[int, ...] = (64, 64)
    learning_rate: float = 3e-3
    noise: float = 0.02
    seed: int = 0
    batch: int = 16
    told: float = 0.0
    traces: int = 0

    def __post_init__(self) -> None:
        sizes = self.rounds, self.epochs, self.batch, *self.hidden
        if min(sizes) < 1 or min(self.cells, self.traces, self.seed) < 0:
            raise ValueError(
                f"rounds, epochs and sizes are 1 at least, cells, traces and seed 0: {self}"
            )
        if not (self.learning_rate > 0.0 and self.noise >= 0.0 and self.told >= 0.0):
            raise ValueError(f"learning_rate is above zero, noise and told not below: {self}")
        if self.cells and self.traces:
            raise ValueError(f"a student has cells or traces, got {self.cells} and {self.traces}")
        if self.told and not (self.cells or self.traces):
            raise ValueError("a student without memory has nothing to say: told is for those with")

    def described(self) -> dict[str, Any]:
        """All numbers but the seed, in JSON types."""
        found = asdict(self) | {"hidden": list(self.hidden)}
        del found["seed"]
        return found

    @property
    def window(self) -> int:
        """Steps through which the gradient goes back in time; through traces all of them."""
        return sys.maxsize if self.traces else WINDOW


class Student(nn.Module):
    """A GRU or traces, if there are any, and dense layers behind, on mixed observations.

    told: so many more numbers, linear in what the cells, or behind traces the last layer but one,
    hold, are of use in training alone.
    """

    def __init__(self, inputs: int, width: int, course: Course, told: int = 0) -> None:
        super().__init__()
        self.cell = nn.GRU(inputs, course.cells, batch_first=True) if course.cells else None
        self.traces = TraceLayer(inputs, course.traces) if course.traces else None
        remembered = self.traces.size if self.traces else course.cells
        sizes = [remembered or inputs, *course.hidden, width]
        self.dense = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        self.tell = nn.Linear(course.cells or sizes[-2], told) if course.told else None
        self.recurrent = bool(remembered)

    def forward(self, z: Any, state: Any = None) -> tuple[Any, Any]:
        """(actions and what is told (B, T, m + q), the next state) of inputs (B, T, k)."""
        memory = self.cell or self.traces
        if memory is not None:
            z, state = memory(z, state)
        held = z
        for layer in self.dense[:-1]:
            z = nn.functional.silu(layer(z))
        more = [] if self.tell is None else [self.tell(held if self.cell else z)]
        return torch.cat([self.dense[-1](z), *more], dim=-1), state

    def whiten(self, drives: Sequence[Drives], scaling: Scaling) -> None:
        """Mix what traces hold plain, so that nothing of it is correlated on these drives."""
        if self.traces is not None:
            self.traces.whiten([(scaling.mixed(each.obs), each.weights > 0.0) for each in drives])

    def network(self, scaling: Scaling) -> Network:
        """The same function of plain observations, by NumPy."""
        numbers = {name: value.detach().numpy().copy() for name, value in self.named_parameters()}
        names = ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
        first = "cell.weight_ih_l0" if self.cell else "dense.0.weight"
        cells: list[Memory] = []
        if self.traces:
            cells.append(self.traces.cell(scaling.mixing))
            layer = [numbers[f"dense.0.{part}"] for part in ("weight", "bias")]
            numbers["dense.0.weight"], numbers["dense.0.bias"] = self.traces.behind(*layer)
        else:
            numbers[first] = numbers[first] @ scaling.mixing
        if self.cell:
            cells.append(Cell("gru", *(numbers[f"cell.{name}"] for name in names)))
        dense = range(len(self.dense))
        return Network(
            scaling.mean,
            scaling.scale,
            [numbers[f"dense.{i}.weight"] for i in dense],
            [numbers[f"dense.{i}.bias"] for i in dense],
            "silu",
            clip=CLIP,
            cells=cells,
        )


def _joined(parts: Sequence[Single]) -> Any:
    return torch.from_numpy(np.concatenate(parts))


class _Episodes:
    """Some episodes of a few lessons at once, cut into windows that the state goes through."""

    def __init__(self, drives: Sequence[Drives], scaling: Scaling, course: Course) -> None:
        self.drives, self.scaling = drives, scaling
        self.batch, self.window = course.batch, course.window
        self.everyone = [(i, j) for i, each in enumerate(drives) for j in range(len(each.costs))]
        longest = max(each.weights.shape[1] for each in drives)
        self.most = -(-len(self.everyone) // self.batch) * -(-longest // self.window)

    def __iter__(self) -> Iterator[Batch]:
        names = ("obs", "labels", "told", "weights")
        for chosen in torch.split(torch.randperm(len(self.everyone)), self.batch):
            rows = [self.everyone[int(i)] for i in chosen]
            longest = max(self.drives[i].weights.shape[1] for i, _ in rows)
            arrays = [
                np.zeros((len(rows), longest, *getattr(self.drives[0], name).shape[2:]), np.float32)
                for name in names
            ]
            for row, (i, j) in enumerate(rows):
                length = self.drives[i].weights.shape[1]
                for array, name in zip(arrays, names, strict=True):
                    array[row, :length] = getattr(self.drives[i], name)[j]
            S = torch.from_numpy(np.stack([self.drives[i].curvature for i, _ in rows]))
            arrays[0] = self.scaling.mixed(arrays[0])
            for at in range(0, longest, self.window):
                z, y, q, w = (torch.from_numpy(a[:, at : at + self.window]) for a in arrays)
                yield z, y, q, w, S, at == 0


class _Steps:
    """`SAMPLES` single steps of all drives at once, as if each were an episode."""

    def __init__(self, drives: Sequence[Drives], scaling: Scaling, _: Course) -> None:
        there = [each.weights > 0.0 for each in drives]
        self.lesson = torch.cat([torch.full((int(t.sum()),), i) for i, t in enumerate(there)])
        self.curvatures = torch.from_numpy(np.stack([each.curvature for each in drives]))
        pairs = list(zip(drives, there, strict=True))
        self.x = _joined([scaling.mixed(each.obs[t]) for each, t in pairs])
        self.y = _joined([each.labels[t] for each, t in pairs])
        self.q = _joined([each.told[t] for each, t in pairs])
        self.w = _joined([each.weights[t] for each, t in pairs])
        self.most = -(-len(self.w) // SAMPLES)

    def __iter__(self) -> Iterator[Batch]:
        for i in torch.split(torch.randperm(len(self.w)), SAMPLES):
            S = self.curvatures[self.lesson[i]]
            yield *(each[i, None] for each in (self.x, self.y, self.q, self.w)), S, True


def fitted(
    model: nn.Module, drives: Sequence[Drives], scaling: Scaling, course: Course, epochs: int
) -> float:
    """Train a model on drives; the loss of the last epoch. Raises FloatingPointError where it
    diverges.

    model: gives actions and state as a `Student`; `recurrent` says whether steps belong together.
    """
    optimiser = torch.optim.Adam(model.parameters(), course.learning_rate)
    batches = (_Episodes if model.recurrent else _Steps)(drives, scaling, course)
    falling = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.02, epochs * batches.most)
    count = sum(len(each.costs) for each in drives)
    length = sum(int((each.weights > 0.0).sum()) for each in drives) / count
    idle = sum(each.missed_by_zero for each in drives) / count
    step, total, state = 0, 0.0, None
    for _ in range(epochs):
        total = 0.0
        for z, y, q, w, S, begins in batches:
            out, state = model(z, None if begins else state)
            state = None if state is None else state.detach()
            there = w > 0.0
            error = out[..., : y.shape[-1]] - y
            added = torch.einsum("bti,bij,btj->bt", error, S, error) * w
            loss = length * added.sum() / there.sum().clamp(min=1)  # of an episode
            if course.told:
                missed = (out[..., y.shape[-1] :] - q)[there].square().mean(-1).sum()
                loss = loss / idle + course.told * missed / there.sum().clamp(min=1)
            optimiser.zero_grad()
            loss.backward()
            norm = nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            if not torch.isfinite(loss + norm):
                raise FloatingPointError(f"the loss is {loss.item()} at step {step}")
            optimiser.step()
            falling.step()
            step += 1
            total += float(added.detach().sum())
    return total / count
