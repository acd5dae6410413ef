"""Commands as records of options: the fields make typer's signature, `run` does the work."""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import MISSING, dataclass, field, fields
from functools import partial
from inspect import Parameter, Signature
from pathlib import Path
from typing import Any, TypeVar

import typer

from ..harness.parallel import PROCESSES
from ..harness.results import check_writable
from .names import complete

Text = str | None
Texts = list[str] | None
File = Path | None
Kind = TypeVar("Kind", bound=type)

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)


def take(
    help: str,
    default: Any = None,
    *names: str,
    declare: Callable[..., Any] = typer.Option,
    ends: str = "",
    kinds: str = "",
    **more: Any,
) -> Any:
    """Make the dataclass field of a command's option.

    Args:
        help: Help text of the option.
        default: Default value, `...` for a required one.
        names: Options that replace the field's name, such as "--jobs" and "-j".
        declare: Typer's function that declares the option.
        ends: Suffixes of a file that is written, which is checked before the work: ".html .htm".
        kinds: Kinds of the names that a shell completes: "agents policies".
        more: Other arguments of `declare`.

    Returns:
        Field whose metadata hold typer's declaration.
    """
    more |= {"autocompletion": complete(*kinds.split())} if kinds else {}
    declared = {"typer": declare(default, *names, help=help, **more), "ends": ends}
    return field(default=MISSING if default is ... else default, metadata=declared)


take_argument = partial(take, declare=typer.Argument)
_SHARED: dict[str, Any] = {
    "address": take("HOST:PORT of the cluster; default: this machine's.", ""),
    "control_period": take("Control period in ticks of 1 ms; default: 10."),
    "engine_name": take(
        "What runs the cases: processes, or ray, a cluster.", PROCESSES, "--engine"
    ),
    "html": take("Write a self-contained report.", ends=".html .htm"),
    "jobs": take("Number of parallel processes.", None, "--jobs", "-j", min=1),
    "json": take("Write the rows as JSON.", ends=".json"),
    "mapping": take(
        "NAME_UNIT=COLUMN of the log (yaw_rate_degps=r), dbc=FILE, or a TOML file; repeatable.",
        None,
        "--map",
    ),
    "parquet": take("Write the rows as Parquet.", ends=".parquet"),
    "seed": take("Seed of the sampler; another on each machine of a study.", 0),
    "steering_offset": take("Offset that is added to the steering (deg at the wheels)."),
    "steering_ratio": take("Logged steering angle over the wheels' angle (15.2)."),
    "steering_sign": take("Sign of the logged steering: 1 or -1."),
    "storage": take("RDB URL or SQLite file; default: sideslip-tune.db here."),
    "trust": take("Read policies' zips, which may run code of their makers.", False, "--trust"),
    "vehicle": take("The car: a name or a TOML or JSON file.", kinds="vehicles"),
}  # a command declares these fields without a value


def register(name: str, line: str | None = None, to: typer.Typer = app) -> Callable[[Kind], Kind]:
    """Make a command of a class with `run`: its help is the docstring, its options the fields.

    Args:
        name: Name of the command.
        line: Short help in the list of commands.
        to: Typer application of the command.

    Returns:
        Decorator of the class.
    """

    def register_class(kind: Kind) -> Kind:
        for shared in kind.__annotations__.keys() - vars(kind).keys():
            setattr(kind, shared, copy(_SHARED[shared]))  # into which the dataclass writes
        record: Any = dataclass(frozen=True)(kind)

        def call(**values: Any) -> None:
            for option in fields(record):
                if ends := option.metadata["ends"]:
                    check_file(values[option.name], ends)
            record(**values).run()

        call.__doc__ = kind.__doc__
        vars(call)["__signature__"] = Signature([
            Parameter(x.name, Parameter.KEYWORD_ONLY, default=x.metadata["typer"],
                      annotation=x.type)
            for x in fields(record)
        ])  # fmt: skip
        to.command(name, short_help=line)(call)
        return kind

    return register_class


def check_file(path: Path | None, ends: str) -> None:
    """Check before the work that a file has a known suffix and can be written.

    Args:
        path: File, None for none.
        ends: Suffixes, such as ".html .htm".
    """
    known = ends.split()
    if path and path.suffix.lower() not in known and not path.is_char_device():
        raise ValueError(f"{path}: expected a file that ends in {' or '.join(known)}")
    check_writable(path)


def parse_options(texts: Sequence[str] | None) -> dict[str, Any]:
    """Parse options; ValueError for a text of another form.

    Args:
        texts: Texts such as NAME=VALUE, None for none; a value is JSON or a word.
    """
    options: dict[str, Any] = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise ValueError(f"an option is NAME=VALUE, got {text!r}")
        if name in options:
            raise ValueError(f"option {name} is there twice, as {options[name]!r} and {value!r}")
        options[name] = value
        with suppress(json.JSONDecodeError):
            options[name] = json.loads(value)
    return options
