"""A mixture of scenarios, whose rows keep their own, and what a network reads of a task."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch

from sideslip.agents.controllers.base import NoControl
from sideslip.agents.learned.policy import PolicyController, load_policy
from sideslip.agents.rollout import evaluate_episodes
from sideslip.agents.training import callbacks, trainer
from sideslip.agents.training.callbacks import (
    POLICY,
    _compute_equal_weights,
    _compute_scenario_weights,
    read_training,
)
from sideslip.agents.training.config import TrainingTask
from sideslip.agents.training.normalise import CLIP, Standardised
from sideslip.agents.training.trainer import _measure_scaling

TINY, ROLLOUT = TrainingTask(num_envs=8, seed=3, n_eval_envs=4), 256  # steps of 8 environments
MIXTURE: list[Any] = ["coms-slalom", {"base": "coms-step", "duration": 0.3}]


def test_a_mixture_survives_autoreset() -> None:
    """Every row has its own scenario, in its first episode and in those after it."""
    task = dataclasses.replace(TINY, scenarios=MIXTURE)
    env = task.vector_env(5)
    env.reset(seed=0)
    base: Any = env.unwrapped
    ended = np.zeros(5, int)
    for _ in range(75):
        _, _, terminated, truncated, _ = env.step(np.zeros((5, 1), np.float32))
        ended += terminated | truncated
    assert ended.tolist() == [0, 2, 0, 2, 0]
    durations = [each.duration for each in base.scenario]
    assert durations == [durations[0], 0.3, durations[0], 0.3, durations[0]] and durations[0] > 1.0


def test_a_mixture_may_be_of_roads_on_which_controllers_are_told_other_friction(
    tmp_path: Path,
) -> None:
    """They would need a design for each kind of car; a network needs none. Its card names both."""
    options = {"vehicle": "passenger-car", "nominal": "passenger-car"}
    scenarios = [{"base": name, "duration": 0.3} for name in ("car-step", "any-friction-step")]
    task = dataclasses.replace(TINY, env_options=options, scenarios=scenarios)
    cars: Any = task.vector_env(2).unwrapped
    assert cars.nominal[0] != cars.nominal[1]
    trainer.Trainer(task, ROLLOUT, tmp_path).train()
    card = load_policy(tmp_path / POLICY).card
    assert card.algorithm_options["scenarios"] == scenarios
    assert card.env_options == options | {"scenario": scenarios[0]}
    assert read_training(tmp_path).task == task


def test_the_scenarios_of_a_mixture_weigh_alike(tmp_path: Path) -> None:
    """In each second of driving, however long its episodes are; and a policy's share of the cost,
    however many drives each scenario has."""
    scenarios = ["coms-brake-in-turn", {"base": "coms-slalom", "duration": 3.0}]
    task = dataclasses.replace(TINY, scenarios=scenarios, n_eval_envs=7)
    env, seeds = task.vector_env(7), callbacks._make_evaluation_seeds(7)
    none = evaluate_episodes(env, NoControl(env), seeds)[0]
    assert none[::2].mean() > 3.0 * none[1::2].mean()  # else there is nothing to weigh
    wide = dataclasses.replace(task, num_envs=64)
    cars: Any = trainer.Trainer(wide, 1, tmp_path).build().model.get_env()
    cars.seed(2**63)
    cars.reset()
    returns, driven, running = np.zeros(64), np.zeros(64), np.ones(64)
    while running.any():
        _, rewards, dones, _ = cars.step(np.zeros((64, 1), np.float32))
        returns, driven = returns + running * rewards, driven + running
        running *= ~dones
    rates = [returns[i::2].sum() / driven[i::2].sum() for i in range(2)]
    assert rates[0] == pytest.approx(rates[1], rel=0.01)
    best = trainer.Trainer(task, ROLLOUT, tmp_path).train().best
    costs = evaluate_episodes(env, PolicyController(env, tmp_path / POLICY), seeds)[0]
    shares = [costs[i::2].mean() / none[i::2].mean() for i in range(2)]
    means = [none[i::2].mean() for i in range(2)]
    assert best.of_none == pytest.approx(np.mean(shares), rel=1e-4)
    assert best.cost == pytest.approx(np.mean(shares) * np.mean(means), rel=1e-4)
    assert load_policy(tmp_path / POLICY).card.algorithm_options["weights"][1] > 1.0


def test_weights_do_not_depend_on_the_evaluation_and_are_bounded() -> None:
    found = _compute_scenario_weights(
        dataclasses.replace(TINY, scenarios=MIXTURE, n_eval_envs=2), 5
    )
    same = _compute_scenario_weights(dataclasses.replace(TINY, scenarios=MIXTURE), 5)
    assert np.array_equal(found, same) and found[0] != found[1]
    assert _compute_equal_weights(np.array([1e-9, 10.0]))[0] == pytest.approx(20.0)
    assert _compute_equal_weights(np.array([4.0, 2.0])).tolist() == [0.75, 1.5]


def test_a_policy_reads_what_its_task_says(tmp_path: Path) -> None:
    """Whatever the other entries are, it acts the same; its card names those that count."""
    short = {"scenario": {"base": "random-steering", "duration": 0.5}}
    task = dataclasses.replace(TINY, env_options=short, reads=["gyro", "steer"])
    trainer.Trainer(task, ROLLOUT, tmp_path).train()
    policy = load_policy(tmp_path / POLICY)
    assert policy.card.algorithm_options["reads"] == ["gyro", "steer"]
    names = [entry.name for entry in task.vector_env(1).unwrapped.layout]  # type: ignore[attr-defined]
    seen = np.zeros((2, len(names)))
    seen[1, ~np.isin(names, ["gyro", "steer"])] = 3.0
    assert np.array_equal(*policy.network(seen))
    seen[1, names.index("gyro")] = 0.1
    assert not np.array_equal(*policy.network(seen))


def test_observations_are_standardised_by_the_network() -> None:
    task = TrainingTask(env_options={"scenario": "sine-with-dwell"}, seed=3)
    mean, scale, clip, mixing = _measure_scaling(task)
    assert mixing is None  # nobody asked for it
    env = task.vector_env(1)
    names = [entry.name for entry in env.unwrapped.layout]  # type: ignore[attr-defined]
    assert scale[names.index("gamma_ref")] == 0.0  # zero-slip: it never varies
    layer = Standardised(env.single_observation_space, mean, scale, clip)
    obs = 30.0 * np.random.default_rng(0).standard_normal((50, len(mean)))
    wanted = np.clip((obs - np.array(mean)) * np.array(scale), -CLIP, CLIP)
    given = layer(torch.tensor(obs, dtype=torch.float32)).numpy()
    assert given == pytest.approx(wanted, abs=1e-3)
    assert np.abs(wanted).max() == CLIP and not list(layer.parameters())
    free = Standardised(env.single_observation_space, mean, scale, None)
    assert float(free(torch.tensor(obs, dtype=torch.float32)).abs().max()) > CLIP
    assert free.numbers[2] is None and layer.numbers[2] == clip


def test_what_is_read_has_no_correlation(monkeypatch: pytest.MonkeyPatch) -> None:
    """On other cars than it was measured on, too: nearly all mixtures vary by about one."""
    monkeypatch.setattr(trainer, "_SCALING_ENVS", 64)
    monkeypatch.setattr(TrainingTask, "scaling_seed", 5)
    env, rng = TrainingTask().vector_env(64), np.random.default_rng(6)
    narrow = {"policy_kwargs": {"log_std_init": float(np.log(0.4))}}
    settings = TrainingTask(algo="gradient").settings | narrow
    task = TrainingTask(algo="gradient", settings=settings)
    mean, scale, clip, mixing = _measure_scaling(task)
    noise, seen = np.zeros((64, 1)), []
    env.reset(seed=6)
    for step in range(400):
        noise = 0.95 * noise + 0.31 * rng.standard_normal((64, 1))
        obs, *_ = env.step((0.4 * noise).clip(-1.0, 1.0).astype(np.float32))
        seen += [obs] if step >= 20 else []
    drives = torch.as_tensor(np.concatenate(seen))

    def about_one(mixed: Any) -> int:
        layer = Standardised(env.single_observation_space, mean, scale, clip, mixed)
        sizes = np.linalg.eigvalsh(np.cov(layer(drives).numpy(), rowvar=False))
        return int(((sizes > 0.5) & (sizes < 2.0)).sum())

    read = np.count_nonzero(scale)
    assert about_one(mixing) >= read - 3 and about_one(None) < read / 2


def test_scales_are_of_seconds_however_short_a_control_period_is() -> None:
    """In 0.4 s nobody steers: what was measured over steps was never read."""
    options = {"scenario": "sine-with-dwell", "control_period": 1}
    task = TrainingTask(env_options=options)
    names = [entry.name for entry in task.vector_env(1).unwrapped.layout]  # type: ignore[attr-defined]
    assert _measure_scaling(task).scale[names.index("steer_command")] > 0.0
