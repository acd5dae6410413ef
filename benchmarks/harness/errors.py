"""A user's error as one line; every other error keeps its traceback."""

import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from gymnasium.error import Error as GymnasiumError
from rich.console import Console
from rich.markup import escape

_USER_ERRORS = (
    ValueError, TypeError, ModuleNotFoundError, OSError, RecursionError, GymnasiumError,
    FloatingPointError,
)  # fmt: skip

_LONGEST = 1000  # letters of a message


@contextmanager
def report_user_errors() -> Iterator[None]:
    """End the process with exit status 2 and the message of a user's error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a result is not lost for a letter
            stream.reconfigure(errors="backslashreplace")
    try:
        yield
    except _USER_ERRORS as error:
        Console(stderr=True, soft_wrap=True).print(
            "[bold red]error:[/]", escape(_truncate_message(str(error))), highlight=False
        )
        sys.exit(2)


def _truncate_message(text: str) -> str:
    """Truncate a long message in its middle."""
    if len(text) <= _LONGEST:
        return text
    return f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
