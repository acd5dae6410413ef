"""Estimators by name; factories, of agents too: built in, registered, or in a user's own file."""

import ast
import hashlib
import importlib
import importlib.util
import inspect
import math
import operator
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, overload

from ..envs.numerics.functions import TICK
from ..envs.sensors.link import SlowSensor
from ..envs.validation import describe_unknown
from ..envs.vehicle.parameters import COMS, VehicleSource, make_vehicle
from .delayed_channels import LateEstimator
from .design.assemble import assemble
from .design.config import parse_config
from .design.options import PARAMETERS
from .estimator import Estimator
from .filters import FILTERS
from .protocol import EstimatorFactory, ForeignEstimator, get_label

SUFFIX = ".py"
_PREFIX = "sideslip_user_file_"  # of the modules that users' files become
_Factory = Callable[..., Any]  # an agent's or an estimator's


def is_user_file(text: str) -> bool:
    """Return whether a text names a user's file: "FILE.py" or "FILE.py:Name".

    Args:
        text: Name of an agent or estimator.
    """
    return text.endswith(SUFFIX) or text.rpartition(":")[0].endswith(SUFFIX)


def find_class(text: str) -> tuple[Path, str]:
    """Find file and name of the class that a text means in a user's file, without running it.

    FileNotFoundError without it; ValueError if it is no Python or has no such or no single class.

    Args:
        text: "FILE.py:Name", or "FILE.py" for its only class.
    """
    file, _, name = (text, "", "") if text.endswith(SUFFIX) else text.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise FileNotFoundError(f"{text!r}: there is no file {path}")
    source = path.read_bytes()
    try:
        tree = ast.parse(source, str(path))
    except SyntaxError as error:
        raise ValueError(f"{path}, line {error.lineno}: {error.msg}") from None
    except ValueError as error:  # a null byte
        raise ValueError(f"{path} is no Python: {error}") from None
    names = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    classes = [word for word in names if not word.startswith("_")]
    definitions = f"it defines {', '.join(classes) or 'no class'}"
    if name and name not in set(_iterate_bindings(tree)):
        raise ValueError(f"{path} has no {name!r}; {definitions}")
    if not name and len(classes) != 1:
        raise ValueError(f"say what of {path} is meant, as {path}:NAME; {definitions}")
    return path, name or classes[0]


def _iterate_bindings(tree: ast.Module) -> Iterator[str]:
    """Iterate over the names that a file binds somewhere."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.alias):
            yield node.asname or node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


def _load_user_class(text: str) -> _Factory:
    """Load a factory of a user's file as `find_class` finds it; the file is run once."""
    path, name = find_class(text)
    try:
        factory = getattr(_load_module(path.resolve()), name)
    except AttributeError:
        raise ValueError(f"{path} has no {name!r} once it is run") from None
    if not callable(factory):
        raise TypeError(f"{text!r} is no class or function but of type {type(factory).__name__}")
    return factory  # type: ignore[no-any-return]


def _load_module(path: Path) -> ModuleType:
    key = hashlib.sha256(str(path).encode() + path.read_bytes()).hexdigest()[:12]
    name = f"{_PREFIX}{path.stem}_{key}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise ValueError(f"{path} cannot be loaded: {describe_error(error)}") from error
    return module


def describe_error(error: BaseException) -> str:
    """Describe an error: kind and text, and the line of the user's file in which it arose.

    Args:
        error: A raised exception.
    """
    text, location, trace = f"{type(error).__name__}: {error}", "", error.__traceback__
    while trace is not None:
        if str(trace.tb_frame.f_globals.get("__name__", "")).startswith(_PREFIX):
            location = f" ({Path(trace.tb_frame.f_code.co_filename).name}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return text + location


class Registry:
    """Factories of one kind of thing by name; iterates over all names.

    Args:
        kind: What they make, for messages.
        builtin: The package's own factories or entry points by name.
    """

    def __init__(self, kind: str, builtin: Mapping[str, _Factory | str]) -> None:
        self._kind = kind
        self._factories: dict[str, _Factory | str] = dict(builtin)

    def register(self, name: str, factory: _Factory | str) -> None:
        """Register a name, else TypeError or ValueError; the same factory again changes nothing.

        Args:
            name: New name, without a colon.
            factory: A callable, "package.module:Name" or "FILE.py:Name", loaded at its first use.
        """
        if not isinstance(name, str):
            raise TypeError(f"the name of an {self._kind} is a str, got {name!r}")
        if not name or ":" in name:
            raise ValueError(f"the name of an {self._kind} has letters and no colon, got {name!r}")
        if isinstance(factory, str) and not is_user_file(factory):
            _split_entry_point(factory)
        elif not (isinstance(factory, str) or callable(factory)):
            text = f"{name!r}: a factory is callable or 'package.module:Name'"
            raise TypeError(f"{text}, got {type(factory).__name__}")
        known = self._factories.setdefault(name, factory)
        if known != factory:
            raise ValueError(f"the {self._kind} {name!r} is registered already, as {known!r}")

    def load(self, name: str, others: Iterable[str] = ()) -> _Factory:
        """Load the factory of a name or an entry point; ValueError if there is none.

        A user's file is run once a process while its content stays; it may import its neighbours.

        Args:
            name: Registered name, "package.module:Name" or "FILE.py:Name".
            others: Further names that may have been meant, for messages.
        """
        factory = self._factories.get(name, name)
        if not isinstance(factory, str):
            return factory
        if is_user_file(factory):
            return _load_user_class(factory)
        if ":" in factory:
            return _import_entry_point(factory)
        raise ValueError(describe_unknown(self._kind, [name], [*self._factories, *others]))

    def __contains__(self, name: object) -> bool:
        return name in self._factories

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self._factories))


