"""Whitening of a network's inputs, moving averages by torch, and memory as an env's observation.

`TraceLayer` is the runtime's `MovingAverages` for training, by whole episodes. `MemoryObservation`
serves algorithms without memory, `CompactObservation` networks with memory on a linear scenario.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.task import AGE_CAP, ObservationEntry, make_space
from ...estimators.learned.forward import MovingAverages
from ...estimators.learned.network import Network

with require_extra("train", "training needs torch"):
    import torch
    from torch import nn

_SAMPLE_STRIDE = 7  # every so many steps one is a sample for a whitening
_MIN_VARIANCE = 1e-4  # least variance of a mixture of means, for `compute_whitening`
_TIMES = (3, 10, 30, 100, 300)
"""Times of the means in steps; of 10 ms each: from the motors' lag to half a drive."""
_BLOCK = 50  # steps whose means are one product of matrices
_MIN_SHARE = 1e-300  # of the earlier means, in place of 0 at the first step, for the logarithm
_SILENT = ("accel_", "wheel_", "roll_rate", "gps_X", "gps_Y", "gps_speed", "gps_satellites")
"""First parts of entries that the linear scenarios drown in noise, or that are constant there."""
_OFFSET, RATE, _AGE = "camera_y_l", "camera_y_l_rate", "camera_age"
MAX_AGE = 1.0  # s, at which ages are capped


_Single = npt.NDArray[np.float32]


def compute_scale(spread: Any, minimum: float = 1e-9) -> Array:
    """Compute the inverse of each standard deviation, zero where nothing varies.

    Args:
        spread: Standard deviations, shape (k,).
        minimum: Deviation below which an input counts as constant.

    Returns:
        Factors, shape (k,).
    """
    return np.where(spread > minimum, 1.0 / np.maximum(spread, minimum), 0.0)


def compute_whitening(z: Any, minimum: float) -> Array:
    """Compute the symmetric matrix that makes the samples' covariance the identity.

    This is ZCA whitening (Bell and Sejnowski 1997), of eigenvalues that are not below a minimum.

    Args:
        z: Samples, shape (n, k).
        minimum: Minimum of the covariance's eigenvalues.

    Returns:
        Matrix, shape (k, k).
    """
    sizes, axes = np.linalg.eigh(np.cov(z, rowvar=False))
    return np.asarray(axes / np.sqrt(np.maximum(sizes, minimum)) @ axes.T)


class TraceLayer(nn.Module):
    """The inputs and SiLU units, with the moving averages of all.

    The inputs and their averages are whitened: `mean` is subtracted, and `mixing` multiplies. A
    small difference of two of them often has most information: it says how a sensor changes.

    Args:
        inputs: Number of inputs.
        n_silu: Number of SiLU units.
        times: Steps of the moving averages.
    """

    def __init__(self, inputs: int, n_silu: int, times: Sequence[float] = _TIMES) -> None:
        super().__init__()
        self.inputs, self.times = inputs, tuple(times)
        self.unit = nn.Linear(inputs, n_silu)
        n_linear = inputs * (1 + len(self.times))
        self.mean: torch.Tensor
        self.register_buffer("mean", torch.zeros(n_linear))
        self.mixing: torch.Tensor
        self.register_buffer("mixing", torch.eye(n_linear))

    @property
    def size(self) -> int:
        """Size of the output: inputs and their averages, then SiLU units and theirs."""
        return (self.inputs + self.unit.out_features) * (1 + len(self.times))

    def forward(self, z: Any, state: Any = None) -> tuple[Any, Any]:
        """Compute units and averages of inputs whose episodes began together.

        Args:
            z: Inputs, shape (B, T, k).
            state: Averages and number of steps, shape (B, times, units + 1); None at the start.

        Returns:
            Units and averages (B, T, size), and the next state.
        """
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

    def fit_whitening(self, samples: Sequence[tuple[Any, Any]]) -> None:
        """Fit the whitening of inputs and their averages.

        Args:
            samples: Inputs (B, T, k) and masks (B, T) of the steps that count.
        """
        outputs, size = [], len(self.mean)
        with torch.no_grad():
            for z, mask in samples:
                linear_part = self(torch.from_numpy(z))[0][..., :size]
                outputs.append(linear_part[torch.from_numpy(mask)][::_SAMPLE_STRIDE])
        linear = torch.cat(outputs).numpy()
        self.mean.copy_(torch.from_numpy(linear.mean(0)))
        self.mixing.copy_(torch.from_numpy(compute_whitening(linear, _MIN_VARIANCE)))

    def cell(self, mixing: Array) -> MovingAverages:
        """Make the runtime's layer for inputs that are mixed first.

        Args:
            mixing: `Scaling.mixing` of the inputs, which the layer's weights take in, shape (k, k).

        Returns:
            Layer of plain NumPy arrays.
        """
        silu_weights = self.unit.weight.detach().numpy() @ mixing
        bias = np.concatenate([np.zeros(self.inputs), self.unit.bias.detach().numpy()])
        weights = np.concatenate([mixing, silu_weights])
        return MovingAverages(weights, bias, self.unit.out_features, self.times)

    def convert_weights(self, weight: Array, bias: Array) -> tuple[Array, Array]:
        """Convert the next layer's weights for the output of `cell`.

        That output is in the order of times, inputs before SiLU units, without whitening.

        Args:
            weight: Weights, shape (m, size).
            bias: Biases, shape (m,).

        Returns:
            Weights, shape (m, size), and biases, shape (m,).
        """
        size, times = len(self.mean), 1 + len(self.times)
        linear = weight[:, :size] @ self.mixing.numpy().astype(np.float64).T
        bias = bias - linear @ self.mean.numpy()
        parts = [block.reshape(len(bias), times, -1) for block in (linear, weight[:, size:])]
        return np.concatenate(parts, -1).reshape(len(bias), -1), bias


