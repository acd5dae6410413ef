"""Kinds of memory as small networks, which learn to imitate a teacher with a filter.

Each reads normalised observations step by step and has a state (B, ...), zero where an episode
begins. In a linear scenario an action costs S_j (u - u*)^2 more than the optimum, with u* the
action of the optimal filter's estimate. So imitation on the student's own drives minimises its
cost, and the student needs memory, not exploration.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from gymnasium.vector import VectorObservationWrapper
from gymnasium.vector.utils import batch_space

from ...envs.numerics import require_extra
from ...envs.record import Array
from ...envs.task import AGE_CAP, ObservationEntry, make_space
from ...envs.validation import check_choice
from ..env_info import CarVectorEnv
from .distill import DistillTask, RoundResult, imitate
from .student import (
    Demonstrations,
    DistillConfig,
    Scaling,
    Single,
    compute_scaling,
    compute_whitening,
    make_dense_layers,
)

with require_extra("train", "memories need torch"):
    import torch
    from torch import Tensor, nn

_HIDDEN = (64, 64)  # of the layers behind a memory
_MIN_STD = 1e-2  # least standard deviation of a mixture of inputs, for `compute_whitening`
_FADE_STEPS = (2.0, 300.0)  # in which the first and the last of a new linear memory fade to 1/e
_SILENT = ("accel_", "wheel_", "roll_rate", "gps_X", "gps_Y", "gps_speed", "gps_satellites")
"""First parts of entries that the linear scenarios drown in noise, or that are constant there."""
_OFFSET, RATE, _AGE = "camera_y_l", "camera_y_l_rate", "camera_age"
MAX_AGE = 1.0  # s, at which ages are capped


class CompactObservation(VectorObservationWrapper[Single, Single, Single, npt.NDArray[Any]]):
    """A vector env whose observations networks learn from more easily.

    The lateral offset varies over metres and is measured to a millimetre. It becomes its mean rate
    between the last two pictures, zero until there are two. With the pictures' ages that is the
    same information, but for the first picture's. Ages end at `MAX_AGE`; entries that begin as in
    `_SILENT` and the references are left out.

    Args:
        env: Vector env of a linear scenario, whose rows do not end and begin in the same step.
    """

    def __init__(self, env: CarVectorEnv) -> None:
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

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Single, dict[str, Any]]:
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
        return super().reset(seed=seed, options=options)

    def observations(self, observations: Single) -> Single:
        """Compute compact observations.

        Args:
            observations: Observations of the inner env, shape (N, all).

        Returns:
            Observations, shape (N, k).
        """
        x = observations[:, self._columns]
        if self._offset is not None and self._at is not None:
            x[:, self._offset] = self._compute_rate(x[:, self._offset], x[:, self._at])
        x[:, self._ages] = np.minimum(x[:, self._ages], MAX_AGE)
        return x

    def _compute_rate(self, offset: Single, age: Single) -> Array:
        """Compute the offset's mean rate between the last two pictures (m/s), shape (N,)."""
        before, rate, aged = self._last
        between = aged + self._period - age  # from the last picture to this one
        new = between > 0.5 * self._period
        known = new & (aged < AGE_CAP)
        rate = np.where(known, (offset - before) / np.where(known, between, 1.0), rate)
        rate = np.where(age < AGE_CAP, np.where(new & ~known, 0.0, rate), 0.0)
        self._last = np.stack([offset, rate, age])
        return rate


_State = Tensor | None
_Output = tuple[Tensor, _State]


