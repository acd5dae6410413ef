"""The options of commands whose cases can run on a cluster."""

from typing import Annotated

import typer

EngineName = Annotated[
    str, typer.Option("--engine", help="What runs the cases: processes, or ray, a cluster.")
]
Address = Annotated[str, typer.Option(help="HOST:PORT of the cluster; default: this machine's.")]
