"""The student of a distillation: its network, what it learns from, and one round of learning.

The loss is what the error of an action adds to the cost of the rest of the drive, by the Riccati
matrix of the teacher's design, over the cost of the episode: the score's logarithm, linearised.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ...envs.backend.extras import extra
from ...envs.task.observation import Entry
from ...estimators.learned.memory import Cell
from ...estimators.learned.network import Network

with extra("train", "distillation needs torch"):
    import torch
    from torch import nn

Array = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]

CLIP = 8.0  # standard deviations of an input
WINDOW = 50  # steps through which the gradient goes back in time
BATCH = 16  # episodes
UNREAD = ("gps_X", "gps_Y", "gps_satellites")
"""Where the car is says nothing of how to hold it."""


class Drives(NamedTuple):
    """Episodes of a lesson, oldest step first: observations (N, T, k), the teacher's actions
    (N, T, m), and the weights of their errors (N, T), zero where an episode was over. curvature:
    (m, m), of a lesson. costs: (N,)."""

    obs: Single
    labels: Single
    weights: Single
    curvature: Single
    costs: Array


@dataclass(frozen=True)
class Course:
    """How a student learns.

    rounds: of driving and learning, the first one with the teacher at the wheel. epochs: passes
    over all drives of a round. cells: of a GRU, 0 for a student without memory. hidden: sizes of
    the dense layers. learning_rate: of Adam, falling to a tenth in each round. noise: largest
    standard deviation of what shakes the teacher's actions. seed: of weights and episodes.

    Raises ValueError for a number out of range.
    """

    rounds: int = 4
    epochs: int = 6
    cells: int = 32
    hidden: tuple[int, ...] = (32,)
    learning_rate: float = 2e-3
    noise: float = 0.02
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.rounds, self.epochs, *self.hidden) < 1 or min(self.cells, self.seed) < 0:
            raise ValueError(f"rounds, epochs and sizes are 1 at least, cells and seed 0: {self}")
        if not (self.learning_rate > 0.0 and self.noise >= 0.0):
            raise ValueError(f"learning_rate is above zero, noise not below: {self}")

    def described(self) -> dict[str, Any]:
        """All numbers but the seed, in JSON types."""
        found = asdict(self) | {"hidden": list(self.hidden)}
        del found["seed"]
        return found


class Student(nn.Module):
    """A GRU, if there is one, and dense layers behind it, on normalised observations."""

    def __init__(self, inputs: int, width: int, course: Course) -> None:
        super().__init__()
        self.cell = nn.GRU(inputs, course.cells, batch_first=True) if course.cells else None
        sizes = [course.cells or inputs, *course.hidden, width]
        self.dense = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))

    def forward(self, z: Any, state: Any = None) -> tuple[Any, Any]:
        """(actions (B, T, m), the next state) of inputs (B, T, k)."""
        if self.cell is not None:
            z, state = self.cell(z, state)
        for layer in self.dense[:-1]:
            z = nn.functional.silu(layer(z))
        return self.dense[-1](z), state

    def network(self, mean: Array, scale: Array) -> Network:
        """The same function of plain observations, by NumPy."""
        numbers = {name: value.detach().numpy().copy() for name, value in self.named_parameters()}
        dense = range(len(self.dense))
        names = ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
        return Network(
            mean,
            scale,
            [numbers[f"dense.{i}.weight"] for i in dense],
            [numbers[f"dense.{i}.bias"] for i in dense],
            "silu",
            clip=CLIP,
            cells=[Cell("gru", *(numbers[f"cell.{name}"] for name in names))] if self.cell else [],
        )


def scaling_of(drives: Sequence[Drives], layout: Sequence[Entry]) -> tuple[Array, Array]:
    """Mean and scale of each entry, zero of what never varies and of `UNREAD`."""
    seen = np.concatenate([each.obs[each.weights > 0.0] for each in drives])
    mean, spread = seen.mean(0, np.float64), seen.std(0, dtype=np.float64)
    reads = (spread > 1e-9) & ~np.isin([entry.name for entry in layout], UNREAD)
    return mean, np.where(reads, 1.0 / np.maximum(spread, 1e-9), 0.0)


def _batches(drives: Sequence[Drives], mean: Array, scale: Array) -> Iterator[tuple[Any, ...]]:
    """All drives once, `BATCH` episodes of a few lessons at once, in a random order: normalised
    observations, labels, weights and curvatures (B, m, m)."""
    everyone = [(i, j) for i, each in enumerate(drives) for j in range(len(each.costs))]
    for chosen in torch.split(torch.randperm(len(everyone)), BATCH):
        rows = [everyone[int(i)] for i in chosen]
        longest = max(drives[i].weights.shape[1] for i, _ in rows)
        x, y, w = (
            np.zeros((len(rows), longest, *getattr(drives[0], name).shape[2:]), np.float32)
            for name in ("obs", "labels", "weights")
        )
        for row, (i, j) in enumerate(rows):
            length = drives[i].weights.shape[1]
            x[row, :length], y[row, :length] = drives[i].obs[j], drives[i].labels[j]
            w[row, :length] = drives[i].weights[j]
        z = np.clip((x - mean.astype(np.float32)) * scale.astype(np.float32), -CLIP, CLIP)
        S = np.stack([drives[i].curvature for i, _ in rows])
        yield tuple(torch.from_numpy(each) for each in (z, y, w, S))


def fitted(
    model: Student, drives: Sequence[Drives], mean: Array, scale: Array, course: Course
) -> float:
    """Train a model on drives; the loss of the last epoch. Raises FloatingPointError where it
    diverges."""
    optimiser = torch.optim.Adam(model.parameters(), course.learning_rate)
    batches = -(-sum(len(each.costs) for each in drives) // BATCH)
    longest = max(each.weights.shape[1] for each in drives)
    most = course.epochs * batches * -(-longest // WINDOW)
    falling = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.1, most)
    step, total, count = 0, 0.0, 0
    for _ in range(course.epochs):
        total, count = 0.0, 0
        for z, y, w, S in _batches(drives, mean, scale):
            state = None
            for at in range(0, z.shape[1], WINDOW):
                here = slice(at, at + WINDOW)
                actions, state = model(z[:, here], state)
                state = None if state is None else state.detach()
                error = actions - y[:, here]
                added = torch.einsum("bti,bij,btj->bt", error, S, error) * w[:, here]
                loss = added.sum() / (w[:, here] > 0.0).sum().clamp(min=1)
                optimiser.zero_grad()
                loss.backward()
                norm = nn.utils.clip_grad_norm_(model.parameters(), 1.0)
                if not torch.isfinite(loss + norm):
                    raise FloatingPointError(f"the loss is {loss.item()} at step {step}")
                optimiser.step()
                falling.step()
                step += 1
                total += float(added.detach().sum())
            count += len(z)
    return total / count