class _MemoryNetwork(nn.Module):
    """Whitened inputs, a memory and layers for the action.

    `fresh_index` is the entry that says whether a packet arrived, `delay_steps` the control periods
    between a packet's capture and its arrival.
    """

    rate: ClassVar[float] = 1e-2  # learning rate of Adam
    recurrent: ClassVar[bool] = True
    mix: Tensor

    def __init__(self, inputs: int, fresh_index: int, delay_steps: int) -> None:
        super().__init__()
        self.inputs, self.fresh_index, self.delay_steps = inputs, fresh_index, delay_steps
        self.register_buffer("mix", torch.eye(inputs))
        self.head: nn.Module = make_dense_layers(self._build_memory() + inputs, *_HIDDEN, 1)

    def _build_memory(self) -> int:
        """Build the memory, and return the width of the output of `_update_memory`."""
        return 0

    def _update_memory(self, z: Tensor, arrived: Tensor, state: _State) -> _Output:
        """Compute memory (B, T, m) and next state by inputs (B, T, k) and arrivals (B, T, 1)."""
        return z[..., :0], state

    def fit_scaling(
        self,
        drives: Sequence[Demonstrations],
        layout: Sequence[ObservationEntry],
        needs: Sequence[str],
    ) -> Scaling:
        """Fit the scaling and whitening on drives, as `Student.fit_scaling` but for the mixing."""
        mixed = compute_scaling(drives, layout, needs, usual_ages=False)
        scaling = mixed._replace(mixing=None)  # memories mix by themselves
        inputs = np.concatenate([scaling.mix_inputs(demo.obs) for demo in drives])
        whitening = compute_whitening(inputs.reshape(-1, self.inputs), _MIN_STD**2)
        self.mix.copy_(torch.from_numpy(whitening))
        return scaling

    def forward(self, z: Tensor, state: _State = None) -> _Output:
        """Compute actions (B, T, 1) and the next state of normalised observations (B, T, k)."""
        arrived, z = (z[..., self.fresh_index, None] > 0.0).to(z.dtype), z @ self.mix
        known, state = self._update_memory(z, arrived, state)
        return self.head(torch.cat([known, z], -1)), state


class _LastObservation(_MemoryNetwork):
    """No memory: layers on the last observation."""

    recurrent = False


class _FrameStack(_MemoryNetwork):
    """The last 32 observations side by side."""

    rate, count = 5e-3, 32

    def _build_memory(self) -> int:
        return (self.count - 1) * self.inputs

    def _update_memory(self, z: Tensor, arrived: Tensor, state: _State) -> _Output:
        before = z.new_zeros(len(z), self.count - 1, self.inputs) if state is None else state
        frames = torch.cat([before, z], 1)
        past = frames[:, :-1].unfold(1, self.count - 1, 1).flatten(2)
        return past, frames[:, 1 - self.count :]


class _Gru(_MemoryNetwork):
    """A gated recurrent unit of 48 cells."""

    size = 48

    def _build_memory(self) -> int:
        self.cell = nn.GRU(self.inputs, self.size, batch_first=True)
        return self.size

    def _update_memory(self, z: Tensor, arrived: Tensor, state: _State) -> _Output:
        known, state = self.cell(z, None if state is None else state[None])
        return known, state[0]


class _LinearRnn(_MemoryNetwork):
    """32 complex numbers that rotate and decay: the LRU of Orvieto et al., ICML 2023."""

    size = 32

    def _build_memory(self) -> int:
        first, last = (math.log10(limit) for limit in _FADE_STEPS)
        fades = torch.logspace(first, last, self.size)
        self.fade = nn.Parameter(-torch.log(fades))
        self.turn = nn.Parameter(0.3 * torch.rand(self.size))
        self.read = nn.Linear(self.inputs, 2 * self.size, bias=False)
        return 2 * self.size

    def _compute_powers(self, steps: int) -> Tensor:
        """Compute the factors of 0 to steps - 1 steps on each number, shape (steps, n)."""
        once = torch.complex(-torch.exp(self.fade), self.turn)
        return torch.exp(torch.arange(steps)[:, None] * once)

    def _project_inputs(self, z: Tensor) -> Tensor:
        """Project inputs to (B, T, n), so that white ones give states of one size."""
        unit = torch.sqrt(1.0 - torch.exp(-2.0 * torch.exp(self.fade)))
        return torch.view_as_complex(self.read(z).unflatten(-1, (self.size, 2))) * unit

    def _update_memory(self, z: Tensor, arrived: Tensor, state: _State) -> _Output:
        steps = z.shape[1]
        powers, ages = self._compute_powers(steps + 1), torch.arange(steps)
        past = ages[:, None] - ages
        weights = torch.where(past[..., None] >= 0, powers[past.clamp(min=0)], 0.0)
        known = torch.einsum("tsn,bsn->btn", weights, self._project_inputs(z))
        if state is not None:
            known = known + powers[1:] * state[:, None]
        return torch.view_as_real(known).flatten(2), known[:, -1]


