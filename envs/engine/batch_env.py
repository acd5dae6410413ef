"""`BatchEnv`: what environments of many cars share, whichever engine steps them."""

import copy
import operator
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ..task import Infos
from ..validation import Mask, format_rows, short_repr, split_by_rows
from .batch import IntArray, NumbaEngine
from .config import EnvConfig
from .layout import EpisodeConfig

ArrayT = TypeVar("ArrayT")


class BatchEnv(VectorEnv[ArrayT, Any, Any], ABC, Generic[ArrayT]):
    """`num_envs` environments that are stepped together by an engine, which a subclass has.

    Options, masks, autoreset and errors of all rows are here. Seeds are, too: each row has a
    generator on the host, unless its engine has one.

    Args:
        autoreset_mode: "NextStep", "SameStep" or "Disabled", or the enum.
        rows: Config of each row, which differ in scenario and vehicles alone.
    """

    engine: NumbaEngine  # on the host, where there is one
    _has_over = False  # whether a row may be over

    def __init__(self, autoreset_mode: str | AutoresetMode, rows: list[EnvConfig]) -> None:
        self.num_envs, self.row_configs, self.config = len(rows), rows, rows[0]
        try:
            self._mode = AutoresetMode(autoreset_mode)
        except ValueError:
            known, got = ", ".join(repr(m.value) for m in AutoresetMode), short_repr(autoreset_mode)
            raise ValueError(f"unknown autoreset_mode {got}; known: {known}") from None
        self.metadata = {**self.metadata, "autoreset_mode": self._mode}
        config, N = rows[0], len(rows)
        self.layout, self.reference = config.layout, config.reference
        self.control_period = int(config.control_period)
        self.single_observation_space, self.single_action_space = config.make_spaces()
        self.observation_space = batch_space(self.single_observation_space, N)
        self.action_space = batch_space(self.single_action_space, N)
        self.configs = [row.base for row in rows]
        self.generators: list[np.random.Generator | None] = [None] * N
        self.seeds: list[int | None] = [None] * N
        self._started = False

    def reset(
        self, *, seed: Any = None, options: Mapping[str, Any] | None = None
    ) -> tuple[ArrayT, Infos]:
        """Start episodes; returns observations (N, width) and the infos of the rows that are reset.

        Where it raises, nothing changes; ResetNeeded if a mask leaves out rows that never started.

        Args:
            seed: An int s (row i gets s + i), or a list (N,) of int or None.
            options: Options of `StabilityEnv`, each one or a list (N,), and `reset_mask`.
        """
        N, remaining = self.num_envs, dict(options or {})
        seeds, mask = _parse_seeds(seed, N), _parse_reset_mask(remaining.pop("reset_mask", None), N)
        if not (self._started or mask.all()):
            raise ResetNeeded("reset all rows first: a reset_mask leaves out some of them")
        chosen = np.flatnonzero(mask)
        seeded = {i: entry for i in chosen.tolist() if (entry := seeds[i]) is not None}
        self._start_rows(chosen, seeded, remaining)
        self._started = True
        return self._read_reset(mask)

    def step(self, actions: npt.ArrayLike) -> tuple[ArrayT, ArrayT, ArrayT, ArrayT, Infos]:
        """Hold each row's action for one control period; rewards and both flags have shape (N,).

        Args:
            actions: Fractions of full scale, shape (N, 1), or (N, 2) with `steering`.

        Raises:
            ResetNeeded: If no episode was started, or a row that ended waits for its reset.
            ValueError: If an action is refused; nothing is stepped.
        """
        if not self._started:
            raise ResetNeeded("no episode was started: call reset() first")
        waits = self._has_over and self._mode == AutoresetMode.DISABLED
        if waits and (rows := self._list_over_rows()):
            over = format_rows(rows)
            raise ResetNeeded(f"the episode is over in {over}: call reset() with a reset_mask")
        return self._step_rows(actions)

    @abstractmethod
    def _start_rows(self, chosen: IntArray, seeds: dict[int, int], options: dict[str, Any]) -> None:
        """Reset the chosen rows (M,), some with new seeds."""

    @abstractmethod
    def _read_reset(self, mask: Mask) -> tuple[ArrayT, Infos]:
        """Read observations and infos after a reset of the rows of a mask (N,)."""

    @abstractmethod
    def _step_rows(self, actions: Any) -> tuple[ArrayT, ArrayT, ArrayT, ArrayT, Infos]:
        """Step all rows, and reset those that it has to."""

    @abstractmethod
    def _list_over_rows(self) -> list[int]:
        """List the rows whose episode is over."""

    def _make_configs(
        self, options: Mapping[str, Any], chosen: IntArray
    ) -> tuple[list[EpisodeConfig], IntArray]:
        """Make configs with options of reset; (configs, index (M,) of each chosen row's)."""
        N, index = self.num_envs, np.empty_like(chosen)
        row_options = split_by_rows(options, N, "reset option ") if options else [{}] * N
        configs: list[EpisodeConfig] = []
        known: dict[tuple[object, ...], int] = {}  # rows with the same objects share a config
        for m, i in enumerate(chosen.tolist()):
            config, values = self.row_configs[i], row_options[i]
            index[m] = place = known.setdefault(
                (id(config), *values, *map(id, values.values())), len(configs)
            )
            if place == len(configs):
                configs.append(config.apply_options(values))
        return configs, index

    def _restart_rows(
        self, chosen: IntArray, configs: list[EpisodeConfig], index: IntArray, seeds: dict[int, int]
    ) -> None:
        """Reset rows of the engine on the host with the next keys of their generators."""
        for i, seed in seeds.items():
            self.generators[i], self.seeds[i] = seeding.np_random(seed)
        keys = np.empty(len(chosen), np.uint64)
        for m, (i, place) in enumerate(zip(chosen.tolist(), index.tolist(), strict=True)):
            keys[m] = self._get_generator(i).integers(0, 2**64, dtype=np.uint64)
            self.configs[i] = configs[place]
        self.engine.reset(chosen, [config.start for config in configs], index, keys)

    def _refuse_actions(self, rows: Sequence[int], commands: Any) -> None:
        """Raise ValueError for the commands (N, width) of rows that are not finite."""
        got = f"is not finite, {commands[rows[0]].tolist()}"
        raise ValueError(f"the action of {format_rows(rows)} {got}; nothing was stepped")

    def _get_generator(self, i: int) -> np.random.Generator:
        """Get row i's generator, which draws one 64-bit key a reset; seeded randomly at first."""
        generator = self.generators[i]
        if generator is None:
            generator, self.seeds[i] = seeding.np_random()
            self.generators[i] = generator
        return generator

    @property  # type: ignore[misc]  # without a setter, as in sync
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """Each row's generator, on the host, which draws one 64-bit key a reset."""
        return tuple(map(self._get_generator, range(self.num_envs)))

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seed of each row's generator."""
        return tuple(self.seeds[: len(self.np_random)])  # a row without a generator gets one now

    def get_state(self) -> Any:
        """Copy the state of all rows, from which `set_state` continues bit for bit."""
        parts = self.engine.arrays._asdict()
        arrays: dict[str, Any] = {name: array.copy() for name, array in parts.items()}
        arrays |= {"configs": list(self.configs), "seeds": list(self.seeds), "layout": self.layout}
        return arrays | {"rng": copy.deepcopy(self.generators), "started": self._started}

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot of this env or of one built with the same arguments.

        Args:
            snapshot: From `get_state`; ValueError if N, control period or observation differ.
        """
        shape, own_shape = np.shape(snapshot["rows"]), self.engine.arrays.rows.shape
        if shape != own_shape:
            sizes = f"{shape[0]} rows of {shape[1]} ticks a step"
            own_sizes = f"this env {own_shape[0]} of {own_shape[1]}"
            raise ValueError(f"the snapshot has {sizes}, {own_sizes}")
        if snapshot["layout"] != self.layout:
            raise ValueError("the snapshot is of an env with other sensors or another observation")
        self.engine.restore(snapshot)
        self.configs, self.seeds = list(snapshot["configs"]), list(snapshot["seeds"])
        self.generators = copy.deepcopy(snapshot["rng"])
        self._started, self._has_over = snapshot["started"], bool(self.engine.arrays.over.any())


def _parse_seeds(seed: object, count: int) -> list[int | None]:
    """Make a seed for each row from s (row i gets s + i), a list (N,) of them or None."""
    if seed is None:
        return [None] * count
    if isinstance(seed, int | np.integer):
        seeds: list[int | None] = [int(seed) + i for i in range(count)]
    else:
        if not isinstance(seed, Sequence | np.ndarray):
            raise TypeError(f"seed: an int or a list of {count}, got {short_repr(seed)}")
        if len(seed) != count:
            raise ValueError(f"seed: an int or a list of {count}, got {len(seed)}")
        seeds = [None if entry is None else operator.index(entry) for entry in seed]
    bad = [i for i, entry in enumerate(seeds) if entry is not None and entry < 0]
    if bad:
        got = short_repr(seeds[bad[0]])
        raise ValueError(f"seed: {format_rows(bad)} would get a negative seed, {got}")
    return seeds


def _parse_reset_mask(mask: Any, count: int) -> Mask:
    """Parse options["reset_mask"], an array or a tensor (N,) of bool; all rows without it."""
    if mask is None:
        return np.ones(count, np.bool_)
    mask = mask.cpu().numpy() if hasattr(mask, "cpu") else mask
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        what = mask.dtype if isinstance(mask, np.ndarray) else type(mask).__name__
        raise TypeError(f"options['reset_mask'] is an array of bool, got {what}")
    if mask.shape != (count,):
        raise ValueError(f"options['reset_mask'] has shape ({count},), got {mask.shape}")
    if not mask.any():
        raise ValueError("options['reset_mask'] resets no row")
    return mask
