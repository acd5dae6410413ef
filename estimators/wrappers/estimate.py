"""EstimateObservation: an estimator's states beside, or instead of, the raw observation."""

import dataclasses
import functools
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn, Self

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from ...envs.numerics.functions import wrap
from ...envs.numerics.jit import as_python, compile_call
from ...envs.numerics.primitives import ARRAYS
from ...envs.sensors.link import SlowSensor
from ...envs.task import Infos, ObservationEntry, make_space
from ...envs.validation import describe_unknown, short_repr
from ...envs.vehicle.parameters import Vehicle, VehicleSource, make_vehicle
from ..core.filter import Observed, OutputTable, StepRecord, observe
from ..core.memory import FILTER
from ..design.options import FOREIGN_STATE, STATES
from ..estimator import Estimator
from ..filters import FILTERS
from ..make import find_entry_point, make_estimator
from ..protocol import EstimatorFactory, EstimatorLike, ForeignEstimator, compute_std, get_label
from .truth import TRUTH, AnyEstimator, calibrate, choose_vehicle, set_stiffness

EstimatorSource = str | EstimatorFactory | EstimatorLike
"""What `EstimateObservation` takes for its estimator: a name, a factory or an object."""
_Floats = npt.NDArray[np.float32]
_TRUTHS = {"beta": 1, "gamma": 2}  # code of each state whose truth `observe` gets; 0: none
_WRAPPED = ("psi", "psi_late")  # angles that are wrapped to +-pi
_ALLOWED_WRAPPERS = (PassiveEnvChecker, OrderEnforcing, TimeLimit)
# stable-baselines3's make_vec_env and rl-zoo put it directly around the environment. It only counts
# and is known by name: this module loads nothing of theirs.
_MONITOR = ("stable_baselines3.common.monitor", "Monitor")
_BASE_MEMBERS = (
    *("rows", "ticks_done", "packets", "delivered", "slow_sensors", "nominal", "layout", "dt"),
    "annotate",
)


BETA, STD, NEES, HEALTHY = range(4)  # places in the summary of a step
_wrap = as_python(wrap, ARRAYS)


@dataclasses.dataclass(frozen=True)
class Outputs:
    """The entries of a wrapped observation."""

    title: str  # of the estimator, for pictures
    layout: tuple[ObservationEntry, ...]
    table: OutputTable
    keys: tuple[tuple[str, int], ...]  # keys of `info`, with their places in the summary


_RIGID = 0.001  # m, arm of a body that no force rolls


class EstimatorSpec(NamedTuple):
    """Vehicle, sensors and speed for which an estimator is built."""

    vehicle: Vehicle  # as the estimator believes it to be
    sensors: Mapping[str, SlowSensor]  # slow ones by name
    speed: float | None = None  # m/s where it is held

    def replace_vehicle(self, car: Vehicle) -> Self:
        """Replace the vehicle; its body is rigid where that of the present one is.

        Args:
            car: The other vehicle.
        """
        is_rigid = self.vehicle.roll_arm == _RIGID
        return self._replace(vehicle=car.replace(roll_arm=_RIGID) if is_rigid else car)

    @property
    def design(self) -> Hashable:
        """A key that is equal for specs that differ in the phases of their clocks alone."""
        clocks = [(name, dataclasses.replace(s, phase=0.0)) for name, s in self.sensors.items()]
        return self.vehicle, tuple(sorted(clocks)), self.speed


def make_spec(base: Any) -> EstimatorSpec:
    """Make the spec of a single env in its present episode; a body that does not roll is rigid.

    Args:
        base: Environment without wrappers; its scenario and held speed may be missing.
    """
    rolls = getattr(getattr(base, "scenario", None), "roll", True)
    vehicle = base.nominal if rolls else base.nominal.replace(roll_arm=_RIGID)
    return EstimatorSpec(vehicle, base.slow_sensors, getattr(base, "held_speed", None))


