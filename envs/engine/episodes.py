"""Fleet: the packed numbers of many cars, their episodes and what these tell."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from gymnasium.utils import seeding

from ..arguments import options_of
from ..record import FAST_WIDTH, PACKET_WIDTH, Array, Record
from ..scenarios.draws import DRAWS_WIDTH
from ..scenarios.scenario import Scenario
from ..sensors.link import SlowSensor
from ..task.info import REPORT
from ..ticks import TICK
from ..vehicle.vehicle import Vehicle
from .batch import reset_rows
from .config import Setting
from .lanes import block_of
from .layout import FLAGS, PARAMS_WIDTH, STATE_WIDTH, P, Z
from .packing import Template
from .views import Each, record_in, slow_in, vehicle_in
from .window import scratch_of

Whole = npt.NDArray[np.int64]
Made = tuple[Template, Array]
T = TypeVar("T")


class Fleet:
    """N cars of one setting: arrays with a row for each, a generator and a template for each.

    `rows` (N, n, FAST_WIDTH) of which `ticks_done` (N,) are there and `packets` (N, room,
    PACKET_WIDTH) of which `delivered` (N,) are make the records; `final_...` are those before a
    row's newest reset. What is no array is a sequence of N whose items are made when asked for.
    """

    def __init__(self, setting: Setting, count: int) -> None:
        self.setting, self._count, N = setting, count, count
        self.control_period = int(setting.control_period)
        self.layout = setting.layout
        self.params, self.states = np.zeros((N, PARAMS_WIDTH)), np.zeros((N, STATE_WIDTH))
        self.switches = np.zeros((N, len(FLAGS)), np.int64)
        self.over = np.zeros(N, np.bool_)  # rows whose episode ended and was not reset yet
        self.obs = np.zeros((N, len(self.layout)), np.float32)
        self.reports = np.zeros((N, len(REPORT)))
        self.rows = np.zeros((N, self.control_period, FAST_WIDTH))
        self.packets = np.zeros((N, self.setting.room, PACKET_WIDTH))
        self.ticks_done, self.delivered = np.zeros(N, np.int64), np.zeros(N, np.int64)
        self.final_rows, self.final_packets = self.rows.copy(), self.packets.copy()
        self.final_ticks_done = self.ticks_done.copy()
        self.final_delivered = self.delivered.copy()
        self._drawn = np.zeros(DRAWS_WIDTH)
        self.scratch = scratch_of(self.control_period)
        self.block = block_of(N, self.control_period)
        self.templates: list[Template] = [self.setting.base] * N
        self.generators: list[np.random.Generator | None] = [None] * N
        self.seeds: list[int | None] = [None] * N

    def optioned(
        self, options: Mapping[str, Any], chosen: Sequence[int]
    ) -> tuple[list[Made], Whole]:
        """What the chosen rows start from by options of reset, and which of these each one does.

        Raises what `Setting.optioned` raises, and ValueError for a list of another length.
        """
        each, places = options_of(options, self._count), []
        made: list[Made] = []
        known: dict[tuple[Any, ...], int] = {}  # rows that are told the same objects share
        for i in chosen:
            told = (*each[i], *map(id, each[i].values()))
            if told not in known:
                known[told] = len(made)
                made.append(self.setting.optioned(each[i]))
            places.append(known[told])
        return made, np.array(places, np.int64)

    def restart(
        self, rows: Whole, made: Sequence[Made] | None = None, of: Whole | None = None
    ) -> None:
        """Reset rows with the next keys of their generators (None: without options)."""
        if made is None or of is None:
            made, of = [self.setting.optioned({})], np.zeros(len(rows), np.int64)
        keys = np.empty(len(rows), np.uint64)
        for m, (i, place) in enumerate(zip(rows.tolist(), of.tolist(), strict=True)):
            keys[m] = self.generator(i).integers(0, 2**64, dtype=np.uint64)
            self.templates[i] = made[place][0]
        reset_rows(
            rows,
            of,
            np.stack([template.params for template, _ in made]),
            np.stack([template.low for template, _ in made]),
            np.stack([template.high for template, _ in made]),
            np.stack([template.switches for template, _ in made]),
            np.stack([start for _, start in made]),
            self._drawn,
            np.stack([keys & 0xFFFFFFFF, keys >> 32], 1).astype(np.int64),
            self.setting.bounds,
            self.params,
            self.states,
            self.switches,
            self.obs,
            self.rows,
            self.packets,
            self.reports,
            self.ticks_done,
            self.delivered,
            self.final_rows,
            self.final_packets,
            self.final_ticks_done,
            self.final_delivered,
        )
        self.sort()

    def sort(self) -> None:
        """Put rows whose ticks have the same text next to each other in the block's order."""
        lags = self.params[:, [P.motor.start, P.steering.start]] > 0.0
        kinds = np.hstack([self.switches, lags])
        mixed = (kinds != kinds[0]).any()
        self.block.order[:] = np.lexsort(kinds.T) if mixed else np.arange(self._count)

    def generator(self, i: int) -> np.random.Generator:
        """A row's, which draws one 64-bit key a reset; seeded by chance if it never was."""
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
        """The true `Motion` of each row now, (N, len(Motion)), in SI units."""
        return self.states[:, Z.motion[0] : Z.motion[-1] + 1].copy()

    @property
    def record(self) -> Sequence[Record]:
        """Each row's `StabilityEnv.record`."""
        return self._each(
            lambda i: record_in(
                self.states[i],
                self.rows[i, : self.ticks_done[i]],
                self.packets[i, : self.delivered[i]],
            )
        )

    @property
    def scenario(self) -> Sequence[Scenario]:
        """The scenario of each row's episode."""
        return self._each(lambda i: self.templates[i].scenario)

    @property
    def vehicle(self) -> Sequence[Vehicle]:
        """The true vehicle of each row's episode, with what its seed drew."""
        return self._each(lambda i: vehicle_in(self.templates[i], self.params[i], self.states[i]))

    @property
    def nominal(self) -> Sequence[Vehicle]:
        """The vehicle that estimators and controllers of each row are told."""
        return self._each(lambda i: self.templates[i].nominal)

    @property
    def held_speed(self) -> Sequence[float | None]:
        """Each row's speed in m/s that is held exactly (small-angle plant), or None."""
        return self._each(lambda i: self.templates[i].held_speed)

    @property
    def slow_sensors(self) -> Sequence[dict[str, SlowSensor]]:
        """Each row's slow sensors by name, with the clock phases that its episode drew."""
        return self._each(lambda i: slow_in(self.templates[i], self.states[i]))

    def _each(self, of: Callable[[int], T]) -> Each[T]:
        return Each(self._count, of)
