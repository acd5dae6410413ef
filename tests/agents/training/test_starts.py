"""A training goes on from a policy: it acts alike at first, and each drive weighs by its cost."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch
from stable_baselines3.common.logger import configure

from sideslip.agents.learned.policy import Policy, load_policy
from sideslip.agents.rollout import COST_FLOOR, evaluate_costs
from sideslip.agents.training import callbacks
from sideslip.agents.training.callbacks import (
    CHECKPOINT,
    WARM_START_FILE,
    EvalCallback,
    Evaluation,
    RunOptions,
    _make_evaluation_seeds,
)
from sideslip.agents.training.config import HYPERPARAMS, TrainingTask
from sideslip.agents.training.normalise import (
    RewardScale,
    RewardScaleWrapper,
    measure_reward_scale,
)
from sideslip.agents.training.trainer import load_initial_policy, read_task, train
from sideslip.agents.training.warm_start import (
    _NetworkAgent,
    make_finetune_task,
    resolve_settings,
)
from sideslip.agents.vec_env import make_vec_env
from sideslip.envs.device import make_device_env

POLICY = load_policy("distill-coms-yaw")
SHORT = {"scenario": {"base": "coms-slalom", "duration": 0.3}}
COMS = {"vehicle": "coms", "nominal": "coms", "reference": "zero-slip"}
FEW = {"num_envs": 4, "n_eval_envs": 4, "env_options": COMS | SHORT}


def started(task: TrainingTask, folder: Path, policy: Policy = POLICY) -> Any:
    return EvalCallback(task, folder, None, RunOptions(), 16, policy).build()


def test_the_task_is_that_of_the_card(tmp_path: Path) -> None:
    card = POLICY.card
    task = make_finetune_task(POLICY)
    assert (task.env_id, task.estimator) == (card.env_id, card.estimator) and not task.scenarios
    assert task.env_options == card.env_options and task.settings["n_steps"] == 64
    assert task.settings["policy_kwargs"]["activation_fn"] == "silu"
    mixed = make_finetune_task(POLICY, scenarios=["coms-slalom", "coms-step"], seed=3)
    assert "scenario" not in mixed.env_options and mixed.seed == 3
    one = make_finetune_task(load_policy("ppo-coms-yaw"), env_options={"scenario": "coms-step"})
    assert one.env_options == COMS | {"scenario": "coms-step"} and not one.scenarios
    assert len(make_finetune_task(load_policy("ppo-coms-yaw")).scenarios) == 7
    for other in ("exact-kf", ""):
        behind = make_finetune_task(POLICY, estimator=other)
        assert (behind.estimator, behind.estimator_options) == (other, {})


def test_a_model_acts_as_the_policy_that_it_begins_with(tmp_path: Path) -> None:
    task = make_finetune_task(POLICY, **FEW)
    model, env = started(task, tmp_path), task.vector_env(4)
    obs, _ = env.reset(seed=0)
    for _ in range(20):
        actions, _ = _NetworkAgent(POLICY.network).predict(obs)
        assert np.abs(model.predict(obs, deterministic=True)[0] - actions).max() < 1e-5
        obs, *_ = env.step(actions)
    assert np.ptp(actions) > 1e-4
    assert model.policy.log_std.item() == pytest.approx(-1.2)


def test_a_file_of_settings_has_an_entry_for_going_on() -> None:
    file = HYPERPARAMS / "ppo.yml"
    assert resolve_settings(file, "ppo", "sideslip/YawVision-v0", POLICY)["n_steps"] == 64
    assert resolve_settings(file, "ppo", "sideslip/YawVision-v0", None)["n_steps"] == 32
    assert resolve_settings(None, "ppo", "", POLICY) == make_finetune_task(POLICY).settings


def test_each_drive_weighs_by_what_the_policy_pays_in_it() -> None:
    """Driven by the policy itself, each whole drive is paid -1 a step in the mean, but for the
    floor."""
    task = make_finetune_task(POLICY, **FEW)
    driver = _NetworkAgent(POLICY.network)

    def cars() -> Any:
        options = task.options(4)
        return make_vec_env(task.env_id, 4, estimator=task.estimator_kwargs, env_kwargs=options)

    table = measure_reward_scale(driver, cars(), 7, 100)  # an episode has 30
    assert all(len(each) == 4 for each in table) and len({x for row in table for x in row}) == 12
    rated, state = RewardScaleWrapper(cars(), RewardScale(table)), None
    rated.seed(7)
    obs: Any = rated.reset()
    start = np.ones(4, np.bool_)
    paid, costs = np.zeros((4, 3)), np.zeros((4, 3))
    for step in range(90):
        actions, state = driver.predict(obs, state, start)
        obs, rewards, start, infos = rated.step(actions)
        paid[:, step // 30] -= rewards
        if start.all():
            costs[:, step // 30] = [-info["episode"]["r"] for info in infos]
    assert start.all() and np.ptp(costs) > 0.5 * costs.mean()
    assert paid == pytest.approx(30.0 * costs / (costs + COST_FLOOR), rel=1e-4)


@pytest.mark.parametrize("algo, name", [("ppo", "distill-coms-yaw"), ("gradient", "raw-car-yaw")])
@pytest.mark.parametrize("steps", [0, 96])
def test_what_a_training_drives_is_what_the_policy_drove(
    algo: str, name: str, steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Driven by the policy, each drive of the training's own cars is paid -1 a step in the mean."""
    policy = load_policy(name)
    car = {name: x for name, x in policy.card.env_options.items() if name != "scenario"}
    base = "coms-slalom" if algo == "ppo" else "car-step"
    options = car | {"scenario": {"base": base, "duration": 0.3}}
    more: dict[str, Any] = {"num_envs": 4, "n_eval_envs": 4, "env_options": options}
    task = make_finetune_task(policy, algo=algo, **more)
    monkeypatch.setattr(callbacks, "_load_parameters", lambda *_: None)
    network, saved = policy.network, None
    if steps:
        scaling = network.mean.tolist(), network.scale.tolist(), network.clip, None
        saved = {"steps": steps, "scaling": scaling, "evaluations": []}
    model: Any = EvalCallback(task, tmp_path, saved, RunOptions(), 400, policy).build()
    driver, cars = _NetworkAgent(network), model.get_env()
    paid, costs, state, start = np.zeros(4), np.zeros(4), None, np.ones(4, np.bool_)
    if algo == "gradient":
        tensors, seeds, rates = model.source(device="cpu", compile=False)
        obs, _ = tensors.reset(seed=seeds)
        rates.begin()
    else:
        obs = cars.reset()
    for step in range(60):  # two drives
        actions, state = driver.predict(np.asarray(obs), state, start)
        if algo == "gradient":
            obs, rewards, start, truncated, _ = tensors.step(torch.from_numpy(actions))
            start = (start | truncated).numpy()
            rewards = rewards.numpy()
            paid, costs = paid - rewards * rates.now, costs - rewards
            rates.start_next_drives(start)
        else:
            obs, rewards, start, infos = cars.step(actions)
            paid -= rewards
            costs = np.array([-i["episode"]["r"] for i in infos]) if start.all() else costs
        if step % 30 == 29:
            assert start.all() and paid == pytest.approx(
                30.0 * costs / (costs + COST_FLOOR), rel=3e-3
            )
            paid, costs = np.zeros(4), np.zeros(4)


