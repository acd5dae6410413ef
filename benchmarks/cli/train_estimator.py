"""`sideslip train-estimator`: a network learns to correct a filter's sideslip angle."""

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ... import __version__
from ...envs.sensors.slow import SENSOR_SETS
from .names import complete
from .output import check_files, options_of, wrote


def train_estimator_command(
    name: Annotated[str, typer.Argument(help="Of the file NAME.safetensors.")],
    base: Annotated[
        str, typer.Option(help="The filter.", autocompletion=complete("estimators"))
    ] = "exact-kf",
    scenarios: Annotated[
        list[str] | None, typer.Option(help="Repeatable; default: of all scored contests.")
    ] = None,
    option: Annotated[
        list[str] | None, typer.Option(help="NAME=VALUE of the filter; repeatable.")
    ] = None,
    episodes: Annotated[int, typer.Option(help="Of each contest, driver and sensor set.")] = 32,
    epochs: Annotated[int, typer.Option(help="Passes over all samples.")] = 20,
    seed: Annotated[int, typer.Option(help="Of weights and episodes.", min=0)] = 0,
    out: Annotated[Path | None, typer.Option(help="The file; default: NAME here.")] = None,
) -> None:
    """Train a correction of a filter; `learned` with `file=FILE` estimates with it."""
    from ...agents.training.corrections import READ, train_correction
    from ...estimators.learned.files import CorrectionCard, save_correction
    from ...estimators.make import make_estimator
    from ..control.contests import YAW, contests

    target, console = out or Path(f"{name}.safetensors"), Console()
    check_files(correction=target)
    wanted = dict.fromkeys(scenarios or [each.scenario for each in contests()])
    drives = [(c.env_id, c.env_options) for c in contests() if c.scenario in wanted]
    known = {c.scenario for c in contests()}
    drives += [(YAW, {"scenario": each}) for each in wanted if each not in known]
    both, options = SENSOR_SETS["fusion"], options_of(option)
    there = make_estimator(base, sensors=both, slow=list(both), **options).names
    card = CorrectionCard(
        base=base,
        base_options=options,
        states=tuple(each for each in READ if each in there),
        scenarios=tuple(wanted),
        seed=seed,
        command=shlex.join(["sideslip", *sys.argv[1:]]),
        sideslip=__version__,
    )
    with console.status("") as status:
        found = train_correction(card, drives, episodes, epochs, status.update)
    save_correction(target, found)
    for what, number in found.card.evaluation.items():
        console.print(f"{what} on held-out seeds: {number:.4g}", highlight=False)
    wrote(console, target)