@functools.cache
def _compute_weights(times: tuple[float, ...], first: int, steps: int) -> tuple[Any, Any]:
    """Compute the weights of a block's steps (times, T, T) and of earlier averages (times, T).

    They solve the recursion m_t = m_(t-1) + a_t (u_t - m_(t-1)) of `MovingAverages`, with the share
    a_t = max(1 / steps so far, 1 - exp(-1 / time)): u_s has the weight a_s prod (1 - a_r) over
    r = s + 1, ..., t.
    """
    ages = first + 1.0 + np.arange(steps)
    shares = np.maximum(1.0 / ages, -np.expm1(-1.0 / np.array(times))[:, None])
    left = np.log(np.maximum(1.0 - shares, _MIN_SHARE)).cumsum(-1)
    since = left[:, :, None] - left[:, None, :]  # `left`: log of what is left of earlier averages
    new = np.tril(np.exp(np.minimum(since, 0.0))) * shares[:, None, :]
    new, old = new.astype(np.float32), np.exp(left).astype(np.float32)
    return torch.from_numpy(new), torch.from_numpy(old)


class Mixing(NamedTuple):
    """The whitening of memory features x: (x - mean) mixing."""

    mean: Array  # shape (k,)
    mixing: Array  # symmetric matrix, shape (k, k)

    def adapt_to_mixed(self, network: Network) -> Network:
        """Adapt a network of plain x to mixed x.

        Args:
            network: Network of plain x.

        Returns:
            Network of mixed x.
        """
        first = network.weights[0] @ np.linalg.inv(self.mixing)
        bias = network.biases[0] + network.weights[0] @ self.mean
        return _replace_first_layer(network, first, bias)

    def adapt_to_plain(self, network: Network) -> Network:
        """Adapt a network of mixed x to plain x.

        Args:
            network: Network of mixed x.

        Returns:
            Network of plain x.
        """
        first = network.weights[0] @ self.mixing
        return _replace_first_layer(network, first, network.biases[0] - first @ self.mean)


def _replace_first_layer(network: Network, weights: Array, biases: Array) -> Network:
    """Replace weights (m, k) and biases (m,) of a network's first dense layer."""
    all_weights, all_biases = [weights, *network.weights[1:]], [biases, *network.biases[1:]]
    return replace(network, weights=all_weights, biases=all_biases)


class MemoryObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """A vector env whose observations (N, k) are the inputs of a network's dense layers.

    Args:
        env: Vector env that resets a row in the step that ends it, with the network's observation.
        network: Network with memory.
        mixing: Whitening of the observations, None for none.
    """

    def __init__(
        self, env: VectorEnv[Any, Any, Any], network: Network, mixing: Mixing | None = None
    ) -> None:
        super().__init__(env)
        names = [f"memory_{i}" for i in range(network.dense.inputs)]
        self.layout = tuple(ObservationEntry(name, "-", -np.inf, np.inf) for name in names)
        self.single_observation_space = make_space(self.layout)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._network, self._state = network, np.zeros((env.num_envs, network.memory))
        self._mixing = mixing and Mixing(mixing.mean, mixing.mixing.astype(np.float32))
        self._last = np.zeros(self.observation_space.shape or (), np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Reset the rows; those that a `reset_mask` leaves out keep their memory and observation.

        Args:
            seed: Seeds of the inner env.
            options: Options of the inner env.

        Returns:
            Observations of all rows, and infos.
        """
        mask = np.array((options or {}).get("reset_mask", np.ones(self.num_envs, np.bool_)))
        obs, infos = self.env.reset(seed=seed, options=options)
        new_state, updated = np.zeros_like(self._state[mask]), self._last.copy()
        updated[mask] = self._read(obs[mask], new_state)
        self._state[mask], self._last = new_state, updated
        return updated.copy(), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the inner env and compute the observations, `final_obs` of the infos too.

        Args:
            actions: Actions, shape (N, width).

        Returns:
            Observations, rewards, terminated, truncated and infos.
        """
        obs, rewards, terminated, truncated, infos = self.env.step(actions)
        over = terminated | truncated
        if over.any():
            last = np.full(len(over), None)
            final_obs = self._read(np.stack(infos["final_obs"][over]), self._state[over])
            for i, final in zip(np.flatnonzero(over), final_obs, strict=True):
                last[i] = final
            infos = infos | {"final_obs": last}
            self._state[over] = 0.0
        self._last = self._read(obs, self._state)
        return self._last.copy(), rewards, terminated, truncated, infos

    def _read(self, obs: Any, state: Any) -> Any:
        """Compute observations (N, k), float32; the state (N, memory) is updated."""
        x = self._network.compute_features(obs.astype(np.float64), state)
        if self._mixing is None:
            return x.astype(np.float32)
        return (x - self._mixing.mean).astype(np.float32) @ self._mixing.mixing


def measure_mixing(
    env: VectorEnv[Any, Any, Any], network: Network, drive: Callable[[Any], Any], seed: int
) -> Mixing:
    """Measure the whitening in a network's own drives, one episode of each row.

    Args:
        env: Vector env, as for `MemoryObservation`.
        network: Network with memory.
        drive: Function from the inputs of its dense layers to actions.
        seed: Seed of the first row.

    Returns:
        Mean and whitening of the dense layers' inputs.
    """
    wrapped, collected = MemoryObservation(env, network), []
    obs, _ = wrapped.reset(seed=seed)
    running, step = np.ones(env.num_envs, np.bool_), 0
    while running.any():
        if step % _SAMPLE_STRIDE == 0:
            collected.append(obs[running])
        obs, _, terminated, truncated, _ = wrapped.step(drive(obs))
        running, step = running & ~(terminated | truncated), step + 1
    x = np.concatenate(collected).astype(np.float64)
    return Mixing(x.mean(0), compute_whitening(x, _MIN_VARIANCE))


class CompactObservation(VectorWrapper[Any, Any, Any, Any, Any]):
    """A vector env whose observations networks learn from more easily.

    The lateral offset varies over metres and is measured to a millimetre. It becomes its mean rate
    between the last two pictures, zero until there are two. With the pictures' ages that is the
    same information, but for the first picture's. Ages end at `MAX_AGE`; entries that begin as in
    `_SILENT` and the references are left out.

    Args:
        env: Vector env of a linear scenario.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(env)
        base: Any = env.unwrapped
        inner = base.layout
        self._period: float = base.control_period * base.dt
        excluded = (*_SILENT, "beta_ref", "gamma_ref")
        chosen = [i for i, entry in enumerate(inner) if not entry.name.startswith(excluded)]
        names = [inner[i].name for i in chosen]
        self._columns = np.array(chosen)
        self._ages = [i for i, name in enumerate(names) if name.endswith("_age")]
        self._offset = names.index(_OFFSET) if _OFFSET in names else None
        self._at = names.index(_AGE) if _AGE in names else None
        rate = ObservationEntry(RATE, "m/s", -100.0, 100.0)
        self.layout = tuple(rate if inner[i].name == _OFFSET else inner[i] for i in chosen)
        self.single_observation_space = make_space(self.layout)
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)
        self._last = np.full((3, env.num_envs), AGE_CAP)  # offset, its rate, age of the picture

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[_Single, dict[str, Any]]:
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

    def step(self, actions: Any) -> tuple[_Single, Any, Any, Any, dict[str, Any]]:
        """Step the inner env and compute the observations.

        Args:
            actions: Actions, shape (N, width).

        Returns:
            Observations, shape (N, k), rewards, terminated, truncated and infos.
        """
        obs, *rest = self.env.step(actions)
        return self._read(obs), *rest

    def _read(self, obs: _Single) -> _Single:
        """Compute compact observations (N, k) of the inner env's."""
        x = obs[:, self._columns]
        if self._offset is not None and self._at is not None:
            x[:, self._offset] = self._compute_rate(x[:, self._offset], x[:, self._at])
        x[:, self._ages] = np.minimum(x[:, self._ages], MAX_AGE)
        return x

    def _compute_rate(self, offset: _Single, age: _Single) -> Any:
        """Compute the offset's mean rate between the last two pictures (m/s), shape (N,)."""
        before, rate, aged = self._last
        between = aged + self._period - age  # from the last picture to this one
        new = between > 0.5 * self._period
        known = new & (aged < AGE_CAP)
        rate = np.where(known, (offset - before) / np.where(known, between, 1.0), rate)
        rate = np.where(age < AGE_CAP, np.where(new & ~known, 0.0, rate), 0.0)
        self._last = np.stack([offset, rate, age])
        return rate
