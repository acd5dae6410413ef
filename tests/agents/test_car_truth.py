"""Oracles in a world whose cars and sensors err: what they are told, and that it is right."""

import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sideslip.agents.baselines import make_oracle
from sideslip.agents.controllers.lqr import TRUE_PARAMETERS, Lqr
from sideslip.agents.controllers.mpc import Nmpc
from sideslip.agents.design.sampled_model import SPEEDS, make_design_model
from sideslip.agents.rollout import evaluate_episodes
from sideslip.envs.engine import layout
from sideslip.envs.vehicle.tyres import fit_fiala
from sideslip.estimators.vector import estimate
from sideslip.estimators.vector.estimate import TruthObservation as VectorTruth
from sideslip.estimators.wrappers.estimate import EstimateObservation
from sideslip.estimators.wrappers.truth import TruthObservation
from tests.agents.helpers import compute_gains
from tests.envs.helpers import bits

FUSION, AFS = "sideslip/YawFusion-v0", "sideslip/AfsYawFusion-v0"
ASKEW = {"steer_offset": 0.002, "steer_scale": 1.03, "wheel_scale": 0.99, "wheel_left": 1.003}
SLALOM: dict[str, Any] = {"scenario": "car-slalom", "vehicle": "passenger-car"}
SLALOM |= {"nominal": "passenger-car", "reference": "lagged"}
CARS = 16


def record(world: Any, told: bool, vector: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Observations of nobody's drive (T, width), and the names of their entries."""
    env: Any = gym.make(AFS, world=world, **SLALOM)
    if vector:
        env = gym.make_vec(AFS, num_envs=2, world=world, **SLALOM)
    kinds = (estimate.EstimateObservation, VectorTruth) if vector else ()
    wrapper, truth = kinds or (EstimateObservation, TruthObservation)
    env = wrapper(env, "exact-kf", std=False, vehicle="truth" if told else None)
    env = truth(env, ("mass",)) if told else env
    obs, rows = env.reset(seed=5)[0], []
    for _ in range(300):
        rows.append(obs[0] if vector else obs)
        obs = env.step(np.zeros((2, 2) if vector else 2, np.float32))[0]
    layout = env.layout if vector or told else env.get_wrapper_attr("layout")
    return np.array(rows), np.array([entry.name for entry in layout])


def test_calibrated_readings_are_those_of_sensors_that_do_not_err() -> None:
    """In observation and filter alike; the references stay those of the sensors that err."""
    (askew, names), (clean, _) = record(ASKEW, True), record("ideal", True)
    is_reference = np.isin(names, ["beta_ref", "gamma_ref"])
    np.testing.assert_allclose(askew[:, ~is_reference], clean[:, ~is_reference], 1e-4, 3e-6)
    assert np.abs(askew - clean)[:, is_reference].max(axis=0).min() > 1e-4
    assert bits(askew) == bits(record(ASKEW, True, vector=True)[0])
    untold = record(ASKEW, False)[0]
    assert bits(untold[:, is_reference[:-1]]) == bits(askew[:, is_reference])
    assert np.abs(untold - askew[:, :-1]).max() > 1e-3


def test_what_is_constant_of_a_sensor_costs_an_oracle_nothing() -> None:
    errors = {"camera_yaw": 0.005, "gyro_scale": 0.99, "accel_roll": 0.02, "map_lag": 0.2}
    costs = []
    for world in (errors, "ideal"):
        driver = make_oracle("oracle-parameters-lqr", FUSION, 4, world=world, **SLALOM)
        costs.append(evaluate_episodes(*driver, range(4))[0])
    assert bits(costs[0]) == bits(costs[1])


real = layout.CarTruth


def drive_uneven(world: dict[str, Any]) -> np.ndarray:
    """Costs in a world that is not ideal."""
    world = {"moment_rate": 1e-9} | world
    driver = make_oracle("oracle-state-lqr", FUSION, CARS, world=world, **SLALOM)
    return evaluate_episodes(*driver, range(CARS))[0]


def test_uneven_motors_are_commanded_accordingly(monkeypatch: pytest.MonkeyPatch) -> None:
    even, uneven = drive_uneven({}), {"torque_scale": 0.5, "torque_left": 1.3}
    np.testing.assert_allclose(drive_uneven(uneven), even, 0.004)
    monkeypatch.setattr(layout, "CarTruth", lambda *x: real(x[0], x[1], 1.0, 1.0, x[-1]))
    assert np.abs(drive_uneven(uneven) / even - 1.0).max() > 0.02  # who does not know it


@pytest.mark.parametrize("kind", ["lqr", "nmpc"])
def test_gains_are_designed_for_each_rows_car(kind: str) -> None:
    """Their mass, inertia, arms and stiffnesses; at a knot of the speeds the gains are exact."""
    _, agent = make_oracle(f"oracle-state-{kind}", FUSION, world="v1", **SLALOM)
    assert isinstance(agent, Lqr)
    car = agent.vehicle.replace(mass=1800.0, yaw_inertia=2100.0, front_arm=1.2, rear_arm=1.5)
    car = car.scale_stiffness(0.8, 1.2)
    numbers = np.array([*(getattr(car, name) for name in TRUE_PARAMETERS[:-2]), 1.0, 1.0])
    other, speed = agent._get_for_car(numbers), SPEEDS[30]
    assert agent._get_for_car(numbers.copy()) is other
    assert other.vehicle == (fit_fiala(car) if kind == "nmpc" else car)
    wanted = make_design_model(other.vehicle, speed, agent.design_spec).solve()[0]
    np.testing.assert_allclose(compute_gains(other, speed), wanted, 1e-9)
    if isinstance(other, Nmpc):
        assert other.design.model.car.m == 1800.0
        assert other.design.model.car.C_f == fit_fiala(car).front_stiffness


@pytest.mark.long
@pytest.mark.parametrize("env_id", [FUSION, AFS])
def test_who_knows_more_pays_less_in_the_world(env_id: str) -> None:
    names = ("nominal", "oracle-parameters-lqr", "oracle-state-lqr")
    seeds = range(2**29, 2**29 + CARS)
    costs = [
        evaluate_episodes(*make_oracle(name, env_id, CARS, world="v1", **SLALOM), seeds)[0]
        for name in names
    ]
    for lower, upper in itertools.pairwise(costs):
        gap = np.log(lower / upper)
        assert gap.mean() > 2.0 * gap.std(ddof=1) / CARS**0.5
