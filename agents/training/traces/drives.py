"""What a student learns from, drives, and what it makes of their observations: scaled, and without
correlation."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ....envs.task.observation import ObservationEntry
from .mixing import compute_scale, compute_whitening

Array = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]

CLIP = 8.0  # of an input, scaled
UNREAD = ("gps_X", "gps_Y", "gps_satellites")
"""Where the car is says nothing of how to hold it."""
_MIN_VARIANCE = 1e-3  # variance, of what varies by 1, that a mixture of inputs has at least
_EARLY, _MEDIAN = 16.0, 50.0  # percentiles of an age


class Demonstrations(NamedTuple):
    """Episodes of a lesson, oldest step first: observations (N, T, k), the teacher's actions
    (N, T, m), what it reads that is not in them (N, T, q), and the weights of the actions' errors
    (N, T), zero where an episode was over. curvature: (m, m), of a lesson. costs: (N,)."""

    obs: Single
    labels: Single
    privileged: Single
    weights: Single
    curvature: Single
    costs: Array

    @property
    def zero_loss(self) -> float:
        """The loss of a student that does nothing, all episodes together."""
        losses = np.einsum("nti,ij,ntj->nt", self.labels, self.curvature, self.labels)
        return float((losses * self.weights).sum())


class Scaling(NamedTuple):
    """What a student makes of an observation: clip((x - mean) scale) mixing.

    mean, scale: (k,), scale zero of what is not read. mixing: (k, k), symmetric; what varies
    little while its parts vary much, as course less heading, then varies as much as they do.
    """

    mean: Array
    scale: Array
    mixing: Array

    def mix_inputs(self, obs: Single) -> Single:
        """Inputs of a `Student`, of observations (..., k)."""
        mixing = self.mixing.astype(np.float32)
        return normalise_inputs(obs, self.mean, self.scale) @ mixing


def compute_scaling(
    drives: Sequence[Demonstrations],
    layout: Sequence[ObservationEntry],
    needs: Sequence[str],
    usual_ages: bool = True,
) -> Scaling:
    """How a student sees what these drives see.

    needs: what the teacher reads. A student that has all of it reads nothing else, of which it
    would only learn noise; one that has less reads whatever varies, but for `UNREAD`. usual_ages:
    an age is scaled as it varies while packets come, and lies at the clip before the first and long
    after the last one; else by its deviation, as everything.
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
    """Observations (..., k) as a student reads them."""
    return np.clip((obs - mean.astype(np.float32)) * scale.astype(np.float32), -CLIP, CLIP)
