"""Demonstrations that a student learns from, and the scaling and whitening of its inputs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ....envs.record import Array
from ....envs.task.observation import ObservationEntry
from .mixing import compute_scale, compute_whitening

Single = npt.NDArray[np.float32]

CLIP = 8.0  # of an input, scaled
UNREAD = ("gps_X", "gps_Y", "gps_satellites")
"""Entries without information for control, as they only locate the car."""
_MIN_VARIANCE = 1e-3  # variance, of what varies by 1, that a mixture of inputs has at least
_EARLY, _MEDIAN = 16.0, 50.0  # percentiles of an age


class Demonstrations(NamedTuple):
    """Episodes of a task, oldest step first.

    Attributes:
        obs: Observations, shape (N, T, k).
        labels: The teacher's actions, shape (N, T, m).
        privileged: The teacher's inputs that the observations lack, shape (N, T, q).
        weights: Weights of the actions' errors, shape (N, T), zero after an episode's end.
        curvature: Weight of an action's error, shape (m, m).
        costs: Costs J, shape (N,).
    """

    obs: Single
    labels: Single
    privileged: Single
    weights: Single
    curvature: Single
    costs: Array

    @property
    def zero_loss(self) -> float:
        """Loss of a student whose actions are zero, summed over episodes."""
        losses = np.einsum("nti,ij,ntj->nt", self.labels, self.curvature, self.labels)
        return float((losses * self.weights).sum())


class Scaling(NamedTuple):
    """The scaling of a student's inputs: clip((x - mean) scale) mixing.

    Attributes:
        mean: Means, shape (k,).
        scale: Factors, shape (k,), zero for an entry that is not read.
        mixing: Symmetric whitening, shape (k, k): it scales up what varies little while its parts
            vary much, such as course less heading.
    """

    mean: Array
    scale: Array
    mixing: Array

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
        usual_ages: Whether an age is scaled by its variation while packets come, and clipped before
            the first and long after the last one; else by its deviation.

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
    return np.clip((obs - mean.astype(np.float32)) * scale.astype(np.float32), -CLIP, CLIP)
