"""`sideslip train`: what it leaves, how it goes on, and each way to type it wrong."""

import shlex
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from sideslip.agents.learned.policy import load_policy

pytest.importorskip("stable_baselines3")
from sideslip.agents.training import trainer
from sideslip.agents.training.callbacks import CURVE, POLICY, read_training
from sideslip.agents.training.config import TrainingTask
from sideslip.benchmarks.cli import policies as train_command
from sideslip.benchmarks.cli.common import parse_options
from sideslip.benchmarks.cli.policies import _make_command
from sideslip.benchmarks.studies import policies as enjoy
from sideslip.benchmarks.studies.policies import _list_tasks
from tests.benchmarks.conftest import Run
from tests.policies import TRACES

NO_COSTS: dict[str, Any] = {"cost": {}}
TINY = ("--num-envs", 8, "--option", "scenario=sine-with-dwell", "--n-eval-envs", 4)


@pytest.fixture
def run(run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Call `sideslip train` in an empty folder; gives (exit status, stdout, stderr)."""
    monkeypatch.setattr(trainer, "_SCALING_ENVS", 8)
    monkeypatch.setattr(train_command, "EPISODES", 4)
    monkeypatch.chdir(tmp_path)
    return partial(run, "train")


@pytest.mark.long
def test_the_policys_card_says_how_it_was_made_and_what_it_costs(run: Run) -> None:
    status, out, err = run(*TINY, "--steps", 256, "--out", "here")
    assert status == 0, err
    assert "best" in out and f"here/{POLICY}" in out and "of none's" in out
    card = load_policy(f"here/{POLICY}").card
    assert shlex.split(card.command)[1:] == [
        "train", "--algo", "ppo", "--env", "sideslip/YawVision-v1",
        "--option", "scenario=sine-with-dwell", "--steps", "256", "--seed", "0", "--num-envs", "8",
        "--n-eval-envs", "4", "--eval-freq", "250000", "--out", "here",
    ]  # fmt: skip
    costs = card.evaluation["cost"]
    assert card.evaluation["salt"] and len(costs) == 3
    assert f"policy {costs['policy']['mean']:.4g}" in out


def test_it_goes_on_with_a_folder(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(enjoy, "record_evaluation", lambda *_: NO_COSTS)
    folder = "train-YawVision-v1-ppo-sine-with-dwell-0"
    assert run(*TINY, "--steps", 256, "--eval-freq", 256)[0] == 0
    status, _, err = run("--resume", "--out", folder, "-n", 512, "-P")
    assert status == 0, err
    assert len((tmp_path / folder / CURVE).read_text().splitlines()) == 3
    status, _, err = run("--resume", "--out", folder, "-n", 768, "--eval-freq", 512)
    assert status == 0, err
    aim = read_training(folder).aim
    assert (aim.steps, aim.eval_freq) == (768, 512) and aim.command.count("sideslip train") == 3
    assert run("--resume", "--out", folder)[0] == 0  # nothing is left to do
    assert read_training(folder).aim == aim
    status, _, err = run(*TINY, "--steps", 256)
    assert status == 2 and "holds a training already" in err
    settings = (tmp_path / "mine.yml", "sideslip/YawGps-v0:\n  n_envs: 8\n  policy: MlpPolicy\n")
    settings[0].write_text(settings[1] + "  n_timesteps: 256\n  n_steps: 32\n")
    own = ("--conf-file", settings[0], "--out", "own")
    assert run(*TINY, "--env", "sideslip/YawGps-v0", *own)[0] == 0
    status, _, err = run("--resume", *own)  # the folder says which env's settings they are
    assert status == 0, err
    status, _, err = run("--resume", "--out", folder, "--seed", 4)
    assert status == 2 and "is of seed 0, not 4" in err


def test_a_gpu_that_is_not_there_is_refused(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    status, _, err = run(*TINY, "--steps", 64, "--device", "cuda:0")
    assert status == 2 and "torch finds no CUDA device, got 'cuda:0'" in " ".join(err.split())


@pytest.mark.parametrize("missing", ["torch", "stable_baselines3"])
def test_without_the_extra_the_command_names_it(
    run: Run, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in list(sys.modules):
        if name.split(".")[0] == missing or name in (
            "sideslip.agents.training.trainer",
            "sideslip.agents.training.config",
            "sideslip.agents.training.callbacks",
            "sideslip.agents.training.config",
            "sideslip.agents.training.normalise",
            "sideslip.agents.vec_env",
        ):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, missing, None)
    status, _, err = run()
    assert status == 2 and "pip install 'sideslip[train]'" in err
    assert missing != "torch" or err.startswith("sideslip: loading PyTorch")


def test_the_command_of_a_card_says_what_the_filter_was(run: Run) -> None:
    told = {"outputs": ["beta", "F_d"], "options": {"fast": ["gyro", "accel_y"]}}
    task = TrainingTask(estimator="exact-kf", estimator_options=told)
    words = _make_command(task, 10)
    found = [words[i + 1] for i, word in enumerate(words) if word == "--estimator-option"]
    assert parse_options(found) == told
    status, _, err = run("--estimator-option", found[0])
    assert status == 2 and "options of an estimator need an estimator" in err


def test_log_folders_are_the_zoos(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(enjoy, "record_evaluation", lambda *_: NO_COSTS)
    for number in (1, 2):
        status, out, err = run(*TINY, "--steps", 64, "-f", "logs")
        assert status == 0, err
        assert f"logs/ppo/sideslip-YawVision-v1_{number}/{POLICY}" in out
    params = tmp_path / "logs/ppo/sideslip-YawVision-v1_2/sideslip-YawVision-v1"
    assert "scenario: sine-with-dwell" in (params / "args.yml").read_text()
    status, _, err = run(*TINY, "-f", "logs", "--out", "here")
    assert status == 2 and "without --out here" in err
    status, _, err = run("--resume", "-f", "logs")
    assert status == 2 and "logs is for a new training: name the old --out" in err
    status, _, err = run("-i", TRACES, "-f", "logs")
    assert status == 2 and "ppo goes on from dense layers" in err
    for wrong in (("--steps", 0), ("--device", "moon"), ("--eval-freq", 0)):
        status, _, err = run(*TINY, *wrong, "-f", "logs")
        assert status == 2 and "error: " in err
    assert not list(tmp_path.glob("logs/*/*_3"))


def test_it_goes_on_from_a_distilled_policy_in_all_contests_of_its_class(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(enjoy, "record_evaluation", lambda *_: NO_COSTS)
    asked: list[Any] = []

    def judged(*about: Any) -> str:
        asked.append(about)
        return "judged"

    monkeypatch.setattr(train_command, "_evaluate_on_tasks", judged)
    small = ("--num-envs", 7, "--n-eval-envs", 7, "--steps", 448, "--out", "on")
    status, out, err = run("-i", "distill-coms-yaw", *small)
    assert status == 0, err
    assert "of its start's" in out and " 1.000" in out and "judged" in out
    assert asked == [(Path("on") / POLICY, "coms-zero-slip", 32)]
    task = read_training("on").task
    known = [each.scenario for each in _list_tasks("coms-zero-slip")]
    assert (task.scenarios, task.estimator) == (known, "joint")
    words = shlex.split(load_policy(f"on/{POLICY}").card.command)[2:]
    assert words[-4:] == ["--trained-agent", "distill-coms-yaw", "--out", "on"]
    status, _, err = run("-i", "distill-coms-yaw", "--algo", "sac", "--out", "off")
    assert status == 2 and "sac begins with a zip, not with policy distill-coms-yaw" in err
    status, _, err = run("-i", "distill-coms", "--out", "off")
    assert status == 2 and "distill-coms" in err and not Path("off").exists()
