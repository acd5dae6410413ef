"""Options of commands: NAME=VALUE, those of several commands, and the line as it was said.

The output of commands: an episode, suites and the progress of a training, and files.

Who drives in `sideslip run`: an agent and its estimator, on an environment that suits both.

`sideslip bench control` with contestants of the user's own.
"""

import json
import platform
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import gymnasium as gym
import numpy as np
import typer
from rich.console import Console

from ... import __version__
from ...agents import make_agent
from ...agents.env_info import make_env
from ...envs.io import atomic_file
from ...estimators.wrappers.estimate import EstimateObservation, choose_estimator
from ..control.entries import list_outputs
from ..harness.parallel import Bar
from ..harness.results import (
    ResultRow,
    Suite,
    check_writable,
    write_json,
    write_parquet,
    write_text,
)
from ..harness.study import call_quietly
from ..report.terminal import print_run, print_suite
from .names import check_env, complete

if TYPE_CHECKING:
    from ...agents.rollout import Rollout
    from ...agents.training.callbacks import Progress as TrainingProgress
    from ...agents.training.config import TrainingTask
    from ..entrants.challenge import ComparisonRequest

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
    from ..report.film import make_track_kml

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


_USUAL = ("sideslip/YawVision-v0", "sideslip/AfsYawFusion-v0")


@dataclass(frozen=True)
class AgentSpec:
    """The names of an agent and its estimator (None: without one), and their options.

    trust: whether a policy's zip may be read, which runs code of its maker's.
    """

    agent: str
    agent_options: dict[str, Any]
    estimator: str | None
    estimator_options: dict[str, Any]
    trust: bool = False

    def build(self, env_id: str | None, options: dict[str, Any]) -> tuple[gym.Env[Any, Any], Any]:
        """(the env with the estimator, the agent), on the first of the usual ids that fits.

        options: of the env. Raises ValueError or TypeError for what is unknown or does not fit.
        """
        if env_id is not None:
            check_env(env_id)
            return self._build(env_id, options)
        first, *others = _USUAL
        try:
            return self._build(first, options)
        except ValueError:
            for other in others:
                try:
                    return self._build(other, options)
                except (TypeError, ValueError):
                    continue
            raise

    def _build(self, env_id: str, options: dict[str, Any]) -> tuple[gym.Env[Any, Any], Any]:
        env = make_env(env_id, options)
        sensors = env.get_wrapper_attr("slow_sensors")
        if self.estimator is not None:
            outputs, filter_options = list_outputs(self.estimator), self.estimator_options
            env = call_quietly(
                EstimateObservation, env, self.estimator, outputs, options=filter_options or None
            )
        elif self.estimator_options:
            raise ValueError("--estimator-option needs --estimator")
        try:
            return env, make_agent(self.agent, env, trust=self.trust, **self.agent_options)
        except ValueError as error:
            if self.estimator is None and "_hat" in str(error):
                raise ValueError(
                    f"{self.agent} works on an estimate: add --estimator, for example "
                    f"--estimator {choose_estimator(sensors)}"
                ) from None
            raise


Agents = Annotated[
    list[str] | None,
    typer.Option(
        "--agent",
        help="Your own: FILE.py:Class, a policy's path, a name; repeatable.",
        autocompletion=complete("agents", "policies"),
    ),
]
Estimators = Annotated[
    list[str] | None,
    typer.Option("--estimator", help="FILE.py:Class, a name, none; repeatable."),
]
Scenarios = Annotated[
    list[str] | None, typer.Option("--scenario", help="A name or a file; repeatable.")
]
EnvId = Annotated[str, typer.Option("--env", help="The contests of this id alone.")]
Fresh = Annotated[
    bool, typer.Option("--fresh", help="Seeds drawn after your files are hashed: publishable.")
]
Limit = Annotated[float, typer.Option(help="s of wall time for a contestant in a contest.")]


def make_request(
    suites: Sequence[str],
    agents: Sequence[str],
    estimators: Sequence[str],
    vehicle: str | None,
    scenarios: Sequence[str],
    env_id: str,
    fresh: bool,
    salt: str,
    limit: float,
    episodes: int | None,
    quick: bool,
    trust: bool,
) -> "ComparisonRequest | None":
    """The challenge of a command line, None without contestants; ValueError for options that go
    with them alone, or with the suite `control` alone."""
    if not (agents or estimators):
        if scenarios or env_id or fresh:
            raise ValueError("--scenario, --env and --fresh go with --agent or --estimator")
        return None
    if list(suites) not in ([], ["control"]):
        raise ValueError("--agent and --estimator go with the suite control alone")
    from ..control.entries import QUICK_EPISODES
    from ..entrants.challenge import EPISODES, ComparisonRequest, make_user_entries

    pairs = make_user_entries(
        agents, ["" if name == "none" else name for name in estimators], trust
    )
    if not pairs:
        raise ValueError("--estimator none goes with --agent")
    n_episodes = episodes or (QUICK_EPISODES if quick else EPISODES)
    return ComparisonRequest(
        tuple(pairs), vehicle, tuple(scenarios), env_id, n_episodes, None, fresh, salt, limit
    )
