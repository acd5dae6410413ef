"""A checkpoint that lacks something says what, and where."""

import dataclasses
import json
from pathlib import Path

import pytest

pytest.importorskip("stable_baselines3")
import torch
from safetensors.torch import save

from sideslip import __version__
from sideslip.agents.training.callbacks import _FORMAT, _STATE, CHECKPOINT
from sideslip.agents.training.config import TrainingTask
from sideslip.agents.training.trainer import read_run_record, read_task

WHOLE: dict[str, object] = dict.fromkeys(sorted(_STATE), 0)
WHOLE |= {"format": _FORMAT, "task": dataclasses.asdict(TrainingTask()), "sideslip": __version__}


def without(key: str, values: dict[str, object]) -> dict[str, object]:
    return {name: value for name, value in values.items() if name != key}


def of(**change: object) -> dict[str, object]:
    """A state whose task has something else."""
    return WHOLE | {"task": dataclasses.asdict(TrainingTask()) | change}


@pytest.mark.parametrize(
    ("state", "message"),
    [
        *((without(key, WHOLE), f": the checkpoint's state lacks {key}") for key in sorted(_STATE)),
        *(
            (WHOLE | {"task": without(each.name, WHOLE["task"])}, f"'s task lacks {each.name}")  # type: ignore[arg-type]
            for each in dataclasses.fields(TrainingTask)
        ),
        (without("format", WHOLE), "is no checkpoint of this format"),
        ([1], "is no checkpoint of this format"),
        (WHOLE | {"sideslip": "0.0.1"}, "was made by sideslip 0.0.1, this is"),
        ("cut", "is no checkpoint: its state is no JSON"),
        (WHOLE | {"task": 0}, "'s task lacks env_id"),
        (of(seed="3"), ": the task: seed is '3', not int"),
        (of(reads=3), ": the task: reads is 3, not list"),
        (of(algo="dqn"), ": the task: unknown algorithm 'dqn'"),
        (of(estimator="evil.py"), ": estimator is a name, got the entry point 'evil.py'"),
        (
            of(estimator="dakf", estimator_options={"estimator": "evil.py"}),
            ": estimator_options holds an estimator",
        ),
        (of(env_id="evil:Car-v0"), ": env_id is that of a registered env, got 'evil:Car-v0'"),
    ],
)
def test_what_a_checkpoint_lacks_is_named(state: object, message: str, tmp_path: Path) -> None:
    text = "{" if state == "cut" else json.dumps(state)
    (tmp_path / CHECKPOINT).write_bytes(save({"a": torch.zeros(1)}, {"checkpoint": text}))
    with pytest.raises(ValueError, match=message) as caught:
        read_task(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / CHECKPOINT))


def test_a_whole_checkpoint_is_read(tmp_path: Path) -> None:
    state = {"checkpoint": json.dumps(WHOLE)}
    (tmp_path / CHECKPOINT).write_bytes(save({"a": torch.zeros(1)}, state))
    assert read_task(tmp_path) == TrainingTask()


def test_what_a_training_was_told_is_typed(tmp_path: Path) -> None:
    for aim, said in (
        (7, "the aim: expected a JSON object"),
        ({"steps": "7"}, "missing eval_freq"),
    ):
        state = {"checkpoint": json.dumps(WHOLE | {"aim": aim})}
        (tmp_path / CHECKPOINT).write_bytes(save({"a": torch.zeros(1)}, state))
        with pytest.raises(ValueError, match=said):
            read_run_record(tmp_path)
