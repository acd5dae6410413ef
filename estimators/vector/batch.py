"""Many filters of one kind in one compiled call: those of one shape in SIMD lanes, others alone.

A block b has a filter's fields of the same names, whose numbers are lanes, so the equations of
`core` are compiled for it unchanged. Filter i of a batch, memory f, has a lane of block i // LANES.
Its model stays there and is loaded anew where its speed changed; its state in every call. A user's
own estimators are an object a row. What all of them read are the records of the vector env.
"""

import copy
import functools
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import SyncVectorEnv

from ...envs.numerics.jit import compile_call
from ...envs.numerics.packed import allocate_aligned, pad_to_cache_line
from ...envs.numerics.simd import LANES
from ...envs.record import FAST, FAST_WIDTH, PACKET_WIDTH, Array
from ...envs.task import ObservationEntry
from ..core.filter import Observed, OutputTable, StepRecord
from ..core.late_samples import CLONE, CONSTANT, IGNORE, STORED
from ..core.memory import FILTER, GAIN, N_CORE, N_FAST, N_INPUTS, FilterLayers
from ..estimator import Estimator
from ..filters import FILTERS
from ..make import make_estimator
from ..protocol import EstimatorFactory, ForeignEstimator, get_label
from ..wrappers.estimate import EstimatorSpec, find_base_env, make_spec, write_outputs
from ..wrappers.truth import AnyEstimator
from .lanes import FilterBank, observe_batch

Build = Callable[..., AnyEstimator]
_Mask = npt.NDArray[np.bool_]
_Shape = tuple[bytes, ...] | None

_MAX_STATES = 16  # states and clones
_ROW_LENGTH = _MAX_STATES + 1  # as long as a power of two, rows would share few places of the cache
_FLOATS: tuple[tuple[tuple[int, ...], tuple[str, ...]], ...] = (
    ((_ROW_LENGTH,), ("x", "own_decay", "decay", "drift", "PC", "gain")),
    ((_MAX_STATES, _ROW_LENGTH), ("P",)),  # on and above the diagonal, as Q
    ((N_CORE, _ROW_LENGTH), ("G", "GT", "Q")),
    ((N_INPUTS, _ROW_LENGTH), ("HT",)),
    ((N_FAST, _ROW_LENGTH), ("K", "C_fast")),  # K: periodic gains of this tick
    ((N_FAST, N_INPUTS), ("D_fast",)),
    ((N_FAST,), ("rest_fast", "r_fast", "y")),
    ((N_INPUTS, 2), ("u_factor",)),
    ((N_FAST, 2), ("y_factor",)),
    ((N_INPUTS,), ("u", "u_new")),
    ((FAST_WIDTH,), ("row",)),  # of this tick
    # ticks are those of now, of the last row, of the next packet to take and capture; model_speed,
    # 0: no model was loaded; here, 1: its filter has a row now, else what the lane holds is of no
    # use; apart, 1: its tick is computed alone; wild, 1: its residual is not finite
    ((), ("speed", "speed_before", "model_speed", "smoothing", "step", "road_turn")),
    ((), ("now", "last", "due", "next", "here", "apart", "wild")),
)
# of a lane: whether its filter has the block's shape, tick, step within the cycle, table of gains,
# packets done
_INTS = ("shaped", "tick", "at", "cell", "cursor")
_SHAPE = (  # what the filters of a block share
    *("n", "dense", "total", "inputs", "fasts", "gain_rule", "measured", "cycle"),
    *("stored", "robust", "u_column", "y_column"),
)
_FIELDS = (
    [(name, np.float64, (*shape, LANES)) for shape, names in _FLOATS for name in names]
    + [(name, np.int64, (LANES,)) for name in _INTS]
    + [(name, FILTER[name]) for name in _SHAPE]
    + [("column", np.int64, (FAST_WIDTH,)), ("columns", np.int64)]  # of a fast row, that are read
)
BLOCK = pad_to_cache_line(_FIELDS)


def _read_shape(layers: FilterLayers) -> _Shape:
    """Read what the filters of a block share; None for a filter whose ticks are computed alone."""
    # lanes compute models that change by speed alone, of which every tick predicts and corrects
    # without rules between samples, and store nothing of the past but predictions
    f = layers[0]
    is_steady = f.tyre_states == 0 and f.velocity == 0.0
    is_plain = f.stride == f.pace == 1 and f.gain_rule in (GAIN.covariance, GAIN.table)
    has_fixed_noise = f.r_share == 0.0 and f.steer_jump == 0.0
    is_small = f.delay_rule in (CLONE, IGNORE, STORED, CONSTANT) and f.total <= _MAX_STATES
    if len(layers) == 1 and is_steady and is_plain and has_fixed_noise and is_small:
        return tuple(f[name].tobytes() for name in _SHAPE)
    return None


