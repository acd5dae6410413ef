"""The compiler and the kinds of numbers: one text for Python, SIMD lanes, NumPy, torch and CasADi.

`jit` compiles a plain function, `as_python` rebuilds its text for another kind of numbers.
`primitives` and `arrays` are what such texts may call; `elementary` and `random` are built from
them. Nothing of sideslip is imported here, and every other room may import this one.

Packages that come with an extra: what to say where one is missing.
"""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def require_extra(name: str, needs: str) -> Iterator[None]:
    """Around imports: ModuleNotFoundError for a missing package names the extra to install.

    needs: what needs what, "pictures need pygame"; {} stands for the missing module's name.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        text = f"{needs.format(error.name)}: pip install 'sideslip[{name}]'"
        raise ModuleNotFoundError(text, name=error.name) from None
