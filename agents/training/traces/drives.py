"""What a student learns from, drives, and what it makes of their observations: scaled, and without
correlation."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ....envs.task.observation import Entry
from .mixing import scale_of, whitening

Array = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]

CLIP = 8.0  # of an input, scaled
UNREAD = ("gps_X", "gps_Y", "gps_satellites")
"""Where the car is says nothing of how to hold it."""
_LEAST = 1e-3  # variance, of what varies by 1, that a mixture of inputs has at least
_SOON, _USUAL = 16.0, 50.0  # percentiles of an age


class Drives(NamedTuple):
    """Episodes of a lesson, oldest step first: observations (N, T, k), the teacher's actions
    (N, T, m), what it reads that is not in them (N, T, q), and the weights of the actions' errors
    (N, T), zero where an episode was over. curvature: (m, m), of a lesson. costs: (N,)."""

    obs: Single
    labels: Single
    told: Single
    weights: Single
    curvature: Single
    costs: Array

    @property
    def missed_by_zero(self) -> float:
        """The loss of a student that does nothing, all episodes together."""
        each = np.einsum("nti,ij,ntj->nt", self.labels, self.curvature, self.labels)
        return float((each * self.weights).sum())


class Scaling(NamedTuple):
    """What a student makes of an observation: clip((x - mean) scale) mixing.

    mean, scale: (k,), scale zero of what is not read. mixing: (k, k), symmetric; what varies
    little while its parts vary much, as course less heading, then varies as much as they do.
    """

    mean: Array
    scale: Array
    mixing: Array

    def mixed(self, obs: Single) -> Single:
        """Inputs of a `Student`, of observations (..., k)."""
        mixing = self.mixing.astype(np.float32)
        return normalised(obs, self.mean, self.scale) @ mixing


def scaling_of(
    drives: Sequence[Drives],
    layout: Sequence[Entry],
    needs: Sequence[str],
    usual_ages: bool = True,
) -> Scaling:
    """How a student sees what these drives see.

    needs: what the teacher reads. A student that has all of it reads nothing else, of which it
    would only learn noise; one that has less reads whatever varies, but for `UNREAD`. usual_ages:
    an age is scaled as it varies while packets come, and lies at the clip before the first and long
    after the last one; else by its deviation, as everything.
    """
    x = np.concatenate([each.obs[each.weights > 0.0] for each in drives])
    names = [entry.name for entry in layout]
    there = np.isin(names, needs) if set(needs) <= set(names) else ~np.isin(names, UNREAD)
    mean, spread = x.mean(0, np.float64), x.std(0, dtype=np.float64)
    for i, name in enumerate(names):
        if usual_ages and name.endswith("_age"):
            soon, usual = np.percentile(x[:, i], (_SOON, _USUAL))
            if usual > soon:
                mean[i], spread[i] = usual, usual - soon
    scale = np.where(there, scale_of(spread), 0.0)
    return Scaling(mean, scale, whitening(normalised(x, mean, scale), _LEAST))


def normalised(obs: Single, mean: Array, scale: Array) -> Single:
    """Observations (..., k) as a student reads them."""
    return np.clip((obs - mean.astype(np.float32)) * scale.astype(np.float32), -CLIP, CLIP)
