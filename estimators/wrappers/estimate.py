"""EstimateObservation: an estimator's states beside, or instead of, the raw observation."""

import dataclasses
import functools
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from ...envs.sensors.link import SlowSensor
from ...envs.task import ObservationEntry, make_space
from ...envs.validation import describe_unknown, short_repr
from ...envs.vehicle.parameters import Vehicle, VehicleSource, make_vehicle
from ..estimator import Estimator
from ..learned.correction import LearnedEstimator
from ..make import make_estimator
from ..protocol import EstimatorFactory, EstimatorLike, ForeignEstimator, get_label
from ..registry import find_entry_point
from .kernel import compile_observe
from .outputs import BETA, STD, Outputs, make_outputs, write_outputs
from .truth import TRUTH, choose_vehicle, set_stiffness

EstimatorSource = str | EstimatorFactory | EstimatorLike
"""What `EstimateObservation` takes for its estimator: a name, a factory or an object."""
_Floats = npt.NDArray[np.float32]
AnyEstimator = Estimator | ForeignEstimator
_PARAMETERS = ("estimator", "outputs", "std", "replace", "vehicle", "options", "name")
_ALLOWED_WRAPPERS = (PassiveEnvChecker, OrderEnforcing, TimeLimit)
# stable-baselines3's make_vec_env and rl-zoo put it directly around the environment. It only counts
# and is known by name: this module loads nothing of theirs.
_MONITOR = ("stable_baselines3.common.monitor", "Monitor")
_BASE_MEMBERS = (
    *("rows", "ticks_done", "packets", "delivered", "slow_sensors", "nominal", "layout", "dt"),
    "annotate",
)


class EstimatorSpec(NamedTuple):
    """Vehicle, sensors and speed for which an estimator is built."""

    vehicle: Vehicle  # as the estimator believes it to be
    sensors: Mapping[str, SlowSensor]  # slow ones by name
    speed: float | None = None  # m/s where it is held

    @property
    def design(self) -> Hashable:
        """A key that is equal for specs that differ in the phases of their clocks alone."""
        clocks = [(name, dataclasses.replace(s, phase=0.0)) for name, s in self.sensors.items()]
        return self.vehicle, tuple(sorted(clocks)), self.speed


def make_spec(base: Any) -> EstimatorSpec:
    """Make the spec of a bare single env in its present episode.

    Args:
        base: Environment without wrappers.

    Returns:
        Nominal vehicle, slow sensors and held speed.
    """
    return EstimatorSpec(base.nominal, base.slow_sensors, getattr(base, "held_speed", None))


def build_estimator(
    source: str | EstimatorFactory, options: Mapping[str, object], dt: float, spec: EstimatorSpec
) -> AnyEstimator:
    """Build an estimator for a spec by `make_estimator`.

    Args:
        source: Name or factory.
        options: Options of the estimator.
        dt: Tick (s).
        spec: Vehicle, sensors and speed.

    Returns:
        The estimator.
    """
    vehicle, sensors, speed = spec
    return make_estimator(source, vehicle=vehicle, sensors=sensors, dt=dt, speed=speed, **options)


class Arguments:
    """The checked arguments of a wrapper, and the estimator they stand for.

    Args:
        estimator: Name, factory or object; None for `choose_estimator` of the sensors.
        outputs: States to append.
        std: Whether standard deviations are appended.
        replace: Whether the inner observation is left out.
        vehicle: Vehicle for the estimator, "truth" for the true one, None for the nominal one.
        options: Options of the estimator.
        name: Prefix of all names, or None.
        slow_sensors: Slow sensors of the env by name.
        misplaced: Keyword arguments that the wrapper does not have.

    Attributes:
        source: Name or factory; None where `object` is the one estimator to use.
        recorded: Arguments for the env's spec.

    Raises:
        TypeError: An argument is misplaced; the message has the nearest name.
        ValueError: An object has a vehicle or options, which would not reach it.
    """

    def __init__(
        self,
        estimator: EstimatorSource | None,
        outputs: Sequence[str],
        std: bool,
        replace: bool,
        vehicle: VehicleSource | None,
        options: Mapping[str, object] | None,
        name: str | None,
        slow_sensors: Mapping[str, SlowSensor],
        misplaced: Mapping[str, object],
    ) -> None:
        source: Any = choose_estimator(slow_sensors) if estimator is None else estimator
        if misplaced:
            wrong = describe_unknown("argument of EstimateObservation", misplaced, _PARAMETERS)
            if isinstance(source, str) and "did you mean" not in wrong:
                # this names the nearest option
                make_estimator(source, sensors=slow_sensors, **misplaced)
                passed = short_repr(dict(misplaced))
                wrong = f"options of an estimator are passed as options={passed}"
            raise TypeError(wrong)
        self.options = dict(options or {})
        self.truth = isinstance(vehicle, str) and vehicle == TRUTH
        self.vehicle = None if vehicle is None or self.truth else make_vehicle(vehicle)
        self.source, self.object, self.label = source, None, get_label(source)
        recorded = source
        if _is_object(source):
            if vehicle is not None or self.options:
                text = "is built already: a vehicle and options go to a name or a factory"
                raise ValueError(f"{self.label} {text}")
            self.source, self.object = None, source
            recorded = functools.partial(_refuse_rebuild, self.label)
        elif not isinstance(source, str):
            recorded = find_entry_point(source) or source
        car = vehicle.to_dict() if isinstance(vehicle, Vehicle) else vehicle
        car = dict(car) if isinstance(car, Mapping) else car
        values = recorded, list(outputs), bool(std), bool(replace), car, self.options, name
        self.recorded = dict(zip(_PARAMETERS, values, strict=True))