@dataclasses.dataclass
class Arguments:
    """The arguments of `EstimateObservation` beside its env, which documents them."""

    estimator: Any = None  # name, factory or object; None: that of `choose_estimator`
    outputs: Sequence[str] = ("beta", "gamma")
    std: bool = True
    replace: bool = False
    vehicle: Any = None
    options: Any = None
    name: str | None = None
    recorded: dict[str, Any] = dataclasses.field(init=False, default_factory=dict)  # for a spec

    @classmethod
    def read(cls, slow_sensors: Mapping[str, SlowSensor], *values: Any, **misplaced: Any) -> Self:
        """Read and check arguments, choose an estimator where there is none, make the vehicle.

        Args:
            slow_sensors: Slow sensors of the env by name.
            *values: Arguments of the wrapper; ValueError if vehicle or options reach no object.
            **misplaced: Unknown arguments; TypeError for them has the nearest name.
        """
        names = [field.name for field in dataclasses.fields(cls) if field.init]
        self = cls(*values)
        if self.estimator is None:
            self.estimator = choose_estimator(slow_sensors)
        if misplaced:
            wrong = describe_unknown("argument of EstimateObservation", misplaced, names)
            if isinstance(self.estimator, str) and "did you mean" not in wrong:
                # this names the nearest option
                make_estimator(self.estimator, sensors=slow_sensors, **misplaced)
                wrong = f"options of an estimator are passed as options={short_repr(misplaced)}"
            raise TypeError(wrong)
        self.options = dict(self.options or {})
        recorded, car = self.estimator, self.vehicle
        if car is not None and not self.is_told_truth:
            self.vehicle = make_vehicle(car)
        if self.is_object:
            if car is not None or self.options:
                text = "is built already: a vehicle and options go to a name or a factory"
                raise ValueError(f"{self.label} {text}")
            recorded = functools.partial(_refuse_rebuild, self.label)
        elif not isinstance(recorded, str):
            recorded = find_entry_point(recorded) or recorded
        car = car.to_dict() if isinstance(car, Vehicle) else car
        car = dict(car) if isinstance(car, Mapping) else car
        values = recorded, list(self.outputs), bool(self.std), bool(self.replace)
        self.recorded = dict(zip(names, (*values, car, self.options, self.name), strict=True))
        return self

    @property
    def label(self) -> str:
        """Name of the estimator for messages."""
        return get_label(self.estimator)

    @property
    def is_object(self) -> bool:
        """Whether the estimator is one, well made or not, rather than what builds one."""
        source = self.estimator
        if isinstance(source, str | type):
            return False
        return not callable(source) or hasattr(source, "step") or hasattr(source, "reset")

    @property
    def is_told_truth(self) -> bool:
        """Whether the vehicle is the true one."""
        return isinstance(self.vehicle, str) and self.vehicle == TRUTH

    @property
    def _finds_noise(self) -> bool:
        """Whether it is a filter that finds its noise, and so knows when it is lost."""
        row = FILTERS.get(self.estimator) if isinstance(self.estimator, str) else None
        options = {} if row is None else dict(row.options) | dict(self.options)
        return bool(options.get("noise_time", 0.0))

    def make_outputs(self, states: tuple[str, ...], inner: tuple[ObservationEntry, ...]) -> Outputs:
        """Make the outputs behind an inner observation's; ValueError for unknown or repeated ones.

        Args:
            states: Names of the estimator's states.
            inner: Entries of the inner observation, which `replace` leaves out.
        """
        for output in self.outputs:
            if output not in states:
                known = ", ".join(states)
                raise ValueError(f"{self.label} has no state {output!r}; it has: {known}")
        prefix = "" if self.name is None else f"{self.name}_"
        kinds = [STATES.get(s, FOREIGN_STATE) for s in self.outputs]
        n_inner, layout = (0, []) if self.replace else (len(inner), list(inner))
        for ending, low in (("hat", -1.0), ("std", 0.0)) if self.std else (("hat", -1.0),):
            for s, (unit, _, bound) in zip(self.outputs, kinds, strict=True):
                layout.append(ObservationEntry(f"{prefix}{s}_{ending}", unit, low * bound, bound))
        names = [entry.name for entry in layout]
        if duplicates := ", ".join(sorted({entry for entry in names if names.count(entry) > 1})):
            raise ValueError(f"{duplicates} would stand twice; give this wrapper a name=...")
        truths = [_TRUTHS.get(s, 0) for s in self.outputs]
        columns = [states.index(s) for s in self.outputs], [s in _WRAPPED for s in self.outputs]
        keys = [("beta_hat", BETA), ("beta_std", STD)] if "beta" in states else []
        keys += [("nees", NEES)] if any(truths) else []
        keys += [("healthy", HEALTHY)] if self._finds_noise else []
        plan = np.array([*columns, truths], np.int64).T.copy()
        limits = np.array([kind.bound for kind in kinds]).astype(np.float32).astype(np.float64)
        table = OutputTable(n_inner, plan, limits)
        title = self.label if self.name is None else f"{self.label} ({self.name})"
        return Outputs(title, tuple(layout), table, tuple((prefix + k, place) for k, place in keys))