class _Kalman(_LinearRnn):
    """A learned observer of a linear car, for packets that come late.

    Its state is `delay_steps` old and its numbers rotate and decay as the car's modes. At a
    packet's arrival x+ = x + L (y - C x), with y a mix of the inputs; L grows with the time since
    the last packet, as a filter's gain does. The present follows from the inputs since then: equal
    to rewinding and filtering again where gains are constant. The action is linear in it.
    """

    size, outputs = 16, 4
    gain_rise_steps = 10.0  # without a packet, after which gains are half way to their limits

    def __init__(self, inputs: int, fresh_index: int, delay_steps: int) -> None:
        super().__init__(inputs, fresh_index, delay_steps)
        self.head = nn.Linear(2 * self.size + inputs, 1)

    def _build_memory(self) -> int:
        width = super()._build_memory()
        self.measure = nn.Linear(self.inputs, self.outputs)
        self.expect = nn.Parameter(torch.zeros(width, self.outputs))
        self.gains = nn.Parameter(0.1 * torch.randn(2, self.outputs, width))
        return width

    def _update_memory(self, z: Tensor, arrived: Tensor, state: _State) -> _Output:
        n, delay_steps, steps = self.size, self.delay_steps, z.shape[1]
        if state is None:
            state = z.new_zeros(len(z), 2 + delay_steps, n, dtype=torch.complex64)
        since, x, waiting = state[:, 0].real, state[:, 1], state[:, 2:]
        pushes = torch.cat([waiting, self._project_inputs(z)], 1)
        powers, measured = self._compute_powers(delay_steps + 2), self.measure(z)
        has_packet, known = arrived.amax((0, 2)).tolist(), []
        for t in range(steps):
            x, since = powers[1] * x + pushes[:, t], since + 1.0
            if has_packet[t]:
                new = measured[:, t] - torch.view_as_real(x).flatten(1) @ self.expect
                grown = (since / (since + self.gain_rise_steps))[:, :1]
                correction = new @ self.gains[0] + grown * (new @ self.gains[1])
                correction = torch.view_as_complex(correction.unflatten(1, (n, 2)))
                x, since = x + arrived[:, t] * correction, since * (1.0 - arrived[:, t])
            known.append(x)
        now = torch.stack(known, 1) * powers[delay_steps]
        if delay_steps:
            inside = pushes[:, 1:].unfold(1, delay_steps, 1)  # (B, T, n, delay_steps), oldest first
            now = now + torch.einsum("btnk,kn->btn", inside, powers[:delay_steps].flip(0))
        state = torch.cat([torch.complex(since, 0.0 * since)[:, None], x[:, None]], 1)
        state = torch.cat([state, pushes[:, steps:]], 1)
        return torch.view_as_real(now).flatten(2), state


