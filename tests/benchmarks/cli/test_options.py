"""Each option of each command changes the call that it is for; nothing is driven."""

import inspect
import re
from collections.abc import Iterator
from contextlib import nullcontext
from math import radians
from pathlib import Path
from pkgutil import resolve_name
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import typer

from sideslip.agents.baselines import FILE as TUNED
from sideslip.benchmarks.cli import main as cli
from sideslip.benchmarks.control.tasks import make_tuning_seeds

CLI = "benchmarks.cli"
DISTIL, TUNE = "distill mine --class coms-model", "tune controller lqr --class coms-model"
Row = tuple[str, str, Any]
CLUSTER: list[Row] = [("--engine ray", "name", "ray"), ("--address head:1", "address", "head:1")]
LOGGED: list[Row] = [
    ("--vehicle coms", "vehicle", "coms"),
    ("--map yaw_rate_degps=r", "mapping", ["yaw_rate_degps=r"]),
    ("--until 12", "until", 12.0),
    ("--steering-ratio 15.2", "wires.ratio", 15.2),
    ("--steering-sign -1", "wires.sign", -1),
    ("--steering-offset 0.5", "wires.offset", radians(0.5)),
]


class Arrived(BaseException):
    """The call that a command ends in."""

    def __init__(self, arguments: dict[str, Any]) -> None:
        self.arguments = arguments


class Case(NamedTuple):
    """A command, an option of it, and where that arrives."""

    command: str
    option: str
    function: str
    argument: str
    """Its name, and what of it: attributes or items, after dots."""
    value: Any


def _of(command: str, function: str, *rows: Row) -> list[Case]:
    """Cases of a command and the function that it ends in."""
    return [Case(command, option, function, argument, value) for option, argument, value in rows]


