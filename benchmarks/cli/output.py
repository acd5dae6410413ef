"""The output of commands: an episode, suites and the progress of a training, and files."""

import json
import platform
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import typer
from rich.console import Console

from ... import __version__
from ...envs.backend.files import atomic_file
from ..harness.parallel import Bar
from ..harness.results import (
    ResultRow,
    Suite,
    check_writable,
    write_json,
    write_parquet,
    write_text,
)
from ..report.terminal import print_run, print_suite
from .options import get_command_line

if TYPE_CHECKING:
    from ...agents.rollout import Rollout
    from ...agents.training.task import TrainingTask
    from ...agents.training.train import Progress as TrainingProgress

_ENDINGS = {
    "correction": (".safetensors",),
    "film": (".mp4", ".avi"),
    "html": (".html", ".htm"),
    "image": (".png", ".jpg", ".jpeg"),
    "json": (".json",),
    "kml": (".kml",),
    "page": (".md",),
    "parquet": (".parquet",),
    "picture": (".png", ".pdf", ".svg"),
    "plot": (".png", ".pdf", ".svg"),
    "policy": (".safetensors",),
    "toml": (".toml",),
}
_SHOWN = ("numpy", "scipy", "numba", "gymnasium", "control", "plotly")


def check_files(**paths: Path | None) -> None:
    """Before the work: by option or kind, the file to be written has its ending and can be written.

    Raises ValueError for another ending, OSError where it cannot be written.
    """
    for option, path in paths.items():
        known = _ENDINGS[option]
        if path and path.suffix.lower() not in known and not path.is_char_device():
            raise ValueError(f"{path}: expected a file that ends in {' or '.join(known)}")
    check_writable(*paths.values())


@contextmanager
def handle_interrupt(how: str) -> Iterator[None]:
    """End with exit status 130 where the user interrupts, and say how to continue."""
    try:
        yield
    except KeyboardInterrupt:
        Console(stderr=True, soft_wrap=True).print(f"stopped; to go on: {how}", highlight=False)
        raise typer.Exit(130) from None


def print_written(console: Console, path: Path) -> None:
    """Print what was written."""
    console.print(f"wrote {path}", highlight=False, soft_wrap=True, markup=False)


def show_episode(
    console: Console,
    drive: "Rollout",
    driver: str,
    plot: Path | None = None,
    parquet: Path | None = None,
    kml: Path | None = None,
) -> None:
    """Print an episode's score in a line and draw it; who: its driver."""
    from ..report.kml import make_track_kml

    slip = drive["beta"]
    console.print(
        f"{drive.log.name}: {drive['t'][-1]:.2f} s, cost {drive.cost:.4g}, "
        f"RMS slip {1e3 * np.sqrt(np.mean(slip**2)):.2f} mrad, "
        f"peak {1e3 * np.max(np.abs(slip)):.2f} mrad" + (", FAILED" if drive.failed else ""),
        soft_wrap=True,
        markup=False,
        highlight=False,
    )
    if plot is not None:
        with atomic_file(plot) as file:
            drive.plot().savefig(file, format=plot.suffix[1:] or "png", dpi=120)
        print_written(console, plot)
    if parquet is not None:
        drive.to_parquet(parquet)
        print_written(console, parquet)
    if kml is not None:
        write_text(kml, make_track_kml(drive.log.name, {driver: (drive["X"], drive["Y"])}))
        print_written(console, kml)


def write_output(
    console: Console,
    suites: Sequence[Suite],
    html: Path | None = None,
    json: Path | None = None,
    parquet: Path | None = None,
    brief: bool = False,
) -> None:
    """Print tables, or verdicts and a table if `brief`; write the files that have a path."""
    if brief:
        print_run(console, suites, html is not None)
    for suite in () if brief else suites:
        print_suite(console, suite)
    rows: list[ResultRow] = [row for suite in suites for row in suite.rows]
    if json is not None:
        write_json(json, rows)
        print_written(console, json)
    if parquet is not None:
        write_parquet(parquet, rows)
        print_written(console, parquet)
    if html is not None:
        from ..report.html import write_report

        write_report(html, list(suites), get_command_line(), collect_versions())
        print_written(console, html)


def make_command(task: "TrainingTask", steps: int) -> list[str]:
    """The command that trains this from the start."""
    words = ["sideslip", "train", "--algo", task.algo, "--env", task.env_id]
    words += ["--estimator", task.estimator] if task.estimator else []
    option_groups = {"--estimator-option": task.estimator_options, "--option": task.env_options}
    for option, values in option_groups.items():
        for name, value in values.items():
            words += [
                option,
                f"{name}={value if isinstance(value, str) else json.dumps(value)}",
            ]
    words += [word for item in task.scenarios for word in ("--scenarios", str(item))]
    words += [word for item in task.reads for word in ("--reads", item)]
    numbers = {"--steps": steps, "--seed": task.seed, "--num-envs": task.num_envs}
    numbers |= {"--n-eval-envs": task.n_eval_envs}
    return words + [word for name, value in numbers.items() for word in (name, str(value))]


def choose_folder(task: "TrainingTask", start: str, out: Path | None, logs: Path | None) -> Path:
    """A training's folder: out, the next one of the zoo's in logs, or by its task and what it
    begins with. ValueError for both."""
    if logs is not None:
        if out is not None:
            raise ValueError(f"--log-folder {logs} numbers its folders itself: without --out {out}")
        return task.find_zoo_folder(logs)
    if out is not None:
        return out
    env_options = task.env_options.items()
    options = [value if isinstance(value, str) else name for name, value in env_options]
    options += ["mixture"] if task.scenarios else []
    words = [task.env_id.rpartition("/")[2], task.algo, task.estimator, *options, start]
    return Path("-".join(["train", *filter(None, words), str(task.seed)]))


def show_training(bar: Bar, now: "TrainingProgress") -> None:
    """Show where a training stands: its newest episodes, the newest and the best evaluation."""
    text = "" if now.cost is None else f"cost {now.cost:.3g} exploring, "
    last, best = (
        now.evaluations[-1],
        min(now.evaluations, key=lambda evaluation: evaluation.criterion),
    )
    if last.of_start is None:
        text += f"of none's {last.of_none:.3f}, best {best.of_none:.3f}"
    else:
        text += f"of its start's {last.of_start:.3f}, best {best.of_start:.3f}"
    bar.update(bar.task_ids[0], completed=now.steps, description=text)


def collect_versions() -> dict[str, str]:
    """Versions that the numbers depend on."""
    versions = {"sideslip": __version__, "Python": platform.python_version()}
    for name in _SHOWN:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions
