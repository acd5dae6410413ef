"""A mixture of scenarios: every row keeps its own, and what there is not is refused."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
from sideslip.agents.controllers.base import NoControl
from sideslip.agents.learned.policy import PolicyController, load_policy
from sideslip.agents.rollout import evaluate_costs
from sideslip.agents.training import callbacks, trainer
from sideslip.agents.training.callbacks import (
    POLICY,
    RunOptions,
    _compute_equal_weights,
    _compute_scenario_weights,
)
from sideslip.agents.training.config import TrainingTask
from sideslip.agents.training.trainer import read_task

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
    """They would need a design for each kind of car; a network needs none."""
    options = {"vehicle": "passenger-car", "nominal": "passenger-car"}
    scenarios = ["car-step", "any-friction-step"]
    task = dataclasses.replace(TINY, env_options=options, scenarios=scenarios)
    cars: Any = task.vector_env(2).unwrapped
    assert cars.nominal[0] != cars.nominal[1]
    trainer.train(task, ROLLOUT, tmp_path)
    assert load_policy(tmp_path / POLICY).card.algorithm_options["scenarios"] == scenarios


def test_a_policy_of_a_mixture_names_it(tmp_path: Path) -> None:
    task = dataclasses.replace(TINY, scenarios=MIXTURE)
    trainer.train(task, ROLLOUT, tmp_path)
    card = load_policy(tmp_path / POLICY).card
    assert card.algorithm_options["scenarios"] == MIXTURE
    assert card.env_options == {"scenario": MIXTURE[0]}
    assert read_task(tmp_path) == task


def test_the_scenarios_of_a_mixture_weigh_alike(tmp_path: Path) -> None:
    """In each second of driving, however long its episodes are; and a policy's share of the cost,
    however many drives each scenario has."""
    scenarios = ["coms-brake-in-turn", {"base": "coms-slalom", "duration": 3.0}]
    task = dataclasses.replace(TINY, scenarios=scenarios, n_eval_envs=7)
    env, seeds = task.vector_env(7), callbacks._make_evaluation_seeds(7)
    none = evaluate_costs(env, NoControl(env), seeds)
    assert none[::2].mean() > 3.0 * none[1::2].mean()  # else there is nothing to weigh
    wide = dataclasses.replace(task, num_envs=64)
    cars: Any = callbacks.EvalCallback(wide, tmp_path, None, RunOptions()).build().get_env()
    cars.seed(2**63)
    cars.reset()
    returns, driven, running = np.zeros(64), np.zeros(64), np.ones(64)
    while running.any():
        _, rewards, dones, _ = cars.step(np.zeros((64, 1), np.float32))
        returns, driven = returns + running * rewards, driven + running
        running *= ~dones
    rates = [returns[i::2].sum() / driven[i::2].sum() for i in range(2)]
    assert rates[0] == pytest.approx(rates[1], rel=0.01)
    best = trainer.train(task, ROLLOUT, tmp_path).best
    costs = evaluate_costs(env, PolicyController(env, tmp_path / POLICY), seeds)
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
    task = dataclasses.replace(TINY, reads=["gyro", "steer"])
    trainer.train(task, ROLLOUT, tmp_path)
    policy = load_policy(tmp_path / POLICY)
    assert policy.card.algorithm_options["reads"] == ["gyro", "steer"]
    names = [entry.name for entry in task.vector_env(1).unwrapped.layout]  # type: ignore[attr-defined]
    seen = np.zeros((2, len(names)))
    seen[1, ~np.isin(names, ["gyro", "steer"])] = 3.0
    assert np.array_equal(*policy.network(seen))
    seen[1, names.index("gyro")] = 0.1
    assert not np.array_equal(*policy.network(seen))