class _Transformer(_MemoryNetwork):
    """Two layers of causal attention over the last 64 steps, with a learned bias for each age."""

    rate, window, layers, width, heads = 3e-3, 64, 2, 32, 2

    def _build_memory(self) -> int:
        width, layers = self.width, range(self.layers)
        self.embed = nn.Linear(self.inputs, width)
        self.attention_inputs = nn.ModuleList(nn.Linear(width, 3 * width) for _ in layers)
        self.attention_outputs = nn.ModuleList(nn.Linear(width, width) for _ in layers)
        self.feedforward = nn.ModuleList(make_dense_layers(width, 64, width) for _ in layers)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2 * self.layers))
        self.bias = nn.Parameter(torch.zeros(self.layers, self.heads, self.window))
        return width

    def _update_memory(self, z: Tensor, arrived: Tensor, state: _State) -> _Output:
        batch, steps, _ = z.shape
        before, width = self.window - 1, self.width
        if state is None:
            state = z.new_zeros(batch, self.layers, before, 2 * width)
        age = torch.arange(steps)[:, None] + before - torch.arange(steps + before)
        visible = (age >= 0) & (age < self.window)
        x, cached = self.embed(z), []
        for i in range(self.layers):
            projected: Any = self.attention_inputs[i](self.norms[2 * i](x))
            query, pair = projected[..., :width], projected[..., width:]
            pairs = torch.cat([state[:, i], pair], 1)
            cached.append(pairs[:, -before:])
            parts = (query, pairs[..., :width], pairs[..., width:])
            q, k, v = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
            bias = torch.where(visible, self.bias[i][:, age.clamp(0, before)], -torch.inf)
            scores = q @ k.mT * (width / self.heads) ** -0.5 + bias
            attended = (scores.softmax(-1) @ v).transpose(1, 2).flatten(2)
            x = x + self.attention_outputs[i](attended)
            x = x + self.feedforward[i](self.norms[2 * i + 1](x))
        return x, torch.stack(cached, 1)


MEMORIES: dict[str, type[_MemoryNetwork]] = {
    "mlp": _LastObservation,
    "frames": _FrameStack,
    "gru": _Gru,
    "linear-rnn": _LinearRnn,
    "kalman": _Kalman,
    "transformer": _Transformer,
}


class _MemoryAgent:
    """A memory as an agent on plain observations."""

    def __init__(self, model: _MemoryNetwork, scaling: Scaling) -> None:
        self.model, self.scaling = model, scaling

    def predict(
        self,
        observation: Single,
        state: _State = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Single, _State]:
        """Compute actions and the next state, with the signature of stable-baselines3."""
        z = torch.from_numpy(self.scaling.mix_inputs(observation))[:, None]
        if state is not None and episode_start is not None and np.any(episode_start):
            state = state.clone()
            state[torch.from_numpy(np.asarray(episode_start))] = 0.0
        with torch.no_grad():
            actions, state = self.model(z, state)
        return actions[:, 0].clamp(-1.0, 1.0).numpy(), state


def train_memory(
    name: str,
    task: DistillTask,
    config: DistillConfig,
    delay_steps: int,
    weight: float = 1.0,
    report: Callable[[RoundResult], None] = lambda _: None,
) -> _MemoryAgent:
    """Train a memory to act as a task's teacher, by DAgger.

    Args:
        name: Key of `MEMORIES`.
        task: Cars and teacher.
        config: Configuration, of which `cells` and `hidden` have no effect.
        delay_steps: Control periods between a packet's capture and its arrival.
        weight: S, the cost of a squared error.
        report: Function that is called after each round.

    Returns:
        Agent of the last round.

    Raises:
        ValueError: The observation does not say whether a packet arrived, or the name is unknown.
    """
    names = [entry.name for entry in task.cars.layout]
    fresh_columns = [i for i, label in enumerate(names) if label.endswith("_fresh")]
    count = len(fresh_columns)
    if count != 1:
        raise ValueError(f"a memory knows one sensor with packets, got {count} in {names}")
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    check_choice("memory", name, MEMORIES)
    model = MEMORIES[name](len(names), fresh_columns[0], delay_steps)

    def make_agent(scaling: Scaling, result: RoundResult) -> _MemoryAgent:
        report(result)
        return _MemoryAgent(model, scaling)

    return imitate(model, [task], config, make_agent, weight)
