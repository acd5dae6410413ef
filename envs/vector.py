"""StabilityVectorEnv: many cars in one compiled call a step, each with a single car's bits."""

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from .engine.batch import step_rows
from .engine.config import EnvConfig
from .engine.episodes import EpisodeBatch
from .engine.layout import Z
from .record import Array
from .rendering.renderer import PackedArrays, VectorRenderMixin
from .stability import StabilityEnv
from .task import REFUSED, WILD, make_infos
from .validation import (
    check_int,
    format_rows,
    parse_actions,
    parse_autoreset_mode,
    parse_reset_mask,
    parse_seeds,
    warn_once,
)

Observations = npt.NDArray[np.float32]
Flags = npt.NDArray[np.bool_]
Infos = dict[str, Any]

_INFO_MODES = ("all", "ends")


class StabilityVectorEnv(
    VectorRenderMixin, EpisodeBatch, VectorEnv[Observations, Any, npt.NDArray[Any]]
):
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

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        info: str = "all",
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **arguments: Any,
    ) -> None:
        self.num_envs = N = check_int("num_envs", num_envs, "environments")
        self._mode = parse_autoreset_mode(autoreset_mode)
        if info not in _INFO_MODES:
            raise ValueError(f"info is 'all' or 'ends', got {info!r}")
        self._all_infos = info == "all"
        self._max_steps = max_episode_steps
        if max_episode_steps is not None:
            self._max_steps = check_int("max_episode_steps", max_episode_steps, "steps")
        first_env, rows = _make_row_configs(arguments, N)
        EpisodeBatch.__init__(self, rows)
        self.reference = first_env.reference
        self._init_rendering(render_mode)
        self.metadata["autoreset_mode"] = self._mode
        self.single_observation_space = first_env.observation_space
        self.single_action_space = first_env.action_space
        self.observation_space = batch_space(first_env.observation_space, N)
        self.action_space = batch_space(first_env.action_space, N)

        self._started = False
        self._n_over = 0  # rows that are over

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

    _spec: EnvSpec | None = None

    def reset(
        self, *, seed: Any = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observations, Infos]:
        """Start episodes; where it raises, everything stays as it was.

        Args:
            seed: An int s (row i gets s + i), or a list (N,) of int or None.
            options: Options of `StabilityEnv`, each one or a list (N,), and `reset_mask`.

        Returns:
            Observations (N, width), and the infos of the rows that were reset.

        Raises:
            ResetNeeded: If a mask leaves out rows that were never started.
        """
        N, remaining = self.num_envs, dict(options or {})
        seeds, mask = parse_seeds(seed, N), parse_reset_mask(remaining.pop("reset_mask", None), N)
        if not (self._started or mask.all()):
            raise ResetNeeded("reset all rows first: a reset_mask leaves out some of them")
        chosen = np.flatnonzero(mask)
        configs, config_index = self.apply_options(remaining, chosen.tolist())
        rows = [i for i in chosen.tolist() if seeds[i] is not None]
        new_generators = {i: seeding.np_random(seeds[i]) for i in rows}
        for i, pair in new_generators.items():
            self.generators[i], self.seeds[i] = pair
        self.reset_rows(chosen, configs, config_index)
        self.over[mask] = False
        self._n_over, self._started = int(self.over.sum()), True
        if self._traces:
            self._record_step()
        return self.obs.copy(), make_infos(self.reports, mask) if self._all_infos else {}

    def step(self, actions: npt.ArrayLike) -> tuple[Observations, Array, Flags, Flags, Infos]:
        """Hold each row's action for one control period.

        Args:
            actions: Fractions of full scale, shape (N, 1), or (N, 2) with `steering`.

        Returns:
            Observations, rewards (N,), terminated (N,), truncated (N,) and infos.

        Raises:
            ResetNeeded: If no episode was started, or a row that ended waits for its reset.
            ValueError: If an action is refused; nothing is stepped.
        """
        N = self.num_envs
        if not self._started:
            raise ResetNeeded("no episode was started: call reset() first")
        if self._n_over and self._mode == AutoresetMode.DISABLED:
            raise ResetNeeded(
                f"the episode is over in {format_rows(np.flatnonzero(self.over))}: "
                "call reset() with a reset_mask"
            )
        config = self.config
        commands = parse_actions(actions, N, config.action_width, config.on_bad_action == "fail")
        over_rows = np.flatnonzero(self.over) if self._n_over else None
        results = np.empty(N), np.empty(N, np.bool_), np.empty(N, np.bool_)
        rewards, terminated, truncated = results
        n_ended = step_rows(self.arrays, commands, config.bounds, results, self.lane_buffers)
        if n_ended == REFUSED:
            bad = np.flatnonzero(~np.isfinite(commands).all(1) & ~self.over)
            raise ValueError(
                f"the action of {format_rows(bad)} is not finite, {commands[bad[0]].tolist()}; "
                "nothing was stepped"
            )
        if n_ended >= WILD:
            n_ended -= WILD
            warn_once(self, commands)
        if over_rows is not None:
            self.reset_rows(over_rows)
        if self._max_steps is not None:
            last_tick = (self._max_steps - 1) * self.control_period
            is_timed_out = self.states[:, Z.clock.tick] > last_tick
            truncated |= is_timed_out
            n_ended += int((is_timed_out & ~self.over).sum())
            self.over |= is_timed_out
        infos: Infos = {}
        if n_ended and self._mode == AutoresetMode.SAME_STEP:
            infos, n_ended = self._reset_finished(), 0
        self._n_over = n_ended
        if self._all_infos:
            infos |= make_infos(self.reports, np.ones(N, np.bool_))
        elif n_ended:
            infos |= make_infos(self.reports, self.over)
        if self._traces:
            self._record_step()
        return self.obs.copy(), rewards, terminated, truncated, infos

    def _reset_finished(self) -> Infos:
        """Reset the rows that are over; returns their last infos."""
        final_obs, rows = np.full(self.num_envs, None), np.flatnonzero(self.over)
        for i in rows:
            final_obs[i] = self.obs[i].copy()
        infos: Infos = {"final_info": make_infos(self.reports, self.over), "final_obs": final_obs}
        for key in tuple(infos):
            infos[f"_{key}"] = self.over.copy()
        self.reset_rows(rows)
        self.over[:] = False
        return infos

    def _get_packed_arrays(self, row: int) -> PackedArrays:
        numbers = self.params[row], self.states[row], self.switches[row], self.reports[row]
        return *numbers, self.configs[row]

    @property  # type: ignore[misc]  # without a setter, as in sync
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Each row's generator, which draws one 64-bit key a reset."""
        return tuple(map(self._get_generator, range(self.num_envs)))

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seed of each row's generator."""
        for i in range(self.num_envs):
            self._get_generator(i)  # a row without one gets one now
        return tuple(self.seeds)

    def get_state(self) -> dict[str, Any]:
        """Copy the state of all rows, from which `set_state` continues bit for bit."""
        arrays = {name: array.copy() for name, array in self.arrays._asdict().items()}
        return arrays | {
            "layout": self.layout,
            "configs": list(self.configs),
            "rng": copy.deepcopy(self.generators),
            "seeds": list(self.seeds),
            "started": self._started,
        }

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of this env or of one built with the same arguments.

        Args:
            snapshot: Return value of `get_state`.

        Raises:
            ValueError: If it has another number of rows, control period or observation.
        """
        shape, own_shape = np.shape(snapshot["rows"]), self.rows.shape
        if shape != own_shape:
            raise ValueError(
                f"the snapshot has {shape[0]} rows of {shape[1]} ticks a step, this env "
                f"{own_shape[0]} of {own_shape[1]}"
            )
        if snapshot["layout"] != self.layout:
            raise ValueError("the snapshot is of an env with other sensors or another observation")
        for name, array in self.arrays._asdict().items():
            if name != "params":
                array[:] = snapshot[name]
        self._set_params(snapshot["params"].copy())
        self.configs, self.seeds = list(snapshot["configs"]), list(snapshot["seeds"])
        self.generators = copy.deepcopy(snapshot["rng"])
        self._started, self._n_over = snapshot["started"], int(self.over.sum())
        self._group_by_variant()


def _make_row_configs(
    arguments: Mapping[str, Any], count: int
) -> tuple[StabilityEnv, list[EnvConfig]]:
    """Make the first row's env, and each row's config; rows with the same objects share both."""
    if arguments.get("vision") == "image":
        mode = "make_vec(..., vectorization_mode='sync')"
        raise ValueError(f"vision='image' sees for one car at a time: {mode}")
    columns = {}
    for name in ("scenario", "vehicle"):  # arguments that may be a list
        value = arguments.get(name)
        if not isinstance(value, list | tuple):
            value = [value] * count
        elif len(value) != count:
            raise ValueError(f"{name}: one or a list of {count}, one a row, got {len(value)}")
        columns[name] = value
    envs: dict[tuple[int, ...], StabilityEnv] = {}
    rows = []
    for values in zip(*columns.values(), strict=True):
        key = tuple(map(id, values))
        if key not in envs:
            named = zip(columns, values, strict=True)
            own_arguments = {name: value for name, value in named if value is not None}
            envs[key] = StabilityEnv(**{**arguments, **own_arguments})
        rows.append(envs[key].config)
    return next(iter(envs.values())), rows
