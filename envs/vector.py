"""StabilityVectorEnv: many cars in one compiled call a step, each with a single car's bits."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeVar, overload

import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

from .engine.batch import IntArray, NumbaEngine
from .engine.batch_env import BatchEnv
from .engine.config import EnvConfig
from .engine.layout import Episode, Z, compute_true_states
from .numerics.functions import TICK
from .record import Array
from .rendering.renderer import VectorRenderMixin
from .stability import StabilityEnv
from .task import REFUSED, WILD, Infos, make_infos
from .validation import Mask, check_int, parse_actions, split_by_rows, warn_once

Observations = npt.NDArray[np.float32]
T = TypeVar("T")


def make_rows(
    num_envs: int, arguments: Mapping[str, Any], is_uniform: bool = False
) -> tuple[StabilityEnv, list[EnvConfig]]:
    """Make a batch's first env, and each row's config; rows with the same objects share one.

    Args:
        num_envs: Number of rows N.
        arguments: Arguments of `StabilityEnv`; scenario and vehicle may each be a list (N,).
        is_uniform: Whether they may not, and all rows have one config.
    """
    N = check_int("num_envs", num_envs, "environments")
    count = 1 if is_uniform else N
    if arguments.get("vision") == "image":
        mode = "make_vec(..., vectorization_mode='sync')"
        raise ValueError(f"vision='image' sees for one car at a time: {mode}")
    lists = {name: arguments[name] for name in ("scenario", "vehicle") if name in arguments}
    envs: dict[tuple[object, ...], StabilityEnv] = {}
    rows = []
    for values in split_by_rows(lists, count):
        key = (*values, *map(id, values.values()))
        if key not in envs:
            envs[key] = StabilityEnv(**{**arguments, **values})
        rows.append(envs[key].config)
    return next(iter(envs.values())), rows * N if is_uniform else rows


class _LazyRows(Sequence[T]):
    """Items of a batch's `count` rows, each made by `make_item` when it is read."""

    def __init__(self, count: int, make_item: Callable[[int], T]) -> None:
        self._rows, self._make_item = range(count), make_item

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, i: int) -> T: ...
    @overload
    def __getitem__(self, i: slice) -> tuple[T, ...]: ...
    def __getitem__(self, i: int | slice) -> T | tuple[T, ...]:
        if isinstance(i, slice):
            return tuple(map(self._make_item, self._rows[i]))
        return self._make_item(self._rows[i])

    def __repr__(self) -> str:
        return f"<{len(self)} rows>"


class _EachRow(Generic[T]):
    """An attribute of a batch: a sequence of what `read` makes of each row's `Episode`."""

    def __init__(self, read: Callable[[Episode], T]) -> None:
        self._read = read

    def __get__(self, env: "StabilityVectorEnv | None", kind: type | None = None) -> Sequence[T]:
        if env is None:  # asked of the class
            return self  # type: ignore[return-value]
        return _LazyRows(env.num_envs, lambda i: self._read(env._get_episode(i)))

    def __set__(self, env: "StabilityVectorEnv", value: object) -> None:
        raise AttributeError("an attribute of the rows is read, not set")


