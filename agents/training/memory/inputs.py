"""Compact observations of a linear env for networks with memory."""

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ....envs.task.observation import AGE_CAP, ObservationEntry, make_space

Single = npt.NDArray[np.float32]

SILENT = ("accel_", "wheel_", "roll_rate", "gps_X", "gps_Y", "gps_speed", "gps_satellites")
"""Entries of sensors that the linear scenarios drown in noise, or that stand still there."""
OFFSET, RATE, AGE = "camera_y_l", "camera_y_l_rate", "camera_age"
MAX_AGE = 1.0  # s, from which on an age is no older


class CompactObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """A vector env whose observations networks learn from more easily.

    The lateral offset varies over metres and is measured to a millimetre. It becomes its mean rate
    between the last two pictures, zero until there are two. With the pictures' ages that is the
    same information, but for the first picture's. Ages end at `MAX_AGE`; entries that begin as in
    `SILENT` and the references are left out.

    Args:
        env: Vector env of a linear scenario.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        base: Any = env.unwrapped
        inner = base.layout
        self._period: float = base.control_period * base.dt
        excluded = (*SILENT, "beta_ref", "gamma_ref")
        chosen = [i for i, entry in enumerate(inner) if not entry.name.startswith(excluded)]
        names = [inner[i].name for i in chosen]
        self._columns = np.array(chosen)
        self._ages = [i for i, name in enumerate(names) if name.endswith("_age")]
        self._offset = names.index(OFFSET) if OFFSET in names else None
        self._at = names.index(AGE) if AGE in names else None
        rate = ObservationEntry(RATE, "m/s", -100.0, 100.0)
        self.layout = tuple(rate if inner[i].name == OFFSET else inner[i] for i in chosen)
        self.single_observation_space = make_space(self.layout)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._last = np.full((3, env.num_envs), AGE_CAP)  # offset, its rate, age of the picture

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Single, dict[str, Any]]:
        """Reset all rows.

        Args:
            seed: Seeds of the inner env.
            options: Options of the inner env, without `reset_mask`.

        Returns:
            Observations, shape (N, k), and infos.

        Raises:
            ValueError: Only some rows are to be reset.
        """
        if "reset_mask" in (options or {}):
            raise ValueError("rates of the lateral offset begin together: reset all rows at once")
        obs, infos = self.env.reset(seed=seed, options=options)
        return self._read(obs), infos

    def step(self, actions: Any) -> tuple[Single, Any, Any, Any, dict[str, Any]]:
        """Step the inner env and compute the observations.

        Args:
            actions: Actions, shape (N, width).

        Returns:
            Observations, shape (N, k), rewards, terminated, truncated and infos.
        """
        obs, *rest = self.env.step(actions)
        return self._read(obs), *rest

    def _read(self, obs: Single) -> Single:
        x = obs[:, self._columns]
        if self._offset is not None and self._at is not None:
            x[:, self._offset] = self._compute_rate(x[:, self._offset], x[:, self._at])
        x[:, self._ages] = np.minimum(x[:, self._ages], MAX_AGE)
        return x

    def _compute_rate(self, offset: Single, age: Single) -> Any:
        before, rate, aged = self._last
        between = aged + self._period - age  # from the last picture to this one
        new = between > 0.5 * self._period
        known = new & (aged < AGE_CAP)
        rate = np.where(known, (offset - before) / np.where(known, between, 1.0), rate)
        rate = np.where(age < AGE_CAP, np.where(new & ~known, 0.0, rate), 0.0)
        self._last = np.stack([offset, rate, age])
        return rate