def test_what_cars_meet_does_not_depend_on_who_drives_them_nor_on_what() -> None:
    """Else a drive would have another drive's weight: episode after episode, on tensors too."""
    task = make_finetune_task(POLICY, **FEW | {"estimator": "", "estimator_options": {}})
    firsts = []
    for action in (0.0, 1.0):
        env: Any = task.vector_env(2)
        obs, _ = env.reset(seed=[5, 6])
        for _ in range(60):
            obs, *_ = env.step(np.full((2, 1), action, np.float32))
        firsts.append(obs)
    assert np.array_equal(*firsts)
    how = {"autoreset_mode": "SameStep", "dtype": "float32", **task.env_options}
    cars: Any = make_device_env(task.env_id, 2, **how)
    seen, _ = cars.reset(seed=[5, 6])
    for _ in range(60):
        seen, *_ = cars.step(torch.zeros(2, 1))
    assert np.abs(seen.numpy() - firsts[0]).max() < 1e-5


def test_a_training_from_a_policy_goes_on_after_a_stop(tmp_path: Path) -> None:
    settings = make_finetune_task(POLICY).settings | {"n_steps": 8, "batch_size": 16, "n_epochs": 1}
    task = make_finetune_task(POLICY, settings=settings, **FEW)
    found = train(task, 64, tmp_path, run_options=RunOptions(eval_freq=32), trained_agent=POLICY)
    first = found.evaluations[0]
    assert first.of_start == pytest.approx(1.0, abs=1e-6) and found.best.of_start == min(
        each.of_start or np.inf for each in found.evaluations
    )
    assert np.array_equal(
        load_policy(tmp_path / WARM_START_FILE).network.scale, POLICY.network.scale
    )
    env, seeds = task.vector_env(4), _make_evaluation_seeds(4)
    start, now = (
        evaluate_costs(env, each, seeds) for each in (_NetworkAgent(POLICY.network), found.model)
    )
    ratio = np.exp(np.log((now + COST_FLOOR) / (start + COST_FLOOR)).mean())
    assert found.evaluations[-1].of_start == pytest.approx(ratio, rel=1e-12)
    assert ratio != 1.0 and read_task(tmp_path) == task
    again = train(task, 96, tmp_path, resume=True)
    card = load_policy(tmp_path / "policy.safetensors").card
    assert card.algorithm_options["begun_with"] == "distill-coms-yaw"
    assert load_initial_policy(tmp_path) is not None
    assert again.evaluations[: len(found.evaluations)] == found.evaluations
    assert again.evaluations[-1].of_start is not None
    lines = (tmp_path / "curve.jsonl").read_text().splitlines()
    assert json.loads(lines[0])["of_start"] == first.of_start
    (tmp_path / WARM_START_FILE).rename(tmp_path / "aside")
    with pytest.raises(FileNotFoundError, match="began with policy distill-coms-yaw, and needs it"):
        train(task, 128, tmp_path, resume=True)
    (tmp_path / "aside").rename(tmp_path / WARM_START_FILE)
    (tmp_path / CHECKPOINT).unlink()  # stopped before it had one: the folder begins anew
    train(dataclasses.replace(task, settings=TrainingTask().settings), 1, tmp_path)
    assert not (tmp_path / WARM_START_FILE).exists()


@pytest.mark.parametrize("ratio, kept", [(2.0, True), (0.5, False)])
def test_the_best_is_that_of_the_score_not_of_the_mean(
    ratio: float, kept: bool, tmp_path: Path
) -> None:
    """An older evaluation is beaten by its ratio to the start, whatever its cost was."""
    other = EvalCallback(
        make_finetune_task(POLICY, **FEW), tmp_path, None, RunOptions(), 16, POLICY
    )
    other.build().set_logger(configure(None, []))
    cost = 0.0 if kept else 1e9
    other.evaluations.append(Evaluation(0, 0.0, cost=cost, of_none=cost, of_start=ratio))
    other.evaluate()
    assert (tmp_path / "policy.safetensors").exists() is kept
