"""A user's error as one line: what came, what was expected, where; everything else is ours and
keeps its traceback."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from gymnasium.error import Error as GymnasiumError
from rich.console import Console
from rich.markup import escape

_OF_USERS = (
    ValueError, TypeError, ModuleNotFoundError, OSError, RecursionError, GymnasiumError,
    FloatingPointError,
)  # fmt: skip


@contextmanager
def one_line() -> Iterator[None]:
    """End the process with exit status 2 and the message of a user's error."""
    try:
        yield
    except _OF_USERS as error:
        Console(stderr=True, soft_wrap=True).print(
            "[bold red]error:[/]", escape(str(error)), highlight=False
        )
        sys.exit(2)
