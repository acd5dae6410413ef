"""Classes in files of a user's own, by "FILE.py:Name": names of agents and estimators."""

import ast
import hashlib
import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

SUFFIX = ".py"
_PREFIX = "sideslip_user_file_"  # of the modules' names


def is_user_file(text: str) -> bool:
    """Return whether a text names a user's file.

    Args:
        text: Name of an agent or estimator.

    Returns:
        True for "FILE.py" and "FILE.py:Name".
    """
    return text.endswith(SUFFIX) or text.rpartition(":")[0].endswith(SUFFIX)


def find_class(text: str) -> tuple[Path, str]:
    """Find the class of a user's file, without running the file.

    Args:
        text: "FILE.py:Name", or "FILE.py" for its only class.

    Returns:
        File and name of the class.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: With file and line: it is no Python, has no such name, or defines no class or
            several and none is named.
    """
    file, _, name = (text, "", "") if text.endswith(SUFFIX) else text.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise FileNotFoundError(f"{text!r}: there is no file {path}")
    try:
        tree = ast.parse(path.read_bytes(), str(path))
    except SyntaxError as error:
        raise ValueError(f"{path}, line {error.lineno}: {error.msg}") from None
    except ValueError as error:  # a null byte
        raise ValueError(f"{path} is no Python: {error}") from None
    classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
    classes = [class_name for class_name in classes if not class_name.startswith("_")]
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


def load_user_class(text: str) -> Callable[..., Any]:
    """Load the class, or another factory, of a user's file.

    The file is run once a process as long as its content stays. It may import its neighbours.

    Args:
        text: "FILE.py:Name", or "FILE.py" for its only class.

    Returns:
        The factory.

    Raises:
        ValueError: As `find_class`, or the file raises; the message has the line.
        TypeError: The name is not callable.
    """
    path, name = find_class(text)
    try:
        factory = getattr(_load_module(path.resolve()), name)
    except AttributeError:
        raise ValueError(f"{path} has no {name!r} once it is run") from None
    if not callable(factory):
        raise TypeError(f"{text!r} is no class or function but of type {type(factory).__name__}")
    return factory  # type: ignore[no-any-return]


def _load_module(path: Path) -> ModuleType:
    content = path.read_bytes()
    name = f"{_PREFIX}{path.stem}_{hashlib.sha256(str(path).encode() + content).hexdigest()[:12]}"
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
    """Describe an error for messages.

    Args:
        error: A raised exception.

    Returns:
        Its kind and text, and the line of the user's file in which it arose, if it did.
    """
    text, location, trace = f"{type(error).__name__}: {error}", "", error.__traceback__
    while trace is not None:
        if str(trace.tb_frame.f_globals.get("__name__", "")).startswith(_PREFIX):
            location = f" ({Path(trace.tb_frame.f_code.co_filename).name}, line {trace.tb_lineno})"
        trace = trace.tb_next
    return text + location
