"""Helpers of the commands: their options' values, the files that they write, who drives.

`AgentSpec` makes who drives in `run` and `live`: an agent, its estimator, and a fitting env.
"""

import json
import platform
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from typer import Exit

from ... import __version__
from ...envs.io import atomic_file
from ..harness.parallel import Bar
from ..harness.results import Suite, check_writable, write_json, write_parquet, write_text
from ..report.terminal import print_run, print_suite
from .names import check_env

if TYPE_CHECKING:
    import gymnasium as gym

    from ...agents.rollout import Rollout
    from ...agents.training.callbacks import Progress as TrainingProgress
    from ...agents.training.config import TrainingTask

_SUFFIXES = {
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
_PACKAGES = ("numpy", "scipy", "numba", "gymnasium", "control", "plotly")  # named in reports
_DEFAULT_ENVS = ("sideslip/YawVision-v0", "sideslip/AfsYawFusion-v0")


def parse_option(text: str) -> tuple[str, Any]:
    """Parse NAME=VALUE to name and value, JSON or a word; ValueError for another form."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise ValueError(f"an option is NAME=VALUE, got {text!r}")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def parse_options(texts: Sequence[str] | None) -> dict[str, Any]:
    """Parse texts of NAME=VALUE, as `parse_option` does, to values by name."""
    return dict(map(parse_option, texts or ()))


def get_command_line() -> str:
    """Get the command line of this process."""
    return shlex.join(["sideslip", *sys.argv[1:]])


def check_files(**paths: Path | None) -> None:
    """Check before the work that files have their kind's suffix and can be written."""
    for option, path in paths.items():
        known = _SUFFIXES[option]
        if path and path.suffix.lower() not in known and not path.is_char_device():
            raise ValueError(f"{path}: expected a file that ends in {' or '.join(known)}")
    check_writable(*paths.values())


def announce_torch() -> None:
    """Say that PyTorch is loaded, which takes seconds; nothing where it is there already."""
    if sys.modules.get("torch") is None:
        print("sideslip: loading PyTorch, some seconds ...", file=sys.stderr, flush=True)


@contextmanager
def handle_interrupt(how: str) -> Iterator[None]:
    """End with exit status 130 where the user interrupts, and print `how` to continue."""
    try:
        yield
    except KeyboardInterrupt:
        Console(stderr=True, soft_wrap=True).print(f"stopped; to go on: {how}", highlight=False)
        raise Exit(130) from None


def print_written(console: Console, path: Path) -> None:
    """Print on the console that the file `path` was written."""
    console.print(f"wrote {path}", highlight=False, soft_wrap=True, markup=False)


def show_episode(
    console: Console,
    drive: "Rollout",
    driver: str,
    plot: Path | None = None,
    parquet: Path | None = None,
    kml: Path | None = None,
) -> None:
    """Print an episode's score, and write its picture, signals and track with the driver's name."""
    from ..report.film import make_track_kml

    slip = drive["beta"]
    text = (
        f"{drive.log.name}: {drive['t'][-1]:.2f} s, cost {drive.cost:.4g}, "
        f"RMS slip {1e3 * np.sqrt(np.mean(slip**2)):.2f} mrad, "
        f"peak {1e3 * np.max(np.abs(slip)):.2f} mrad" + (", FAILED" if drive.failed else "")
    )
    console.print(text, soft_wrap=True, markup=False, highlight=False)
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
    """Print all tables, or if `brief` verdicts and a table; write report and rows to files."""
    if brief:
        print_run(console, suites, html is not None)
    for suite in () if brief else suites:
        print_suite(console, suite)
    rows = [row for suite in suites for row in suite.rows]
    for path, write in ((json, write_json), (parquet, write_parquet)):
        if path is not None:
            write(path, rows)
            print_written(console, path)
    if html is not None:
        from ..report.html import write_report

        versions = {"sideslip": __version__, "Python": platform.python_version()}
        for name in _PACKAGES:
            with suppress(PackageNotFoundError):
                versions[name] = version(name)
        write_report(html, list(suites), get_command_line(), versions)
        print_written(console, html)


def make_command(task: "TrainingTask", steps: int) -> list[str]:
    """Make the words of the command that trains a task from the start, for so many steps."""
    words = ["sideslip", "train", "--algo", task.algo, "--env", task.env_id]
    words += ["--estimator", task.estimator] if task.estimator else []
    option_groups = {"--estimator-option": task.estimator_options, "--option": task.env_options}
    for option, values in option_groups.items():
        for name, value in values.items():
            words += [option, f"{name}={value if isinstance(value, str) else json.dumps(value)}"]
    words += [word for item in task.scenarios for word in ("--scenarios", str(item))]
    words += [word for item in task.reads for word in ("--reads", item)]
    numbers = {"--steps": steps, "--seed": task.seed, "--num-envs": task.num_envs}
    numbers |= {"--n-eval-envs": task.n_eval_envs}
    return words + [word for name, value in numbers.items() for word in (name, str(value))]


def choose_folder(task: "TrainingTask", start: str, out: Path | None, logs: Path | None) -> Path:
    """Choose a training's folder: `out`, the zoo's next one in `logs`, or one named by its task.

    Raises ValueError for both of them. start: Name of the policy that it begins with, "" for none.
    """
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
    """Show in a bar a training's newest episodes, and its newest and best evaluation."""
    text = "" if now.cost is None else f"cost {now.cost:.3g} exploring, "
    last = now.evaluations[-1]
    best = min(now.evaluations, key=lambda evaluation: evaluation.criterion)
    if last.of_start is None:
        text += f"of none's {last.of_none:.3f}, best {best.of_none:.3f}"
    else:
        text += f"of its start's {last.of_start:.3f}, best {best.of_start:.3f}"
    bar.update(bar.task_ids[0], completed=now.steps, description=text)


@dataclass(frozen=True)
class AgentSpec:
    """An agent and the estimator in front of it, by their names and options."""

    agent: str
    agent_options: dict[str, Any]
    estimator: str | None  # None without one
    estimator_options: dict[str, Any]
    trust: bool = False  # whether a policy's zip may be read, which runs code of its maker's

    def build(self, env_id: str | None, options: dict[str, Any]) -> "tuple[gym.Env[Any, Any], Any]":
        """Make the env with the estimator, and the agent.

        Args:
            env_id: Id of the env; None: the first of the usual ones that fits.
            options: Options of the env.

        Returns:
            Env and agent.
        """
        if env_id is not None:
            check_env(env_id)
            return self._build(env_id, options)
        first, *others = _DEFAULT_ENVS
        try:
            return self._build(first, options)
        except ValueError:
            for other in others:
                try:
                    return self._build(other, options)
                except (TypeError, ValueError):
                    continue
            raise

    def _build(self, env_id: str, options: dict[str, Any]) -> "tuple[gym.Env[Any, Any], Any]":
        from ...agents import make_agent
        from ...agents.env_info import make_env
        from ...estimators.wrappers.estimate import EstimateObservation, choose_estimator
        from ..control.entries import list_outputs
        from ..harness.drives import call_quietly

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
