"""A training that is logged to Weights & Biases, which is not needed here: a mock stands for it."""

import json
import sys
from pathlib import Path
from unittest.mock import Mock, call

import pytest

pytest.importorskip("stable_baselines3")
from sideslip.agents.training import trainer
from sideslip.agents.training.callbacks import CURVE, RunOptions
from sideslip.agents.training.config import TrainingTask

TINY, ROLLOUT = TrainingTask(num_envs=8, seed=3, n_eval_envs=4), 256  # steps of 8 environments


def test_a_tracked_training_hands_over_what_is_logged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One run: named as the folder, told the task, given evaluations and losses, and ended."""
    run = Mock()
    monkeypatch.setitem(sys.modules, "wandb", Mock(init=run.init))
    trainer.train(TINY, ROLLOUT, tmp_path / "mine", run_options=RunOptions(track="cars"))
    assert run.init.call_args.kwargs["project"] == "cars"
    assert run.init.call_args.kwargs["name"] == "mine"
    assert run.init.call_args.kwargs["config"]["env_id"] == TINY.env_id
    own = run.init.return_value
    logged = [(each.kwargs["step"], each.args[0]) for each in own.log.call_args_list]
    lines = [json.loads(line) for line in (tmp_path / "mine" / CURVE).read_text().splitlines()]
    rewards = {
        step: each["eval/mean_reward"] for step, each in logged if "eval/mean_reward" in each
    }
    assert rewards == {each["steps"]: -each["cost"] for each in lines}
    assert any("train/loss" in each for _, each in logged)
    own.finish.assert_called_once_with()
    assert own.method_calls[-1] == call.finish()  # a run that ended takes nothing
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(ModuleNotFoundError, match="tracking needs wandb: pip install wandb"):
        trainer.train(TINY, ROLLOUT, tmp_path / "other", run_options=RunOptions(track="cars"))
    assert not (tmp_path / "other").exists()
