"""CudaVectorEnv: many cars in one CUDA kernel a step; state, resets and results on the device."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ..arguments import actions_of, brief, count_of, mask_of, mode_of, named, options_of, seeds_of
from ..backend.on_torch import torch
from ..engine.layout import Z
from ..engine.packing import EpisodeConfig
from ..engine.step import kind_in
from ..vector import StabilityVectorEnv
from .generator import WORDS, words_of
from .kernel import ASKED, RUNS, How, Memory, how_of, packed_starts, specification
from .launch import kernel_on
from .tensors import check_arguments, device_of, dtype_of, infos_in
from .text import SIMULATED

Tensor = torch.Tensor
Infos = dict[str, Any]

_FRESH = ("actions", "rewards", "terminated", "truncated", "final_obs", "final_reports")
"""What is new in every step; all else stays where it is."""
_TORCH = {np.uint8: torch.uint8, np.int64: torch.int64, np.float32: torch.float32}


class Snapshot(NamedTuple):
    """All that the rows of a `CudaVectorEnv` go on from."""

    num_envs: int
    how: How
    dtype: torch.dtype
    started: bool
    memory: Memory


class CudaVectorEnv(VectorEnv[Any, Any, Any]):
    """`num_envs` environments on a GPU: the text, the noise and the episodes of
    `StabilityVectorEnv`, seed by seed, one CUDA thread a row and one kernel a step.

    The kernel takes the ticks, sensors, packets, observation, cost and resets; keys of new episodes
    come from each row's PCG64 on the device. Nothing waits for the host, but with
    `on_bad_action="raise"` a step asks whether an action is bad, and with "Disabled" whether an
    episode is over. It launches on torch's current stream. Needs torch and numba-cuda, of the
    extras `train` and `cuda`; the first env of a kind compiles for half a minute, then PTX is on
    disk.

    ## Arguments
    arguments: those of `StabilityEnv`. device: "cuda", "cuda:1", ...; "cpu" in numba's simulator
    (NUMBA_ENABLE_CUDASIM=1), a few rows for tests. dtype: "float64", which contracts no product
    with a sum and has the bits of `StabilityVectorEnv`; or "float32". autoreset_mode: as of
    `StabilityVectorEnv`. record: whether `rows` and `packets` are written.

    ## Tensors
    As of `DeviceVectorEnv`: observations (N, k) float32, rewards (N,), `terminated`, `truncated`
    (N,) of bool, infos (N,), new ones each time and on the device. With "SameStep" infos have
    `final_obs` and `final_info`, zeros in rows that did not end.

    Options of reset are those of `StabilityVectorEnv`; all rows have a plant of one kind.

    Raises TypeError or ValueError for an argument out of place and a device that is not there,
    MemoryError where the rows do not fit.
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
        self.num_envs = N = count_of("num_envs", num_envs, "environments")
        self._mode = mode_of(autoreset_mode)
        self.device, self.dtype = device_of(device), dtype_of(dtype)
        if (self.device.type == "cpu") != SIMULATED:
            runs = "in numba's simulator on 'cpu'" if SIMULATED else "on a CUDA device"
            raise ValueError(f"engine='cuda' runs {runs}, got {str(device)!r}")
        one = StabilityVectorEnv(1, **arguments)
        self.layout, self.control_period = one.layout, one.control_period
        self.reference, self._config = one.reference, one.config
        self.metadata = {**one.metadata, "autoreset_mode": self._mode}
        self.single_observation_space = one.single_observation_space
        self.single_action_space = one.single_action_space
        self.observation_space = batch_space(self.single_observation_space, N)
        self.action_space = batch_space(self.single_action_space, N)
        self._how = how_of(self._config, self._mode.value, record)
        self._real = np.float64 if self.dtype == torch.float64 else np.float32
        sizes = specification(self._how, self._real, N, 1)
        if not SIMULATED:
            check_memory(sizes, N, self.device)
        self._kernel = kernel_on(self._how, self._real, self.device)
        self._memory = Memory(*(self._made(*each) for each in sizes))
        words = np.random.default_rng().integers(0, 2**32, (WORDS, N))
        words[WORDS // 2] |= 1  # PCG64's increment is odd
        self._memory.generators.copy_(torch.as_tensor(words))
        self._memory.bounds.copy_(torch.as_tensor(self._config.bounds))
        self._started = False

    def _made(self, kind: Any, shape: tuple[int, ...]) -> Tensor:
        return torch.zeros(shape, dtype=_TORCH.get(kind, self.dtype), device=self.device)

    def reset(
        self, *, seed: Any = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Tensor, Infos]:
        """Start episodes; seeds, options and errors are those of `StabilityVectorEnv`."""
        N, rest = self.num_envs, dict(options or {})
        mask = rest.pop("reset_mask", None)
        mask = mask_of(mask.cpu().numpy() if isinstance(mask, torch.Tensor) else mask, N)
        seeds = seeds_of(seed, N)
        if not (self._started or mask.all()):
            raise ResetNeeded("reset all rows first: a reset_mask leaves out some of them")
        configs, which = self._with_options(rest, mask)
        seeded = [i for i in np.flatnonzero(mask).tolist() if seeds[i] is not None]
        words = words_of([seeding.np_random(seeds[i])[0] for i in seeded])
        self._memory.generators[:, seeded] = torch.as_tensor(words, device=self.device)
        packed, switches = packed_starts([config.start for config in configs])
        self._memory = self._memory._replace(
            which=torch.as_tensor(which, device=self.device),
            starts=torch.as_tensor(packed).to(self.device, self.dtype),
            switches=torch.as_tensor(switches, device=self.device),
        )
        self._memory.over[torch.as_tensor(mask, device=self.device)] = ASKED
        self._kernel(N, True, self._memory)
        self._started = True
        return self._memory.obs.clone(), infos_in(self._memory.reports.clone())

    def _with_options(
        self, options: Mapping[str, Any], mask: Any
    ) -> tuple[Sequence[EpisodeConfig], Any]:
        """The starts' configs, that without options first, and the place of each row's.

        Raises ValueError for a plant of another kind.
        """
        configs, which = [self._config.base], np.zeros(self.num_envs, np.int64)
        known: dict[tuple[Any, ...], int] = {}
        for i, own in enumerate(options_of(options, self.num_envs) if options else ()):
            key = (*own, *map(id, own.values()))
            if own and mask[i]:
                if key not in known:
                    known[key] = len(configs)
                    configs.append(self._config.with_options(own))
                which[i] = known[key]
        for config in configs[1:]:
            kind, width = kind_in(config.start), len(config.start.params)
            if kind != self._how.kind or width != self._how.width:
                raise ValueError(
                    f"on a device all rows have one kind of plant, {self._how.kind} with "
                    f"{self._how.width} parameters; scenario {config.scenario.name!r} has {kind} "
                    f"with {width}"
                )
        return configs, which

    def step(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Infos]:
        """Hold each row's action for one control period."""
        if not self._started:
            raise ResetNeeded("no episode was started: call reset() first")
        memory = self._memory
        if self._mode == AutoresetMode.DISABLED and (memory.over != RUNS).any():
            raise ResetNeeded(
                f"the episode is over in {named(memory.over.nonzero()[:, 0].tolist())}: "
                "call reset() with a reset_mask"
            )
        sizes = specification(self._how, self._real, self.num_envs, 1)
        fresh = {name: self._made(*getattr(sizes, name)) for name in _FRESH[1:]}
        self._memory = memory = memory._replace(actions=self._taken(actions), **fresh)
        self._kernel(self.num_envs, False, memory)
        ends = memory.terminated.view(torch.bool), memory.truncated.view(torch.bool)
        infos = infos_in(memory.reports.clone())
        if self._mode == AutoresetMode.SAME_STEP:
            infos |= {"final_obs": memory.final_obs, "final_info": infos_in(memory.final_reports)}
            infos |= {f"_{key}": ends[0] | ends[1] for key in ("final_obs", "final_info")}
        return memory.obs.clone(), memory.rewards, *ends, infos

    def _taken(self, actions: Any) -> Tensor:
        """Actions (N, width) as float32 on the device, checked."""
        N, width, fail = self.num_envs, self._how.inputs, self._config.on_bad_action == "fail"
        if not isinstance(actions, torch.Tensor):
            actions = torch.as_tensor(actions_of(actions, N, width, fail)).to(self.device)
        if actions.device != self.device:
            raise ValueError(
                f"actions are on {actions.device}, the env on {self.device}; nothing was stepped"
            )
        if actions.shape != (N, width):
            if not fail:
                raise ValueError(
                    f"actions have shape ({N}, {width}), got {tuple(actions.shape)}; "
                    "nothing was stepped"
                )
            actions = torch.full((N, width), torch.nan, device=self.device)
        taken: Tensor = actions.detach().to(torch.float32).contiguous()
        if not fail:
            bad = ~torch.isfinite(taken).all(1) & (self._memory.over == RUNS)
            if bad.any():  # here the host waits
                rows = bad.nonzero()[:, 0].tolist()
                raise ValueError(
                    f"the action of {named(rows)} is not finite, {taken[rows[0]].tolist()}; "
                    "nothing was stepped"
                )
        return taken

    @property
    def rows(self) -> Tensor:
        """The fast rows of the newest record, (N, n, FAST_WIDTH); ValueError without `record`."""
        return self._recorded(self._memory.rows).permute(2, 0, 1)

    @property
    def packets(self) -> Tensor:
        """The packets of the newest record, (N, most, PACKET_WIDTH)."""
        return self._recorded(self._memory.packets).permute(2, 0, 1)

    @property
    def ticks_done(self) -> Tensor:
        """How many of `rows` are there, (N,)."""
        return self._recorded(self._memory.counts)[0]

    @property
    def delivered(self) -> Tensor:
        """How many of `packets` are there, (N,)."""
        return self._recorded(self._memory.counts)[1]

    def _recorded(self, part: Tensor) -> Tensor:
        if not self._how.record:
            raise ValueError("there is no record: build the env with record=True")
        return part

    @property
    def motion(self) -> Tensor:
        """The true `Motion` of each row now, (N, len(Motion)), in SI units."""
        states: Tensor = self._memory.states
        return states[Z.motion[0] : Z.motion[-1] + 1].T.clone()

    def tensors(self) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """The state of the rows on the device and the newest step's outcome; the env's own."""
        m = self._memory
        results = m.obs, m.rewards, m.terminated, m.truncated, m.rows, m.packets
        return (m.states, m.reports, m.over), results

    def get_state(self) -> Snapshot:
        """A snapshot of all rows, on the device."""
        memory = Memory(*(each.clone() for each in self._memory))
        return Snapshot(self.num_envs, self._how, self.dtype, self._started, memory)

    def set_state(self, snapshot: Snapshot) -> None:
        """Go back to a snapshot of this env, or of one built with the same arguments.

        Raises ValueError for one of other rows, another dtype, plant, sensors or records.
        """
        if not isinstance(snapshot, Snapshot):
            raise ValueError(f"a snapshot of this engine is a Snapshot, got {brief(snapshot)}")
        theirs, ours = snapshot[:3], (self.num_envs, self._how, self.dtype)
        if theirs != ours:
            raise ValueError(f"the snapshot is of other rows, {theirs}, not {ours}")
        self._memory = Memory(*(each.to(self.device, copy=True) for each in snapshot.memory))
        self._started = snapshot.started


def bytes_of(sizes: Memory) -> int:
    """What an env needs of the device's memory: its own, and the results of three steps."""
    return sum(
        math.prod(shape) * np.dtype(kind).itemsize * (3 if name in (*_FRESH, "obs") else 1)
        for name, (kind, shape) in sizes._asdict().items()
    )


def check_memory(sizes: Memory, count: int, device: torch.device) -> None:
    """MemoryError where these rows do not fit on the device."""
    needed, free = bytes_of(sizes), torch.cuda.mem_get_info(device)[0]
    if needed > free:
        row = -(-needed // count)
        raise MemoryError(
            f"{count} rows of {row} bytes do not fit on {device}, where {free} bytes are free: "
            f"at most {free // row} rows"
        )
