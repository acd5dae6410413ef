"""`gradient`: its slope is the cost's own, episodes keep apart, faults are named."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch

from sideslip.agents.learned.policy import PolicyController, load_policy
from sideslip.agents.training.config import TrainingTask
from sideslip.agents.training.gradient import (
    AnalyticPolicyGradient,
    GruPolicy,
    TrainingSource,
    _unroll_window,
)
from sideslip.agents.training.normalise import RewardScale
from sideslip.agents.training.trainer import Trainer
from sideslip.agents.vec_env import make_vec_env
from sideslip.envs.device import make_device_env
from tests.policies import GRU

VISION, FUSION = "sideslip/YawVision-v0", "sideslip/YawFusion-v0"
SHORT = {"scenario": {"base": "sine-with-dwell", "duration": 0.016}, "control_period": 2}


def cars_of(count: int, **options: Any) -> Any:
    how: dict[str, Any] = {"grad": True, "autoreset_mode": "SameStep", **SHORT, **options}
    return make_device_env(VISION, count, **how)


def policy_of(cars: Any, **options: Any) -> Any:
    """A policy of a few cells in double precision, which acts and reads in size."""
    torch.manual_seed(0)
    k = len(cars.layout)
    scaling = {"mean": [0.0] * k, "scale": [0.3] * k}
    policy: Any = GruPolicy(
        cars.single_observation_space,
        cars.single_action_space,
        lambda _: 1e-3,
        cells=5,
        net_arch=[4],
        features_extractor_kwargs=scaling,
        **options,
    )
    with torch.no_grad():
        policy.layers[-1].weight *= 10.0
    return policy.double()


def paid_by(policy: Any, cars: Any, weights: Any, steps: int) -> Any:
    obs, _ = cars.reset(seed=list(range(cars.num_envs)))
    rates = RewardScale([[each] for each in weights.tolist()])
    return _unroll_window(policy, cars, obs, policy._begin(cars.num_envs).double(), rates, steps)


def test_the_slope_is_that_of_the_cost() -> None:
    """Along random directions of all weights, by central differences, over episodes' ends."""
    cars, weights = cars_of(3), torch.tensor([1e3, 2e3, 500.0], dtype=torch.float64)
    policy = policy_of(cars)
    steps = 10  # an episode has 8
    parts = list(policy.parameters())
    paid_by(policy, cars, weights, steps)[0].backward()
    slopes = [each.grad.clone() for each in parts]
    generator = torch.Generator().manual_seed(1)
    for _ in range(2):
        way = [torch.randn(each.shape, generator=generator).double() for each in parts]
        costs = []
        for size in (1e-5, -1e-5):
            with torch.no_grad():
                for each, by in zip(parts, way, strict=True):
                    each += size * by
                costs.append(paid_by(policy, cars, weights, steps)[0].item())
                for each, by in zip(parts, way, strict=True):
                    each -= size * by
        expected = (costs[0] - costs[1]) / 2e-5
        found = sum(float((a * b).sum()) for a, b in zip(slopes, way, strict=True))
        assert abs(expected) > 1e-4 and found == pytest.approx(expected, rel=1e-5)


def test_a_car_of_weight_zero_teaches_nothing() -> None:
    cars, policy = cars_of(2), policy_of(cars_of(2))
    paid, *_ = paid_by(policy, cars, torch.tensor([0.0, 1.0], dtype=torch.float64), 4)
    alone = cars_of(1)
    obs, _ = alone.reset(seed=[1])
    one, *_ = _unroll_window(policy, alone, obs, policy._begin(1).double(), RewardScale([[1.0]]), 4)
    assert paid.item() == pytest.approx(0.5 * one.item(), rel=1e-12) and one.item() > 0.0


def test_where_an_episode_ends_the_memory_does_too() -> None:
    cars = cars_of(1)
    policy, ones = policy_of(cars), torch.ones(1, dtype=torch.float64)
    assert paid_by(policy, cars, ones, 7)[2].abs().min() > 0.0
    assert (paid_by(policy, cars, ones, 8)[2] == 0.0).all()


CAR = {"vehicle": "passenger-car", "nominal": "passenger-car", "reference": "lagged"}


def tuned_task(**more: Any) -> TrainingTask:
    """Of the form and the observation of `raw-car-yaw`."""
    settings = {"policy": "GruPolicy", "n_timesteps": 9, "n_envs": 2}
    settings |= {"policy_kwargs": {"cells": 96, "net_arch": [64, 64]}, **more}
    options = {"scenario": "car-step", **CAR}
    return TrainingTask(FUSION, "gradient", "", options, settings=settings, n_eval_envs=4)


def test_a_drive_has_a_weight_of_its_own() -> None:
    """In a window over an episode's end, each part counts by its own drive's weight."""
    cars = cars_of(1)
    policy, parts = policy_of(cars), []
    for rates in ([2.0, 0.0], [0.0, 3.0], [2.0, 3.0]):
        obs, _ = cars.reset(seed=[0])
        start = policy._begin(1).double()
        paid, *_ = _unroll_window(
            policy, cars, obs, start, RewardScale([rates]), 10
        )  # an episode has 8
        parts.append(paid.item())
    assert min(parts) > 0.0 and parts[2] == pytest.approx(parts[0] + parts[1], rel=1e-6)


def begun(task: TrainingTask, folder: Path) -> Any:
    return Trainer(task, 1, folder, initial=load_policy(GRU)).build().model


def test_what_begins_with_a_distilled_policy_acts_as_it_does(tmp_path: Path) -> None:
    task = tuned_task()
    model, env = begun(task, tmp_path), task.vector_env(4)
    ours = PolicyController(env, GRU)
    obs, _ = env.reset(seed=0)
    mine, theirs, start = None, None, np.ones(4, np.bool_)
    for _ in range(100):
        a, mine = ours.predict(obs, mine, start)
        b, theirs = model.predict(obs, theirs, start)
        assert np.abs(a - b).max() < 1e-5
        obs, _, terminated, truncated, _ = env.step(a)
        start = terminated | truncated


class Torn:
    """Cars whose rewards have no finite slope."""

    num_envs, dtype, device = 2, torch.float32, torch.device("cpu")

    def __init__(self, width: int) -> None:
        self.obs = torch.zeros(2, width)

    def reset(self, seed: Any) -> Any:
        return self.obs, {}

    def step(self, actions: Any) -> Any:
        never = torch.zeros(2, dtype=torch.bool)
        return self.obs, (actions[:, 0] - actions[:, 0]).sqrt(), never, never, {}

    def detach(self) -> None:
        pass


def made(source: Any, **more: Any) -> Any:
    env = make_vec_env(VISION, 2)
    k = env.observation_space.shape[0]  # type: ignore[index]
    scaling = {"features_extractor_kwargs": {"mean": [0.0] * k, "scale": [0.1] * k}}
    return AnalyticPolicyGradient(
        "GruPolicy", env, source=source, policy_kwargs=scaling, device="cpu", **more
    )


def test_a_slope_that_is_not_finite_stops_it_at_its_step() -> None:
    width = made(None).observation_space.shape[0]

    def torn(device: Any, compile: bool) -> TrainingSource:
        return TrainingSource(Torn(width), [0, 1], RewardScale([[1.0], [1.0]]))

    model = made(torn, n_steps=3)
    before = [each.clone() for each in model.policy.parameters()]
    with pytest.raises(FloatingPointError, match="slope is not finite after step 6"):
        model.learn(12)
    assert all(torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))
