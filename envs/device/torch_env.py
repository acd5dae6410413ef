"""`DeviceVectorEnv`: many cars on torch tensors, whose results stay on the device."""

from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv

from ..engine.config import EpisodeConfig
from ..engine.layout import FLAGS, P
from ..engine.step import get_start_variant
from ..numerics.packed import read
from ..numerics.torch_backend import torch
from ..sensors.link import Link
from ..sensors.slow import SLOW_NAMES
from ..validation import (
    check_choice,
    check_int,
    format_rows,
    parse_autoreset_mode,
    parse_reset_mask,
    short_repr,
)
from ..vector import StabilityVectorEnv
from .base import (
    DeviceRows,
    check_arguments,
    is_compile_used,
    parse_device,
    parse_device_actions,
    parse_dtype,
    read_infos,
    refuse_actions,
)
from .gradients import NO_TENSORS, split_inputs
from .torch_outputs import PacketCapacity, compute_capacity
from .torch_step import StepOutcome, TorchReset, TorchState, TorchStep

Tensor = torch.Tensor
Infos = dict[str, Any]
_Links = dict[int, set[Link]]  # by the sensor's place


class DeviceVectorEnv(VectorEnv[Any, Any, Any]):
    """`num_envs` environments on a device, `StabilityVectorEnv` in tensors, seed by seed.

    In float64 an env-step agrees with the other engines' from the same state to 1e-9, and so does a
    second of stable driving. In float32 a step of 10 ms is within 1e-5 m/s, 1e-6 rad/s and 1e-4 m
    (30 m from the start), a second within 1e-4 m/s, 2e-5 rad/s and 5e-4 m.
    `DeviceVectorEnv.make(id, num_envs=N, device="cuda")` builds that of an id. Needs torch, of the
    extra `train`.

    ## Tensors
    Observations are (N, k) float32, rewards (N,), `terminated` and `truncated` (N,) of bool, infos
    (N,) of every row; all are new ones each time. The first `ticks_done` (N,) of `rows`
    (N, n, FAST_WIDTH) and `delivered` (N,) of `packets` (N, max, PACKET_WIDTH) make the record.
    Actions are tensors (N, width) on the device, a bad one as in the vector env. A step waits for
    the device once, to learn whether one was bad and whether an episode ended.

    ## Reset
    The compiled engine resets on the host, from each row's own generator; its draws are copied.
    Options are those of `StabilityVectorEnv`, but all rows have a plant of one kind: tyres, roll,
    lags, small angles and whether a driver reacts to the car are those of the env's own scenario.

    ## Gradients
    With `grad=True` observations, rewards, infos, `rows`, `packets` and `motion` have gradients to
    actions and to tensors () or (N,) in `reset`'s options: `state`, by the names of a `Motion`, and
    `parameters`, by those of a `Vehicle`, true ones in place of the seed's draws. Observations are
    then of `dtype`, and actions are not rounded. A row that is reset starts a graph of its own. At
    a limit (actuators, grip, actions, the cost's cap) the gradients are those of one side; they do
    not contain the times of failures, ends and arrivals. An env-step in which a row's numbers
    overflow has none.

    Raises TypeError or ValueError for an argument out of place and a device that is not there.

    Args:
        num_envs: Number of environments N.
        device: "cpu", "cuda", "cuda:1", ...
        dtype: "float64" or "float32".
        autoreset_mode: "NextStep", "SameStep" or "Disabled", as of `StabilityVectorEnv`.
        compile: Whether a tick and the step's end go through `torch.compile`, which takes minutes
            once, and on the CPU needs a C++ compiler (without one it warns and does not).
        engine: "torch", or "cuda", which makes a `CudaVectorEnv`: one kernel a step.
        grad: Whether results have gradients.
        arguments: Arguments of `StabilityEnv`.
    """

    def __new__(cls, *arguments: Any, engine: str = "torch", **named: Any) -> Any:
        """Make the environments of the chosen engine."""
        check_choice("engine", engine, ("torch", "cuda"))
        if engine == "torch":
            return super().__new__(cls)
        if unsupported := [name for name in ("compile", "grad") if named.pop(name, False)]:
            raise ValueError(f"{unsupported[0]} is of engine='torch', not of 'cuda'")
        from .cuda_env import CudaVectorEnv

        return CudaVectorEnv(*arguments, **named)

    def __init__(
        self,
        num_envs: int = 1,
        device: Any = "cpu",
        dtype: Any = "float64",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        *,
        compile: bool = False,
        engine: str = "torch",
        grad: bool = False,
        **arguments: Any,
    ) -> None:
        check_arguments(arguments)
        self.num_envs = check_int("num_envs", num_envs, "environments")
        self._mode = parse_autoreset_mode(autoreset_mode)
        self.device, self.dtype = parse_device(device), parse_dtype(dtype)
        self._use_compile = is_compile_used(compile, self.device)
        self._grad = grad
        self._host = host = StabilityVectorEnv(num_envs, **arguments)  # it resets the rows
        self.layout, self.control_period = host.layout, host.control_period
        self.reference = host.reference
        self.metadata = {**host.metadata, "autoreset_mode": self._mode}
        self.single_observation_space = host.single_observation_space
        self.single_action_space = host.single_action_space
        self.observation_space = host.observation_space
        self.action_space = host.action_space
        self._started = self._has_over = False
        self._kind = get_start_variant(host.config.base.start)
        slow = host.config.slow
        self._links: _Links = {i: set() for i, name in enumerate(SLOW_NAMES) if name in slow}
        self._links, capacities = self._collect_links(host.configs)
        self._build(capacities)

    @classmethod
    def make(cls, env_id: str, num_envs: int = 1, **arguments: Any) -> "DeviceVectorEnv":
        """Make `num_envs` environments of a registered `env_id`; `arguments` replace its own."""
        spec = gym.spec(env_id)
        if spec.vector_entry_point != "sideslip.envs.vector:StabilityVectorEnv":
            raise ValueError(f"{env_id} has no environment on the device")
        return cls(num_envs, **{**spec.kwargs, **arguments})

    def _collect_links(
        self, configs: Iterable[EpisodeConfig]
    ) -> tuple[_Links, dict[int, PacketCapacity]]:
        """Collect the slow sensors' links, these configs' and those before, and their capacity."""
        configs = list({id(config): config for config in configs}.values())
        for config in configs:
            if config.scenario.steering in ("trace", "wander"):
                label = f"{config.scenario.name!r}: no {config.scenario.steering}"
                raise ValueError(f"{label} is driven on a device")
            kind = get_start_variant(config.start)
            if kind != self._kind:
                reason = f"scenario {config.scenario.name!r} has {kind}, not {self._kind}"
                raise ValueError(f"on a device all rows have one kind of plant: {reason}")
        links = {
            sensor: previous | {read(config.start.params, P.slow[sensor]) for config in configs}
            for sensor, previous in self._links.items()
        }
        n = self.control_period
        return links, {i: compute_capacity(list(known), n) for i, known in links.items()}

    def _build(self, capacities: dict[int, PacketCapacity]) -> None:
        """Build the step with these capacities, and copy all rows to the device."""
        host = self._host
        switches = read(host.config.base.start.switches, FLAGS)
        obs_dtype = self.dtype if self._grad else torch.float32
        tensor_args = self.dtype, obs_dtype, self.device, self._use_compile
        n, bounds = self.control_period, host.config.bounds
        self._step = step = TorchStep(self._kind, n, capacities, switches, bounds, *tensor_args)
        start = TorchReset(step, tuple(capacities)) if self._grad else None
        self._rows = DeviceRows(host, capacities, self.device, self.dtype, start)

    def reset(
        self, *, seed: Any = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Tensor, Infos]:
        """Start episodes; seeds, options and errors are those of `StabilityVectorEnv`."""
        host, reset_options = self._host, dict(options or {})
        mask = reset_options.get("reset_mask")
        if isinstance(mask, torch.Tensor):
            mask = reset_options["reset_mask"] = mask.cpu().numpy()
        chosen = np.flatnonzero(parse_reset_mask(mask, self.num_envs))
        inputs = NO_TENSORS
        if self._grad:
            place = host.config.base, self.num_envs, self._rows.params
            reset_options, inputs = split_inputs(reset_options, *place)
        episode_options = {k: value for k, value in reset_options.items() if k != "reset_mask"}
        configs, _ = host.apply_options(episode_options, chosen.tolist())
        links, capacities = self._collect_links(configs)
        needs_rebuild = capacities != self._rows.capacities
        if needs_rebuild and self._grad and len(chosen) < self.num_envs:
            reason = "these sensors take more room than any before"
            raise ValueError(f"{reason}: reset all rows, or the others would lose their gradients")
        if needs_rebuild:
            self._rows.download(host)
        host.reset(seed=seed, options=reset_options)
        self._links = links
        if needs_rebuild:
            self._build(capacities)
        self._rows.upload(host, chosen, inputs)
        self._started, self._has_over = True, bool(self._rows.state.over.any())
        return self._rows.outcome.obs.clone(), self._make_infos()

    def step(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Infos]:
        """Hold each row's action for one control period."""
        if not self._started:
            raise ResetNeeded("no episode was started: call reset() first")
        if self._has_over and self._mode == AutoresetMode.DISABLED:
            over = format_rows(self._rows.state.over.nonzero()[:, 0].tolist())
            raise ResetNeeded(f"the episode is over in {over}: call reset() with a reset_mask")
        config, rows = self._host.config, self._rows
        fail = config.on_bad_action == "fail"
        commands = parse_device_actions(
            actions, self.num_envs, config.action_width, fail, self.device, self.dtype, self._grad
        )
        with torch.set_grad_enabled(self._grad and torch.is_grad_enabled()):
            state, outcome = self._step(rows.params, rows.keys, rows.state, commands)
        flags = torch.stack((outcome.refused.any(), state.over.any()))
        refused, ended = flags.tolist()  # the one time the device is waited for
        if refused and not fail:
            refuse_actions(commands, outcome.refused)
        over_rows = rows.state.over if self._has_over else None
        rows.state, rows.outcome, self._has_over = state, outcome, ended
        infos: Infos = {}
        if over_rows is not None:
            self._reset_rows(over_rows)
        if ended and self._mode == AutoresetMode.SAME_STEP:
            infos = {"final_obs": outcome.obs, "final_info": self._make_infos()}
            infos |= {f"_{key}": state.over.clone() for key in infos}
            self._reset_rows(state.over)
            self._has_over = False
        infos |= self._make_infos()
        ends = outcome.terminated, outcome.truncated
        return rows.outcome.obs.clone(), outcome.rewards, *ends, infos

    def detach(self) -> None:
        """Cut the graph at the state, from earlier actions and states; parameters stay attached."""
        self._rows.detach()

    def _reset_rows(self, over: Tensor) -> None:
        """Reset these rows (N,) without options."""
        chosen = over.nonzero()[:, 0].cpu().numpy()
        self._host.reset_rows(chosen)
        self._host.over[chosen] = False
        self._rows.upload(self._host, chosen)

    def _make_infos(self) -> Infos:
        """Make the numbers of `info` of every row, (N,) each."""
        return read_infos(self._rows.state.report.clone())

    @property
    def rows(self) -> Tensor:
        """Fast rows of the newest record, (N, n, FAST_WIDTH)."""
        return self._rows.outcome.rows.permute(2, 0, 1)

    @property
    def packets(self) -> Tensor:
        """Packets of the newest record, (N, max, PACKET_WIDTH)."""
        return self._rows.outcome.packets.permute(2, 0, 1)

    @property
    def ticks_done(self) -> Tensor:
        """Number of `rows` of the newest record, (N,)."""
        return self._rows.outcome.done

    @property
    def delivered(self) -> Tensor:
        """Number of `packets` of the newest record, (N,)."""
        return self._rows.outcome.delivered

    @property
    def motion(self) -> Tensor:
        """True `Motion` of each row now, (N, len(Motion)), in SI units."""
        return self._rows.state.motion.T.clone()

    def tensors(self) -> tuple[TorchState, StepOutcome]:
        """Get the state of the rows and the newest step's outcome, the env's own tensors."""
        return self._rows.state, self._rows.outcome

    @property  # type: ignore[misc]  # without a setter, as in the vector env
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Each row's generator, on the host, which draws one 64-bit key a reset."""
        return self._host.np_random

    def get_state(self) -> dict[str, Any]:
        """Copy the state of all rows, which `StabilityVectorEnv.set_state` takes too."""
        self._rows.download(self._host)
        return self._host.get_state()

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of this env, or of a `StabilityVectorEnv` with the same arguments.

        Raises ValueError for one of other rows or sizes, or of another kind of plant.
        """
        if not isinstance(snapshot, Mapping):
            raise ValueError(f"a snapshot of this engine is a mapping, got {short_repr(snapshot)}")
        links, capacities = self._collect_links(snapshot["configs"])
        self._host.set_state(snapshot)
        self._links = links
        self._build(capacities)
        self._started, self._has_over = snapshot["started"], bool(self._rows.state.over.any())