def _split_entry_point(entry_point: str) -> tuple[str, str]:
    module, _, name = entry_point.partition(":")
    if not all(word.isidentifier() for word in (*module.split("."), *name.split("."))):
        raise ValueError(f"an entry point is 'package.module:Name', got {entry_point!r}")
    return module, name


def _import_entry_point(entry_point: str) -> _Factory:
    """Import the factory at an entry point, "package.module:Name"."""
    module, name = _split_entry_point(entry_point)
    try:
        imported_module = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # a module that it needs is missing
        raise ValueError(f"{entry_point!r}: there is no module {error.name!r}") from None
    try:
        factory = operator.attrgetter(name)(imported_module)
    except AttributeError:
        raise ValueError(f"{entry_point!r}: the module {module!r} has no {name!r}") from None
    if not callable(factory):
        raise TypeError(f"{entry_point!r} is no factory but of type {type(factory).__name__}")
    return factory  # type: ignore[no-any-return]


def find_entry_point(factory: _Factory) -> str | None:
    """Find the "package.module:Name" by which a factory can be imported; None without one.

    Args:
        factory: A class or a function.
    """
    text = f"{getattr(factory, '__module__', '')}:{getattr(factory, '__qualname__', '')}"
    try:
        is_found = not text.startswith("__main__:") and _import_entry_point(text) is factory
    except (TypeError, ValueError):
        return None
    return text if is_found else None


if TYPE_CHECKING:

    @overload
    def make_estimator(name: str, **arguments: Any) -> Estimator: ...

    @overload
    def make_estimator(
        name: EstimatorFactory, **arguments: Any
    ) -> Estimator | ForeignEstimator: ...


def make_estimator(
    name: str | EstimatorFactory, *, vehicle: VehicleSource = COMS,
    sensors: Mapping[str, SlowSensor] | None = None, dt: float = TICK, speed: float | None = None,
    present: Collection[str] | None = None, **options: Any,
) -> Estimator | ForeignEstimator:  # fmt: skip
    """Build an estimator by name (`sideslip.estimators.FILTERS` lists them).

    An unknown option raises TypeError; unknown names, absent sensors and options that are at odds
    ValueError, as do noise that is no covariance, a sensor later than the window, and divergence.

    Args:
        name: Name of `FILTERS`, registered name, entry point "package.module:Name", class in a
            file, "FILE.py:Name", or a factory, called with the arguments below; what that
            builds comes as a `ForeignEstimator`.
        vehicle: The filter's vehicle, as `make_vehicle` takes it.
        sensors: Available slow sensors by name ("camera", "gps").
        dt: Tick (s).
        speed: Speed (m/s) if it is held; None measures it with the front wheels.
        present: Columns that the record carries, as `Record.present`; None: all. A filter of
            `FILTERS` does without absent fast sensors, unless `fast` names them.
        **options: Options of a filter of `FILTERS`, which `FilterOptions` lists, or of the factory.
    """
    available, label = dict(sensors or {}), get_label(name)
    if not dt > 0.0:
        raise ValueError(f"{label}: a tick of {dt!r} s")
    if not (isinstance(name, str) and name in FILTERS):
        factory = ESTIMATORS.load(name) if isinstance(name, str) else name
        car = make_vehicle(vehicle)
        built = factory(vehicle=car, sensors=available, dt=dt, speed=speed, **options)
        if isinstance(built, Estimator):
            return built
        return ForeignEstimator(built, label, dt, available)
    if speed is not None and not 0.0 <= speed < math.inf:
        raise ValueError(f"{name}: speed is in m/s and not negative, got {speed!r}")
    fast = dict(FILTERS[name].options).get("fast", ())
    if present is not None and not {*fast} <= {"gyro", *present}:
        options = {"fast": tuple(x for x in fast if x in {"gyro", *present})} | options
    config = parse_config(name, FILTERS[name], available, options)
    car = make_vehicle(vehicle)
    layers, schedules = assemble(config, car, dt, speed)
    estimator = (LateEstimator if config.latency else Estimator)(config, dt, layers, schedules)
    checked = config.linear_part
    estimator.check(layers if checked is config else assemble(checked, car, dt, speed)[0])
    return estimator


_SIGNATURE = inspect.signature(make_estimator)
*_NAMED, _OTHERS = _SIGNATURE.parameters.values()
# completions and `help` see every option of a filter
make_estimator.__signature__ = _SIGNATURE.replace(  # type: ignore[attr-defined]
    parameters=[*_NAMED, *PARAMETERS, _OTHERS]
)

ESTIMATORS = Registry("estimator", {name: partial(make_estimator, name) for name in FILTERS})
"""Every estimator that has a name: the package's own and those that were registered."""


def register_estimator(name: str, factory: EstimatorFactory | str) -> None:
    """Register an estimator of your own under a name that works wherever an estimator's name does.

    A name is known in this process alone. Worker processes and `sideslip`'s command line take the
    entry point itself for a name. Errors are those of `Registry.register`.

    Args:
        name: New name, without a colon.
        factory: An `EstimatorFactory`, or "package.module:Name", imported at its first use.
    """
    ESTIMATORS.register(name, factory)
