"""`CudaVectorEnv`: many cars in one CUDA kernel a step, with state and resets on the device."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode

from ..engine.batch import IntArray
from ..engine.layout import Z
from ..engine.step import get_start_variant
from ..numerics.torch_backend import torch
from .base import StepEnds, Tensor, TensorVectorEnv
from .cuda_kernel import (
    ASKED,
    RUNS,
    SIMULATED,
    WORDS,
    DeviceArrays,
    KernelConstants,
    make_constants,
    make_specification,
)
from .cuda_launch import load_kernel

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


class CudaVectorEnv(TensorVectorEnv):
    """`TensorVectorEnv` on a GPU, one CUDA thread a row and one kernel a step.

    The kernel takes the ticks, sensors, packets, observation, cost and resets; keys of new episodes
    come from each row's PCG64 on the device. The host waits only to learn whether an action is bad
    (`on_bad_action="raise"`) or an episode is over ("Disabled"). Needs torch and numba-cuda, of the
    extras `train` and `cuda`; the first env of a kind compiles for half a minute. With "SameStep"
    infos have `final_obs` and `final_info`, zeros in rows that did not end.

    Args:
        num_envs: Number of environments N.
        device: "cuda", "cuda:1", ...; "cpu" in numba's simulator (NUMBA_ENABLE_CUDASIM=1), a few
            rows for tests.
        dtype: "float64", which has the bits of `StabilityVectorEnv`, or "float32".
        autoreset_mode: "NextStep", "SameStep" or "Disabled".
        record: Whether `rows` and `packets` are written; without it they raise ValueError.
        arguments: Arguments of `StabilityEnv`.

    Raises:
        TypeError: For an argument out of place.
        ValueError: For a value out of place, and a device that is not there.
        MemoryError: Where the rows do not fit.
    """

    _snapshot_type = Snapshot
    _has_over = True  # for all that the host knows

    def __init__(
        self, num_envs: int = 1, device: str | torch.device = "cuda",
        dtype: str | torch.dtype = "float64",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP, *, record: bool = False,
        **arguments: Any,
    ) -> None:  # fmt: skip
        super().__init__(num_envs, device, dtype, autoreset_mode, arguments, is_uniform=True)
        if (self.device.type == "cpu") != SIMULATED:
            runs = "in numba's simulator on 'cpu'" if SIMULATED else "on a CUDA device"
            raise ValueError(f"engine='cuda' runs {runs}, got {str(device)!r}")
        self._constants = make_constants(self.config, self._mode.value, record)
        self._real = np.float64 if self.dtype == torch.float64 else np.float32
        sizes = make_specification(self._constants, self._real, num_envs, 1)
        if not SIMULATED:
            _check_memory(sizes, num_envs, self.device)
        self._kernel = load_kernel(self._constants, self._real, self.device)
        self._memory = DeviceArrays(*(self._allocate(*spec) for spec in sizes))
        words = np.random.default_rng().integers(0, 2**32, (WORDS, num_envs))
        words[WORDS // 2] |= 1  # PCG64's increment is odd
        self._memory.generators.copy_(torch.as_tensor(words))
        self._memory.bounds.copy_(torch.as_tensor(self.config.bounds))

    def _allocate(self, kind: Any, shape: tuple[int, ...]) -> Tensor:
        """Allocate zeros of a NumPy type on the device."""
        return torch.zeros(shape, dtype=_TORCH.get(kind, self.dtype), device=self.device)

    def _start_rows(self, chosen: IntArray, seeds: dict[int, int], options: dict[str, Any]) -> None:
        """Reset rows on the device, where their generators are."""
        configs, index = self._make_configs(options, chosen)
        own_kind, own_width = self._constants.kind, self._constants.width
        for config in configs:
            kind, width = get_start_variant(config.start), len(config.start.params)
            if kind != own_kind or width != own_width:
                rule = f"all rows have one kind of plant, {own_kind} with {own_width} parameters"
                got = f"scenario {config.scenario.name!r} has {kind} with {width}"
                raise ValueError(f"on a device {rule}; {got}")
        words = _read_words([seeding.np_random(seed)[0] for seed in seeds.values()])
        self._memory.generators[:, list(seeds)] = torch.as_tensor(words, device=self.device)
        start_index = np.zeros(self.num_envs, np.int64)  # 0: without options
        start_index[chosen] = 1 + index
        starts = [config.start for config in (self.config.base, *configs)]
        packed = np.stack([np.concatenate([x.params, x.low, x.high, x.motion]) for x in starts])
        switches = np.stack([start.switches for start in starts])
        self._memory = self._memory._replace(
            which=torch.as_tensor(start_index, device=self.device),
            starts=torch.as_tensor(packed).to(self.device, self.dtype),
            switches=torch.as_tensor(switches, device=self.device),
        )
        self._memory.over[torch.as_tensor(chosen, device=self.device)] = ASKED
        self._kernel(self.num_envs, True, self._memory)

    def _advance(self, actions: Any) -> StepEnds:
        """Start a kernel that steps rows or resets them."""
        commands = self._parse_actions(actions, torch.float32).contiguous()
        if self.config.on_bad_action != "fail":  # here the host waits
            bad = ~torch.isfinite(commands).all(1) & (self._memory.over == RUNS)
            if rows := bad.nonzero()[:, 0].tolist():
                self._refuse_actions(rows, commands)
        sizes = make_specification(self._constants, self._real, self.num_envs, 1)
        new_arrays = {name: self._allocate(*getattr(sizes, name)) for name in _NEW_ARRAYS[1:]}
        self._memory = memory = self._memory._replace(actions=commands, **new_arrays)
        self._kernel(self.num_envs, False, memory)
        ends = memory.terminated.view(torch.bool), memory.truncated.view(torch.bool)
        is_same_step = self._mode == AutoresetMode.SAME_STEP
        finals = (memory.final_obs, memory.final_reports) if is_same_step else (None, None)
        return StepEnds(memory.rewards, *ends, *finals)

    def _get_outputs(self) -> tuple[Tensor, Tensor, Tensor]:
        return self._memory.obs, self._memory.reports, self._memory.over

    def _get_record(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        if not self._constants.record:
            raise ValueError("there is no record: build the env with record=True")
        m = self._memory
        return m.rows, m.packets, m.counts[0], m.counts[1]

    def _get_motion(self) -> Tensor:
        states: Tensor = self._memory.states
        return states[Z.motion[0] : Z.motion[-1] + 1]

    def tensors(self) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Get the state of the rows and the newest step's outcome, the env's own tensors."""
        m = self._memory
        results = m.obs, m.rewards, m.terminated, m.truncated, m.rows, m.packets
        return (m.states, m.reports, m.over), results

    def get_state(self) -> Snapshot:
        """Copy the state of all rows, on the device."""
        memory = DeviceArrays(*(array.clone() for array in self._memory))
        return Snapshot(self.num_envs, self._constants, self.dtype, self._started, memory)

    def _restore(self, snapshot: Snapshot) -> None:
        snapshot_facts, own_facts = snapshot[:3], (self.num_envs, self._constants, self.dtype)
        if snapshot_facts != own_facts:
            raise ValueError(f"the snapshot is of other rows, {snapshot_facts}, not {own_facts}")
        self._memory = DeviceArrays(*(x.to(self.device, copy=True) for x in snapshot.memory))
        self._started = snapshot.started


def _read_words(generators: Sequence[np.random.Generator]) -> npt.NDArray[np.int64]:
    """Read the words (WORDS, N) of N generators of NumPy's PCG64."""
    words = np.empty((WORDS, len(generators)), np.int64)
    for i, generator in enumerate(generators):
        state: Any = generator.bit_generator.state["state"]
        for k, number in enumerate((state["state"], state["inc"])):
            words[4 * k : 4 * k + 4, i] = [number >> 32 * part & 0xFFFFFFFF for part in range(4)]
    return words


def _check_memory(sizes: DeviceArrays, count: int, device: torch.device) -> None:
    """Check that arrays of `sizes`, and the results of three steps, fit on the device."""
    needed, free = 0, torch.cuda.mem_get_info(device)[0]
    for name, (kind, shape) in sizes._asdict().items():
        copies = 3 if name in (*_NEW_ARRAYS, "obs") else 1
        needed += math.prod(shape) * np.dtype(kind).itemsize * copies
    if needed > free:
        row = -(-needed // count)
        text = f"{count} rows of {row} bytes do not fit on {device}, where {free} bytes are free"
        raise MemoryError(f"{text}: at most {free // row} rows")
