"""`DeviceVectorEnv`: many cars on torch tensors, with gradients; results stay on the device."""

import os
import shutil
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from gymnasium.vector import AutoresetMode

from ..engine.batch import IntArray, NumbaEngine
from ..engine.batch_env import BatchEnv
from ..engine.config import EpisodeConfig
from ..engine.layout import P
from ..engine.step import get_start_variant
from ..numerics.packed import read
from ..numerics.torch_backend import torch
from ..sensors.link import Link
from ..sensors.slow import SLOW_NAMES
from .base import StepEnds, Tensor, TensorVectorEnv
from .torch_rows import NO_TENSORS, DeviceRows, split_inputs
from .torch_sensors import PacketCapacity
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
        self, num_envs: int = 1, device: str | torch.device = "cpu",
        dtype: str | torch.dtype = "float64",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP, *, compile: bool = False,
        grad: bool = False, **arguments: Any,
    ) -> None:  # fmt: skip
        super().__init__(num_envs, device, dtype, autoreset_mode, arguments, is_uniform=False)
        self.engine = NumbaEngine(self.config, num_envs)  # on the host, which resets
        compiler = os.environ.get("CXX", "g++")  # where torch looks for it
        if compile and self.device.type == "cpu" and shutil.which(compiler) is None:
            text = f"compile=True needs a C++ compiler on the CPU, and there is no {compiler!r}"
            warnings.warn(f"{text}: ticks are not compiled", RuntimeWarning, stacklevel=2)
            compile = False
        self._compile, self._grad, config = compile, grad, self.config
        self._kind = get_start_variant(config.base.start)
        self._links: _Links = {i: set() for i, name in enumerate(SLOW_NAMES) if name in config.slow}
        self._links, capacities = self._collect_links(self.configs)
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
        return links, {i: _compute_capacity(list(known), n) for i, known in links.items()}

    def _build(self, capacities: dict[int, PacketCapacity]) -> None:
        """Build the step with these capacities, and copy all rows to the device."""
        kinds = self.dtype, self.dtype if self._grad else torch.float32, self.device, self._compile
        self._step = TorchStep(self.config, capacities, *kinds)
        start = TorchReset(self._step) if self._grad else None
        self._rows = DeviceRows(self.engine.arrays, capacities, self.device, self.dtype, start)

    def _start_rows(self, chosen: IntArray, seeds: dict[int, int], options: dict[str, Any]) -> None:
        """Reset rows on the host, and copy them to the device."""
        inputs, host = NO_TENSORS, self.engine
        if self._grad:
            place = self.config.base, self.num_envs, self._rows.params
            options, inputs = split_inputs(options, *place)
        configs, index = self._make_configs(options, chosen)
        links, capacities = self._collect_links(configs)
        needs_rebuild = capacities != self._rows.capacities
        if needs_rebuild and self._grad and len(chosen) < self.num_envs:
            reason = "these sensors take more room than any before"
            raise ValueError(f"{reason}: reset all rows, or the others would lose their gradients")
        if needs_rebuild:
            self._rows.download(host.arrays)
        self._restart_rows(chosen, configs, index, seeds)
        self._links = links
        if needs_rebuild:
            self._build(capacities)
        self._rows.upload(host.arrays, chosen, self.configs, inputs)
        self._has_over = bool(self._rows.state.over.any())

    def _advance(self, actions: Any) -> StepEnds:
        """Step all rows; those that were over are reset instead."""
        rows = self._rows
        commands = self._parse_actions(actions, self.dtype, self._grad)
        with torch.set_grad_enabled(self._grad and torch.is_grad_enabled()):
            state, outcome = self._step(rows.params, rows.keys, rows.state, commands)
        flags = torch.stack((outcome.refused.any(), state.over.any()))
        refused, ended = flags.tolist()  # the one time the device is waited for
        if refused and self.config.on_bad_action != "fail":
            self._refuse_actions(outcome.refused.nonzero()[:, 0].tolist(), commands)
        over_rows = rows.state.over if self._has_over else None
        rows.state, rows.outcome, self._has_over = state, outcome, ended
        ends = StepEnds(outcome.rewards, outcome.terminated, outcome.truncated)
        if over_rows is not None:
            self._start_rows(over_rows.nonzero()[:, 0].cpu().numpy(), {}, {})
        if ended and self._mode == AutoresetMode.SAME_STEP:
            ends = ends._replace(final_obs=outcome.obs, final_report=state.report.clone())
            self._start_rows(state.over.nonzero()[:, 0].cpu().numpy(), {}, {})
        return ends

    def detach(self) -> None:
        """Cut the graph at the state, from earlier actions and states; parameters stay attached."""
        self._rows.detach()

    def _get_outputs(self) -> tuple[Tensor, Tensor, Tensor]:
        return self._rows.outcome.obs, self._rows.state.report, self._rows.state.over

    def _get_record(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        outcome = self._rows.outcome
        return outcome.rows, outcome.packets, outcome.done, outcome.delivered

    def _get_motion(self) -> Tensor:
        return self._rows.state.motion

    def tensors(self) -> tuple[TorchState, StepOutcome]:
        """Get the state of the rows and the newest step's outcome, the env's own tensors."""
        return self._rows.state, self._rows.outcome

    def get_state(self) -> Any:
        """Copy the state of all rows, which `StabilityVectorEnv.set_state` takes too."""
        self._rows.download(self.engine.arrays)
        return super().get_state()

    def _restore(self, snapshot: Mapping[str, Any]) -> None:
        links, capacities = self._collect_links(snapshot["configs"])
        BatchEnv.set_state(self, snapshot)
        self._links = links
        self._build(capacities)


def _compute_capacity(links: Sequence[Link], n: int) -> PacketCapacity:
    """Compute the capacity for sensors with any of some links, in env-steps of n ticks."""
    return PacketCapacity(
        max(-int(-n // link.period) for link in links),
        max(link.max_in_flight for link in links),
        2 if any(link.duplicate > 0.0 for link in links) else 1,
    )
