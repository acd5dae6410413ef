"""`sideslip export`: a stable-baselines3 zip as a policy's file, which cannot run code."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from ..harness.results import check_writable
from .options import get_command_line, parse_options
from .output import print_written

if TYPE_CHECKING:
    from ...estimators.learned.network import Network

ENV = "sideslip/YawVision-v0"
Trust = Annotated[
    bool, typer.Option("--trust", help="Read policies' zips, which may run code of their makers.")
]


def export_command(
    zipped: Annotated[Path, typer.Argument(metavar="ZIP", help="Of stable-baselines3.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Default: NAME.safetensors beside it.")
    ] = None,
    env: Annotated[str, typer.Option(help="The id that it was trained on.")] = ENV,
    estimator: Annotated[str, typer.Option(help="The estimator around it.")] = "",
    option: Annotated[
        list[str] | None, typer.Option(help="NAME=VALUE of the environment; repeatable.")
    ] = None,
    normalise: Annotated[
        Path | None,
        typer.Option(help="VecNormalize's pickle; default: NAME.pkl or vecnormalize.pkl beside."),
    ] = None,
    trust: Trust = False,
) -> None:
    """Make a policy's file of a zip: weights and a card, which no reader has to trust."""
    from ...agents.training.zips import export_zip, find_normaliser

    target = out or zipped.with_suffix(".safetensors")
    check_writable(target)
    options = parse_options(option)
    policy = export_zip(
        zipped, target, env, options, estimator,
        trust=trust, normalise=normalise, command=get_command_line(),
    )  # fmt: skip
    console, scaled = Console(soft_wrap=True), find_normaliser(zipped, normalise)
    console.print(
        f"network: {describe_sizes(policy.network)}; observations normalised by: "
        f"{scaled or 'nothing'}",
        markup=False,
        highlight=False,
    )
    print_written(console, target)


def describe_sizes(network: "Network") -> str:
    """What an observation goes through, as "22 x 3 frames x 16 lstm x 64 x 1"."""
    frames = [f"{network.history} frames"] if network.history > 1 else []
    cells = [f"{cell.size} {cell.kind}" for cell in network.cells]
    layers = map(str, (*network.hidden, network.width))
    return " x ".join([str(network.inputs), *frames, *cells, *layers])


@contextmanager
def export_policy(name: str, env: str | None, trust: bool) -> Iterator[str]:
    """A policy's name or path as it is; a zip as the path of its export, for the time being."""
    if not name.endswith(".zip"):
        yield name
        return
    from ...agents.training.zips import export_zip

    with TemporaryDirectory() as folder:
        target = Path(folder) / f"{Path(name).stem}.safetensors"
        export_zip(name, target, env or ENV, trust=trust)
        yield str(target)
