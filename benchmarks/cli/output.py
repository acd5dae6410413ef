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
from ...envs.backend.files import whole
from ..harness.parallel import Bar
from ..harness.results import (
    Row,
    Suite,
    check_writable,
    write_json,
    write_parquet,
    write_text,
)
from ..report.terminal import print_run, print_suite
from .options import command_line

if TYPE_CHECKING:
    from ...agents.rollout import Rollout
    from ...agents.training.task import Task
    from ...agents.training.train import Progress as Now

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
def explain_interrupt(how: str) -> Iterator[None]:
    """End with exit status 130 where the user interrupts, and say how to continue."""
    try:
        yield
    except KeyboardInterrupt:
        Console(stderr=True, soft_wrap=True).print(f"stopped; to go on: {how}", highlight=False)
        raise typer.Exit(130) from None


def wrote(console: Console, path: Path) -> None:
    """Print what was written."""
    console.print(f"wrote {path}", highlight=False, soft_wrap=True, markup=False)


def show_episode(
    console: Console,
    drive: "Rollout",
    who: str,
    plot: Path | None = None,
    parquet: Path | None = None,
    kml: Path | None = None,
) -> None:
    """Print an episode's score in a line and draw it; who: its driver."""
    from ..report.kml import track_kml

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
        with whole(plot) as file:
            drive.plot().savefig(file, format=plot.suffix[1:] or "png", dpi=120)
        wrote(console, plot)
    if parquet is not None:
        drive.to_parquet(parquet)
        wrote(console, parquet)
    if kml is not None:
        write_text(kml, track_kml(drive.log.name, {who: (drive["X"], drive["Y"])}))
        wrote(console, kml)


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
    rows: list[Row] = [row for suite in suites for row in suite.rows]
    if json is not None:
        write_json(json, rows)
        wrote(console, json)
    if parquet is not None:
        write_parquet(parquet, rows)
        wrote(console, parquet)
    if html is not None:
        from ..report.html import write_report

        write_report(html, list(suites), command_line(), environment())
        wrote(console, html)


def words_of(task: "Task", steps: int) -> list[str]:
    """The command that trains this from the start."""
    words = ["sideslip", "train", "--algo", task.algo, "--env", task.env_id]
    words += ["--estimator", task.estimator] if task.estimator else []
    given = {"--estimator-option": task.estimator_options, "--option": task.env_options}
    for option, values in given.items():
        for name, value in values.items():
            words += [
                option,
                f"{name}={value if isinstance(value, str) else json.dumps(value)}",
            ]
    words += [word for each in task.scenarios for word in ("--scenarios", str(each))]
    words += [word for each in task.reads for word in ("--reads", each)]
    numbers = {"--steps": steps, "--seed": task.seed, "--num-envs": task.num_envs}
    numbers |= {"--n-eval-envs": task.n_eval_envs}
    return words + [word for name, value in numbers.items() for word in (name, str(value))]


def folder_of(task: "Task", start: str, out: Path | None, logs: Path | None) -> Path:
    """A training's folder: out, the next one of the zoo's in logs, or by its task and what it
    begins with. ValueError for both."""
    if logs is not None:
        if out is not None:
            raise ValueError(f"--log-folder {logs} numbers its folders itself: without --out {out}")
        return task.zoo_folder(logs)
    if out is not None:
        return out
    given = task.env_options.items()
    options = [each if isinstance(each, str) else name for name, each in given]
    options += ["mixture"] if task.scenarios else []
    words = [task.env_id.rpartition("/")[2], task.algo, task.estimator, *options, start]
    return Path("-".join(["train", *filter(None, words), str(task.seed)]))


def show_training(bar: Bar, now: "Now") -> None:
    """Show where a training stands: its newest episodes, the newest and the best evaluation."""
    text = "" if now.cost is None else f"cost {now.cost:.3g} exploring, "
    last, best = now.evaluations[-1], min(now.evaluations, key=lambda each: each.judged)
    if last.of_start is None:
        text += f"of none's {last.of_none:.3f}, best {best.of_none:.3f}"
    else:
        text += f"of its start's {last.of_start:.3f}, best {best.of_start:.3f}"
    bar.update(bar.task_ids[0], completed=now.steps, description=text)


def environment() -> dict[str, str]:
    """Versions that the numbers depend on."""
    found = {"sideslip": __version__, "Python": platform.python_version()}
    for name in _SHOWN:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