# fmt: off
CASES = [
    *_of("run", "agents.rollout.rollout", ("--seed 3", "seed", 3)),
    *_of("run", f"{CLI}.common.make_driver",
         ("--control-period 20", "setup.options.control_period", 20)),
    *_of("bench control", f"{CLI}.main.run_suites",
         ("--episodes 8", "request.episodes", 8),
         ("--salt ab12", "request.salt", "ab12"),
         ("--keep cases", "request.keep", Path("cases")),
         ("--jobs 3", "request.jobs", 3)),
    *_of("bench control", f"{CLI}.main.use_engine", *CLUSTER),
    *_of("bench control --agent mine.py:Mine", f"{CLI}.main.run_suites",
         ("--limit 5", "request.limit", 5.0),
         ("--fresh", "request.fresh", True),
         ("--salt ab12", "request.salt", "ab12"),
         ("--episodes 8", "request.episodes", 8),
         ("--env sideslip/YawGps-v0", "request.env_id", "sideslip/YawGps-v0"),
         ("--scenario gust", "request.scenarios", ("gust",)),
         ("--vehicle coms", "request.vehicle", "coms")),
    *_of("bench control --agent esc", "benchmarks.entrants.challenge.make_user_entries",
         ("--trust", "trust", True)),
    *_of("bench control", f"{CLI}.main.write_page", ("--page a.md", "path", Path("a.md"))),
    *_of("calibrate", f"{CLI}.main.use_engine", *CLUSTER),
    *_of("enjoy distill-car-yaw", "benchmarks.studies.policies.evaluate_policy",
         ("--seed 7", "seed", 7)),
    *_of("export a.zip", "agents.training.export.export_zip",
         ("--option reference=model", "env_options", {"reference": "model"}),
         ("--normalise a.pkl", "normalise", Path("a.pkl"))),
    *_of("replay log.csv", "benchmarks.recorded.replay.replay_file", *LOGGED,
         ("--nominal coms", "nominal", "coms"),
         ("--estimator joint", "settings.estimators", ["joint"]),
         ("--estimator-option joint.gate=0.9", "settings.options", {"joint": {"gate": 0.9}}),
         ("--latency gps=0.2", "wires.latency", {"gps": 0.2}),
         ("--course-rate 5", "settings.course_rate", 5.0),
         ("--course-noise 0.1", "settings.course_noise_deg", 0.1),
         ("--course-delay 0.3", "settings.delay", 0.3),
         ("--course-bias 0.4", "settings.bias_deg", 0.4),
         ("--gyro-bias 0.6", "settings.gyro_bias_degps", 0.6)),
    *_of("identify log.csv", "benchmarks.recorded.identify.identify_file", *LOGGED,
         ("--tyres fiala", "tyres", "fiala"), ("--validate", "validate", True)),
    *_of("inspect log.csv", "benchmarks.recorded.inspection.inspect_file",
         *(row for row in LOGGED if row[1] != "until"),
         ("--latency gps=0.2", "wires.latency.gps", 0.2)),
    *_of("identify log.csv", "estimators.wires.write_vehicle",
         ("--out car.toml", "path", Path("car.toml"))),
    *_of("live exact-kf --port 0", f"{CLI}.common.make_driver",
         ("--vehicle coms", "setup.options.vehicle", "coms"),
         ("--control-period 20", "setup.options.control_period", 20),
         ("--option reference=model", "setup.options.reference", "model"),
         ("--agent-option grip=0.6", "setup.agent_options", {"grip": 0.6}),
         ("--estimator-option q_beta=1", "setup.estimator_options", {"q_beta": 1}),
         ("--trust", "trust", True)),
    *_of("live exact-kf --port 0", "agents.live.controller.OnboardController",
         ("--seed 5", "seed", 5)),
    *_of("live exact-kf --port 0", "agents.live.loop.Loop.run", ("--duration 9", "duration", 9.0)),
    *_of("live exact-kf --port 0 --gps log.nmea", "agents.live.loop.Relay",
         ("--latency 0.3", "latency", 0.3),
         ("--speed 2", "speed", 2.0)),
    *_of("live --relay log.nmea", "agents.live.loop.Relay",
         ("--latency 0.3", "latency", 0.3),
         ("--to 127.0.0.1:9", "to", ("127.0.0.1", 9))),
    *_of("live --simulate", "agents.live.peers.simulate",
         ("--seed 5", "seed", 5),
         ("--to 127.0.0.1:9", "to", ("127.0.0.1", 9)),
         ("--step", "step", True)),
    *_of("train --algo ppo", "agents.training.trainer.Trainer",
         ("--reads gyro", "task.reads", ["gyro"]),
         ("--num-envs 8", "task.num_envs", 8),
         ("--n-eval-envs 4", "task.n_eval_envs", 4),
         ("--tensorboard-log logs", "run_options.tensorboard_log", "logs"),
         ("--trust", "trust", True)),
    *_of(DISTIL, "agents.training.distill.distill",
         ("--rounds 2", "config.rounds", 2),
         ("--epochs 3", "config.epochs", 3),
         ("--cells 4", "config.cells", 4),
         ("--hidden 8 --hidden 9", "config.hidden", (8, 9)),
         ("--batch 5", "config.batch", 5),
         ("--noise 0.1", "config.noise", 0.1),
         ("--traces 6", "config.traces", 6),
         ("--seed 7", "config.seed", 7),
         ("--out a.safetensors", "path", Path("a.safetensors"))),
    *_of(f"{DISTIL} --traces 6", "agents.training.distill.distill",
         ("--told 0.5", "config.auxiliary_weight", 0.5)),
    *_of("distill mine", "benchmarks.studies.policies.Lessons",
         ("--class coms-model", "kind", "coms-model")),
    *_of(DISTIL, "benchmarks.studies.policies.Lessons",
         ("--teacher lqr", "teacher", "lqr"),
         ("--estimator exact-kf", "estimator", "exact-kf"),
         ("--cars 3", "cars", 3),
         ("--varied 2", "varied", 2),
         ("--option fast=true", "observation_options", {"fast": True}),
         ("--seed 7", "seed", 7)),
    *_of(DISTIL, f"{CLI}.policies._evaluate_on_tasks", ("--episodes 8", "episodes", 8)),
    *_of("tune estimator exact-kf --scenario gust", "benchmarks.tuning.estimator.run",
         ("--seed 4", "search.seed", 4)),
    *_of("tune controller lqr", "benchmarks.tuning.controllers.make_controller_tuning",
         ("--class car-yaw", "kind", "car-yaw"),
         ("--seeds 3", "seeds", make_tuning_seeds(3))),
    *_of(TUNE, "benchmarks.tuning.controllers.tune",
         ("--trials 5", "search.trials", 5),
         ("--storage a.db", "search.storage", "a.db"),
         ("--seed 4", "search.seed", 4),
         ("--jobs 3", "search.jobs", 3)),
    *_of(TUNE, f"{CLI}.main.use_engine", *CLUSTER),
    *_of(TUNE, "benchmarks.tuning.controllers.write_tuned",
         ("--out a.toml", "path", Path("a.toml")),
         ("--write", "path", TUNED)),
    *_of(TUNE, "benchmarks.tuning.controllers.write_log",
         ("--log logs", "path", Path("logs/coms-model.lqr.json"))),
]
NOTHING = SimpleNamespace(spec=None, search={}, car=None, wires=None, reason="")
BASE = SimpleNamespace(base=SimpleNamespace(spec=SimpleNamespace(id="")))
RETURNED: dict[str, dict[str, Any]] = {
    "run": {f"{CLI}.common.make_driver": (NOTHING, None), f"{CLI}.common.show_episode": None,
            "agents.rollout.rollout": None},
    "bench": {f"{CLI}.main.check_page": None, f"{CLI}.main.use_engine": nullcontext(),
              f"{CLI}.main.run_suites": [], f"{CLI}.common.write_output": None},
    "inspect": {"benchmarks.recorded.inspection.inspect_file": NOTHING,
                f"{CLI}.common.write_output": None},
    "identify": {"benchmarks.recorded.identify.identify_file": (NOTHING, None),
                 f"{CLI}.data.print_suite": None},
    "live": {f"{CLI}.common.make_driver": (None, None), f"{CLI}.live._watch_signals": [],
             "agents.live.controller.OnboardController": BASE,
             "agents.live.loop.Loop.run": None, f"{CLI}.live.gym.make": None},
    "distill": {"benchmarks.studies.policies.Lessons.make_card": None,
                "benchmarks.studies.policies.Lessons.make_tasks": None,
                "agents.training.distill.distill": None, f"{CLI}.policies._evaluate_on_tasks": ""},
    "tune": {"benchmarks.tuning.estimator.make_estimator_tuning": NOTHING,
             "benchmarks.tuning.controllers.make_controller_tuning": None,
             "benchmarks.tuning.controllers.tune": {"options": {}},
             "benchmarks.tuning.controllers.make_suite": None,
             "benchmarks.tuning.controllers.write_log": None,
             "benchmarks.tuning.controllers.write_tuned": None,
             f"{CLI}.main.use_engine": nullcontext(), f"{CLI}.main.print_suite": None},
}
"""What functions on a command's way give back instead of working."""
# fmt: on
ABSENT = object()