class StabilityVectorEnv(VectorRenderMixin, BatchEnv[npt.NDArray[Any]]):
    """`num_envs` environments, each of which is a `StabilityEnv(**arguments)` bit for bit.

    Observations, rewards, ends, infos and records are those of `SyncVectorEnv`: row i of
    `reset(seed=s)` is the single environment of `reset(seed=s + i)`, and its later episodes come
    from its own generator. `gym.make_vec(id, num_envs=N, **arguments)` builds it.

    ## Reset
    `seed`: an int, or a list (N,) of int or None. `options`: those of `StabilityEnv`, each one for
    all rows or a list (N,); and `reset_mask`, (N,) of bool: the rows to reset. Rows that the
    environment resets itself start without options.

    ## Actions
    (N, 1), or (N, 2) with `steering`. With `on_bad_action="raise"` a wrong number of actions, or
    one that is not finite or not numeric, raises ValueError, names the rows and steps nothing;
    with "fail" it ends these rows' episodes as failures. Of rows that this step resets the values
    are not read.

    ## Records
    `rows` (N, n, FAST_WIDTH) of which `ticks_done` (N,) are filled, `packets` (N, k,
    PACKET_WIDTH), k the most of a step, of which `delivered` (N,) are; `final_...` are those
    before a row's newest reset. `record[i]` is a row's `Record`.

    `vehicle`, `nominal`, `held_speed`, `slow_sensors`, `scenario` and `record` are sequences of N
    whose items are made on access; `motion` is (N, len(Motion)).

    Args:
        num_envs: Number of rows N.
        autoreset_mode: "NextStep", "SameStep" or "Disabled" (rows that ended wait for `reset` with
            a `reset_mask`), or the enum.
        info: "all" has the infos of every row in every step, as `SyncVectorEnv` does; "ends" only
            those of the last step of an episode, and none at resets.
        render_mode: None, "rgb_array" or "human".
        max_episode_steps: Steps after which a row is truncated, as by `TimeLimit`; None: no limit.
        arguments: Arguments of `StabilityEnv`; scenario and vehicle may each be a list (N,), one a
            row, for all its episodes.

    Raises:
        ValueError: For an argument out of place; TypeError for one of another type.
    """

    dt = TICK
    """The base tick (s)."""
    _spec: EnvSpec | None = None

    def __init__(
        self, num_envs: int = 1, autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        info: str = "all", render_mode: str | None = None, max_episode_steps: int | None = None,
        **arguments: Any,
    ) -> None:  # fmt: skip
        if info not in ("all", "ends"):
            raise ValueError(f"info is 'all' or 'ends', got {info!r}")
        self._all_infos, self._max_steps = info == "all", max_episode_steps
        if max_episode_steps is not None:
            self._max_steps = check_int("max_episode_steps", max_episode_steps, "steps")
        _, rows = make_rows(num_envs, arguments)
        super().__init__(autoreset_mode, rows)
        self._init_rendering(render_mode)
        self.engine = NumbaEngine(self.config, self.num_envs)
        arrays = self.engine.arrays
        self._obs, self._over, self._reports = arrays.obs, arrays.over, arrays.reports
        self.rows, self.packets, self.ticks_done, self.delivered = arrays.record
        final = self.engine.final
        self.final_rows, self.final_packets, self.final_ticks_done, self.final_delivered = final

    @property
    def spec(self) -> EnvSpec | None:
        """The spec that `gym.make_vec` builds this env from; JSON types where the arguments are."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        """Set the spec.

        Args:
            spec: Spec whose autoreset mode becomes a text.
        """
        if spec is not None and "autoreset_mode" in spec.kwargs:
            spec.kwargs["autoreset_mode"] = self._mode.value  # as JSON writes it
        self._spec = spec

    def _start_rows(self, chosen: IntArray, seeds: dict[int, int], options: dict[str, Any]) -> None:
        self._restart_rows(chosen, *self._make_configs(options, chosen), seeds)
        self._has_over = bool(self._over.any())

    def _read_reset(self, mask: Mask) -> tuple[Observations, Infos]:
        if self._traces:
            self._record_step()
        return self._obs.copy(), make_infos(self._reports, mask) if self._all_infos else {}

    def _list_over_rows(self) -> list[int]:
        return np.flatnonzero(self._over).tolist()

    def _step_rows(self, actions: Any) -> tuple[Observations, Array, Mask, Mask, Infos]:
        N, config, over = self.num_envs, self.config, self._over
        commands = parse_actions(actions, N, config.action_width, config.on_bad_action == "fail")
        over_rows = np.flatnonzero(over) if self._has_over else None
        rewards, terminated, truncated = np.empty(N), np.empty(N, np.bool_), np.empty(N, np.bool_)
        n_ended = self.engine.step(commands, (rewards, terminated, truncated))
        if n_ended == REFUSED:
            bad = np.flatnonzero(~np.isfinite(commands).all(1) & ~over)
            self._refuse_actions(bad.tolist(), commands)
        if n_ended >= WILD:
            n_ended -= WILD
            warn_once(self, commands)
        if over_rows is not None:
            self._start_rows(over_rows, {}, {})
        if self._max_steps is not None:
            last_tick = (self._max_steps - 1) * self.control_period
            is_timed_out = self.engine.arrays.states[:, Z.clock.tick] > last_tick
            truncated |= is_timed_out
            n_ended += int((is_timed_out & ~over).sum())
            over |= is_timed_out
        infos: Infos = {}
        if n_ended and self._mode == AutoresetMode.SAME_STEP:
            infos, n_ended = self._reset_finished(), 0
        self._has_over = n_ended > 0
        if self._all_infos:
            infos |= make_infos(self._reports, np.ones(N, np.bool_))
        elif n_ended:
            infos |= make_infos(self._reports, over)
        if self._traces:
            self._record_step()
        return self._obs.copy(), rewards, terminated, truncated, infos

    def _reset_finished(self) -> Infos:
        """Reset the rows that are over; returns their last infos."""
        final_obs, over = np.full(self.num_envs, None), self._over.copy()
        rows = np.flatnonzero(over)
        for i in rows:
            final_obs[i] = self._obs[i].copy()
        infos: Infos = {"final_info": make_infos(self._reports, over), "final_obs": final_obs}
        self._start_rows(rows, {}, {})
        return infos | {f"_{key}": over.copy() for key in infos}

    def _get_episode(self, row: int) -> Episode:
        params, states, switches, *_ = self.engine.arrays
        rows, packets = self.rows[row], self.packets[row]
        record = rows[: self.ticks_done[row]], packets[: self.delivered[row]]
        numbers = params[row], states[row], switches[row], self._reports[row]
        return Episode(*numbers, self.configs[row], *record)

    @property
    def motion(self) -> Array:
        """True `Motion` of each row now, in SI units, shape (N, len(Motion))."""
        return np.array(self.engine.arrays.states[:, Z.motion[0] : Z.motion[-1] + 1])

    @property
    def true_state(self) -> Array:
        """`TrueState` of each row now, which no sensor has, shape (N, len(TrueState))."""
        return compute_true_states(*self.engine.arrays[:3])

    # what `StabilityEnv` has by these names, of each row's episode
    record = _EachRow(lambda episode: episode.record)
    """Record of each row's last step."""
    scenario = _EachRow(lambda episode: episode.config.scenario)
    """Scenario of each row's episode."""
    vehicle = _EachRow(lambda episode: episode.vehicle)
    """True vehicle of each row's episode, with what its seed drew."""
    car_truth = _EachRow(lambda episode: episode.car_truth)
    """What an oracle is told of each row's episode."""
    nominal = _EachRow(lambda episode: episode.config.nominal)
    """Vehicle that estimators and controllers of each row are designed from."""
    held_speed = _EachRow(lambda episode: episode.config.held_speed)
    """Speed (m/s) of each row that is held exactly (small-angle plant), or None."""
    slow_sensors = _EachRow(lambda episode: episode.slow_sensors)
    """Slow sensors of each row, with the clock phases that its episode drew."""
