"""Options of commands: NAME=VALUE, those of several commands, and the line as it was said."""

import json
import shlex
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer

EngineName = Annotated[
    str, typer.Option("--engine", help="What runs the cases: processes, or ray, a cluster.")
]
Address = Annotated[str, typer.Option(help="HOST:PORT of the cluster; default: this machine's.")]
Salt = Annotated[
    str, typer.Option(help="Of the test seeds, hexadecimal; default: of the contestants' sources.")
]


def parse_option(text: str) -> tuple[str, Any]:
    """NAME=VALUE; a value that is no JSON is a word."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise ValueError(f"an option is NAME=VALUE, got {text!r}")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def parse_options(texts: Sequence[str] | None) -> dict[str, Any]:
    """The options in texts of NAME=VALUE; ValueError for a text of another form."""
    return dict(map(parse_option, texts or ()))


def get_command_line() -> str:
    """The command line of this process."""
    return shlex.join(["sideslip", *sys.argv[1:]])
