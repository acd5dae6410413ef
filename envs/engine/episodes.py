"""`EpisodeBatch`: the state of N episodes, arrays with a row for each."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, overload

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding

from ..record import FAST_WIDTH, PACKET_WIDTH, Array, Record
from ..scenarios.scenario import Scenario
from ..sensors.link import SlowSensor
from ..task import REPORT
from ..ticks import TICK
from ..validation import split_options
from ..vehicle.parameters import Vehicle
from .batch import BatchArrays, RecordArrays, make_lane_buffers, reset_rows
from .config import EnvConfig, EpisodeConfig
from .layout import FLAGS, PARAMS_WIDTH, STATE_WIDTH, P, Z
from .views import compute_true_states, get_slow_sensors, get_vehicle, make_record
from .workspace import EpisodeStart

IntArray = npt.NDArray[np.int64]
T = TypeVar("T")


def _pad_params(params: Array, width: int) -> Array:
    """Pad packed parameters to (width,): a trace repeats its last angle, others append zeros."""
    has_trace = len(params) > PARAMS_WIDTH
    return np.pad(params, (0, width - len(params)), "edge" if has_trace else "constant")


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


class EpisodeBatch:
    """N episodes: arrays with a row for each, and each one's generator.

    The first `ticks_done` (N,) of `rows` (N, n, FAST_WIDTH) and `delivered` (N,) of `packets`
    (N, max, PACKET_WIDTH) make the records; `final_...` are those before a row's newest reset.

    Args:
        rows: Config of each row, which differ in scenario and vehicles alone.
    """

    def __init__(self, rows: Sequence[EnvConfig]) -> None:
        config, N = rows[0], len(rows)
        self.config, self._count, self._row_configs = config, N, list(rows)
        distinct = {id(row_config): row_config for row_config in rows}
        self._distinct_configs = list(distinct.values())
        self._config_index = np.array([list(distinct).index(id(row_config)) for row_config in rows])
        self.control_period = int(config.control_period)
        self.layout = config.layout
        self.arrays = BatchArrays(
            params=np.zeros((N, PARAMS_WIDTH)), states=np.zeros((N, STATE_WIDTH)),
            switches=np.zeros((N, len(FLAGS)), np.int64),
            obs=np.zeros((N, len(self.layout)), np.float32),
            rows=np.zeros((N, self.control_period, FAST_WIDTH)),
            packets=np.zeros((N, config.max_packets, PACKET_WIDTH)),
            reports=np.zeros((N, len(REPORT))), ticks_done=np.zeros(N, np.int64),
            delivered=np.zeros(N, np.int64), over=np.zeros(N, np.bool_),
        )  # fmt: skip
        self.params, self.states, self.switches, self.obs, *record, self.over = self.arrays
        self.rows, self.packets, self.reports, self.ticks_done, self.delivered = record
        records = self.rows, self.packets, self.ticks_done, self.delivered
        self._final = final = RecordArrays(*(array.copy() for array in records))
        self.final_rows, self.final_packets, self.final_ticks_done, self.final_delivered = final
        self.lane_buffers = make_lane_buffers(N, self.control_period, len(self.layout))
        self.configs: list[EpisodeConfig] = [row_config.base for row_config in rows]
        self.generators: list[np.random.Generator | None] = [None] * N
        self.seeds: list[int | None] = [None] * N

    def apply_options(
        self, options: Mapping[str, Any], chosen: Sequence[int]
    ) -> tuple[list[EpisodeConfig], IntArray]:
        """Make configs with options of reset.

        Args:
            options: Options by name, each one or a list (N,).
            chosen: The rows, shape (M,).

        Returns:
            The configs, and the index (M,) of each chosen row's.
        """
        row_options, places = split_options(options, self._count), []
        configs: list[EpisodeConfig] = []
        known: dict[tuple[Any, ...], int] = {}  # rows with the same objects as options share one
        for i in chosen:
            key = (id(self._row_configs[i]), *row_options[i], *map(id, row_options[i].values()))
            if key not in known:
                known[key] = len(configs)
                configs.append(self._row_configs[i].apply_options(row_options[i]))
            places.append(known[key])
        return configs, np.array(places, np.int64)

    def reset_rows(
        self,
        chosen: IntArray,
        configs: Sequence[EpisodeConfig] | None = None,
        config_index: IntArray | None = None,
    ) -> None:
        """Reset rows with the next keys of their generators.

        Args:
            chosen: The rows, shape (M,).
            configs: Configs of their episodes; None for those without options.
            config_index: Index of each one's config, shape (M,).
        """
        if configs is None or config_index is None:
            places, config_index = np.unique(self._config_index[chosen], return_inverse=True)
            configs = [self._distinct_configs[place].base for place in places]
        keys = np.empty(len(chosen), np.uint64)
        for m, (i, place) in enumerate(zip(chosen.tolist(), config_index.tolist(), strict=True)):
            keys[m] = self._get_generator(i).integers(0, 2**64, dtype=np.uint64)
            self.configs[i] = configs[place]
        words = np.stack([keys & 0xFFFFFFFF, keys >> 32], 1).astype(np.int64)
        width = max(self.params.shape[1], *(len(config.start.params) for config in configs))
        if width > self.params.shape[1]:  # for a trace
            self._set_params(np.array([_pad_params(row, width) for row in self.params]))
        packed = [c.start._replace(params=_pad_params(c.start.params, width)) for c in configs]
        starts = EpisodeStart(*map(np.stack, zip(*packed, strict=True)))
        reset_rows(
            chosen, config_index, starts, words, self.config.bounds, self.arrays, self._final
        )
        self._group_by_variant()

    def _set_params(self, params: Array) -> None:
        """Replace the packed parameters by others, shape (N, width)."""
        self.params = params
        self.arrays = self.arrays._replace(params=params)

    def _group_by_variant(self) -> None:
        """Sort rows of the same variant next to each other in the block's order."""
        lags = self.params[:, [P.motor.start, P.steering.start]] > 0.0
        variants = np.hstack([self.switches, lags])
        is_mixed = (variants != variants[0]).any()
        self.lane_buffers.order[:] = np.lexsort(variants.T) if is_mixed else np.arange(self._count)

    def _get_generator(self, i: int) -> np.random.Generator:
        """Get row i's generator, which draws one 64-bit key a reset; seeded randomly at first."""
        generator = self.generators[i]
        if generator is None:
            generator, self.seeds[i] = seeding.np_random()
            self.generators[i] = generator
        return generator

    @property
    def dt(self) -> float:
        """The base tick in seconds."""
        return TICK

    @property
    def motion(self) -> Array:
        """True `Motion` of each row now, in SI units, shape (N, len(Motion))."""
        return np.array(self.states[:, Z.motion[0] : Z.motion[-1] + 1])

    @property
    def true_state(self) -> Array:
        """`TrueState` of each row now, which no sensor has, shape (N, len(TrueState))."""
        return compute_true_states(self.params, self.states, self.switches)

    @property
    def record(self) -> Sequence[Record]:
        """Each row's `StabilityEnv.record`."""

        def make(i: int) -> Record:
            rows, packets = self.rows[i, : self.ticks_done[i]], self.packets[i, : self.delivered[i]]
            return make_record(self.states[i], rows, packets)

        return self._map_rows(make)

    @property
    def scenario(self) -> Sequence[Scenario]:
        """The scenario of each row's episode."""
        return self._map_rows(lambda i: self.configs[i].scenario)

    @property
    def vehicle(self) -> Sequence[Vehicle]:
        """The true vehicle of each row's episode, with what its seed drew."""
        return self._map_rows(
            lambda i: get_vehicle(self.configs[i], self.params[i], self.states[i])
        )

    @property
    def nominal(self) -> Sequence[Vehicle]:
        """The vehicle that estimators and controllers of each row are designed from."""
        return self._map_rows(lambda i: self.configs[i].nominal)

    @property
    def held_speed(self) -> Sequence[float | None]:
        """Each row's speed in m/s that is held exactly (small-angle plant), or None."""
        return self._map_rows(lambda i: self.configs[i].held_speed)

    @property
    def slow_sensors(self) -> Sequence[dict[str, SlowSensor]]:
        """Each row's slow sensors by name, with the clock phases that its episode drew."""
        return self._map_rows(lambda i: get_slow_sensors(self.configs[i], self.states[i]))

    def _map_rows(self, make_item: Callable[[int], T]) -> _LazyRows[T]:
        return _LazyRows(self._count, make_item)
