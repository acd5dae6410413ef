"""The arguments of `EstimateObservation`, single and vector: an estimator, and its car."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn

from ...envs.arguments import describe_unknown, short_repr
from ...envs.sensors.link import SlowSensor
from ...envs.vehicle.vehicle import Vehicle
from ...envs.vehicle.vehicles import VehicleSource, make_vehicle
from ..estimator import Estimator
from ..make import make_estimator
from ..protocol import EstimatorFactory, EstimatorLike, ForeignEstimator, get_label
from ..registry import find_entry_point
from .truth import TRUTH

EstimatorSource = str | EstimatorFactory | EstimatorLike
"""What `EstimateObservation` takes for its estimator: a name, a factory or an object."""
AnyEstimator = Estimator | ForeignEstimator
_PARAMETERS = ("estimator", "outputs", "std", "replace", "vehicle", "options", "name")


class EstimatorSpec(NamedTuple):
    """Vehicle, sensors and speed for which an estimator is built.

    Attributes:
        vehicle: The vehicle as the estimator believes it to be.
        sensors: Slow sensors by name.
        speed: Speed (m/s) where it is held, else None.
    """

    vehicle: Vehicle
    sensors: Mapping[str, SlowSensor]
    speed: float | None = None

    @property
    def design(self) -> Any:
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
    source: str | EstimatorFactory, options: Mapping[str, Any], dt: float, spec: EstimatorSpec
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
    """The checked arguments of a wrapper, and the estimators they stand for.

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
        TypeError: An argument is misplaced; the message has the nearest name of the wrapper's or of
            the estimator's options.
        ValueError: An object has a vehicle or options, which would not reach it.
    """

    def __init__(
        self,
        estimator: EstimatorSource | None,
        outputs: Sequence[str],
        std: bool,
        replace: bool,
        vehicle: VehicleSource | None,
        options: Mapping[str, Any] | None,
        name: str | None,
        slow_sensors: Mapping[str, SlowSensor],
        misplaced: Mapping[str, Any],
    ) -> None:
        source: Any = choose_estimator(slow_sensors) if estimator is None else estimator
        recorded = source
        if misplaced:
            wrong = describe_unknown("argument of EstimateObservation", misplaced, _PARAMETERS)
            if isinstance(source, str) and "did you mean" not in wrong:
                make_estimator(
                    source, sensors=slow_sensors, **misplaced
                )  # names the nearest option
                wrong = (
                    f"options of an estimator are passed as options={short_repr(dict(misplaced))}"
                )
            raise TypeError(wrong)
        self.options = dict(options or {})
        self.truth = isinstance(vehicle, str) and vehicle == TRUTH
        self.vehicle = None if vehicle is None or self.truth else make_vehicle(vehicle)
        self.source, self.object, self.label = source, None, get_label(source)
        if not _is_object(source):
            recorded = source if isinstance(source, str) else find_entry_point(source) or source
        else:
            if vehicle is not None or self.options:
                raise ValueError(
                    f"{self.label} is built already: a vehicle and options go to a name or a "
                    "factory"
                )
            self.source, self.object, recorded = None, source, NotSerializable(self.label)
        car = vehicle.to_dict() if isinstance(vehicle, Vehicle) else vehicle
        self.recorded = {
            "estimator": recorded,
            "outputs": list(outputs),
            "std": bool(std),
            "replace": bool(replace),
            "vehicle": dict(car) if isinstance(car, Mapping) else car,
            "options": self.options,
            "name": name,
        }

    def build(self, spec: EstimatorSpec, dt: float) -> AnyEstimator:
        """Build an estimator; where one object is used, return that one.

        Args:
            spec: Vehicle, sensors and speed.
            dt: Tick (s).

        Returns:
            The estimator.

        Raises:
            ValueError: The object was built for another tick.
        """
        if self.object is None:
            return build_estimator(self.source, self.options, dt, spec)
        if not isinstance(self.object, AnyEstimator):
            self.object = ForeignEstimator(self.object, self.label, dt, spec.sensors)
        elif abs(self.object.dt - dt) > 1e-9:
            raise ValueError(
                f"{self.label} was built for ticks of {self.object.dt:g} s, the env has {dt:g} s"
            )
        estimator: AnyEstimator = self.object
        return estimator


class NotSerializable:
    """The place of an object in a spec: building from that spec raises the reason.

    Args:
        label: Name of the object for the message.
    """

    def __init__(self, label: str) -> None:
        self._label = label

    def __call__(self, **_: Any) -> NoReturn:
        """Refuse to be the factory that the spec would need."""
        raise TypeError(
            f"a spec cannot build {self._label} once more: it was passed as an object; pass its "
            "class, a factory or a name"
        )


def choose_estimator(slow_sensors: Iterable[str]) -> str:
    """Choose the estimator where none is named.

    Args:
        slow_sensors: Names of the slow sensors.

    Returns:
        "dakf" where there is a GPS, else "exact-kf".
    """
    return "dakf" if "gps" in slow_sensors else "exact-kf"


def _is_object(source: Any) -> bool:
    """Return whether this is an estimator, well made or not, rather than what builds one."""
    if isinstance(source, str | type):
        return False
    return not callable(source) or hasattr(source, "step") or hasattr(source, "reset")