def _run(words: str) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr("sys.argv", ["sideslip", *words.split()])
        cli.main()
        raise SystemExit


def _arrived(case: Case, words: str) -> Any:
    """The argument of the function that a command line ends in, ABSENT where it is not called."""
    name = f"sideslip.{case.function}"
    called = inspect.signature(resolve_name(name))

    def arrive(*args: Any, **named: Any) -> None:
        bound = called.bind(*args, **named)
        bound.apply_defaults()
        raise Arrived(bound.arguments)

    with pytest.MonkeyPatch.context() as patch:
        for other, value in RETURNED.get(words.split()[0], {}).items():
            patch.setattr(f"sideslip.{other}", lambda *_, value=value, **__: value)
        patch.setattr(name, arrive)
        try:
            _run(words)
        except Arrived as end:
            value = end.arguments
            for part in case.argument.split("."):
                value = value.get(part, ABSENT) if isinstance(value, dict) else getattr(value, part)
            return value
    return ABSENT


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.command} {case.option}")
def test_an_option_changes_the_call_that_it_is_for(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It arrives as what was said, and without it something else does."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("class Mine:\n    pass\n")
    try:
        resolve_name(f"sideslip.{case.function}")
    except ModuleNotFoundError as error:
        pytest.skip(str(error))
    assert _arrived(case, f"{case.command} {case.option}") == case.value
    assert _arrived(case, case.command) != case.value


def _options(command: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """(words of a command, an option of it), of all commands below one."""
    for name, each in getattr(command, "commands", {}).items():
        yield from _options(each, (*words, name))
    for option in command.params:
        if words and option.param_type_name == "option":
            yield words, option


def test_every_option_is_in_the_table_or_in_a_test_of_its_command() -> None:
    others = [path.read_text() for path in Path(__file__).parent.glob("test_*.py")
              if path.name != Path(__file__).name]  # fmt: skip
    for words, option in _options(typer.main.get_command(cli.app)):
        names = [*option.opts, *option.secondary_opts]
        quoted = [text for text in others if all(f'"{word}"' in text for word in words)]
        spelled = any(re.search(rf'"{name}["=]', text) for text in quoted for name in names)
        tabled = any(
            case.command.split()[: len(words)] == [*words] and name in case.option.split()
            for case in CASES
            for name in names
        )
        assert tabled or spelled, (*words, option.opts)
