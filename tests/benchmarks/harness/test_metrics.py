"""Metrics: what the steps of an episode make of a number, one unit a name, tyres' dissipation."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.benchmarks.harness.metrics import EPISODE, METRICS, REDUCTIONS, compute_dissipation

VALUES = np.array([[0.3, -2.0], [-1.5, 0.5], [0.2, 0.1]])  # of 3 steps and 2 cars


@pytest.mark.parametrize(
    ("fold", "expected"),
    [
        ("sum", VALUES.sum(axis=0)),
        ("mean", VALUES.mean(axis=0)),
        ("rms", np.sqrt((VALUES**2).mean(axis=0))),
        ("max", np.abs(VALUES).max(axis=0)),
        ("last", VALUES[-1]),
    ],
)
def test_a_fold_is_what_its_name_is(fold: str, expected: np.ndarray) -> None:
    total = np.zeros(2)
    for step in VALUES:
        total = REDUCTIONS[fold].add(total, np.abs(step) if fold == "max" else step)
    assert REDUCTIONS[fold].finish(total, np.full(2, 3.0)) == pytest.approx(expected)


def test_every_metric_of_an_episode_has_a_unit_and_a_fold() -> None:
    names = [metric.name for metric in EPISODE]
    assert len(set(names)) == len(names)
    for metric in EPISODE:
        assert METRICS[metric.name] == metric.unit and metric.reduction in REDUCTIONS


NOTHING = ("acceleration", "disturbance_force", "disturbance_moment", "onset")
COASTING = dict.fromkeys(NOTHING, 0.0) | {"roll": False, "duration": 2.0}


@pytest.mark.parametrize("tyres", ["linear", "fiala"])
def test_it_is_the_kinetic_energy_that_a_coasting_car_loses(tyres: str) -> None:
    """No motor, wind, bank or roll: d/dt (m v^2 + I gamma^2) / 2 is minus the dissipation."""
    scenario = {"base": "slalom", "amplitude": 0.06, "frequency": 0.5, "tyres": tyres} | COASTING
    env: Any = gym.make_vec(
        "sideslip/YawFusion-v0", num_envs=2, scenario=scenario, control_period=1
    )
    env.reset(seed=[1, 2])
    base = env.unwrapped
    m, inertia = base.vehicle[0].mass, base.vehicle[0].yaw_inertia
    energy, heat = [], []
    for _ in range(1999):
        env.step(np.zeros((2, 1), np.float32))
        v_x, v_y, gamma = base.motion[:, :3].T
        energy.append(0.5 * m * (v_x**2 + v_y**2) + 0.5 * inertia * gamma**2)
        heat.append(compute_dissipation(*base.engine.arrays[:3]))
    lost = energy[0] - energy[-1]
    found = np.trapezoid(heat, dx=1e-3, axis=0)
    assert lost.min() > 20.0
    np.testing.assert_allclose(found, lost, rtol=2e-3)
