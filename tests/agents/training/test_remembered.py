"""PPO goes on from a policy with traces: they are part of its environments, and stay."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch

from sideslip.agents.learned.policy import Card, Policy, load_policy
from sideslip.agents.rollout import evaluate_costs
from sideslip.agents.training.callbacks import (
    _SCALING_SEEDS,
    WARM_START_FILE,
    RunOptions,
    _make_evaluation_seeds,
)
from sideslip.agents.training.export import convert_sb3_policy
from sideslip.agents.training.student import DistillConfig, Scaling, Student
from sideslip.agents.training.trainer import train
from sideslip.agents.training.warm_start import (
    MemoryObservation,
    PolicyWarmStart,
    _measure_mixing,
    _NetworkAgent,
    make_finetune_task,
)

ID = "sideslip/YawFusion-v0"
OPTIONS: dict[str, Any] = {"vehicle": "coms", "nominal": "coms", "reference": "zero-slip"}
OPTIONS |= {"scenario": {"base": "coms-slalom", "duration": 0.3}}
STEPS = 30  # of an episode


def cars(count: int) -> Any:
    return gym.make_vec(ID, num_envs=count, autoreset_mode="SameStep", info="ends", **OPTIONS)


@pytest.fixture(scope="module")
def policy() -> Policy:
    """Random weights: it acts in some way that what is remembered decides."""
    torch.manual_seed(0)
    card, rng = Card.from_env_id(ID, OPTIONS), np.random.default_rng(0)
    wide = len(card.observation)
    scaling = Scaling(rng.normal(size=wide), np.full(wide, 0.3), np.eye(wide))
    student = Student(wide, 1, DistillConfig(traces=6, hidden=(8, 4)))
    return Policy("traced", student.network(scaling), card)


def test_an_observation_is_what_is_remembered_across_episodes(policy: Policy) -> None:
    """The last one of an episode too, which the row's next episode does not see."""
    bare, env = cars(3), MemoryObservation(cars(3), policy.network)
    state = np.zeros((3, policy.network.memory))
    seen, (obs, _) = bare.reset(seed=5)[0], env.reset(seed=5)
    ended = 0
    for step in range(1, 2 * STEPS + 3):
        assert obs == pytest.approx(
            policy.network.compute_features(seen.astype(float), state), abs=1e-5
        )
        action = np.full((3, 1), 0.1, np.float32)
        seen, _, _, over, bares = bare.step(action)
        obs, _, _, same, infos = env.step(action)
        assert np.array_equal(over, same) and obs in env.observation_space
        if over.any():
            last = np.stack(bares["final_obs"][over]).astype(float)
            theirs = policy.network.compute_features(last, state[over].copy())
            assert np.stack(infos["final_obs"][over]) == pytest.approx(theirs, abs=1e-5)
            state[over], ended = 0.0, ended + 1
            assert step % STEPS == 0
    assert ended == 2
    env.reset(seed=5)
    first = policy.network.compute_features(bare.reset(seed=5)[0].astype(float), 0.0 * state)
    assert env.reset(seed=5)[0] == pytest.approx(first, abs=1e-5)


def test_a_row_that_is_not_reset_goes_on_with_its_memory(policy: Policy) -> None:
    rows, mask = [MemoryObservation(cars(3), policy.network) for _ in range(2)], np.arange(3) == 1
    action = np.full((3, 1), 0.1, np.float32)
    seen = []
    for env in rows:
        env.reset(seed=5)
        env.step(action)
        seen.append(env.step(action)[0])
    before = seen[1]
    seen[0][:] = 9.0  # whoever has an observation may write into it
    first = rows[0].reset(seed=[None, 8, None], options={"reset_mask": mask})[0]
    assert np.array_equal(first[~mask], before[~mask])
    assert np.array_equal(
        first[mask], MemoryObservation(cars(3), policy.network).reset(seed=7)[0][mask]
    )
    ours, theirs = (env.step(action)[0] for env in rows)
    assert np.array_equal(ours[~mask], theirs[~mask]) and (ours[mask] != theirs[mask]).any()


def test_mixed_and_back_a_network_is_the_same(policy: Policy) -> None:
    """And what is remembered in its own drives varies alike, mixed."""
    net = policy.network
    mixing = _measure_mixing(cars(60), net, 3)
    mixed, x = (
        mixing.adapt_to_mixed(net),
        np.random.default_rng(1).normal(size=(5, net.dense.inputs)),
    )
    theirs = net.dense(x)
    assert mixed.dense((x - mixing.mean) @ mixing.mixing) == pytest.approx(theirs, abs=1e-5)
    assert np.abs(mixed.dense(x) - theirs).max() > 1e-3
    assert mixing.adapt_to_plain(mixed).dense(x) == pytest.approx(theirs, abs=1e-4)
    env = MemoryObservation(cars(60), net, mixing)
    seen, (obs, _) = [], env.reset(seed=3)
    for _ in range(STEPS):
        seen.append(obs)
        obs, *_ = env.step(_NetworkAgent(mixed.dense).predict(obs)[0])
    found = np.concatenate(seen[::7])
    assert np.abs(found.mean(0)).max() < 0.05 and np.var(found, axis=0).max() < 1.1


def test_ppo_goes_on_behind_the_traces(policy: Policy, tmp_path: Path) -> None:
    settings = make_finetune_task(policy).settings | {"n_steps": 8, "batch_size": 16, "n_epochs": 1}
    assert settings["learning_rate"] == "lin_1e-4"  # of the entry for hundreds of inputs
    task = make_finetune_task(policy, settings=settings, num_envs=4, n_eval_envs=4)
    found = train(task, 64, tmp_path, run_options=RunOptions(eval_freq=64), trained_agent=policy)
    assert found.evaluations[0].of_start == pytest.approx(1.0, abs=1e-6)
    kept = load_policy(tmp_path / "policy.safetensors").network
    for part in ("weight_in", "bias_in"):
        assert np.array_equal(*(getattr(each.cells[0], part) for each in (kept, policy.network)))
    assert np.array_equal(kept.mean, policy.network.mean)
    begun = PolicyWarmStart(policy, task, task.vector_env(4), _SCALING_SEEDS + task.seed)
    last = begun.merge_network(convert_sb3_policy(found.model))
    seeds = _make_evaluation_seeds(4)
    begins, ours, best = (
        evaluate_costs(task.vector_env(4), _NetworkAgent(each), seeds)
        for each in (policy.network, last, kept)
    )
    theirs = evaluate_costs(begun.wrap_env(task.vector_env(4)), found.model, seeds)
    assert ours == pytest.approx(theirs, rel=1e-5) and ours != pytest.approx(begins, rel=1e-4)
    first = found.best is found.evaluations[0]
    assert best == pytest.approx(begins if first else ours, rel=1e-5)
    layer: Any = found.model.policy.action_net
    moved = np.abs(layer.weight.detach().numpy() - policy.network.weights[-1])
    assert moved.max() > 1e-5 and (tmp_path / WARM_START_FILE).exists()
    again = train(task, 96, tmp_path, resume=True)
    assert again.evaluations[:2] == found.evaluations and len(again.evaluations) == 3
