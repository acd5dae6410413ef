"""What the tyres dissipate is what a coasting car loses."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import sideslip
from sideslip.benchmarks.harness.metrics import compute_dissipation

assert sideslip.__version__
COASTING = {
    "acceleration": 0.0,
    "disturbance_force": 0.0,
    "disturbance_moment": 0.0,
    "roll": False,
    "duration": 2.0,
    "onset": 0.0,
}


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
        heat.append(compute_dissipation(base.params, base.states, base.switches))
    lost = energy[0] - energy[-1]
    found = np.trapezoid(heat, dx=1e-3, axis=0)
    assert lost.min() > 20.0
    np.testing.assert_allclose(found, lost, rtol=2e-3)
