"""Every public argument is documented: a word on it stands where `help` shows it."""

import dataclasses
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import pytest

from sideslip.estimators.design.options import FilterOptions

ROOMS = ("", ".envs", ".estimators", ".estimators.vector", ".agents", ".agents.vec_env")
THEIRS = {"env", "seed", "options", "action", "actions", "observation", "obs", "deterministic"}
"""Names that Gymnasium and stable-baselines3 give a meaning, the same everywhere."""


def public(room: str) -> Iterator[tuple[str, Any, str]]:
    """(name, callable, what `help` of its class has) of a room's names and their methods."""
    module = import_module(f"sideslip{room}")
    here = [name for name, found in vars(module).items()
            if getattr(found, "__module__", "") == module.__name__ and name[0] != "_"]  # fmt: skip
    for name in getattr(module, "__all__", here):
        found = getattr(module, name)
        if inspect.isfunction(found):
            # the options of a filter stand in a class of their own
            yield name, found, class_help(FilterOptions) if name == "make_estimator" else ""
        if not inspect.isclass(found) or issubclass(found, Warning):
            continue
        about = class_help(found)
        yield name, found, about
        for method, made in inspect.getmembers(found, inspect.isfunction):
            if not method.startswith("_") and made.__module__.startswith("sideslip"):
                yield f"{name}.{method}", made, about


def class_help(found: type) -> str:
    """Docstrings of a class and its bases, the comments behind its fields and the fields' texts."""
    ours = [each for each in found.__mro__ if each.__module__.startswith("sideslip")]
    commented = re.compile(r'^    (\w+): .*(?:  # |\n    """)', re.MULTILINE)
    names = [name for each in ours for name in commented.findall(inspect.getsource(each))]
    fields = dataclasses.fields(found) if dataclasses.is_dataclass(found) else ()
    names += [field.name for field in fields if field.metadata.get("text")]
    return " ".join([*(each.__doc__ or "" for each in ours), *names])


def undocumented(made: Any, about: str) -> list[str]:
    """The arguments of which neither its docstring nor its class has a word; a single one is what
    the first line is about."""
    names = [
        name
        for name, argument in inspect.signature(made).parameters.items()
        if name != "self" and argument.kind not in (argument.VAR_KEYWORD, argument.VAR_POSITIONAL)
    ]
    text = f"{inspect.getdoc(made)} {about}"
    missing = [name for name in names if name not in THEIRS and not re.search(rf"\b{name}\b", text)]
    return [] if len(names) == 1 and inspect.getdoc(made) else missing


@pytest.mark.parametrize("room", ROOMS)
def test_no_public_argument_is_undocumented(room: str) -> None:
    found = {name: undocumented(made, about) for name, made, about in public(room)}
    assert not {name: missing for name, missing in found.items() if missing}


def test_what_is_undocumented_is_found() -> None:
    def planted(first: int, second: int) -> None:
        """A function. first: a number."""

    assert undocumented(planted, "") == ["second"]
