"""A training goes on from a policy: it acts alike at first, and each drive weighs by its cost."""

import dataclasses
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

from sideslip.agents.env_info import get_layout
from sideslip.agents.learned.policy import Policy, load_policy
from sideslip.agents.rollout import COST_FLOOR, evaluate_episodes
from sideslip.agents.training.callbacks import (
    BEST,
    CHECKPOINT,
    INITIAL_FILE,
    Checkpoint,
    EvalCallback,
    Evaluation,
    RunOptions,
    RunRecord,
    _make_evaluation_seeds,
    read_training,
)
from sideslip.agents.training.config import (
    HYPERPARAMS,
    TrainingTask,
    make_finetune_task,
    resolve_settings,
)
from sideslip.agents.training.normalise import CLIP, RewardScale, RewardScaleWrapper
from sideslip.agents.training.trainer import Trainer, _measure_reward_scale
from sideslip.agents.vec_env import get_scales, make_vec_env
from sideslip.envs.device import make_device_env
from tests.policies import GRU

POLICY = load_policy("distill-coms-yaw")
SHORT = {"scenario": {"base": "coms-slalom", "duration": 0.3}}
COMS = {"vehicle": "coms", "nominal": "coms", "reference": "zero-slip", "lead_in": 0.0}
FEW = {"num_envs": 4, "n_eval_envs": 4, "env_options": COMS | SHORT}


def started(task: TrainingTask, folder: Path, policy: Policy = POLICY) -> Any:
    return Trainer(task, 16, folder, initial=policy).build()


def test_the_task_is_that_of_the_card(tmp_path: Path) -> None:
    card = POLICY.card
    task = make_finetune_task(POLICY)
    assert (task.env_id, task.estimator) == (card.env_id, card.estimator) and not task.scenarios
    assert task.env_options == card.env_options and task.settings["n_steps"] == 64
    assert task.settings["policy_kwargs"]["activation_fn"] == "silu"
    mixed = make_finetune_task(POLICY, scenarios=["coms-slalom", "coms-step"], seed=3)
    assert "scenario" not in mixed.env_options and mixed.seed == 3
    one = make_finetune_task(POLICY, env_options={"scenario": "coms-step"})
    assert one.env_options == card.env_options | {"scenario": "coms-step"} and not one.scenarios
    for other in ("exact-kf", ""):
        behind = make_finetune_task(POLICY, estimator=other)
        assert (behind.estimator, behind.estimator_options) == (other, {})


def test_another_option_of_the_env_keeps_the_policys_mixture() -> None:
    mixture = ["coms-slalom", "coms-step"]
    card = replace(
        POLICY.card,
        env_options=POLICY.card.env_options | {"scenario": mixture[0]},
        algorithm_options={"scenarios": mixture},
    )
    task = make_finetune_task(replace(POLICY, card=card), env_options={"lead_in": 0.5})
    assert task.scenarios == mixture and task.env_options["lead_in"] == 0.5


def test_a_model_acts_as_the_policy_that_it_begins_with(tmp_path: Path) -> None:
    task = make_finetune_task(POLICY, **FEW)
    model, env = started(task, tmp_path).model, task.vector_env(4)
    obs, _ = env.reset(seed=0)
    for _ in range(20):
        actions, _ = POLICY.network.predict(obs)
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
    driver = POLICY.network

    def cars() -> Any:
        options = task.options(4)
        kwargs: Any = {"estimator": task.estimator_kwargs, "env_kwargs": options}
        return make_vec_env(task.env_id, 4, **kwargs, scaled=False)

    table = _measure_reward_scale(driver, cars(), 7, 100)  # an episode has 30
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


