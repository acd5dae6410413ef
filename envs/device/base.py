"""`TensorVectorEnv`: what environments on tensors share, whichever engine steps their cars."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from gymnasium.vector import AutoresetMode

from ..engine.batch_env import BatchEnv
from ..engine.layout import EpisodeConfig
from ..engine.step import get_start_variant
from ..numerics.torch_backend import DTYPES, torch
from ..task import REPORT, RUNNING, Infos, StepReport
from ..validation import Mask, check_mapping, parse_actions, short_repr
from ..vector import make_rows

Tensor = torch.Tensor


class StepEnds(NamedTuple):
    """Rewards and ends of an env-step, (N,) each, and what "SameStep" saw last of rows that end."""

    rewards: Tensor
    terminated: Tensor
    truncated: Tensor
    final: tuple[Tensor, Tensor] | None = None  # observations (N, k), reports (len(StepReport), N)


class TensorVectorEnv(BatchEnv[Tensor]):
    """`num_envs` environments on a device, `StabilityVectorEnv` in tensors, seed by seed.

    Observations are (N, k), rewards (N,), `terminated` and `truncated` (N,) of bool, infos (N,) of
    every row; all are new ones each time. The first `ticks_done` (N,) of `rows` (N, n, FAST_WIDTH)
    and `delivered` (N,) of `packets` (N, max, PACKET_WIDTH) make the record. Actions are tensors
    (N, width) on the device, a bad one as in the vector env. Seeds, options and errors of a reset
    are those of `StabilityVectorEnv`, but all rows have a plant of one kind: tyres, roll, lags,
    small angles and whether a driver reacts to the car are those of the env's own scenario.

    Args:
        num_envs: Number of environments N.
        device: Device of the tensors.
        dtype: Type of floats.
        autoreset_mode: "NextStep", "SameStep" or "Disabled".
        arguments: Arguments of `StabilityEnv`.
        is_uniform: Whether scenario and vehicle may not be lists (N,).
    """

    def __init__(
        self, num_envs: int, device: str | torch.device, dtype: str | torch.dtype,
        autoreset_mode: str | AutoresetMode, arguments: Mapping[str, Any], is_uniform: bool,
    ) -> None:  # fmt: skip
        for name in ("max_episode_steps", "info", "render_mode"):
            if arguments.get(name) is not None:
                got = short_repr(arguments[name])
                raise TypeError(f"an env on a device has no {name}, got {got}")
        self.device, known = _parse_device(device), DTYPES | {x: x for x in DTYPES.values()}
        if dtype not in known:
            raise ValueError(f"dtype is 'float64' or 'float32', got {dtype!r}")
        self.dtype = known[dtype]
        env, rows = make_rows(num_envs, arguments, is_uniform)
        self.metadata = env.metadata
        super().__init__(autoreset_mode, rows)

    def _check_plants(self, configs: Iterable[EpisodeConfig]) -> None:
        """Check that these episodes have the kind of plant of the env's own scenario."""
        base = self.config.base.start
        kind = get_start_variant(base), len(base.params)
        for config in configs:
            got = get_start_variant(config.start), len(config.start.params)
            if got != kind:
                rule = f"on a device all rows have one kind of plant, {kind}"
                raise ValueError(f"{rule}; scenario {config.scenario.name!r} has {got}")

    def _read_reset(self, mask: Mask) -> tuple[Tensor, Infos]:
        obs, report, _ = self._get_outputs()
        return obs.clone(), _read_infos(report.clone())

    def _list_over_rows(self) -> list[int]:
        return self._get_outputs()[2].nonzero()[:, 0].tolist()

    def _step_rows(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Infos]:
        ends = self._advance(actions)
        obs, report, _ = self._get_outputs()
        infos: Infos = {}
        if ends.final is not None:
            infos = {"final_obs": ends.final[0], "final_info": _read_infos(ends.final[1])}
            infos |= {f"_{key}": ends.terminated | ends.truncated for key in infos}
        infos |= _read_infos(report.clone())
        return obs.clone(), ends.rewards, ends.terminated, ends.truncated, infos

    @property
    def motion(self) -> Tensor:
        """True `Motion` of each row now, (N, len(Motion)), in SI units."""
        return self._get_motion().T.clone()

    @abstractmethod
    def tensors(self) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Get the state of the rows and the newest step's outcome, the env's own tensors."""

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot of this env, or of one built with the same arguments.

        Args:
            snapshot: Return value of `get_state`; the gradient engine also takes that of a
                `StabilityVectorEnv`. ValueError for one of other rows, sizes, plant or engine.
        """
        self._restore(check_mapping("a snapshot", snapshot))

    @abstractmethod
    def _advance(self, actions: Any) -> StepEnds:
        """Step all rows, and reset those that it has to."""

    @abstractmethod
    def _get_outputs(self) -> tuple[Tensor, Tensor, Tensor]:
        """Get observations (N, k), reports (len(StepReport), N) and whether rows are over (N,)."""

    def _parse_actions(self, actions: Any, dtype: torch.dtype, grad: bool = False) -> Tensor:
        """Parse actions as (N, width), rounded to float32 unless a tensor's graph is kept."""
        config, N = self.config, self.num_envs
        width, fail = config.action_width, config.on_bad_action == "fail"
        if not isinstance(actions, torch.Tensor):
            rounded: Tensor = torch.as_tensor(parse_actions(actions, N, width, fail))
            return rounded.to(self.device, dtype)
        if actions.device != self.device:
            places = f"on {actions.device}, the env on {self.device}"
            raise ValueError(f"actions are {places}; nothing was stepped")
        if actions.shape != (N, width):
            if not fail:
                shapes = f"({N}, {width}), got {tuple(actions.shape)}"
                raise ValueError(f"actions have shape {shapes}; nothing was stepped")
            actions = torch.full((N, width), torch.nan, device=self.device)
        if not grad:
            actions = actions.detach().to(torch.float32)
        commands: Tensor = actions.to(dtype)
        return commands

    @abstractmethod
    def _get_motion(self) -> Tensor:
        """Get the true motion, (len(Motion), N)."""

    @abstractmethod
    def _restore(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of this engine."""

    @abstractmethod
    def _get_record(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Get the newest `RecordArrays`; of rows and packets the last axis is the env's rows."""

    @property
    def rows(self) -> Tensor:
        """Fast rows of the newest record, (N, n, FAST_WIDTH)."""
        return self._get_record()[0].permute(2, 0, 1)

    @property
    def packets(self) -> Tensor:
        """Packets of the newest record, (N, max, PACKET_WIDTH)."""
        return self._get_record()[1].permute(2, 0, 1)

    @property
    def ticks_done(self) -> Tensor:
        """Number of `rows` of the newest record, (N,)."""
        return self._get_record()[2]

    @property
    def delivered(self) -> Tensor:
        """Number of `packets` of the newest record, (N,)."""
        return self._get_record()[3]


def _read_infos(report: Tensor) -> Infos:
    """Read the numbers of `info` of every row, (N,) each, which share the report's memory."""
    infos: Infos = dict(zip(StepReport._fields, report[: REPORT.failure], strict=False))
    infos["failure"] = failure = report[REPORT.failure].to(torch.int64)
    infos["is_success"] = (report[REPORT.ended] == 1.0) & (failure == RUNNING)
    return infos


def _parse_device(device: str | torch.device) -> torch.device:
    """Parse a device as its tensors have it: a GPU with an index, the CPU without."""
    try:
        parsed = torch.device(device)
    except (RuntimeError, TypeError):
        parsed = None
    if parsed is None or parsed.type not in ("cpu", "cuda"):
        raise ValueError(f"unknown device {device!r}; known: 'cpu', 'cuda', 'cuda:0', ...")
    if parsed.type == "cpu":
        return torch.device("cpu")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if (parsed.index or 0) >= count:
        available = ", ".join(["cpu", *(f"cuda:{i}" for i in range(count))])
        missing = ": no CUDA driver" if torch.version.cuda else ": built without CUDA"
        finds = f"torch {torch.__version__} finds {available}{'' if count else missing}"
        raise ValueError(f"device {str(device)!r} is not there: {finds}")
    index = torch.cuda.current_device() if parsed.index is None else parsed.index
    return torch.device("cuda", index)