def _refuse_rebuild(label: str, **_: object) -> NoReturn:
    """Raise the reason why a spec with an object cannot be built, in the place of a factory."""
    text = f"a spec cannot build {label} once more: it was passed as an object"
    raise TypeError(f"{text}; pass its class, a factory or a name")


@functools.cache
def compile_observe() -> Any:
    """Return `observe` as a plain call with the same positional arguments."""
    small, wide, matrix = np.zeros(1, np.float32), np.zeros(1), np.zeros((1, 1))
    memory, record = (np.zeros(1, FILTER), np.zeros((1, 1, 1))), StepRecord(matrix, 0, matrix, 0)
    table = OutputTable(0, np.zeros((1, 3), np.int64), wide)
    observed = Observed(small, table, 0.0, 0.0, small, wide)
    return compile_call(observe, *memory, record, 0, observed)


def write_outputs(estimator: EstimatorLike, observed: Observed) -> None:
    """Write a user's estimates as `observe` writes a compiled filter's; raises as `estimator.x`.

    Args:
        estimator: The user's estimator.
        observed: Observation and outputs.
    """
    obs, (inner, plan, limits), beta, gamma, out, summary = observed
    x, P = np.asarray(estimator.x), np.asarray(estimator.P)
    std, states, m = compute_std(P), plan[:, 0], len(plan)
    out[:inner] = obs[:inner]
    with np.errstate(invalid="ignore"):
        values = np.where(plan[:, 1] == 1, _wrap(x[states]), x[states])
    out[inner : inner + m] = np.clip(values, -limits, limits)
    if len(out) > inner + m:
        out[inner + m :] = np.clip(std[states], -limits, limits)
    first = estimator.names.index("beta") if "beta" in estimator.names else 0
    truth_plan = plan[plan[:, 2] > 0]
    e = x[truth_plan[:, 0]] - np.where(truth_plan[:, 2] == 1, beta, gamma)
    P_e = P[np.ix_(truth_plan[:, 0], truth_plan[:, 0])]
    nees = e @ np.linalg.solve(P_e, e) / len(e) if len(e) and np.linalg.det(P_e) > 0.0 else 0.0
    summary[:] = x[first], std[first], nees, float(getattr(estimator, "is_healthy", True))


def choose_estimator(slow_sensors: Iterable[str]) -> str:
    """Choose the estimator where none is named: "dakf" with a GPS, else "exact-kf".

    Args:
        slow_sensors: Names of the slow sensors.
    """
    return "dakf" if "gps" in slow_sensors else "exact-kf"


