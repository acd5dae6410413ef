"""`CudaVectorEnv`: many cars in one CUDA kernel a step, with state and resets on the device."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ..engine.config import EpisodeConfig
from ..engine.layout import Z
from ..engine.step import get_start_variant
from ..numerics.torch_backend import torch
from ..validation import (
    check_int,
    format_rows,
    parse_autoreset_mode,
    parse_reset_mask,
    parse_seeds,
    short_repr,
    split_options,
)
from ..vector import StabilityVectorEnv
from .base import (
    check_arguments,
    parse_device,
    parse_device_actions,
    parse_dtype,
    read_infos,
    refuse_actions,
)
from .cuda_kernel import (
    ASKED,
    RUNS,
    WORDS,
    DeviceArrays,
    KernelConstants,
    make_constants,
    make_specification,
    pack_starts,
    read_words,
)
from .cuda_launch import load_kernel
from .cuda_text import SIMULATED

Tensor = torch.Tensor
Infos = dict[str, Any]

_NEW_ARRAYS = ("actions", "rewards", "terminated", "truncated", "final_obs", "final_reports")
"""Arrays that are new in every step; the others stay at their place."""
_TORCH = {np.uint8: torch.uint8, np.int64: torch.int64, np.float32: torch.float32}


class Snapshot(NamedTuple):
    """Snapshot of all rows of a `CudaVectorEnv`."""

    num_envs: int
    constants: KernelConstants
    dtype: torch.dtype
    started: bool
    memory: DeviceArrays


class CudaVectorEnv(VectorEnv[Any, Any, Any]):
    """`num_envs` environments on a GPU, one CUDA thread a row and one kernel a step.

    Equations, noise and episodes are those of `StabilityVectorEnv`, seed by seed. The kernel takes
    the ticks, sensors, packets, observation, cost and resets; keys of new episodes come from each
    row's PCG64 on the device. The host waits only to learn whether an action is bad
    (`on_bad_action="raise"`) or an episode is over ("Disabled"). Needs torch and numba-cuda, of the
    extras `train` and `cuda`; the first env of a kind compiles for half a minute.

    Tensors are as of `DeviceVectorEnv`, new ones each time. With "SameStep" infos have `final_obs`
    and `final_info`, zeros in rows that did not end. Options of reset are those of
    `StabilityVectorEnv`; all rows have a plant of one kind.

    Raises TypeError or ValueError for an argument out of place and a device that is not there,
    MemoryError where the rows do not fit.

    Args:
        num_envs: Number of environments N.
        device: "cuda", "cuda:1", ...; "cpu" in numba's simulator (NUMBA_ENABLE_CUDASIM=1), a few
            rows for tests.
        dtype: "float64", which has the bits of `StabilityVectorEnv`, or "float32".
        autoreset_mode: "NextStep", "SameStep" or "Disabled".
        record: Whether `rows` and `packets` are written.
        arguments: Arguments of `StabilityEnv`.
    """

    def __init__(
        self,
        num_envs: int = 1,
        device: Any = "cuda",
        dtype: Any = "float64",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        *,
        record: bool = False,
        **arguments: Any,
    ) -> None:
        check_arguments(arguments)
        self.num_envs = N = check_int("num_envs", num_envs, "environments")
        self._mode = parse_autoreset_mode(autoreset_mode)
        self.device, self.dtype = parse_device(device), parse_dtype(dtype)
        if (self.device.type == "cpu") != SIMULATED:
            runs = "in numba's simulator on 'cpu'" if SIMULATED else "on a CUDA device"
            raise ValueError(f"engine='cuda' runs {runs}, got {str(device)!r}")
        template = StabilityVectorEnv(1, **arguments)
        self.layout, self.control_period = template.layout, template.control_period
        self.reference, self._config = template.reference, template.config
        self.metadata = {**template.metadata, "autoreset_mode": self._mode}
        self.single_observation_space = template.single_observation_space
        self.single_action_space = template.single_action_space
        self.observation_space = batch_space(self.single_observation_space, N)
        self.action_space = batch_space(self.single_action_space, N)
        self._constants = make_constants(self._config, self._mode.value, record)
        self._real = np.float64 if self.dtype == torch.float64 else np.float32
        sizes = make_specification(self._constants, self._real, N, 1)
        if not SIMULATED:
            check_memory(sizes, N, self.device)
        self._kernel = load_kernel(self._constants, self._real, self.device)
        self._memory = DeviceArrays(*(self._allocate(*spec) for spec in sizes))
        words = np.random.default_rng().integers(0, 2**32, (WORDS, N))
        words[WORDS // 2] |= 1  # PCG64's increment is odd
        self._memory.generators.copy_(torch.as_tensor(words))
        self._memory.bounds.copy_(torch.as_tensor(self._config.bounds))
        self._started = False

    def _allocate(self, kind: Any, shape: tuple[int, ...]) -> Tensor:
        """Allocate zeros of a NumPy type on the device."""
        return torch.zeros(shape, dtype=_TORCH.get(kind, self.dtype), device=self.device)

    def reset(
        self, *, seed: Any = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Tensor, Infos]:
        """Start episodes; seeds, options and errors are those of `StabilityVectorEnv`."""
        N, remaining = self.num_envs, dict(options or {})
        mask = remaining.pop("reset_mask", None)
        mask = parse_reset_mask(mask.cpu().numpy() if isinstance(mask, torch.Tensor) else mask, N)
        seeds = parse_seeds(seed, N)
        if not (self._started or mask.all()):
            raise ResetNeeded("reset all rows first: a reset_mask leaves out some of them")
        configs, start_index = self._make_configs(remaining, mask)
        seeded_rows = [i for i in np.flatnonzero(mask).tolist() if seeds[i] is not None]
        words = read_words([seeding.np_random(seeds[i])[0] for i in seeded_rows])
        self._memory.generators[:, seeded_rows] = torch.as_tensor(words, device=self.device)
        packed, switches = pack_starts([config.start for config in configs])
        self._memory = self._memory._replace(
            which=torch.as_tensor(start_index, device=self.device),
            starts=torch.as_tensor(packed).to(self.device, self.dtype),
            switches=torch.as_tensor(switches, device=self.device),
        )
        self._memory.over[torch.as_tensor(mask, device=self.device)] = ASKED
        self._kernel(N, True, self._memory)
        self._started = True
        return self._memory.obs.clone(), read_infos(self._memory.reports.clone())

    def _make_configs(
        self, options: Mapping[str, Any], mask: Any
    ) -> tuple[Sequence[EpisodeConfig], Any]:
        """Make the starts' configs, that without options first, and each row's index among them."""
        configs, start_index = [self._config.base], np.zeros(self.num_envs, np.int64)
        known: dict[tuple[Any, ...], int] = {}
        for i, row_options in enumerate(split_options(options, self.num_envs) if options else ()):
            key = (*row_options, *map(id, row_options.values()))
            if row_options and mask[i]:
                if key not in known:
                    known[key] = len(configs)
                    configs.append(self._config.apply_options(row_options))
                start_index[i] = known[key]
        for config in configs[1:]:
            kind, width = get_start_variant(config.start), len(config.start.params)
            if kind != self._constants.kind or width != self._constants.width:
                raise ValueError(
                    f"on a device all rows have one kind of plant, {self._constants.kind} with "
                    f"{self._constants.width} parameters; scenario {config.scenario.name!r} "
                    f"has {kind} with {width}"
                )
        return configs, start_index

    def step(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Infos]:
        """Hold each row's action for one control period."""
        if not self._started:
            raise ResetNeeded("no episode was started: call reset() first")
        memory = self._memory
        if self._mode == AutoresetMode.DISABLED and (memory.over != RUNS).any():
            over = format_rows(memory.over.nonzero()[:, 0].tolist())
            raise ResetNeeded(f"the episode is over in {over}: call reset() with a reset_mask")
        sizes = make_specification(self._constants, self._real, self.num_envs, 1)
        new_arrays = {name: self._allocate(*getattr(sizes, name)) for name in _NEW_ARRAYS[1:]}
        self._memory = memory = memory._replace(actions=self._parse_actions(actions), **new_arrays)
        self._kernel(self.num_envs, False, memory)
        ends = memory.terminated.view(torch.bool), memory.truncated.view(torch.bool)
        infos = read_infos(memory.reports.clone())
        if self._mode == AutoresetMode.SAME_STEP:
            infos |= {"final_obs": memory.final_obs, "final_info": read_infos(memory.final_reports)}
            infos |= {f"_{key}": ends[0] | ends[1] for key in ("final_obs", "final_info")}
        return memory.obs.clone(), memory.rewards, *ends, infos

    def _parse_actions(self, actions: Any) -> Tensor:
        """Parse actions (N, width) as float32 on the device."""
        fail = self._config.on_bad_action == "fail"
        actions = parse_device_actions(
            actions, self.num_envs, self._constants.inputs, fail, self.device, torch.float32, False
        )
        commands: Tensor = actions.contiguous()
        if not fail:
            bad = ~torch.isfinite(commands).all(1) & (self._memory.over == RUNS)
            if bad.any():  # here the host waits
                refuse_actions(commands, bad)
        return commands

    @property
    def rows(self) -> Tensor:
        """Fast rows of the newest record, (N, n, FAST_WIDTH); ValueError without `record`."""
        return self._get_record(self._memory.rows).permute(2, 0, 1)

    @property
    def packets(self) -> Tensor:
        """Packets of the newest record, (N, max, PACKET_WIDTH)."""
        return self._get_record(self._memory.packets).permute(2, 0, 1)

    @property
    def ticks_done(self) -> Tensor:
        """Number of `rows` of the newest record, (N,)."""
        return self._get_record(self._memory.counts)[0]

    @property
    def delivered(self) -> Tensor:
        """Number of `packets` of the newest record, (N,)."""
        return self._get_record(self._memory.counts)[1]

    def _get_record(self, part: Tensor) -> Tensor:
        """Get a part of the record; ValueError without `record`."""
        if not self._constants.record:
            raise ValueError("there is no record: build the env with record=True")
        return part

    @property
    def motion(self) -> Tensor:
        """True `Motion` of each row now, (N, len(Motion)), in SI units."""
        states: Tensor = self._memory.states
        return states[Z.motion[0] : Z.motion[-1] + 1].T.clone()

    def tensors(self) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Get the state of the rows and the newest step's outcome, the env's own tensors."""
        m = self._memory
        results = m.obs, m.rewards, m.terminated, m.truncated, m.rows, m.packets
        return (m.states, m.reports, m.over), results

    def get_state(self) -> Snapshot:
        """Copy the state of all rows, on the device."""
        memory = DeviceArrays(*(array.clone() for array in self._memory))
        return Snapshot(self.num_envs, self._constants, self.dtype, self._started, memory)

    def set_state(self, snapshot: Snapshot) -> None:
        """Restore a snapshot of this env, or of one built with the same arguments.

        Raises ValueError for one of other rows, another dtype, plant, sensors or records.
        """
        if not isinstance(snapshot, Snapshot):
            raise ValueError(f"a snapshot of this engine is a Snapshot, got {short_repr(snapshot)}")
        snapshot_facts, own_facts = snapshot[:3], (self.num_envs, self._constants, self.dtype)
        if snapshot_facts != own_facts:
            raise ValueError(f"the snapshot is of other rows, {snapshot_facts}, not {own_facts}")
        copies = (array.to(self.device, copy=True) for array in snapshot.memory)
        self._memory = DeviceArrays(*copies)
        self._started = snapshot.started


def count_bytes(sizes: DeviceArrays) -> int:
    """Count the bytes that an env needs: its arrays, and the results of three steps."""
    return sum(
        math.prod(shape) * np.dtype(kind).itemsize * (3 if name in (*_NEW_ARRAYS, "obs") else 1)
        for name, (kind, shape) in sizes._asdict().items()
    )


def check_memory(sizes: DeviceArrays, count: int, device: torch.device) -> None:
    """Check that arrays of these sizes, of `count` rows, fit on the device; else MemoryError."""
    needed, free = count_bytes(sizes), torch.cuda.mem_get_info(device)[0]
    if needed > free:
        row = -(-needed // count)
        raise MemoryError(
            f"{count} rows of {row} bytes do not fit on {device}, where {free} bytes are free: "
            f"at most {free // row} rows"
        )