def _refuse_rebuild(label: str, **_: object) -> NoReturn:
    """Raise the reason why a spec with an object cannot be built, in the place of a factory."""
    raise TypeError(
        f"a spec cannot build {label} once more: it was passed as an object; pass its class, a "
        "factory or a name"
    )


def choose_estimator(slow_sensors: Iterable[str]) -> str:
    """Choose the estimator where none is named.

    Args:
        slow_sensors: Names of the slow sensors.

    Returns:
        "dakf" where there is a GPS, else "exact-kf".
    """
    return "dakf" if "gps" in slow_sensors else "exact-kf"


def _is_object(source: object) -> bool:
    """Return whether this is an estimator, well made or not, rather than what builds one."""
    if isinstance(source, str | type):
        return False
    return not callable(source) or hasattr(source, "step") or hasattr(source, "reset")


class EstimateObservation(gym.Wrapper[_Floats, Any, _Floats, Any], RecordConstructorArgs):
    """Runs an estimator on the car's record and appends its states to the observation.

    It must be the innermost wrapper: the estimator sees every tick of every step. Others of its
    class may be stacked, each with its own `name`; `TimeLimit` and stable-baselines3's `Monitor`
    may be inside.

    `info` gains `beta_hat` and `beta_std` where the estimator has beta and, if beta or gamma is
    among the outputs, `nees`: their normalised estimation error squared, divided by their number.
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
            env's nominal. "truth" is the true car of each episode, as it is at the reset.
        options: Options of `make_estimator`.
        name: Put before every name as `<name>_`.
        **misplaced: Refused; the message names the nearest argument or option.
    """

    def __init__(
        self,
        env: gym.Env[_Floats, Any],
        estimator: EstimatorSource | None = None,
        outputs: Sequence[str] = ("beta", "gamma"),
        std: bool = True,
        replace: bool = False,
        vehicle: VehicleSource | None = None,
        options: Mapping[str, object] | None = None,
        name: str | None = None,
        **misplaced: object,
    ) -> None:
        self._base = find_base_env(env)
        clocks = self._base.slow_sensors
        self._arguments = Arguments(
            estimator, outputs, std, replace, vehicle, options, name, clocks, misplaced
        )
        RecordConstructorArgs.__init__(self, **self._arguments.recorded)
        gym.Wrapper.__init__(self, env)
        self._estimator_spec: EstimatorSpec | None = None
        self.estimator: AnyEstimator = self._update_estimator()
        inner: tuple[ObservationEntry, ...] = () if replace else env.get_wrapper_attr("layout")
        states, label = self.estimator.names, self._arguments.label
        self.outputs: Outputs = make_outputs(label, states, outputs, std, name, inner)
        self.layout: tuple[ObservationEntry, ...] = self.outputs.layout
        self.observation_space = make_space(self.layout)
        self._title, self._summary = label if name is None else f"{label} ({name})", np.zeros(3)

    def _update_estimator(self) -> AnyEstimator:
        """Return the estimator for the env's present spec; that at hand where nothing changed."""
        base, arguments, previous = self._base, self._arguments, self._estimator_spec
        spec = make_spec(base)
        if arguments.vehicle is not None:
            spec = spec._replace(vehicle=arguments.vehicle)
        elif arguments.truth:
            car = base.vehicle
            if previous is not None:
                car = choose_vehicle(self.estimator, previous.vehicle, car)
            spec = spec._replace(vehicle=car)
        if previous is None or spec.design != previous.design:
            self.estimator, self._estimator_spec = self._build_estimator(spec), spec
            self._is_native = isinstance(self.estimator, Estimator) and self.estimator.compiled
        if arguments.truth:
            set_stiffness(self.estimator, base.vehicle)
        return self.estimator

    def _build_estimator(self, spec: EstimatorSpec) -> AnyEstimator:
        """Build an estimator for a spec; where one object is used, return that one."""
        arguments, dt = self._arguments, self._base.dt
        if arguments.object is None:
            return build_estimator(arguments.source, arguments.options, dt, spec)
        if not isinstance(arguments.object, AnyEstimator):
            arguments.object = ForeignEstimator(arguments.object, arguments.label, dt, spec.sensors)
        elif abs(arguments.object.dt - dt) > 1e-9:
            built = f"{arguments.label} was built for ticks of {arguments.object.dt:g} s"
            raise ValueError(f"{built}, the env has {dt:g} s")
        estimator: AnyEstimator = arguments.object
        return estimator

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[_Floats, dict[str, Any]]:
        """Reset the env, then the estimator with this episode's clocks, and take tick 0.

        Args:
            seed: Seed of the env, or None.
            options: Options of the env's reset, or None.

        Returns:
            Observation and info.
        """
        obs, info = self.env.reset(seed=seed, options=options)
        self._update_estimator().reset(self._base.slow_sensors)
        return self._append_estimates(obs, info), info

    def step(self, action: Any) -> tuple[_Floats, Any, bool, bool, dict[str, Any]]:
        """Step the env; the estimator takes its record before the observation is made.

        Args:
            action: Action of the env.

        Returns:
            Observation, reward, terminated, truncated and info.
        """
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._append_estimates(obs, info), reward, terminated, truncated, info

    def get_state(self) -> dict[str, object]:
        """Return a snapshot of the env and the estimator for `set_state`."""
        inner = self.env.get_wrapper_attr("get_state")()
        return {"env": inner, "estimator": self.estimator.get_state()}

    def set_state(self, snapshot: Mapping[str, Any]) -> None:
        """Restore a snapshot of this env or of one built with the same arguments.

        Args:
            snapshot: Result of `get_state`.
        """
        self.env.get_wrapper_attr("set_state")(snapshot["env"])
        self._update_estimator().set_state(snapshot["estimator"])

    def _append_estimates(self, obs: _Floats, info: dict[str, Any]) -> _Floats:
        """Process the newest step; return the observation with its outputs, (width,)."""
        base, outputs, summary = self._base, self.outputs, self._summary
        estimator: Any = self.estimator
        inner = None if self._is_native else getattr(estimator, "inner", None)
        out, rows, done = np.empty(len(self.layout), np.float32), base.ticks_done, 0
        record = base.rows, rows, base.packets, base.delivered
        layout_args = outputs.inner, outputs.plan, outputs.limits
        observe_args = obs, *layout_args, info["beta"], info["gamma"], out, summary
        if isinstance(inner, LearnedEstimator):
            memory = inner.base.filters, inner.base.gains
            compile_observe(corrected=True)(*memory, record, inner.memory, inner.net, observe_args)
        elif not self._is_native:
            estimator.step(base.rows[:rows], base.packets[: base.delivered])
            write_outputs(estimator, *observe_args)
        while self._is_native:
            memory = estimator.filters, estimator.gains
            done = compile_observe()(*memory, *record, done, *observe_args)
            if done == rows:  # which a refused action leaves at none
                break
            estimator.design_missing()
        values = summary.tolist()
        for key, index in outputs.keys:
            info[key] = values[index]
            if index == BETA:
                base.annotate(self._title, values[BETA], values[STD])
        return out


def find_base_env(env: gym.Env[_Floats, Any]) -> Any:
    """Find the base env, with no wrapper in between that may hide ticks from the estimator.

    Args:
        env: Environment, wrapped or not.

    Returns:
        The environment that has the record.

    Raises:
        TypeError: Another wrapper is inside, or the environment has no record.
    """
    layer = env
    while isinstance(layer, gym.Wrapper):
        kind = type(layer)
        is_allowed = isinstance(layer, (*_ALLOWED_WRAPPERS, EstimateObservation))
        if not is_allowed and (kind.__module__, kind.__name__) != _MONITOR:
            raise TypeError(
                "EstimateObservation must be the innermost wrapper, directly around the "
                f"environment; inside it is {kind.__name__}"
            )
        layer = layer.env
    missing = [name for name in _BASE_MEMBERS if not hasattr(layer, name)]
    if missing:
        raise TypeError(
            f"EstimateObservation reads the record of a sideslip environment; "
            f"{type(layer).__name__} has no {', '.join(missing)}"
        )
    return layer