class EstimateObservation(gym.Wrapper[_Floats, Any, _Floats, Any], RecordConstructorArgs):
    """Runs an estimator on the car's record and appends its states to the observation.

    It must be the innermost wrapper: the estimator sees every tick of every step. Others of its
    class may be stacked, each with its own `name`; `TimeLimit` and stable-baselines3's `Monitor`
    may be inside.

    `info` gains `beta_hat` and `beta_std` where the estimator has beta and, if beta or gamma is
    among the outputs, `nees`: their normalised estimation error squared, divided by their number.
    `healthy` is 0 while innovations of a filter that finds its noise say that it is lost, else 1.
    An estimate that is not finite is passed on, so that controllers and the env see the failure.
    `layout` describes the whole observation, `outputs` what is appended; `estimator` is the
    estimator at work, around a user's own as a `ForeignEstimator`. In `spec` a factory that can be
    imported stands as its entry point; `spec.to_json()` refuses others and objects with TypeError.

    TypeError says that it is not the innermost wrapper, that the env has no record or that the
    estimator is none. ValueError says that an output is unknown, that names would stand twice, or
    that an object has a vehicle or options.

    >>> import gymnasium as gym
    >>> env = EstimateObservation(gym.make("sideslip/YawVision-v0"), "multirate-kf")
    >>> [entry.name for entry in env.layout[-4:]]
    ['beta_hat', 'gamma_hat', 'beta_std', 'gamma_std']

    See also `make_estimator`, `sideslip.estimators.vector.EstimateObservation` for vector envs and
    `register_estimator`.

    Args:
        env: Environment, or wrappers that may be inside.
        estimator: Name of `make_estimator`, entry point "package.module:Name", factory, or object,
            which hears of no other car. None for `choose_estimator` of the env's sensors.
        outputs: States to append, each as `<state>_hat`.
        std: Whether each one's standard deviation is appended as `<state>_std`.
        replace: Whether the observation is these alone.
        vehicle: Vehicle as the estimator believes it to be, a preset or a mapping; None for the
            env's nominal. "truth" is the true car of each episode, as it is at the reset, and
            readings are calibrated as in `TruthObservation`; its tyres have Fiala's law. Where the
            scenario's body does not roll, it is rigid.
        options: Options of `make_estimator`.
        name: Put before every name as `<name>_`.
        **misplaced: Refused; the message names the nearest argument or option.
    """

    def __init__(
        self, env: gym.Env[_Floats, Any], estimator: EstimatorSource | None = None,
        outputs: Sequence[str] = ("beta", "gamma"), std: bool = True, replace: bool = False,
        vehicle: VehicleSource | None = None, options: Mapping[str, object] | None = None,
        name: str | None = None, **misplaced: object,
    ) -> None:  # fmt: skip
        self._base = find_base_env(env)
        values = estimator, outputs, std, replace, vehicle, options, name
        self._arguments = Arguments.read(self._base.slow_sensors, *values, **misplaced)
        RecordConstructorArgs.__init__(self, **self._arguments.recorded)
        gym.Wrapper.__init__(self, env)
        self._estimator_spec: EstimatorSpec | None = None
        self.estimator: AnyEstimator = self._update_estimator()
        inner = env.get_wrapper_attr("layout")
        self.outputs = self._arguments.make_outputs(self.estimator.names, inner)
        self.layout = self.outputs.layout
        self.observation_space = make_space(self.layout)
        self._summary = np.zeros(4)

    def _update_estimator(self) -> AnyEstimator:
        """Return the estimator for the env's present spec; that at hand where nothing changed."""
        base, arguments, previous = self._base, self._arguments, self._estimator_spec
        spec, car = make_spec(base), arguments.vehicle
        if arguments.is_told_truth:
            truth = base.car_truth
            car, self._calibration = truth.fiala, truth.calibration
            if previous is not None:
                car = choose_vehicle(self.estimator, previous.vehicle, truth.fiala)
        spec = spec if car is None else spec.replace_vehicle(car)
        if previous is None or spec.design != previous.design:
            self.estimator, self._estimator_spec = self._build_estimator(spec), spec
        if arguments.is_told_truth:
            set_stiffness(self.estimator, truth.fiala)
        return self.estimator

    def _build_estimator(self, spec: EstimatorSpec) -> AnyEstimator:
        """Build an estimator for a spec; where one object is used, return that one."""
        arguments, dt, label = self._arguments, self._base.dt, self._arguments.label
        if not arguments.is_object:
            named = spec._asdict() | {"dt": dt}
            made: AnyEstimator = make_estimator(arguments.estimator, **named, **arguments.options)
            return made
        if not isinstance(arguments.estimator, AnyEstimator):
            arguments.estimator = ForeignEstimator(arguments.estimator, label, dt, spec.sensors)
        elif abs(arguments.estimator.dt - dt) > 1e-9:
            built = f"{label} was built for ticks of {arguments.estimator.dt:g} s"
            raise ValueError(f"{built}, the env has {dt:g} s")
        estimator: AnyEstimator = arguments.estimator
        return estimator

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[_Floats, Infos]:
        """Reset the env, then the estimator with this episode's clocks, and take tick 0.

        Args:
            seed: Seed of the env, or None.
            options: Options of the env's reset, or None.
        """
        obs, info = self.env.reset(seed=seed, options=options)
        self._update_estimator().reset(self._base.slow_sensors)
        return self._append_estimates(obs, info), info

    def step(self, action: Any) -> tuple[_Floats, Any, bool, bool, Infos]:
        """Step the env; the estimator takes its record before the observation is made.

        Args:
            action: Action of the env.
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._append_estimates(obs, info), reward, terminated, truncated, info

    def get_state(self) -> dict[str, object]:
        """Return a snapshot of the env, step limits inside and the estimator for `set_state`."""
        inner = self.env.get_wrapper_attr("get_state")()
        steps = [limit._elapsed_steps for limit in self._find_step_limits()]
        return {"env": inner, "steps": steps, "estimator": self.estimator.get_state()}

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of this env or of one built with the same arguments.

        Args:
            snapshot: Result of `get_state`; ValueError for one of an env with other step limits.
        """
        limits, steps = self._find_step_limits(), snapshot.get("steps", [])
        if len(limits) != len(steps):
            has = f"the snapshot has {len(steps)} step limits"
            raise ValueError(f"{has}, this env {len(limits)}")
        self.env.get_wrapper_attr("set_state")(snapshot["env"])
        for limit, elapsed in zip(limits, steps, strict=True):
            limit._elapsed_steps = elapsed
        self._update_estimator().set_state(snapshot["estimator"])

    def _find_step_limits(self) -> list[gym.wrappers.TimeLimit[Any, Any]]:
        """Return the step limits between the env and here; an estimator inside has its own."""
        layer, limits = self.env, []
        while isinstance(layer, gym.Wrapper) and not isinstance(layer, EstimateObservation):
            limits += [layer] if isinstance(layer, gym.wrappers.TimeLimit) else []
            layer = layer.env
        return limits

    def _append_estimates(self, obs: _Floats, info: Infos) -> _Floats:
        """Process the newest step; return the observation with its outputs, (width,)."""
        base, estimator, out = self._base, self.estimator, np.empty(len(self.layout), np.float32)
        rows = base.rows
        if self._arguments.is_told_truth:
            rows = calibrate(rows, self._calibration)
        record = StepRecord(rows, base.ticks_done, base.packets, base.delivered)
        truth = info["beta"], info["gamma"]  # for the NEES in info; the filter never reads it
        observed, done = Observed(obs, self.outputs.table, *truth, out, self._summary), 0
        if isinstance(estimator, Estimator) and estimator.compiled:
            while True:
                memory = estimator.filters, estimator.gains
                done = compile_observe()(*memory, record, done, observed)
                if done == record.rows:  # 0 after a bad action that failed
                    break  # else a table of gains is missing
                estimator.design_missing()
        else:
            estimator.step(record.fast[: record.rows], record.packets[: record.count])
            write_outputs(estimator, observed)
        values = self._summary.tolist()
        for key, index in self.outputs.keys:
            info[key] = values[index]
            if index == BETA:
                base.annotate(self.outputs.title, values[BETA], values[STD])
        return out


def find_base_env(env: gym.Env[_Floats, Any]) -> Any:
    """Find the base env, with no wrapper in between that may hide ticks from the estimator.

    Args:
        env: Environment, wrapped or not; TypeError if it has another wrapper or no record.
    """
    layer = env
    while isinstance(layer, gym.Wrapper):
        kind = type(layer)
        is_allowed = isinstance(layer, (*_ALLOWED_WRAPPERS, EstimateObservation))
        if not is_allowed and (kind.__module__, kind.__name__) != _MONITOR:
            text = "EstimateObservation must be the innermost wrapper, directly around the"
            raise TypeError(f"{text} environment; inside it is {kind.__name__}")
        layer = layer.env
    if missing := [name for name in _BASE_MEMBERS if not hasattr(layer, name)]:
        text = "EstimateObservation reads the record of a sideslip environment"
        raise TypeError(f"{text}; {type(layer).__name__} has no {', '.join(missing)}")
    return layer