def _make_blocks(filters: FilterLayers, shapes: Sequence[_Shape]) -> Any:
    """Make the blocks of filters (N, layers), each of its first shape."""
    blocks = allocate_aligned((-(-len(filters) // LANES),), BLOCK)
    for b, first in zip(blocks, range(0, len(filters), LANES), strict=True):
        group = shapes[first : first + LANES]
        shape = next(filter(None, group), None)
        if shape is not None:
            f = filters[first + group.index(shape), 0]
            for name in _SHAPE:
                b[name] = f[name]
            columns = {*f["u_column"][: f["inputs"]].flat, *f["y_column"][: f["fasts"]].flat}
            columns |= {FAST.wheel_left, FAST.wheel_right} if f["measured"] else set()
            b["columns"] = len(columns)
            b["column"][: len(columns)] = sorted(columns)
            b["shaped"][: len(group)] = [lane_shape == shape for lane_shape in group]
    return blocks


@functools.cache
def _compile_observe_batch() -> Callable[..., int]:
    """Return `observe_batch` as a plain call, for the types that all banks and records have."""
    counts, numbers, cube = np.zeros(1, np.int64), np.zeros(1), np.zeros((1, 1, 1))
    bank = FilterBank(np.zeros((1, 1), FILTER), numbers, np.zeros((1, 4), np.int64))
    record, obs = StepRecord(cube, counts, cube, counts), np.zeros((1, 0), np.float32)
    blocks = allocate_aligned((1,), BLOCK)
    table = OutputTable(0, np.zeros((0, 3), np.int64), numbers)
    observed = Observed(obs, table, numbers, numbers, obs, np.zeros((1, 4)))
    return compile_call(observe_batch, bank, counts, blocks, record, observed)


class BatchEstimator:
    """N filters of one name in one compiled call.

    `batch[i]` is the `Estimator` at work in row i: it shares that row's memory in `filters`, shape
    (N, layers). Filters of equal specs, but for the phases of clocks, share one table of gains.
    ValueError says that the filters have different states.

    Args:
        name: Name of the filters.
        specs: Vehicle, sensors and speed of each filter, N of them.
        dt: Tick (s).
        build: Function that builds one filter from its spec.
    """

    def __init__(self, name: str, specs: Sequence[EstimatorSpec], dt: float, build: Build) -> None:
        self.name, self.dt, self._build = name, dt, build
        self._specs: list[EstimatorSpec] = list(specs)
        self._designs: list[Hashable] = [None] * len(specs)
        self._shared: dict[Hashable, Estimator] = {}  # by design
        self._shapes: dict[Hashable, _Shape] = {}
        first = self._get_estimator(specs[0])
        self.names, self.units = first.names, first.units
        self.filters = allocate_aligned((len(specs), len(first.filters)), FILTER)
        self.configure(range(len(specs)), specs)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy: its filters lie on cache lines, too, and its lanes are empty."""
        self.__dict__.update(state)
        if "filters" not in state:  # estimators of a user's, each an object of its own
            return
        filters, self.filters = self.filters, allocate_aligned(self.filters.shape, FILTER)
        self.filters[:] = filters
        self._pool_gains()

    def _get_estimator(self, spec: EstimatorSpec) -> Estimator:
        """Return the estimator for a spec, built unless it is at hand."""
        if spec.design not in self._shared:
            estimator = self._build(**spec._asdict())
            if not isinstance(estimator, Estimator):
                text = "a batch is of filters of ours or of none"
                raise TypeError(f"{text}, got {estimator!r} as well")
            self._shared[spec.design] = estimator
            self._shapes[spec.design] = _read_shape(estimator.filters)
        return self._shared[spec.design]

    def _pool_gains(self) -> None:
        """Lay the gains of all designs in use side by side in a new pool, and make empty lanes."""
        self._shared = {design: self._shared[design] for design in self._designs}
        self._shapes = {design: self._shapes[design] for design in self._designs}
        self._pool = np.concatenate([x.gains.ravel() for x in self._shared.values()])
        places, start = dict[Hashable, tuple[int, ...]](), 0
        for design, estimator in self._shared.items():
            shape, end = estimator.gains.shape, start + estimator.gains.size
            places[design], estimator.gains = (start, *shape), self._pool[start:end].reshape(shape)
            start = end
        self._places = np.array([places[design] for design in self._designs], np.int64)
        self._lanes = _make_blocks(self.filters, [self._shapes[design] for design in self._designs])

    def __len__(self) -> int:
        return len(self.filters)

    def __getitem__(self, i: int) -> Any:
        estimator = copy.copy(self._shared[self._designs[i]])
        estimator.sensors = {name: self._specs[i].sensors[name] for name in estimator.sensors}
        estimator.filters = self.filters[i]
        return estimator

    def __iter__(self) -> Iterator[Any]:
        return (self[i] for i in range(len(self)))

    def configure(self, rows: Iterable[int], specs: Iterable[EstimatorSpec]) -> None:
        """Fit the filters of some rows to their specs; a reset has to follow.

        Where more than the phases of the clocks differ, a filter is built anew.
        """
        has_changed = False
        for i, spec in zip(rows, specs, strict=True):
            self._specs[i], design = spec, spec.design
            if design != self._designs[i]:
                built = self._get_estimator(spec)
                self._check_states(i, built.names)
                self._designs[i], self.filters[i], has_changed = design, built.filters, True
        if has_changed:
            self._pool_gains()

    def _check_states(self, i: int, names: tuple[str, ...]) -> None:
        if names != self.names:
            first, other = ", ".join(self.names), ", ".join(names)
            text = f"{self.name}: the filters of a batch have the same states"
            raise ValueError(f"{text}, row 0 has {first} and row {i} {other}")

    def reset(self, mask: _Mask) -> None:
        """Reset some filters to the clocks of their specs."""
        for i in np.flatnonzero(mask).tolist():
            self[i].reset()

    def take(self, mask: _Mask | None, record: StepRecord, observed: Observed) -> None:
        """Process rows and packets of some filters and write their outputs."""
        # rows done: -1 before the first; a filter that the mask leaves out has done all
        done = np.full(len(self), -1) if mask is None else np.where(mask, -1, record.rows)
        bank = FilterBank(self.filters, self._pool, self._places)
        while _compile_observe_batch()(bank, done, self._lanes, record, observed) > 0:
            missing = np.flatnonzero(done < record.rows)  # without gains; each design is made once
            keys = [(self._designs[i], int(self.filters[i, 0].missing_cell)) for i in missing]
            for i in dict(zip(keys, missing.tolist(), strict=True)).values():
                self[i].design_missing()

    def get_state(self) -> Any:
        """Return a snapshot, from which `set_state` restores every bit."""
        return self.filters.copy()

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot of this batch or of one with the same specs."""
        self.filters[:] = snapshot

    def __repr__(self) -> str:
        return f"<{len(self)} x {self.name}: {', '.join(self.names)}>"


class ForeignBatch(BatchEstimator):
    """N estimators of one factory, each an object of its row; none of them compiled.

    Args:
        first: Estimator of row 0.
        specs: Vehicle, sensors and speed of each estimator, N of them.
        dt: Tick (s).
        build: Function that builds one estimator from its spec.
    """

    def __init__(
        self, first: AnyEstimator, specs: Sequence[EstimatorSpec], dt: float, build: Build
    ) -> None:
        self.name, self.dt, self.names, self.units = first.name, dt, first.names, first.units
        self._build, others = build, [build(**spec._asdict()) for spec in specs[1:]]
        self._estimators: list[AnyEstimator] = [first, *others]
        self._designs = [spec.design for spec in specs]
        self.configure(range(len(specs)), specs)

    def __len__(self) -> int:
        return len(self._estimators)

    def __getitem__(self, i: int) -> AnyEstimator:
        return self._estimators[i]

    def configure(self, rows: Iterable[int], specs: Iterable[EstimatorSpec]) -> None:
        """Fit the estimators of some rows to their specs as `BatchEstimator.configure` does."""
        for i, spec in zip(rows, specs, strict=True):
            if spec.design != self._designs[i]:
                self._estimators[i] = self._build(**spec._asdict())
                self._designs[i] = spec.design
            self._check_states(i, self[i].names)
            self[i].sensors = dict(spec.sensors)

    def take(self, mask: _Mask | None, record: StepRecord, observed: Observed) -> None:
        """Process rows and packets as `BatchEstimator.take` does."""
        chosen = (np.arange(len(self)) if mask is None else np.flatnonzero(mask)).tolist()
        obs, table, beta, gamma, out, summary = observed
        for i in self._step_rows(chosen, record):
            row = Observed(obs[i], table, beta[i], gamma[i], out[i], summary[i])
            write_outputs(self[i], row)

    def _step_rows(self, rows: Sequence[int], record: StepRecord) -> Iterator[int]:
        """Step the estimators of some rows, and yield each row when it is done."""
        for i in rows:
            fast, n_rows, packets, count = (array[i] for array in record)
            self[i].step(fast[:n_rows], packets[:count])
            yield i

    def get_state(self) -> Any:
        """Return deep copies of the users' objects."""
        return [estimator.get_state() for estimator in self._estimators]

    def set_state(self, snapshot: Any) -> None:
        """Restore a snapshot of this batch or of one with the same specs."""
        for estimator, state in zip(self._estimators, snapshot, strict=True):
            estimator.set_state(state)


def build_batch(
    source: str | EstimatorFactory, specs: Sequence[EstimatorSpec], dt: float,
    options: Mapping[str, Any],
) -> BatchEstimator:  # fmt: skip
    """Build an estimator for each spec, compiled together where all are ours without `latency`."""
    build_one = functools.partial(make_estimator, source, dt=dt, **options)
    if not (isinstance(source, str) and source in FILTERS) or options.get("latency"):
        first = build_one(**specs[0]._asdict())
        if isinstance(first, ForeignEstimator):
            batch_class = getattr(first.inner, "batch", ForeignBatch)
            return batch_class(first, specs, dt, build_one)
        if not first.compiled:
            return ForeignBatch(first, specs, dt, build_one)
    return BatchEstimator(get_label(source), specs, dt, build_one)


_MEMBERS = ("rows", "ticks_done", "packets", "delivered")  # of a `StepRecord` in the env
BATCHED_MEMBERS = (
    *_MEMBERS,
    *(f"final_{name}" for name in _MEMBERS),  # before a car's newest reset
    *("slow_sensors", "nominal", "held_speed"),  # of each car, as those of a single env
    *("layout", "dt"),
)
"""What a vector env that steps all cars at once offers."""


class BatchedRecords:
    """The records of a vector env that offers `BATCHED_MEMBERS`."""

    def __init__(self, env: Any) -> None:
        self._env = env
        self.layout: tuple[ObservationEntry, ...] = env.layout
        self.dt: float = env.dt

    def read(self, prefix: str, rows: Iterable[int]) -> StepRecord:
        """Return the newest step's records, or with "final_" those of episodes that just ended."""
        arrays = (getattr(self._env, prefix + name) for name in _MEMBERS)
        types = (np.float64, np.int64) * 2
        records: Any = map(np.ascontiguousarray, arrays, types)  # copied where they are not
        return StepRecord(*records)

    def make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators."""
        names = ["nominal", "slow_sensors", "held_speed"]
        names += ["scenario"] * hasattr(self._env, "scenario")  # a foreign env has none
        columns = {name: getattr(self._env, name) for name in names}
        cars = ({name: values[i] for name, values in columns.items()} for i in rows)
        return [make_spec(SimpleNamespace(**car)) for car in cars]

    def annotate(self, label: str, beta: Array, std: Array, mask: _Mask) -> None:
        """Pass estimates (rad) of some rows to an env that draws, beside the truth."""
        if hasattr(self._env, "annotate"):
            self._env.annotate(label, beta, std, mask)


class SyncRecords:
    """The records of the environments in a `SyncVectorEnv`, copied into one array each."""

    def __init__(self, env: SyncVectorEnv[Any, Any]) -> None:
        self._bases = bases = [find_base_env(sub_env) for sub_env in env.envs]
        layouts = [sub_env.get_wrapper_attr("layout") for sub_env in env.envs]
        for i, layout in enumerate(layouts):
            if layout != layouts[0]:
                raise ValueError(f"environment {i} of the vector env has another layout than 0")
        self.layout: tuple[ObservationEntry, ...] = layouts[0]
        self.dt: float = bases[0].dt
        N = len(bases)
        fast = np.zeros((N, max(len(base.rows) for base in bases), FAST_WIDTH))
        packets = np.zeros((N, max(len(base.packets) for base in bases), PACKET_WIDTH))
        self._records = StepRecord(fast, np.zeros(N, np.int64), packets, np.zeros(N, np.int64))

    def read(self, prefix: str, rows: Iterable[int]) -> StepRecord:
        """Copy the records of some environments, those before a reset with "final_"."""
        records = self._records
        for i in rows:
            ticks, n, arrived, m = (getattr(self._bases[i], prefix + name) for name in _MEMBERS)
            records.fast[i, :n], records.packets[i, :m] = ticks[:n], arrived[:m]
            records.rows[i], records.count[i] = n, m
        return records

    def make_specs(self, rows: Sequence[int]) -> list[EstimatorSpec]:
        """Make the specs of some rows' estimators."""
        return [make_spec(self._bases[i]) for i in rows]

    def annotate(self, label: str, beta: Array, std: Array, mask: _Mask) -> None:
        """Pass estimates (rad) of some rows to the envs that draw."""
        for i in np.flatnonzero(mask):
            self._bases[i].annotate(label, float(beta[i]), float(std[i]))
