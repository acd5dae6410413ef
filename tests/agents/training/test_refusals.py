"""What cannot be trained, or be trained on, is refused before a checkpoint is left."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecNormalize

from sideslip.agents.learned.policy import Card, load_policy
from sideslip.agents.training.callbacks import CHECKPOINT
from sideslip.agents.training.config import DistillConfig, TrainingTask, make_finetune_task
from sideslip.agents.training.distill import DistillTask, distill
from sideslip.agents.training.export import convert_sb3_policy
from sideslip.agents.training.trainer import Trainer, _measure_scaling
from sideslip.agents.vec_env import make_vec_env
from tests.agents.training.test_distill import COURSE, ID, OPTIONS
from tests.agents.training.test_distill import lesson as distilled
from tests.agents.training.test_gradient import made, tuned_task
from tests.agents.training.test_starts import TASK, foreign
from tests.policies import GRU

VISION = "sideslip/YawVision-v0"
TINY = TrainingTask(num_envs=8, seed=3, n_eval_envs=4)
SETTINGS = {algo: TrainingTask(algo=algo).settings for algo in ("ppo", "gradient")}
POLICY, RAW = load_policy("distill-coms-yaw"), load_policy(GRU)
COMS = {"vehicle": "coms", "nominal": "coms", "reference": "zero-slip", "scenario": "coms-slalom"}
FEW: dict[str, Any] = {"num_envs": 4, "n_eval_envs": 4, "env_options": COMS}
SLALOM = "coms-slalom"
Call = Callable[[Path], Any]
Refusal = tuple[Call, str]


def config(message: str, **wrong: Any) -> Refusal:
    return lambda _: DistillConfig(**wrong), message


def task(message: str, *arguments: Any, **wrong: Any) -> Refusal:
    return lambda _: TrainingTask(*arguments, **wrong), message


def mixture(message: str, *scenarios: Any) -> Refusal:
    return lambda _: dataclasses.replace(TINY, scenarios=list(scenarios)), message


def training(message: str, *arguments: Any, steps: int = 10, **wrong: Any) -> Refusal:
    return lambda folder: Trainer(TrainingTask(*arguments, **wrong), steps, folder).train(), message


def settings(message: str, algo: str, **kwargs: Any) -> Refusal:
    return task(message, algo=algo, settings=SETTINGS[algo] | {"policy_kwargs": kwargs})


def finetuned(message: str, policy: Any, algo: str = "ppo") -> Refusal:
    return lambda _: make_finetune_task(policy, algo=algo), message


def started(message: str, policy: Any, make: Callable[[], TrainingTask]) -> Refusal:
    """Before anybody drives."""
    return lambda folder: Trainer(make(), 16, folder, initial=policy).train(), message


def scaled(message: str, *reads: str) -> Refusal:
    return lambda _: _measure_scaling(TrainingTask(reads=list(reads))), message


def taught(message: str, *lessons: Any, **wrong: Any) -> Refusal:
    card, course = Card.from_env_id(ID, OPTIONS), dataclasses.replace(COURSE, **wrong)
    return lambda folder: distill(card, [x() for x in lessons], course, folder / "a"), message


def seeing() -> DistillTask:
    """A lesson whose student sees all that its teacher reads."""
    _, twins, teacher = distilled()
    return DistillTask(twins, twins, teacher)


def normalised_twice(folder: Path) -> None:
    model = Trainer(TINY, 1, folder).build().model
    convert_sb3_policy(model, VecNormalize(make_vec_env(TINY.env_id, 2)))


QUIET = {"base": "straight", "duration": 0.3, "disturbance_force": 0.0, "disturbance_moment": 0.0}
TANH = dataclasses.replace(POLICY, network=dataclasses.replace(RAW.network, activation="tanh"))
LAST = POLICY.network.weights[-1]
TWICE = dataclasses.replace(
    POLICY.network,
    weights=[*POLICY.network.weights[:-1], np.concatenate([LAST, LAST])],
    biases=[*POLICY.network.biases[:-1], np.zeros(2)],
)
REFUSED: dict[str, Refusal] = {
    "rounds": config("1 at least", rounds=0),
    "hidden": config("1 at least", hidden=(0,)),
    "negative seed": config("1 at least", seed=-1),
    "rate": config("learning_rate", learning_rate=float("nan")),
    "noise": config("learning_rate is above zero, noise", noise=-0.1),
    "told": config("noise and told not below", auxiliary_weight=-1.0),
    "batch": config("1 at least", batch=0),
    "told without memory": config("nothing to say", auxiliary_weight=1.0, cells=0),
    "negative traces": config("cells, traces and seed 0", traces=-1),
    "cells and traces": config("cells or traces, got 3 and 4", traces=4, cells=3),
    "no lessons": taught("no lessons"),
    "nothing to tell": taught("nothing is left to be told", seeing, auxiliary_weight=0.5),
    "unknown algorithm": task("unknown algorithm 'dqn'; known: ppo, sac, tqc", algo="dqn"),
    "task's seed": task("seed is at least 0, got -1", seed=-1),
    "estimator on tensors": task(
        "gradient reads sensors alone: no estimator runs on", VISION, "gradient", "exact-kf"
    ),
    "activation's name": settings(
        r"unknown activation_fn 'nn\.SiLU'", "ppo", activation_fn="nn.SiLU"
    ),
    "activation of gradient": settings(
        "the layers of gradient are of silu: it has no activ", "gradient", activation_fn="silu"
    ),
    "extractor": settings(
        "features_extractor_class is the training's own", "ppo", features_extractor_class={}
    ),
    "extractor's arguments": settings(
        "features_extractor_kwargs is the training's own", "ppo", features_extractor_kwargs={}
    ),
    "scenario beside a mixture": task(
        r"are \['gust'\], and env_options have the scenario 'moose'",
        scenarios=["gust"],
        env_options={"scenario": "moose"},
    ),
    "mixture's name": mixture("scenario 1 of the mixture: unknown scenario 'moon'", SLALOM, "moon"),
    "mixture's type": mixture("scenario 0 of the mixture: a scenario is a name", 7),
    "long mixture": mixture("9 scenarios take as many environments, got num_envs 8", *[SLALOM] * 9),
    "mixture's evaluation": mixture(
        "5 scenarios take as many environments, got n_eval_envs 4", *[SLALOM] * 5
    ),
    "no steps": training("steps is at least 1, got 0", steps=0),
    "no sensor": training("dakf needs the slow sensor gps", estimator="dakf"),
    "no estimator": training("kf", estimator="kf"),
    "no scenario": training("unknown scenario 'moon'", env_options={"scenario": "moon"}),
    "other env": training("has no native vector env", "CartPole-v1"),
    "nothing to pay": training(
        "costs nothing there: there is nothing to learn", VISION, env_options={"scenario": QUIET}
    ),
    "no window": (lambda _: made(None, n_steps=0), "n_steps is at least 1, got 0"),
    "no source": (lambda _: made(None).learn(1), "needs their source"),
    "no entry": scaled(
        "the observation has no beta_hat to read; it has gyro, ", "gyro", "beta_hat"
    ),
    "constant": scaled("nothing of what the network reads varies within 4 s", "gamma_ref"),
    "normalised twice": (normalised_twice, "normalised twice"),
    "sac": finetuned("sac begins with a zip, not with policy distill-coms-yaw", POLICY, "sac"),
    "cells": finetuned(r"ppo goes on from .* of raw-car-yaw are .*'gru'", RAW),
    "no cells": finetuned(
        r"gradient goes on from .* of distill-coms-yaw are .*", POLICY, "gradient"
    ),
    "tanh": finetuned("gradient goes on from layers of silu, not of tanh", TANH, "gradient"),
    "other form": started(
        r"network of {.*'cells': 96}, and the .* {'cells': 8,",
        RAW,
        lambda: tuned_task(policy_kwargs={"cells": 8, "net_arch": [64, 64]}),
    ),
    "other activation": started(
        "'activation_fn': 'silu'}, and the settings say",
        POLICY,
        lambda: dataclasses.replace(make_finetune_task(POLICY, **FEW), settings=SETTINGS["ppo"]),
    ),
    "other action": started(
        "distill-coms-yaw gives 2 numbers, the env's action is of Box",
        dataclasses.replace(POLICY, network=TWICE),
        lambda: make_finetune_task(POLICY, **FEW),
    ),
    "other entries": started(
        r"distill-coms-yaw reads gyro, .*beta_hat.*; here there",
        POLICY,
        lambda: make_finetune_task(POLICY, estimator="", **FEW),
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_trained_is_refused_without_a_checkpoint(name: str, tmp_path: Path) -> None:
    call, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        call(tmp_path)
    assert not list(tmp_path.rglob("*.safetensors"))


def test_what_no_training_can_begin_with_is_refused(tmp_path: Path) -> None:
    zipped, folder = tmp_path / "model.zip", tmp_path / "new"
    foreign(zipped, True)

    def refuse(kind: Any, said: str, start: Any = zipped, of: Any = TASK, **more: Any) -> None:
        with pytest.raises(kind, match=said):
            Trainer(of, 128, folder, initial=start, **more).train()
        assert not (folder / CHECKPOINT).exists()

    refuse(PermissionError, "vecnormalize.pkl is a pickle.*--trust")
    refuse(FileNotFoundError, "none.zip: no such file", tmp_path / "none.zip")
    refuse(ValueError, "is no zip, or is cut short", tmp_path / "vecnormalize.pkl")
    refuse(ValueError, "goes on from its checkpoint begins with nothing else", resume=True)
    reading = dataclasses.replace(TASK, reads=["gyro"])  # of which the zip's network knows nothing
    refuse(ValueError, "give reads or a network", of=reading)
    (tmp_path / "vecnormalize.pkl").unlink()
    foreign(zipped, False, policy_kwargs={"net_arch": [8]})
    refuse(ValueError, "holds other networks than this training's PPO")
    SAC("MlpPolicy", make_vec_env(TASK.env_id, 1), buffer_size=10, device="cpu").save(zipped)
    refuse(ValueError, "holds other networks than this training's PPO")
