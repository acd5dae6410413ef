"""Packages that come with an extra: what to say where one is missing."""

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
