"""`DeviceVectorEnv`: many cars on torch tensors, with gradients; results stay on the device."""

import os
import shutil
import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from ..engine.config import EpisodeConfig
from ..engine.layout import P
from ..engine.step import get_start_variant
from ..numerics.packed import read
from ..numerics.torch_backend import torch
from ..sensors.link import Link
from ..sensors.slow import SLOW_NAMES
from ..validation import Mask
from .base import StepEnds, Tensor, TensorVectorEnv
from .gradients import NO_TENSORS, split_inputs
from .torch_rows import DeviceRows
from .torch_sensors import PacketCapacity, compute_capacity
from .torch_step import StepOutcome, TorchReset, TorchState, TorchStep

_Links = dict[int, set[Link]]  # by the sensor's place


class DeviceVectorEnv(TensorVectorEnv):
    """`TensorVectorEnv` by torch's own operations, on any device, with gradients on request.

    In float64 an env-step agrees with the other engines' from the same state to 1e-9, and so does a
    second of stable driving. In float32 a step of 10 ms is within 1e-5 m/s, 1e-6 rad/s and 1e-4 m
    (30 m from the start), a second within 1e-4 m/s, 2e-5 rad/s and 5e-4 m. A step waits for the
    device once, to learn whether an action was bad and whether an episode ended. The compiled
    engine resets on the host, from each row's own generator; its draws are copied. Needs torch, of
    the extra `train`.

    ## Gradients
    With `grad=True` observations, rewards, infos, `rows`, `packets` and `motion` have gradients to
    actions and to tensors () or (N,) in `reset`'s options: `state`, by the names of a `Motion`, and
    `parameters`, by those of a `Vehicle`, true ones in place of the seed's draws. Observations are
    then of `dtype`, else float32, and actions are not rounded. A row that is reset starts a graph
    of its own. At a limit (actuators, grip, actions, the cost's cap) the gradients are those of one
    side; they do not contain the times of failures, ends and arrivals. An env-step in which a row's
    numbers overflow has none.

    Args:
        num_envs: Number of environments N.
        device: "cpu", "cuda", "cuda:1", ...
        dtype: "float64" or "float32".
        autoreset_mode: "NextStep", "SameStep" or "Disabled", as of `StabilityVectorEnv`.
        compile: Whether a tick and the step's end go through `torch.compile`, which takes minutes
            once, and on the CPU needs a C++ compiler (without one it warns and does not).
        grad: Whether results have gradients.
        arguments: Arguments of `StabilityEnv`.

    Raises:
        TypeError: For an argument out of place.
        ValueError: For a value out of place, and a device that is not there.
    """

    def __init__(
        self,
        num_envs: int = 1,
        device: str | torch.device = "cpu",
        dtype: str | torch.dtype = "float64",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        *,
        compile: bool = False,
        grad: bool = False,
        **arguments: Any,
    ) -> None:
        self._init_env(num_envs, device, dtype, autoreset_mode, num_envs, arguments)
        compiler = os.environ.get("CXX", "g++")  # where torch looks for it
        if compile and self.device.type == "cpu" and shutil.which(compiler) is None:
            warnings.warn(
                f"compile=True needs a C++ compiler on the CPU, and there is no {compiler!r}: "
                "ticks are not compiled",
                RuntimeWarning,
                stacklevel=2,
            )
            compile = False
        self._compile, self._grad, config = compile, grad, self._host.config
        self._has_over = False
        self._kind = get_start_variant(config.base.start)
        self._links: _Links = {i: set() for i, name in enumerate(SLOW_NAMES) if name in config.slow}
        self._links, capacities = self._collect_links(self._host.configs)
        self._build(capacities)

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
        host, dtype = self._host, self.dtype
        obs_dtype = dtype if self._grad else torch.float32
        tensor_args = dtype, obs_dtype, self.device, self._compile
        self._step = TorchStep(host.config, capacities, *tensor_args)
        start = TorchReset(self._step) if self._grad else None
        self._rows = DeviceRows(host, capacities, self.device, dtype, start)

    def _start_episodes(self, seed: object, options: dict[str, Any], mask: Mask) -> None:
        """Reset rows on the host, and copy them to the device."""
        host, inputs, chosen = self._host, NO_TENSORS, np.flatnonzero(mask)
        if self._grad:
            place = host.config.base, self.num_envs, self._rows.params
            options, inputs = split_inputs(options, *place)
        configs, _ = host.apply_options(options, chosen.tolist())
        links, capacities = self._collect_links(configs)
        needs_rebuild = capacities != self._rows.capacities
        if needs_rebuild and self._grad and len(chosen) < self.num_envs:
            reason = "these sensors take more room than any before"
            raise ValueError(f"{reason}: reset all rows, or the others would lose their gradients")
        if needs_rebuild:
            self._rows.download(host)
        host.reset(seed=seed, options=options | {"reset_mask": mask})
        self._links = links
        if needs_rebuild:
            self._build(capacities)
        self._rows.upload(host, chosen, inputs)
        self._has_over = bool(self._rows.state.over.any())

    def _advance(self, actions: Any) -> StepEnds:
        """Step all rows; those that were over are reset instead."""
        rows = self._rows
        commands = self._parse_actions(actions, self.dtype, self._grad)
        with torch.set_grad_enabled(self._grad and torch.is_grad_enabled()):
            state, outcome = self._step(rows.params, rows.keys, rows.state, commands)
        flags = torch.stack((outcome.refused.any(), state.over.any()))
        refused, ended = flags.tolist()  # the one time the device is waited for
        if refused and self._host.config.on_bad_action != "fail":
            self._refuse_actions(commands, outcome.refused)
        over_rows = rows.state.over if self._has_over else None
        rows.state, rows.outcome, self._has_over = state, outcome, ended
        ends = StepEnds(outcome.rewards, outcome.terminated, outcome.truncated)
        if over_rows is not None:
            self._reset_rows(over_rows)
        if ended and self._mode == AutoresetMode.SAME_STEP:
            ends = ends._replace(final_obs=outcome.obs, final_report=state.report.clone())
            self._reset_rows(state.over)
            self._has_over = False
        return ends

    def detach(self) -> None:
        """Cut the graph at the state, from earlier actions and states; parameters stay attached."""
        self._rows.detach()

    def _reset_rows(self, over: Tensor) -> None:
        """Reset these rows (N,) without options."""
        chosen = over.nonzero()[:, 0].cpu().numpy()
        self._host.reset_rows(chosen)
        self._host.over[chosen] = False
        self._rows.upload(self._host, chosen)

    def _get_outputs(self) -> tuple[Tensor, Tensor, Tensor]:
        return self._rows.outcome.obs, self._rows.state.report, self._rows.state.over

    def _get_record(self, part: str) -> Tensor:
        record: Tensor = getattr(self._rows.outcome, part)
        return record

    def _get_motion(self) -> Tensor:
        return self._rows.state.motion

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

    def _restore(self, snapshot: Mapping[str, Any]) -> None:
        links, capacities = self._collect_links(snapshot["configs"])
        self._host.set_state(snapshot)
        self._links = links
        self._build(capacities)
        self._started, self._has_over = snapshot["started"], bool(self._rows.state.over.any())
