"""Factories by name: those of the package, and those that users register as with Gymnasium."""

import importlib
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from ..envs.arguments import describe_unknown
from .user_files import is_user_file, load_user_class

Factory = Callable[..., Any]


class Registry:
    """Factories of one kind of thing by name; iterates over all names.

    Args:
        kind: What they make, for messages.
        builtin: The package's own factories or entry points by name.
    """

    def __init__(self, kind: str, builtin: Mapping[str, Factory | str]) -> None:
        self._kind = kind
        self._factories: dict[str, Factory | str] = dict(builtin)

    def register(self, name: str, factory: Factory | str) -> None:
        """Register a name; the same factory once more changes nothing.

        Args:
            name: New name, without a colon.
            factory: A callable, or "package.module:Name" or "FILE.py:Name", loaded at its first
                use.

        Raises:
            TypeError: The name is no str, or the factory neither a callable nor a str.
            ValueError: The name is empty, has a colon or belongs to another factory, or the string
                is no entry point.
        """
        if not isinstance(name, str):
            raise TypeError(f"the name of an {self._kind} is a str, got {name!r}")
        if not name or ":" in name:
            raise ValueError(f"the name of an {self._kind} has letters and no colon, got {name!r}")
        if isinstance(factory, str):
            if not is_user_file(factory):
                _split_entry_point(factory)
        elif not callable(factory):
            raise TypeError(
                f"{name!r}: a factory is callable or 'package.module:Name', "
                f"got {type(factory).__name__}"
            )
        known = self._factories.setdefault(name, factory)
        if known != factory:
            raise ValueError(f"the {self._kind} {name!r} is registered already, as {known!r}")

    def load(self, name: str, others: Iterable[str] = ()) -> Factory:
        """Load the factory of a name or an entry point; errors as in `import_entry_point`.

        Args:
            name: Registered name, "package.module:Name" or "FILE.py:Name" (see `load_user_class`).
            others: Further names that may have been meant, for messages.

        Returns:
            The factory.

        Raises:
            ValueError: The name is not registered.
        """
        factory = self._factories.get(name, name)
        if not isinstance(factory, str):
            return factory
        if is_user_file(factory):
            return load_user_class(factory)
        if ":" in factory:
            return import_entry_point(factory)
        raise ValueError(describe_unknown(self._kind, [name], [*self._factories, *others]))

    def __contains__(self, name: object) -> bool:
        return name in self._factories

    def __len__(self) -> int:
        return len(self._factories)

    def __iter__(self) -> Iterator[str]:
        return iter(tuple(self._factories))


def _split_entry_point(entry_point: str) -> tuple[str, str]:
    module, _, name = entry_point.partition(":")
    if not all(word.isidentifier() for word in (*module.split("."), *name.split("."))):
        raise ValueError(f"an entry point is 'package.module:Name', got {entry_point!r}")
    return module, name


def import_entry_point(entry_point: str) -> Factory:
    """Import the factory at an entry point.

    Args:
        entry_point: "package.module:Name".

    Returns:
        The factory.

    Raises:
        ModuleNotFoundError: The module needs another one that is missing.
        TypeError: The object is not callable.
        ValueError: There is no such module or name.
    """
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


def find_entry_point(factory: Factory) -> str | None:
    """Find the entry point of a factory.

    Args:
        factory: A class or a function.

    Returns:
        "package.module:Name", from which `import_entry_point` loads the factory, else None.
    """
    text = f"{getattr(factory, '__module__', '')}:{getattr(factory, '__qualname__', '')}"
    try:
        return (
            text
            if not text.startswith("__main__:") and import_entry_point(text) is factory
            else None
        )
    except (TypeError, ValueError):
        return None
