"""`TensorVectorEnv`: what environments on tensors share, whichever engine steps their cars."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ..numerics.torch_backend import DTYPES, torch
from ..task import REPORT, RUNNING, StepReport
from ..validation import (
    Mask,
    check_int,
    format_rows,
    parse_actions,
    parse_autoreset_mode,
    parse_reset_mask,
    short_repr,
)
from ..vector import StabilityVectorEnv

Tensor = torch.Tensor
Infos = dict[str, Any]


class StepEnds(NamedTuple):
    """Rewards and ends of an env-step, (N,) each, and what "SameStep" saw last of rows that end."""

    rewards: Tensor
    terminated: Tensor
    truncated: Tensor
    final_obs: Tensor | None = None  # (N, k)
    final_report: Tensor | None = None  # (len(StepReport), N)


class TensorVectorEnv(VectorEnv[Tensor, Any, Any], ABC):
    """`num_envs` environments on a device, `StabilityVectorEnv` in tensors, seed by seed.

    Observations are (N, k), rewards (N,), `terminated` and `truncated` (N,) of bool, infos (N,) of
    every row; all are new ones each time. The first `ticks_done` (N,) of `rows` (N, n, FAST_WIDTH)
    and `delivered` (N,) of `packets` (N, max, PACKET_WIDTH) make the record. Actions are tensors
    (N, width) on the device, a bad one as in the vector env. Seeds, options and errors of a reset
    are those of `StabilityVectorEnv`, but all rows have a plant of one kind: tyres, roll, lags,
    small angles and whether a driver reacts to the car are those of the env's own scenario.
    """

    _has_over = True  # whether a row may be over
    _snapshot_type: type = Mapping

    def _init_env(
        self, num_envs: int, device: str | torch.device, dtype: str | torch.dtype,
        autoreset_mode: str | AutoresetMode, host_rows: int,
        arguments: Mapping[str, Any],
    ) -> None:  # fmt: skip
        """Take the arguments that all engines have; the env on the host has `host_rows` rows."""
        for name in ("max_episode_steps", "info", "render_mode"):
            if arguments.get(name) is not None:
                got = short_repr(arguments[name])
                raise TypeError(f"an env on a device has no {name}, got {got}")
        self.num_envs = check_int("num_envs", num_envs, "environments")
        self._mode = parse_autoreset_mode(autoreset_mode)
        self.device, known = _parse_device(device), DTYPES | {x: x for x in DTYPES.values()}
        if dtype not in known:
            raise ValueError(f"dtype is 'float64' or 'float32', got {dtype!r}")
        self.dtype = known[dtype]
        self._host = host = StabilityVectorEnv(host_rows, **arguments)
        self.layout, self.control_period = host.layout, host.control_period
        self.reference = host.reference
        self.metadata = {**host.metadata, "autoreset_mode": self._mode}
        self.single_observation_space = host.single_observation_space
        self.single_action_space = host.single_action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._started = False

    def reset(
        self, *, seed: Any = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Tensor, Infos]:
        """Start episodes; where it raises, everything stays as it was.

        Args:
            seed: An int s (row i gets s + i), or a list (N,) of int or None.
            options: Options of `StabilityVectorEnv`.

        Returns:
            Observations (N, k), and the infos of all rows.
        """
        remaining = dict(options or {})
        mask = remaining.pop("reset_mask", None)
        mask = mask.cpu().numpy() if isinstance(mask, torch.Tensor) else mask
        self._start_episodes(seed, remaining, parse_reset_mask(mask, self.num_envs))
        self._started = True
        obs, report, _ = self._get_outputs()
        return obs.clone(), _read_infos(report.clone())

    def step(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Infos]:
        """Hold each row's action for one control period.

        Args:
            actions: Fractions of full scale, shape (N, 1), or (N, 2) with `steering`.

        Returns:
            Observations, rewards, terminated, truncated and infos.
        """
        if not self._started:
            raise ResetNeeded("no episode was started: call reset() first")
        waits = self._mode == AutoresetMode.DISABLED and self._has_over
        if waits and (rows := self._get_outputs()[2].nonzero()[:, 0].tolist()):
            over = format_rows(rows)
            raise ResetNeeded(f"the episode is over in {over}: call reset() with a reset_mask")
        ends = self._advance(actions)
        obs, report, _ = self._get_outputs()
        infos: Infos = {}
        if ends.final_obs is not None and ends.final_report is not None:
            infos = {"final_obs": ends.final_obs, "final_info": _read_infos(ends.final_report)}
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

    @abstractmethod
    def get_state(self) -> Any:
        """Copy the state of all rows, from which `set_state` continues bit for bit."""

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot of this env, or of one built with the same arguments.

        Args:
            snapshot: Return value of `get_state`; the gradient engine also takes that of a
                `StabilityVectorEnv`.

        Raises:
            ValueError: For one of other rows, sizes, plant or engine.
        """
        kind = self._snapshot_type
        if not isinstance(snapshot, kind):
            what = f"a {kind.__name__ if issubclass(kind, tuple) else 'mapping'}"
            raise ValueError(f"a snapshot of this engine is {what}, got {short_repr(snapshot)}")
        self._restore(snapshot)

    @abstractmethod
    def _start_episodes(self, seed: object, options: dict[str, Any], mask: Mask) -> None:
        """Reset the rows of a mask (N,)."""

    @abstractmethod
    def _advance(self, actions: Any) -> StepEnds:
        """Step all rows, and reset those that it has to."""

    @abstractmethod
    def _get_outputs(self) -> tuple[Tensor, Tensor, Tensor]:
        """Get observations (N, k), reports (len(StepReport), N) and whether rows are over (N,)."""

    def _parse_actions(self, actions: Any, dtype: torch.dtype, grad: bool = False) -> Tensor:
        """Parse actions as (N, width), rounded to float32 unless a tensor's graph is kept."""
        config, N = self._host.config, self.num_envs
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

    def _refuse_actions(self, commands: Tensor, bad: Tensor) -> None:
        """Raise ValueError if commands (N, width) are not finite where `bad` (N,) holds."""
        if rows := bad.nonzero()[:, 0].tolist():
            got = f"is not finite, {commands[rows[0]].tolist()}"
            raise ValueError(f"the action of {format_rows(rows)} {got}; nothing was stepped")

    @abstractmethod
    def _get_motion(self) -> Tensor:
        """Get the true motion, (len(Motion), N)."""

    @abstractmethod
    def _restore(self, snapshot: Any) -> None:
        """Restore a snapshot of this engine."""

    @abstractmethod
    def _get_record(self, part: str) -> Tensor:
        """Get "rows", "packets", "done" or "delivered" of the newest record, rows last."""

    @property
    def rows(self) -> Tensor:
        """Fast rows of the newest record, (N, n, FAST_WIDTH)."""
        return self._get_record("rows").permute(2, 0, 1)

    @property
    def packets(self) -> Tensor:
        """Packets of the newest record, (N, max, PACKET_WIDTH)."""
        return self._get_record("packets").permute(2, 0, 1)

    @property
    def ticks_done(self) -> Tensor:
        """Number of `rows` of the newest record, (N,)."""
        return self._get_record("done")

    @property
    def delivered(self) -> Tensor:
        """Number of `packets` of the newest record, (N,)."""
        return self._get_record("delivered")


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