@pytest.mark.parametrize(
    "algo, name, steps",
    [
        ("ppo", "distill-coms-yaw", 0),
        ("ppo", "distill-coms-yaw", 96),
        ("gradient", GRU, 96),
    ],
)
@torch.no_grad()
def test_what_a_training_drives_is_what_the_policy_drove(
    algo: str, name: str, steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Driven by the policy, each drive of the training's own cars is paid -1 a step in the mean."""
    policy, length = load_policy(name), 30 if algo == "ppo" else 6  # tensors cost much more
    car = {name: x for name, x in policy.card.env_options.items() if name != "scenario"}
    base = "coms-slalom" if algo == "ppo" else "car-step"
    options = car | {"scenario": {"base": base, "duration": 0.01 * length}, "lead_in": 0.0}
    more: dict[str, Any] = {"num_envs": 4, "n_eval_envs": 4, "env_options": options}
    task = make_finetune_task(policy, algo=algo, **more)
    network, training = policy.network, Trainer(task, 400, tmp_path, initial=policy)
    if steps:
        monkeypatch.setattr(EvalCallback, "load_parameters", lambda *_: None)
        scaling = network.mean.tolist(), network.scale.tolist(), network.clip, None
        aim = RunRecord(400, 1)
        training._checkpoint = Checkpoint({}, "", task, steps, aim, list(scaling), [])
    model: Any = training.build().model
    driver, cars = network, model.get_env()
    paid, costs, state, start = np.zeros(4), np.zeros(4), None, np.ones(4, np.bool_)
    if algo == "gradient":
        tensors, seeds, rates = model.source(device="cpu", compile=False)
        obs, _ = tensors.reset(seed=seeds)
        rates.begin()
    else:
        obs = cars.reset()
    for step in range(2 * length):
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
        if step % length == length - 1:
            expected = length * costs / (costs + COST_FLOOR)
            assert start.all() and paid == pytest.approx(expected, rel=3e-3)
            paid, costs = np.zeros(4), np.zeros(4)


@pytest.mark.long
def test_what_cars_meet_does_not_depend_on_who_drives_them_nor_on_what() -> None:
    """Else a drive would have another drive's weight: episode after episode, on tensors too."""
    short = {"env_options": COMS | {"scenario": {"base": "coms-slalom", "duration": 0.05}}}
    task = make_finetune_task(POLICY, **FEW | short | {"estimator": "", "estimator_options": {}})
    firsts = []
    for action in (0.0, 1.0):
        env: Any = task.vector_env(2)
        obs, _ = env.reset(seed=[5, 6])
        for _ in range(10):  # two drives
            obs, *_ = env.step(np.full((2, 1), action, np.float32))
        firsts.append(obs)
    assert np.array_equal(*firsts)
    how = {"autoreset_mode": "SameStep", "dtype": "float32", **task.env_options}
    cars: Any = make_device_env(task.env_id, 2, **how)
    seen, _ = cars.reset(seed=[5, 6])
    for _ in range(10):
        seen, *_ = cars.step(torch.zeros(2, 1))
    assert np.abs(seen.numpy() - firsts[0]).max() < 1e-5


def test_a_training_from_a_policy_goes_on_after_a_stop(tmp_path: Path) -> None:
    settings = make_finetune_task(POLICY).settings | {"n_steps": 8, "batch_size": 16, "n_epochs": 1}
    task = make_finetune_task(POLICY, settings=settings, **FEW)
    options = RunOptions(eval_freq=32)
    found = Trainer(task, 64, tmp_path, run_options=options, initial=POLICY).train()
    first = found.evaluations[0]
    assert first.of_start == pytest.approx(1.0, abs=1e-6) and found.best.of_start == min(
        each.of_start or np.inf for each in found.evaluations
    )
    assert np.array_equal(load_policy(tmp_path / INITIAL_FILE).network.scale, POLICY.network.scale)
    env, seeds = task.vector_env(4), _make_evaluation_seeds(4)
    start, now = (evaluate_episodes(env, each, seeds)[0] for each in (POLICY.network, found.model))
    ratio = np.exp(np.log((now + COST_FLOOR) / (start + COST_FLOOR)).mean())
    assert found.evaluations[-1].of_start == pytest.approx(ratio, rel=1e-12)
    assert ratio != 1.0 and read_training(tmp_path).task == task
    again = Trainer(task, 96, tmp_path, resume=True).train()
    card = load_policy(tmp_path / "policy.safetensors").card
    assert card.algorithm_options["begun_with"] == "distill-coms-yaw"
    assert read_training(tmp_path).load_initial(tmp_path) is not None
    assert again.evaluations[: len(found.evaluations)] == found.evaluations
    assert again.evaluations[-1].of_start is not None
    lines = (tmp_path / "curve.jsonl").read_text().splitlines()
    assert json.loads(lines[0])["of_start"] == first.of_start
    (tmp_path / INITIAL_FILE).rename(tmp_path / "aside")
    with pytest.raises(FileNotFoundError, match="began with policy distill-coms-yaw, and needs it"):
        Trainer(task, 128, tmp_path, resume=True).train()
    (tmp_path / "aside").rename(tmp_path / INITIAL_FILE)
    (tmp_path / CHECKPOINT).unlink()  # stopped before it had one: the folder begins anew
    Trainer(dataclasses.replace(task, settings=TrainingTask().settings), 1, tmp_path).train()
    assert not (tmp_path / INITIAL_FILE).exists()


@pytest.mark.parametrize("ratio, kept", [(2.0, True), (0.5, False)])
def test_the_best_is_that_of_the_score_not_of_the_mean(
    ratio: float, kept: bool, tmp_path: Path
) -> None:
    """An older evaluation is beaten by its ratio to the start, whatever its cost was."""
    other = started(make_finetune_task(POLICY, **FEW), tmp_path)
    other.model.set_logger(configure(None, []))
    cost = 0.0 if kept else 1e9
    other.evaluations.append(Evaluation(0, 0.0, cost=cost, of_none=cost, of_start=ratio))
    other.evaluate()
    assert (tmp_path / "policy.safetensors").exists() is kept


FAST: dict[str, Any] = {"scenario": {"base": "sine-with-dwell", "duration": 0.3}}
TASK = TrainingTask(num_envs=4, env_options=FAST, n_eval_envs=4)


def observations() -> Any:
    env = TASK.vector_env(4)
    obs, _ = env.reset(seed=1)
    return np.concatenate([obs, env.step(np.full((4, 1), 0.5))[0]])


def begin(tmp_path: Path, zipped: Path, trust: bool = False) -> Any:
    """The model before its first step."""
    training = Trainer(TASK, 1, tmp_path / "new", initial=zipped, trust=trust)
    return training.build().model


def foreign(path: Path, normalised: bool, scaled: bool = False, **options: Any) -> Any:
    """A zip as rl-baselines3-zoo leaves it, and what acts in it."""
    env: Any = make_vec_env(TASK.env_id, 2, env_kwargs=FAST, scaled=scaled)
    scales = get_scales(get_layout(TASK.vector_env(2))) if scaled else 1.0
    if normalised:
        env = VecNormalize(env)
    model = PPO("MlpPolicy", env, device="cpu", seed=1, n_steps=32, batch_size=64, **options)
    model.learn(64)
    model.save(path)
    if normalised:
        env.save(path.with_name("vecnormalize.pkl"))

    def act(x: Any) -> Any:
        x = x / scales
        return model.predict(env.normalize_obs(x) if normalised else x, deterministic=True)[0]

    return act


def test_our_zip_goes_on_as_it_was(tmp_path: Path) -> None:
    first = Trainer(TASK, 128, tmp_path / "first").train().model
    model = begin(tmp_path, tmp_path / "first" / BEST)
    assert model.num_timesteps == 0
    one, other = first.policy.state_dict(), model.policy.state_dict()
    best = PPO.load(tmp_path / "first" / BEST, device="cpu").policy.state_dict()
    assert one.keys() == other.keys()
    assert all(torch.equal(best[name], other[name]) for name in best)
    assert float(other["features_extractor.clip"]) == CLIP
    start = tmp_path / "first" / BEST
    done = Trainer(TASK, 128, tmp_path / "on", initial=start).train()
    assert done.model.num_timesteps == 128
    again = Trainer(TASK, 256, tmp_path / "on", resume=True).train().model
    name = "features_extractor.mean"  # the scaling is the zip's still
    assert torch.equal(again.policy.state_dict()[name], other[name])


@pytest.mark.parametrize(
    ("normalised", "scaled"), [(True, False), (False, False), (True, True), (False, True)]
)
def test_a_zip_from_elsewhere_acts_as_it_did(
    normalised: bool, scaled: bool, tmp_path: Path
) -> None:
    acts = foreign(tmp_path / "model.zip", normalised, scaled)
    model = begin(tmp_path, tmp_path / "model.zip", trust=True)
    x = observations()
    assert np.ptp(acts(x)) > 1e-4
    if normalised:  # what hardly varied in training is not read, as in an export
        scale = model.policy.state_dict()["features_extractor.scale"].numpy()
        x[:, scale == 0.0] = model.policy.state_dict()["features_extractor.mean"].numpy()[
            scale == 0.0
        ]
    assert model.predict(x, deterministic=True)[0] == pytest.approx(acts(x), abs=1e-6)
